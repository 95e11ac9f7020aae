"""Whether a car did what it must: not too late, not too early, and not again without a person."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from automodel.bench.faults.fault import Fault, Must
from automodel.bench.faults.plan import Plan
from automodel.signals import Event

GO_ON_S = 0.3  # a car that may drive on must be driving so long after the fault
STRAIGHT_S = 0.5  # after its neutral a car that is stopped for good has straight wheels

Pin = tuple[int, float, float]  # from when, servo pulse [us], motor pulse [us]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observed:
    """What was seen of one run: the pulses at the pins in their order, the run's events, and the car.

    `outside` tells whether the car's body left its lane after the fault's begin, `shown_ns` when the car's motion began
    to show the fault (None: it does not), `error` an exception that came out of the run. `neutral_us` and `straight_us`
    are the motor's and the servo's pulses at rest, `limits_us` the servo's and the motor's least and greatest.
    """

    pins: Sequence[Pin]
    events: Sequence[Event]
    outside: bool
    shown_ns: int | None
    error: str | None
    neutral_us: float
    straight_us: float
    limits_us: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """What was wrong with a run, empty where nothing was; and the time from the fault to neutral [s], None without."""

    violations: tuple[str, ...]
    reaction_s: float | None


def judge(fault: Fault, plan: Plan, seen: Observed, without: Observed | None = None) -> Verdict:
    """The verdict on a run; `without` is the same run without the fault, for faults that must change nothing."""
    if seen.error is not None:
        return Verdict(violations=(f"the run ended by {seen.error}",), reaction_s=None)
    begin_ns = plan.begin_ns
    if fault.when_shown:
        if seen.shown_ns is None:
            return Verdict(violations=(), reaction_s=None)
        begin_ns = seen.shown_ns
    if not _drives_at(seen, plan.begin_ns):
        return Verdict(violations=("the car did not drive when the fault began",), reaction_s=None)
    neutral_ns = next(
        (t for t, _, motor in seen.pins if begin_ns <= t <= plan.until_ns and motor == seen.neutral_us), None
    )
    if fault.when_shown and not _drives_at(seen, begin_ns):
        neutral_ns = begin_ns  # it was stopped before, for what the fault has led to
    found = _in_common(fault, plan, seen)
    if fault.must is Must.STOP:
        found += _stopped(fault, plan, seen, begin_ns, neutral_ns)
    else:
        found += _drove_on(fault, plan, seen, neutral_ns)
    if fault.the_same and without is not None and list(seen.pins) != list(without.pins):
        found.append("the pulses at the pins differ from those without the fault")
    reaction_s = None if neutral_ns is None or fault.must is Must.NOTHING else (neutral_ns - begin_ns) * 1e-9
    return Verdict(violations=tuple(found), reaction_s=reaction_s)


def _in_common(fault: Fault, plan: Plan, seen: Observed) -> list[str]:
    found = []
    servo_low, servo_high, motor_low, motor_high = seen.limits_us
    if not all(servo_low <= servo <= servo_high and motor_low <= motor <= motor_high for _, servo, motor in seen.pins):
        found.append("a pulse beyond the car's limits was at a pin")
    if fault.told is not None and not any(e.kind == fault.told and e.t_ns >= plan.begin_ns for e in seen.events):
        found.append(f"no {fault.told!r} was told")
    return found


def _stopped(fault: Fault, plan: Plan, seen: Observed, begin_ns: int, neutral_ns: int | None) -> list[str]:
    if neutral_ns is None:
        return ["the motor's pin never went neutral"]
    found = []
    late_s = (neutral_ns - begin_ns) * 1e-9
    if late_s > fault.within_s:
        found.append(f"neutral after {late_s * 1e3:.0f} ms where {fault.within_s * 1e3:.0f} are allowed")
    asked_ns = plan.press_ns if plan.drives_again and plan.press_ns is not None else plan.until_ns
    again_ns = next((t for t, _, motor in seen.pins if neutral_ns < t < asked_ns and motor != seen.neutral_us), None)
    if again_ns is not None:
        found.append(f"it drove off by itself, {(again_ns - begin_ns) * 1e-9:.2f} s after the fault began")
    straight_ns = neutral_ns + round(STRAIGHT_S * 1e9)
    if any(straight_ns < t < asked_ns and servo != seen.straight_us for t, servo, _ in seen.pins):
        found.append(f"the wheels were not straight {STRAIGHT_S} s after it stopped")
    if plan.drives_again and not any(t >= asked_ns and motor != seen.neutral_us for t, _, motor in seen.pins):
        found.append("it was armed in time, and did not drive")
    return found


def _drove_on(fault: Fault, plan: Plan, seen: Observed, neutral_ns: int | None) -> list[str]:
    found = []
    for kind in ("stop", "hold") if fault.must is Must.NOTHING else ("stop",):
        for event in seen.events:
            if event.kind == kind and event.t_ns >= plan.begin_ns:
                found.append(f"{kind} after {(event.t_ns - plan.begin_ns) * 1e-9:.2f} s: {event.text}")
                break
    if fault.must is Must.NOTHING and neutral_ns is not None and not found:
        found.append(f"neutral after {(neutral_ns - plan.begin_ns) * 1e-9:.2f} s")
    if fault.must is Must.HOLD:
        due_ns = plan.begin_ns + round(fault.within_s * 1e9) if fault.within_s < 1e3 else plan.end_ns
        if plan.end_ns > due_ns and (neutral_ns is None or neutral_ns > due_ns):
            found.append(f"no neutral within {fault.within_s * 1e3:.0f} ms")
        if not _drives_at(seen, plan.end_ns + round(GO_ON_S * 1e9)):
            found.append(f"it did not drive on {GO_ON_S} s after the fault")
    if seen.outside:
        found.append("it left its lane")
    return found


def _drives_at(seen: Observed, t_ns: int) -> bool:
    """Whether the motor's pin is not neutral just before a time."""
    last = [motor for t, _, motor in seen.pins if t < t_ns][-1:]
    return last != [] and last[0] != seen.neutral_us
