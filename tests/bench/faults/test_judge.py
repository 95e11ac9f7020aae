"""The judge on constructed pulses: it finds each violation, and nothing else."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from automodel.bench.faults.fault import Fault, Hooks, Kind, Must
from automodel.bench.faults.judge import Observed, Pin, Plan, judge
from automodel.signals import Event

MS = 1_000_000
SERVO_FRAME_MS = 20
PLAN = Plan(
    seed="",
    start_ns=2003 * MS,
    end_ns=2500 * MS,
    until_ns=4000 * MS,
    press_ns=None,
    coast_s=1.0,
    drives_again=False,
    place=0.0,
    offset_m=0.0,
    speed_mps=1.0,
    look=0,
)
ARMED_AGAIN = replace(PLAN, press_ns=3500 * MS, drives_again=True)


def fault(must: Must, **how: object) -> Fault:
    return Fault(name="it", kind=Kind.OFF, must=must, text="", hooks=lambda random, end_ns: Hooks(), **how)  # type: ignore[arg-type]


def pins(*rests_ms: tuple[float, float], until_ms: int = 4300, crooked: bool = False) -> list[Pin]:
    """Servo frames of a car that drives but for the spans (from, to) in which its motor is neutral."""
    made = []
    for t_ms in range(0, until_ms, SERVO_FRAME_MS):
        rests = any(start <= t_ms < end for start, end in rests_ms)
        made.append((t_ms * MS, 1400.0 if crooked or not rests else 1500.0, 1500.0 if rests else 1600.0))
    return made


def seen(made: list[Pin], **how: object) -> Observed:
    plain = Observed(
        pins=made,
        events=(),
        left_m=0.0,
        rolled_m=0.0,
        shown_ns=None,
        error=None,
        neutral_us=1500.0,
        straight_us=1500.0,
        limits_us=(1050.0, 1950.0, 1100.0, 1900.0),
    )
    return replace(plain, **how)  # type: ignore[arg-type]


def event(t_ms: float, kind: str) -> Event:
    return Event(t_ns=round(t_ms * MS), kind=kind, text="why")


STOP, HOLD, NOTHING = fault(Must.STOP), fault(Must.HOLD), fault(Must.NOTHING)


def test_a_stop_in_time_is_right() -> None:
    verdict = judge(STOP, PLAN, seen(pins((2140, 9999))))
    assert verdict.violations == ()
    assert verdict.reaction_s == pytest.approx(0.137)


def test_a_stop_may_take_150_ms_and_no_more() -> None:
    (text,) = judge(STOP, PLAN, seen(pins((2160, 9999)))).violations
    assert text == "neutral after 157 ms, expected at most 150 ms"
    assert judge(fault(Must.STOP, within_s=0.2), PLAN, seen(pins((2160, 9999)))).violations == ()


def test_a_car_that_never_stops_is_found() -> None:
    assert judge(STOP, PLAN, seen(pins())).violations == ("the motor's pin never went neutral",)


def test_neutral_at_the_end_of_the_run_is_no_stop() -> None:
    assert judge(STOP, PLAN, seen(pins((4001, 9999)))).violations == ("the motor's pin never went neutral",)


def test_a_car_that_drives_off_by_itself_is_found() -> None:
    (text,) = judge(STOP, PLAN, seen(pins((2100, 2980), (3000, 9999)))).violations  # for one servo frame
    assert text == "it drove off by itself, 0.98 s after the fault started"


def test_a_car_that_is_armed_in_time_must_drive_and_not_before() -> None:
    assert judge(STOP, ARMED_AGAIN, seen(pins((2100, 3540)))).violations == ()
    (text,) = judge(STOP, ARMED_AGAIN, seen(pins((2100, 9999)))).violations
    assert text == "it was armed in time and did not drive"
    (text,) = judge(STOP, ARMED_AGAIN, seen(pins((2100, 3480)))).violations
    assert text == "it drove off by itself, 1.48 s after the fault started"


def test_a_request_that_comes_too_early_must_be_refused() -> None:
    plan = replace(PLAN, press_ns=2700 * MS)
    assert judge(STOP, plan, seen(pins((2100, 9999)))).violations == ()
    text, *_ = judge(STOP, plan, seen(pins((2100, 2720)))).violations
    assert text == "it drove off by itself, 0.72 s after the fault started"


def test_the_wheels_of_a_stopped_car_are_straight() -> None:
    (text,) = judge(STOP, PLAN, seen(pins((2100, 9999), until_ms=4600, crooked=True))).violations
    assert text == "the wheels were not straight 2.4 s after it stopped"


def test_a_car_that_did_not_drive_tells_nothing() -> None:
    verdict = judge(STOP, PLAN, seen(pins((1900, 9999))))
    assert verdict.violations == ("the car did not drive when the fault started",)
    assert verdict.reaction_s is None


def test_nothing_must_mean_nothing() -> None:
    assert judge(NOTHING, PLAN, seen(pins((4001, 9999)))).violations == ()
    assert judge(NOTHING, PLAN, seen(pins((3020, 3040)))).violations == ("neutral after 1.02 s",)
    for kind in ("hold", "stop"):
        (text,) = judge(NOTHING, PLAN, seen(pins(), events=[event(2100, kind)])).violations
        assert text == f"{kind} after 0.10 s: why"
    assert judge(NOTHING, PLAN, seen(pins(), events=[event(1900, "hold")])).violations == ()
    assert judge(NOTHING, PLAN, seen(pins())).reaction_s is None


def test_a_hold_goes_neutral_in_time_and_then_on() -> None:
    verdict = judge(HOLD, PLAN, seen(pins((2100, 2520)), events=[event(2090, "hold")]))
    assert verdict.violations == ()
    assert verdict.reaction_s == pytest.approx(0.097)
    assert judge(HOLD, PLAN, seen(pins((2160, 2520)))).violations == ("no neutral within 150 ms",)
    assert judge(HOLD, PLAN, seen(pins())).violations == ("no neutral within 150 ms",)
    assert judge(HOLD, PLAN, seen(pins((2100, 2900)))).violations == ("it did not drive on 0.3 s after the fault",)
    (text,) = judge(HOLD, PLAN, seen(pins((2100, 2520)), events=[event(2400, "stop")])).violations
    assert text == "stop after 0.40 s: why"


def test_a_fault_that_is_over_within_the_bound_may_be_ridden_through() -> None:
    short = replace(PLAN, end_ns=2100 * MS)
    assert judge(HOLD, short, seen(pins())).violations == ()
    assert judge(HOLD, short, seen(pins((2060, 2120)))).violations == ()


@pytest.mark.parametrize("must", [Must.HOLD, Must.NOTHING])
def test_a_car_that_drives_on_stays_in_its_lane(must: Must) -> None:
    short = replace(PLAN, end_ns=2100 * MS)
    assert judge(fault(must), short, seen(pins(), left_m=0.01)).violations == ("it left its lane",)
    assert judge(fault(must), short, seen(pins(), rolled_m=0.3)) == judge(fault(must), short, seen(pins()))


def test_a_stop_that_leaves_the_lane_says_by_how_much_up_to_standstill() -> None:
    verdict = judge(STOP, PLAN, seen(pins((2100, 9999)), left_m=0.1, rolled_m=0.3))
    assert (verdict.violations, verdict.left_m) == ((), 0.3)
    again = judge(STOP, ARMED_AGAIN, seen(pins((2100, 9999)), left_m=0.1, rolled_m=0.3))
    assert (again.violations, again.left_m) == ((), 0.1)  # a person has to put it back first; it was driven since


@pytest.mark.parametrize("wrong", [(1045.0, 1600.0), (1955.0, 1600.0), (1400.0, 1095.0), (1400.0, 1905.0)])
def test_no_pulse_goes_beyond_the_cars_limits(wrong: tuple[float, float]) -> None:
    made = pins()
    made[150] = (made[150][0], *wrong)
    assert judge(NOTHING, PLAN, seen(made)).violations == ("a pulse beyond the car's limits was at a pin",)


def test_a_stop_says_whether_the_lane_was_wrong() -> None:
    """A false stop is one of a car that knew where it was."""
    errors = [(2080 * MS, 0.3), (2090 * MS, 0.004), (2110 * MS, math.inf)]
    for t_ms, text in (
        (2085, " (offset wrong by 0.300 m)"),
        (2100, " (offset wrong by 0.004 m)"),
        (2120, " (no lane)"),
    ):
        found = judge(NOTHING, PLAN, seen(pins(), events=[event(t_ms, "stop")], errors_m=errors)).violations
        assert found == (f"stop after {(t_ms - 2003) * 1e-3:.2f} s: why{text}",)
    assert (
        judge(NOTHING, PLAN, seen(pins(), events=[event(2050, "stop")], errors_m=errors)).violations[0].endswith("why")
    )


def test_an_event_is_reported_after_the_fault_started() -> None:
    warned = fault(Must.NOTHING, event="vehicle-fault")
    assert judge(warned, PLAN, seen(pins(), events=[event(2100, "vehicle-fault")])).violations == ()
    for events in ((), [event(1990, "vehicle-fault")], [event(2100, "end")]):
        assert judge(warned, PLAN, seen(pins(), events=events)).violations == ("no 'vehicle-fault' was reported",)


def test_what_must_change_nothing_gives_the_same_pulses() -> None:
    same = fault(Must.NOTHING, same_pulses=True)
    assert judge(same, PLAN, seen(pins()), seen(pins())).violations == ()
    other = pins()
    other[-1] = (other[-1][0], 1400.5, 1600.0)
    (text,) = judge(same, PLAN, seen(pins()), seen(other)).violations
    assert text == "the pulses at the pins differ from those without the fault"


def test_a_fault_that_must_show_first_counts_from_then() -> None:
    shown = fault(Must.STOP, timed_from_motion=True, within_s=0.45)
    assert judge(shown, PLAN, seen(pins())).violations == ()  # it never showed
    verdict = judge(shown, PLAN, seen(pins((2900, 9999)), shown_ns=2600 * MS))
    assert verdict.violations == ()
    assert verdict.reaction_s == pytest.approx(0.3)
    (text,) = judge(shown, PLAN, seen(pins((3100, 9999)), shown_ns=2600 * MS)).violations
    assert text == "neutral after 500 ms, expected at most 450 ms"
    before = judge(shown, PLAN, seen(pins((2500, 9999)), shown_ns=2600 * MS))
    assert (before.violations, before.reaction_s) == ((), 0.0)


def test_a_run_that_ends_by_an_exception_is_wrong() -> None:
    (text,) = judge(STOP, PLAN, seen(pins((2100, 9999)), error="KeyError: 3")).violations
    assert text == "the run ended by KeyError: 3"


def test_a_car_that_is_held_again_and_again_is_timed_to_its_stop() -> None:
    flaps = fault(Must.STOP, holds_first=True, within_s=0.5)
    held = pins((2060, 2160), (2220, 2320), (2400, 9999))
    verdict = judge(flaps, PLAN, seen(held, events=[event(2060, "hold"), event(2390, "stop")]))
    assert verdict.violations == ()
    assert verdict.reaction_s == pytest.approx(0.397)
    (text,) = judge(flaps, PLAN, seen(held)).violations
    assert text == "the motor's pin never went neutral"


def test_a_car_that_must_stay_may_leave_its_lane_by_so_much() -> None:
    made = pins((2100, 4300))
    stay = fault(Must.STAY, outside_m=0.05)
    assert judge(stay, PLAN, seen(made, left_m=0.04, rolled_m=0.05)).violations == ()
    (text,) = judge(stay, PLAN, seen(made, rolled_m=0.06)).violations
    assert text == "it left its lane by 0.060 m"
    assert judge(stay, PLAN, seen(pins())).reaction_s is None
    assert judge(stay, PLAN, seen(pins(), rolled_m=0.06)).violations == ()  # the run's end stops it


def test_a_car_that_must_not_be_armed_may_never_move() -> None:
    refuse = fault(Must.REFUSE, from_start=True)
    plan = replace(PLAN, start_ns=0, end_ns=3000 * MS, until_ns=3000 * MS)
    assert judge(refuse, plan, seen(pins((0, 9999)))).violations == ()
    (text,) = judge(refuse, plan, seen(pins((0, 2480), (2500, 9999)))).violations
    assert text == "it was armed, and moved off after 2.48 s"
    (text,) = judge(replace(refuse, event="fault"), plan, seen(pins((0, 9999)))).violations
    assert text == "no 'fault' was reported"


def test_a_car_that_is_wrong_from_the_start_may_drive_where_it_stays_in_its_lane() -> None:
    stay = fault(Must.STAY, from_start=True, outside_m=0.1)
    plan = replace(PLAN, start_ns=0, end_ns=3000 * MS, until_ns=3000 * MS)
    for made in (pins((0, 9999)), pins((0, 600)), pins((0, 600), (2000, 9999))):
        assert judge(stay, plan, seen(made, left_m=0.1)).violations == ()
        assert judge(stay, plan, seen(made, left_m=0.05)).left_m == 0.05
        (text,) = judge(stay, plan, seen(made, left_m=0.11)).violations
        assert text == "it left its lane by 0.110 m"
    stopped = judge(stay, plan, seen(pins((0, 600), (2000, 9999)), rolled_m=0.11))
    assert stopped.violations == ("it left its lane by 0.110 m",)
    assert judge(stay, plan, seen(pins((0, 600)), rolled_m=0.11)).violations == ()  # the run has ended


def test_a_refusal_is_right_where_no_pipeline_could_start() -> None:
    made = pins((2100, 4300))
    assert judge(fault(Must.STOP), ARMED_AGAIN, seen(made, could_start=False)).violations == ()
    assert judge(fault(Must.STOP), ARMED_AGAIN, seen(made)).violations == ("it was armed in time and did not drive",)
