"""When what happens in a run, by its seed; and whether the car did what it must: in time, and only then."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from random import Random

from automodel.bench.faults.fault import Fault, Must
from automodel.config import SafetyConfig
from automodel.runtime.safety import ROLL_OUT_S
from automodel.signals import Event

RENDERED_NS = 1_500_000_000  # from here on the camera sees the road, and the pipeline gets the frames
# and from here on its estimates drive the car: at 0.7 m/s, too, it has then followed the lane for a lane's width
PIPELINE_NS = 2_200_000_000
START_NS = (2_300_000_000, 2_700_000_000)  # the fault starts between these; the car drives steadily
COAST_S = (0.5, 2.0)  # a car's way to standstill at neutral takes so long: motor controllers that brake, or freewheel
TRACK = "oval"
TRACKS = ("oval", "chicane", "tmr")
RANDOM_LOOKS = 1_000_000
REARM_S = 0.5
LONGEST_S = 4.0  # until a car that must be stopped is stopped
_QUIET_S = 0.25  # the car is watched so long after the time at which arming would work
GO_ON_S = 0.3  # so long after the fault a car that may drive on must be driving
STAY_S = 1.0  # so long after the fault a car that drives must still stay in its lane
# so long after neutral a car that is stopped must have straight wheels: held, rolled out, and the board's servo frame
STRAIGHT_S = SafetyConfig().hold_s + ROLL_OUT_S + 0.1

Pin = tuple[int, float, float]  # from when, servo pulse [us], motor pulse [us]


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """One run; times on the run's own clock.

    `press_ns` is when a person asks to arm, None for never; `drives_again` whether the car must then drive. The run
    ends at `until_ns`. At neutral the car rolls for `coast_s`. It starts at the share `place` (0 .. 1) of the lane's
    length, `offset_m` beside its middle; `look` chooses light and floor, `track` the track. The pipeline gets images of
    the road from `rendered_ns` on, and its estimates count from `pipeline_ns` on.
    """

    seed: str
    start_ns: int
    end_ns: int
    until_ns: int
    press_ns: int | None
    drives_again: bool
    coast_s: float
    place: float
    offset_m: float
    speed_mps: float
    look: int
    track: str = TRACK
    rendered_ns: int = RENDERED_NS
    pipeline_ns: int = PIPELINE_NS

    def hooks_random(self) -> Random:
        """The generator for what is random in the fault itself."""
        return Random(f"{self.seed}/hooks")


def draw_plan(fault: Fault, seed: int, index: int, looks: int) -> Plan:
    """The plan of the fault's run number `index`; the same arguments give the same plan."""
    name = f"{seed}/{fault.name}/{index}"
    random = Random(name)
    start_ns = 0 if fault.from_start else random.randint(*START_NS)
    end_ns = start_ns + round(random.uniform(*fault.duration_s) * 1e9)
    coast_s = random.uniform(*COAST_S)
    press_ns, drives_again, until_ns = _afterwards(fault, random, (start_ns, end_ns), coast_s)
    return Plan(
        seed=name,
        start_ns=start_ns,
        end_ns=end_ns,
        until_ns=until_ns,
        press_ns=press_ns,
        drives_again=drives_again,
        coast_s=coast_s,
        place=random.random(),
        offset_m=random.uniform(-0.02, 0.02),
        speed_mps=random.uniform(0.7, 1.3),
        look=random.randrange(looks, RANDOM_LOOKS) if fault.anywhere else random.randrange(looks),
        track=random.choice(TRACKS) if fault.anywhere else TRACK,
        rendered_ns=0 if fault.from_start else RENDERED_NS,
        pipeline_ns=0 if fault.from_start else PIPELINE_NS,
    )


def at_another_place(plan: Plan, attempt: int) -> Plan:
    """The same run, started elsewhere on the lane; `attempt` 0 is the plan itself."""
    return plan if attempt == 0 else replace(plan, place=Random(f"{plan.seed}/place/{attempt}").random())


def _afterwards(
    fault: Fault, random: Random, lasts_ns: tuple[int, int], coast_s: float
) -> tuple[int | None, bool, int]:
    """When a person asks to arm, whether the car must then drive, and when the run ends.

    A car that must not be armed at all is asked at any time, besides once at the start, as by `--arm`.
    After a stop either nobody touches the car; or a person asks too early, which must be refused and forgotten; or in
    time, once the car stands, which must work: a lane that was lost is looked for as at the start then.
    """
    start_ns, end_ns = lasts_ns
    stands_ns = start_ns + round((min(fault.within_s, LONGEST_S) + SafetyConfig().hold_s + coast_s) * 1e9)
    healthy_ns = max(end_ns + round(fault.recovery_s * 1e9), stands_ns) + round(REARM_S * 1e9)
    quiet_ns = healthy_ns + round(_QUIET_S * 1e9)
    how = random.choice(("nobody", "early", "in time") if fault.host_notices else ("nobody", "in time"))
    early_ns = round(random.uniform(start_ns + 0.2e9, end_ns + (REARM_S - 0.05) * 1e9))
    if fault.from_start:
        return round(random.uniform(0.1e9, end_ns - 0.5e9)), False, end_ns
    if fault.must is not Must.STOP:
        return None, False, end_ns + round((STAY_S if fault.must is Must.STAY else GO_ON_S + 0.05) * 1e9)
    if not fault.ends:
        return (None if fault.timed_from_motion else early_ns), False, max(start_ns + round(1.2e9), end_ns)
    if how == "nobody":
        return None, False, quiet_ns
    if how == "early":
        return early_ns, False, quiet_ns
    press_ns = healthy_ns + round(0.05e9)
    return press_ns, True, press_ns + round(0.35e9)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observed:
    """One run as it was observed: the pulses at the pins in their order, the run's events, and the car.

    `left_m` [m] is how far the car's body was outside its lane at most, from the fault's start to the run's end,
    `rolled_m` where it stands at last. `could_start` is whether the pipeline, started anew, is sure enough of its lane
    there to be armed. `knows` is whether the pipeline was sure of its lane when the fault started.
    `shown_ns` is when the car's motion, or its bus, began to show
    the fault (None: never), `error` an exception that left the run. `neutral_us` and `straight_us` are the motor's and
    the servo's pulses at rest, `limits_us` the servo's and the motor's least and greatest. `errors_m` are the
    times of the frames [ns] and by how much the pipeline's offset was wrong [m], infinite where it had none. `actuator`
    and `rest` name what is watched, and its state at rest; `also` are violations that were found while the run was
    observed.
    """

    pins: Sequence[Pin]
    events: Sequence[Event]
    left_m: float
    rolled_m: float
    shown_ns: int | None
    error: str | None
    knows: bool = True
    could_start: bool = True
    neutral_us: float
    straight_us: float
    limits_us: tuple[float, float, float, float]
    errors_m: Sequence[tuple[int, float]] = ()
    actuator: str = "the motor's pin"
    rest: str = "neutral"
    also: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """What the car did wrong in a run; and the time from the fault to neutral [s], None where it never was.

    `moved` is how many other places were tried before, where the pipeline was not sure of its lane when the fault
    started. `left_m` [m] is how far the car's body was outside its lane, up to standstill where it was stopped. A stop
    that leaves the lane is no violation but a figure: the steering is held while the car rolls out, but not along a
    lane whose curvature changes, nor by a board that restarts.
    """

    violations: tuple[str, ...]
    reaction_s: float | None
    left_m: float = 0.0
    moved: int = 0


def judge(fault: Fault, plan: Plan, seen: Observed, without: Observed | None = None) -> Verdict:
    """The verdict on a run; `without` is the same run without the fault, for `same_pulses`."""
    if seen.error is not None:
        return Verdict(violations=(f"the run ended by {seen.error}",), reaction_s=None)
    if fault.from_start:
        return _from_the_start(fault, plan, seen)
    start_ns = plan.start_ns
    if fault.timed_from_motion or fault.shown_by:
        if seen.shown_ns is None:
            return Verdict(violations=(), reaction_s=None)
        start_ns = seen.shown_ns
    if not _drives_at(seen, plan.start_ns):
        return Verdict(violations=("the car did not drive when the fault started",), reaction_s=None)
    from_ns: float = start_ns
    if fault.holds_first:
        from_ns = next((e.t_ns for e in seen.events if e.kind == "stop" and e.t_ns >= start_ns), math.inf)
    neutral_ns = next(
        (t for t, _, motor in seen.pins if from_ns <= t <= plan.until_ns and motor == seen.neutral_us), None
    )
    if (fault.timed_from_motion or fault.shown_by) and not _drives_at(seen, start_ns):
        neutral_ns = start_ns  # it was stopped before, by a consequence of the fault
    stopped = not _drives_at(seen, plan.until_ns)  # else it is the run's end that stops it, wherever it is
    stays = fault.must in (Must.STOP, Must.STAY) and not plan.drives_again and stopped
    left_m = max(seen.left_m, seen.rolled_m) if stays else seen.left_m
    found = _in_common(fault, plan, seen)
    if fault.must is Must.STOP:
        found += _stopped(fault, plan, seen, start_ns, neutral_ns)
    elif fault.must is Must.STAY:
        found += [] if left_m <= fault.outside_m else [f"it left its lane by {left_m:.3f} m"]
    else:
        found += _drove_on(fault, plan, seen, neutral_ns)
    if fault.same_pulses and without is not None and list(seen.pins) != list(without.pins):
        found.append("the pulses at the pins differ from those without the fault")
    reaction_s = (
        None if neutral_ns is None or fault.must in (Must.NOTHING, Must.STAY) else (neutral_ns - start_ns) * 1e-9
    )
    return Verdict(violations=tuple(found), reaction_s=reaction_s, left_m=left_m)


def _in_common(fault: Fault, plan: Plan, seen: Observed) -> list[str]:
    found = list(seen.also)
    servo_low, servo_high, motor_low, motor_high = seen.limits_us
    if not all(servo_low <= servo <= servo_high and motor_low <= motor <= motor_high for _, servo, motor in seen.pins):
        found.append("a pulse beyond the car's limits was at a pin")
    if fault.event is not None and not any(e.kind == fault.event and e.t_ns >= plan.start_ns for e in seen.events):
        found.append(f"no {fault.event!r} was reported")
    return found


def _from_the_start(fault: Fault, plan: Plan, seen: Observed) -> Verdict:
    """That of a car that must not be armed (REFUSE), or stay in its lane where it is (STAY)."""
    found, left_m = _in_common(fault, plan, seen), seen.left_m
    if not _drives_at(seen, plan.until_ns):  # else it is the run's end that stops it, wherever it is
        left_m = max(left_m, seen.rolled_m)
    moved_ns = next((t for t, _, motor in seen.pins if t <= plan.until_ns and motor != seen.neutral_us), None)
    if fault.must is Must.REFUSE and moved_ns is not None:
        found.append(f"it was armed, and moved off after {moved_ns * 1e-9:.2f} s")
    if fault.must is Must.STAY and left_m > fault.outside_m:
        found.append(f"it left its lane by {left_m:.3f} m")
    return Verdict(violations=tuple(found), reaction_s=None, left_m=left_m)


def _stopped(fault: Fault, plan: Plan, seen: Observed, start_ns: int, neutral_ns: int | None) -> list[str]:
    if neutral_ns is None:
        return [f"{seen.actuator} never went {seen.rest}"]
    found = []
    late_s = (neutral_ns - start_ns) * 1e-9
    if late_s > fault.within_s:
        found.append(f"{seen.rest} after {late_s * 1e3:.0f} ms, expected at most {fault.within_s * 1e3:.0f} ms")
    asked_ns = plan.press_ns if plan.drives_again and plan.press_ns is not None else plan.until_ns
    again_ns = next((t for t, _, motor in seen.pins if neutral_ns < t < asked_ns and motor != seen.neutral_us), None)
    if again_ns is not None:
        found.append(f"it drove off by itself, {(again_ns - start_ns) * 1e-9:.2f} s after the fault started")
    straight_ns = neutral_ns + round(STRAIGHT_S * 1e9)
    watched_ns = asked_ns if plan.drives_again else math.inf
    if any(straight_ns < t < watched_ns and servo != seen.straight_us for t, servo, _ in seen.pins):
        found.append(f"the wheels were not straight {STRAIGHT_S} s after it stopped")
    # otherwise the person would have to put it elsewhere first: into its lane, or where its lines are in view
    drivable = seen.left_m == 0 and seen.could_start
    if plan.drives_again and drivable and not drives_from(seen.pins, asked_ns, seen.neutral_us):
        found.append("it was armed in time and did not drive")
    return found


def _drove_on(fault: Fault, plan: Plan, seen: Observed, neutral_ns: int | None) -> list[str]:
    found = []
    for kind in ("stop", "hold") if fault.must is Must.NOTHING else ("stop",):
        for event in seen.events:
            if event.kind == kind and event.t_ns >= plan.start_ns:
                found.append(
                    f"{kind} after {(event.t_ns - plan.start_ns) * 1e-9:.2f} s: {event.text}{_wrong(seen, event.t_ns)}"
                )
                break
    if fault.must is Must.NOTHING and neutral_ns is not None and not found:
        found.append(f"{seen.rest} after {(neutral_ns - plan.start_ns) * 1e-9:.2f} s")
    if fault.must is Must.HOLD:
        due_ns = plan.start_ns + round(fault.within_s * 1e9) if fault.within_s < 1e3 else plan.end_ns
        if plan.end_ns > due_ns and (neutral_ns is None or neutral_ns > due_ns):
            found.append(f"no neutral within {fault.within_s * 1e3:.0f} ms")
        if not _drives_at(seen, plan.end_ns + round(GO_ON_S * 1e9)):
            found.append(f"it did not drive on {GO_ON_S} s after the fault")
    if seen.left_m > 0:
        found.append("it left its lane")
    return found


def _wrong(seen: Observed, t_ns: int) -> str:
    """By how much the offset was wrong in the last frame before a time; "" where that was not observed.

    It tells a stop that was right, since the car was not where it believed, from a false one.
    """
    error_m = next((error_m for frame_ns, error_m in reversed(seen.errors_m) if frame_ns <= t_ns), None)
    if error_m is None:
        return ""
    return f" (offset wrong by {error_m:.3f} m)" if math.isfinite(error_m) else " (no lane)"


def drives_from(pins: Sequence[Pin], t_ns: int, neutral_us: float) -> bool:
    """Whether the motor's pin is ever not neutral from a time on."""
    return any(t >= t_ns and motor != neutral_us for t, _, motor in pins)


def _drives_at(seen: Observed, t_ns: int) -> bool:
    """Whether the motor's pin is not neutral just before a time."""
    last = [motor for t, _, motor in seen.pins if t < t_ns][-1:]
    return last != [] and last[0] != seen.neutral_us
