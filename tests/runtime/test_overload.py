"""A machine that is too slow, or stands still for a moment: whole runs on virtual time, with the emulated board."""

from __future__ import annotations

from dataclasses import replace

import pytest

from automodel.bench.faults.catalogue import FAULTS
from automodel.bench.faults.fault import At, Hooks, Stall
from automodel.bench.faults.judge import Observed, draw_plan
from automodel.bench.faults.measure import CAR, TRUTH, FaultRig
from automodel.config import CarConfig

START_NS = 2_000_000_000
SHOWN_NS = 1_500_000_000  # the run goes on for so long


def driven(stall: Stall, speed_mps: float) -> Observed:
    """The run of a car that drives steadily at `speed_mps` when the stall comes."""
    plan = draw_plan(FAULTS[0], 0, 0, 1)
    plan = replace(plan, start_ns=START_NS, end_ns=START_NS + SHOWN_NS, until_ns=START_NS + SHOWN_NS, press_ns=None)
    plan = replace(plan, place=0.0, offset_m=0.0, speed_mps=speed_mps)
    car: CarConfig = replace(CAR, control=replace(CAR.control, speed_mps=speed_mps))
    seen = FaultRig(car, TRUTH, plan, Hooks(stall=stall)).run()
    assert seen.error is None
    return seen


def events(seen: Observed) -> list[tuple[str, str]]:
    return [(event.kind, event.text) for event in seen.events if event.t_ns >= START_NS]


def drives(seen: Observed, t_ns: int) -> bool:
    """Whether the motor is driven at that time."""
    return [motor for t, _, motor in seen.pins if t <= t_ns][-1] != seen.neutral_us


@pytest.mark.parametrize("at", [At.PIPELINE, At.AFTER])
def test_a_slow_car_drives_on_after_a_pause_in_which_its_board_disarmed_itself(at: At) -> None:
    seen = driven(Stall(at=at, seconds=0.15), 0.5)
    found = [event for event in events(seen) if event[0] not in ("vehicle-fault", "end")]
    assert [kind for kind, _ in found][:2] == ["hold", "driving"]
    assert found[0][1].startswith("the loop stood still for 0.1")
    assert "stop" not in [kind for kind, _ in found]
    neutral_ns = next(t for t, _, motor in seen.pins if t > START_NS and motor == seen.neutral_us)
    assert neutral_ns <= START_NS + 150_000_000  # the board's own timer, whatever the host does
    assert drives(seen, START_NS + 500_000_000)
    assert drives(seen, START_NS + SHOWN_NS)


@pytest.mark.parametrize(("seconds", "speed_mps"), [(0.15, 1.0), (0.31, 0.1)])
def test_a_fast_car_and_a_long_pause_stop(seconds: float, speed_mps: float) -> None:
    seen = driven(Stall(at=At.PIPELINE, seconds=seconds), speed_mps)
    assert events(seen)[0][0] == "stop"
    assert not drives(seen, START_NS + SHOWN_NS)


def test_a_machine_that_is_far_too_slow_says_so_and_stops_when_the_hold_is_over() -> None:
    seen = driven(Stall(at=At.PIPELINE, seconds=0.075, again=True), 1.0)
    found = [(kind, text) for kind, text in events(seen) if kind in ("hold", "stop")]
    assert [kind for kind, _ in found] == ["hold", "stop"]
    assert found[0][1] == "overloaded: frames 78 ms late (limit 60)"
    assert found[1][1].endswith(": overloaded: frames 78 ms late (limit 60)")
