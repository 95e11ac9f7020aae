from __future__ import annotations

from dataclasses import replace

import pytest

from automodel.runtime.safety import Action, Safety, SafetyInputs, SafetyMode, Seen
from automodel.signals import LaneStatus
from tests.support.safety_rig import CONFIG, MS, Rig


def test_starts_disarmed_and_sends_neutral() -> None:
    decision = Rig().turns(200)
    assert (decision.mode, decision.action, decision.reason) == (SafetyMode.DISARMED, Action.NEUTRAL, None)
    assert not decision.arm


def test_arms_by_request_after_healthy_time() -> None:
    rig = Rig()
    rig.turns(51)  # the first healthy turn starts the 500 ms
    asked = rig.turn(arm=True)
    assert (asked.mode, asked.action, asked.arm) == (SafetyMode.ARMING, Action.NEUTRAL, True)
    driving = rig.turn()
    assert (driving.mode, driving.action, driving.arm) == (SafetyMode.DRIVING, Action.PASS, False)
    assert [kind for kind, _ in rig.events] == ["arming", "driving"]


def test_request_before_healthy_time_is_refused_and_forgotten() -> None:
    rig = Rig()
    rig.turns(50)  # 490 ms since the first
    decision = rig.turn(step_ms=9.0, arm=True)
    assert (decision.mode, decision.arm) == (SafetyMode.DISARMED, False)
    assert rig.events == [("arm-refused", "the input is healthy for 0.499 s only, expected 0.500 s")]
    assert rig.turns(100).mode is SafetyMode.DISARMED


@pytest.mark.parametrize(
    ("how", "text"),
    [
        ({"status": LaneStatus.LOST}, "the lane is lost"),
        ({"faults": ("the pose is not finite",)}, "the pose is not finite"),
        ({"age_ms": 61.0, "step_ms": 70.0}, "overloaded: frames 61 ms late (limit 60)"),
        ({"age_ms": -51.0}, "the frame's time lies 0.051 s ahead"),
        ({"age_ms": 30.0}, "the frame's time is not after the one before: -0.018 s"),
        ({"age_ms": 12.0}, "the frame's time is not after the one before: 0.000 s"),
        ({"link_up": False}, "the link to the vehicle is down"),
        ({"hello": False}, "the vehicle has not said hello"),
        ({"work_ms": 0.0, "age_ms": None, "step_ms": 58.0}, "the newest frame is 0.060 s old"),
        ({"step_ms": 101.0}, "the loop stood still for 0.101 s"),
        ({"step_ms": -5.0, "age_ms": -20.0}, "the clock went back by 0.005 s"),
    ],
)
def test_request_while_unhealthy_is_refused_with_the_reason(how: dict[str, object], text: str) -> None:
    rig = Rig()
    rig.turns(100)
    decision = rig.turn(arm=True, **how)  # type: ignore[arg-type]
    assert (decision.mode, decision.action, decision.reason) == (SafetyMode.DISARMED, Action.NEUTRAL, text)
    assert rig.events == [("arm-refused", text)]
    rig.turn(age_ms=-1.0 if how.get("age_ms") == -51.0 else 2.0)
    assert rig.turn(arm=True).mode is SafetyMode.DISARMED  # the 500 ms begin anew


def test_request_before_the_first_frame_is_refused() -> None:
    rig = Rig()
    decision = rig.turn(age_ms=None, arm=True)
    assert decision.reason == "no frame has come yet"
    assert rig.events == [("arm-refused", "no frame has come yet")]


@pytest.mark.parametrize("status", [LaneStatus.TRACKING, LaneStatus.ONE_LINE, LaneStatus.COASTING])
def test_every_status_but_lost_drives(status: LaneStatus) -> None:
    decision = Rig().drive().turns(300, status=status)
    assert (decision.mode, decision.action) == (SafetyMode.DRIVING, Action.PASS)


def test_drives_on_between_frames() -> None:
    rig = Rig().drive()
    decision = rig.turn(step_ms=57.9, age_ms=None)
    assert (decision.mode, decision.action) == (SafetyMode.DRIVING, Action.PASS)
    decision = rig.turn(step_ms=0.1, age_ms=None)
    assert (decision.mode, decision.action) == (SafetyMode.HOLD, Action.HOLD_STEERING)


@pytest.mark.parametrize(
    "how",
    [
        {"status": LaneStatus.LOST},
        {"faults": ("the pose is not finite",)},
        {"faults": ("the state is not finite",), "age_ms": None},
        {"age_ms": 60.0, "step_ms": 70.0, "work_ms": 0.0},
        {"age_ms": 101.0, "step_ms": 99.9, "work_ms": 1.0, "status": LaneStatus.TRACKING},  # late when it came
        {"age_ms": 40.0},
        {"age_ms": -51.0},
    ],
)
def test_unwell_holds_at_once_and_drives_on_with_the_next_good_frame(how: dict[str, object]) -> None:
    rig = Rig().drive()
    rig.turns(10)
    if how.get("age_ms") == 101.0:
        rig.turn(age_ms=99.0, step_ms=98.0, work_ms=0.0)  # late as well, so that frame times go forward
    held = rig.turn(**how)  # type: ignore[arg-type]
    assert (held.mode, held.action) == (SafetyMode.HOLD, Action.HOLD_STEERING)
    assert not held.disarm
    if how.get("age_ms") != -51.0:
        assert rig.turn(age_ms=None).mode is SafetyMode.HOLD  # healthy without a new frame is not enough
    back = rig.turn(step_ms=60.0)
    assert (back.mode, back.action) == (SafetyMode.DRIVING, Action.PASS)
    assert rig.events[-1][0] == "driving"


def test_a_fault_of_a_frame_lasts_until_the_next_frame() -> None:
    rig = Rig().drive()
    rig.turn(faults=("the pose is not finite",))
    decision = rig.turn(age_ms=None)
    assert decision.reason == "the pose is not finite"
    assert decision.mode is SafetyMode.HOLD


@pytest.mark.parametrize("start", ["drive", "hold"])
def test_a_person_who_asks_for_a_stop_gets_it_in_the_same_turn(start: str) -> None:
    rig = getattr(Rig(), start)()
    stopped = rig.turn(stop="STOP", age_ms=None, arm=True)
    assert (stopped.mode, stopped.action, stopped.disarm) == (SafetyMode.STOPPED, Action.HOLD_STEERING, True)
    assert rig.events[-1] == ("stop", "STOP")
    assert rig.turns(300).mode is SafetyMode.STOPPED


def test_a_stop_before_the_start_uses_the_automatic_arming_up() -> None:
    rig = Rig(auto_arm=True)
    rig.turn(stop="STOP")
    assert rig.turns(300).mode is SafetyMode.DISARMED


def test_hold_is_bounded_and_the_stop_latched() -> None:
    rig = Rig().hold()
    held = rig.turns(29, status=LaneStatus.LOST)
    assert (held.mode, held.action) == (SafetyMode.HOLD, Action.HOLD_STEERING)
    stopped = rig.turn(status=LaneStatus.LOST)
    assert (stopped.mode, stopped.action, stopped.disarm) == (SafetyMode.STOPPED, Action.HOLD_STEERING, True)
    assert rig.events[-1] == ("stop", "held for 0.300 s: the lane is lost")
    assert rig.turns(300).mode is SafetyMode.STOPPED


def test_a_good_frame_comes_too_late_when_the_hold_is_over() -> None:
    rig = Rig().hold()
    rig.turns(29, status=LaneStatus.LOST)
    assert rig.turn().mode is SafetyMode.STOPPED


@pytest.mark.parametrize("mode", [SafetyMode.DRIVING, SafetyMode.HOLD])
@pytest.mark.parametrize(
    ("how", "text"),
    [
        ({"link_up": False}, "the link to the vehicle is down"),
        ({"hello": False}, "the vehicle has not said hello"),
        ({"step_ms": 101.0}, "the loop stood still for 0.101 s"),
        ({"work_ms": 60.0, "age_ms": 100.0, "step_ms": 99.0}, "the command went stale in the loop, 0.060 s after"),
        ({"step_ms": -1.0, "age_ms": -10.0}, "the clock went back by 0.001 s"),
    ],
)
def test_broken_stops_at_once(mode: SafetyMode, how: dict[str, object], text: str) -> None:
    rig = Rig().drive() if mode is SafetyMode.DRIVING else Rig().hold()
    stopped = rig.turn(**how)  # type: ignore[arg-type]
    assert (stopped.mode, stopped.action, stopped.disarm) == (SafetyMode.STOPPED, Action.HOLD_STEERING, True)
    assert rig.events[-1][0] == "stop"
    assert rig.events[-1][1].startswith(text)
    assert rig.turns(300).mode is SafetyMode.STOPPED


@pytest.mark.parametrize(
    ("how", "text"),
    [
        ({"age_ms": 97.5, "work_ms": 50.0, "step_ms": 99.0}, "overloaded: frames 97 ms late (limit 60)"),
        ({"age_ms": 70.0, "work_ms": 5.0, "step_ms": 90.0}, "overloaded: frames 70 ms late (limit 60)"),  # woken late
        ({"age_ms": 70.0, "work_ms": 5.0, "step_ms": 45.0}, "the newest frame is 0.070 s old"),  # the camera's doing
        ({"age_ms": None, "step_ms": 60.0}, "the newest frame is 0.062 s old"),
    ],
)
def test_frames_that_are_late_are_the_machines_doing_or_the_cameras(how: dict[str, object], text: str) -> None:
    rig = Rig().drive()
    if how["step_ms"] == 45.0:
        rig.turns(2, step_ms=40.0, age_ms=75.0)  # held already, by frames that came as late
        rig.events.clear()
        assert rig.turn(**how).reason == text  # type: ignore[arg-type]
        return
    held = rig.turn(**how)  # type: ignore[arg-type]
    assert (held.mode, rig.events[-1]) == (SafetyMode.HOLD, ("hold", text))


STALLS = [
    ({"step_ms": 120.0}, "the loop stood still for 0.120 s"),
    ({"work_ms": 60.0, "age_ms": 100.0, "step_ms": 99.0}, "the command went stale in the loop, 0.060 s after"),
]


@pytest.mark.parametrize(("how", "text"), STALLS)
@pytest.mark.parametrize("disarms", [True, False])
def test_a_loop_that_stood_still_holds_a_slow_car_and_arms_it_again(
    how: dict[str, object], text: str, disarms: bool
) -> None:
    rig = Rig().drive()
    rig.speed_mps = 0.83  # 0.1 m in 120 ms
    if disarms:
        rig.state = replace(rig.state, armed=False)  # its own timer ran out
    held = rig.turn(**how)  # type: ignore[arg-type]
    assert (held.mode, held.action, held.arm) == (SafetyMode.HOLD, Action.HOLD_STEERING, disarms)
    assert rig.events[-1][1].startswith(text)
    assert (rig.turn().mode, rig.events[-1][0]) == (SafetyMode.DRIVING, "driving")
    assert rig.state.armed
    assert rig.turns(50).mode is SafetyMode.DRIVING


def test_a_vehicle_that_says_late_that_it_disarmed_while_the_loop_stood_still_is_armed_again() -> None:
    rig = Rig().drive()
    rig.speed_mps = 0.5
    rig.turn(step_ms=120.0)
    assert rig.turn().mode is SafetyMode.DRIVING
    rig.state = replace(rig.state, armed=False)
    held = rig.turn()
    assert (held.mode, held.arm) == (SafetyMode.HOLD, True)
    assert rig.events[-1] == ("hold", "the vehicle has disarmed itself while the loop stood still")
    assert rig.turn().mode is SafetyMode.DRIVING
    rig.turns(28)  # 300 ms after the pause it must have said so
    rig.state = replace(rig.state, armed=False)
    assert rig.turn().mode is SafetyMode.STOPPED


def test_a_vehicle_that_does_not_arm_again_stops_when_the_hold_is_over() -> None:
    rig = Rig().drive()
    rig.speed_mps, rig.obeys = 0.0, False
    rig.state = replace(rig.state, armed=False)
    rig.turn(step_ms=120.0)
    held = [rig.turn() for _ in range(29)]
    assert {decision.mode for decision in held} == {SafetyMode.HOLD}
    assert [n for n, decision in enumerate(held) if decision.arm] == [9, 19]  # again every 100 ms
    assert rig.turn().mode is SafetyMode.STOPPED


@pytest.mark.parametrize(("step_ms", "speed_mps"), [(120.0, 0.84), (101.0, 1.0), (300.0, 0.0), (120.0, float("nan"))])
def test_a_loop_that_stood_still_stops_a_fast_car_and_any_after_the_time_of_a_hold(
    step_ms: float, speed_mps: float
) -> None:
    rig = Rig().drive()
    rig.speed_mps = speed_mps
    stopped = rig.turn(step_ms=step_ms)
    assert (stopped.mode, stopped.disarm, rig.events[-1][0]) == (SafetyMode.STOPPED, True, "stop")


def test_a_restarted_board_is_not_armed_again_after_a_pause() -> None:
    rig = Rig().drive()
    rig.speed_mps = 0.0
    rig.state = replace(rig.state, armed=False, boot_id=4)
    assert rig.turn(step_ms=120.0).mode is SafetyMode.STOPPED


def test_holds_that_return_too_often_stop() -> None:
    rig = Rig().drive()
    for _ in range(CONFIG.holds_max):
        assert rig.turn(status=LaneStatus.LOST).mode is SafetyMode.HOLD
        assert rig.turns(198).mode is SafetyMode.DRIVING  # about 2 s: five take 9.95 s
    assert rig.turn(status=LaneStatus.LOST).mode is SafetyMode.STOPPED
    assert rig.events[-1] == ("stop", "held 5 times within 10 s, and again: the lane is lost")


def test_holds_that_are_rare_stop_nothing_and_a_person_clears_the_count() -> None:
    rig = Rig().drive()
    for _ in range(3 * CONFIG.holds_max):
        assert rig.turn(status=LaneStatus.LOST).mode is SafetyMode.HOLD
        assert rig.turns(200).mode is SafetyMode.DRIVING
    rig.turns(3, link_up=False)
    rig.drive()
    for _ in range(CONFIG.holds_max):
        assert rig.turn(status=LaneStatus.LOST).mode is SafetyMode.HOLD
        assert rig.turn().mode is SafetyMode.DRIVING


@pytest.mark.parametrize("mode", [SafetyMode.DRIVING, SafetyMode.HOLD])
@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"boot_id": 4}, "the vehicle's controller has restarted"),
        ({"boot_id": 4, "armed": False}, "the vehicle's controller has restarted"),
        ({"boot_id": None}, "the vehicle's controller has restarted"),
        ({"driver_override": True}, "the driver has the car"),
        ({"driver_override": True, "armed": False}, "the driver has the car"),
        ({"armed": False}, "the vehicle has disarmed itself"),
    ],
)
def test_a_board_that_restarts_or_disarms_stops(mode: SafetyMode, change: dict[str, object], text: str) -> None:
    rig = Rig().drive() if mode is SafetyMode.DRIVING else Rig().hold()
    rig.state = replace(rig.state, **change)  # type: ignore[arg-type]
    assert rig.turn().mode is SafetyMode.STOPPED
    assert rig.events[-1] == ("stop", text)


def test_a_silent_vehicle_stops() -> None:
    rig = Rig().drive()
    assert rig.turns(10, silent=True).mode is SafetyMode.DRIVING
    assert rig.turn(silent=True).mode is SafetyMode.STOPPED
    assert rig.events[-1] == ("stop", "the vehicle has said nothing for 0.110 s")


def test_a_vehicle_that_speaks_from_the_future_stops() -> None:
    rig = Rig().drive()
    rig.state = replace(rig.state, t_ns=rig.now_ns + 300 * MS)
    assert rig.turn(silent=True).mode is SafetyMode.STOPPED


def test_reported_faults_alone_stop_nothing() -> None:
    rig = Rig().drive()
    rig.state = replace(rig.state, faults=("frame errors",))
    assert rig.turns(50).mode is SafetyMode.DRIVING


def test_the_vehicle_is_asked_again_while_it_does_not_follow() -> None:
    rig = Rig()
    rig.obeys = False
    rig.turns(52)
    asked = [rig.turn(arm=n == 0).arm for n in range(40)]
    assert [n for n, arm in enumerate(asked) if arm] == [0, 10, 20, 30]
    rig.state = replace(rig.state, armed=True)
    assert rig.turn().mode is SafetyMode.DRIVING
    asked = [rig.turn(link_up=n != 0).disarm for n in range(25)]
    assert [n for n, disarm in enumerate(asked) if disarm] == [0, 10, 20]
    rig.state = replace(rig.state, armed=False)
    assert not any(rig.turn().disarm for _ in range(20))


def test_a_vehicle_found_armed_is_disarmed_before_all_else() -> None:
    rig = Rig()
    rig.state = replace(rig.state, armed=True)
    first = rig.turn()
    assert (first.mode, first.disarm, first.reason) == (SafetyMode.DISARMED, True, "the vehicle is still armed")


def test_arming_is_given_up_after_a_second() -> None:
    rig = Rig()
    rig.obeys = False
    rig.turns(52)
    rig.turn(arm=True)
    assert rig.turns(99).mode is SafetyMode.ARMING
    given_up = rig.turn()
    assert (given_up.mode, given_up.disarm) == (SafetyMode.DISARMED, True)
    assert rig.events[-1] == ("disarmed", "the vehicle has not armed within 1.0 s")
    assert rig.turns(200).mode is SafetyMode.DISARMED


def test_auto_arm_waits_before_it_asks_a_vehicle_again_that_did_not_arm() -> None:
    rig = Rig(auto_arm=True)
    rig.obeys = False
    rig.turns(51 + 100)
    assert rig.safety.mode is SafetyMode.DISARMED
    assert rig.turns(50).mode is SafetyMode.DISARMED
    assert rig.turn().mode is SafetyMode.ARMING


@pytest.mark.parametrize("how", [{"status": LaneStatus.LOST}, {"link_up": False}, {"step_ms": 150.0}])
def test_arming_is_given_up_when_anything_goes_wrong(how: dict[str, object]) -> None:
    rig = Rig()
    rig.turns(52)
    rig.turn(arm=True)
    decision = rig.turn(**how)  # type: ignore[arg-type]
    assert (decision.mode, decision.action, decision.disarm) == (SafetyMode.DISARMED, Action.NEUTRAL, True)


def test_after_a_driver_it_is_not_armed_before_half_a_second_nor_by_itself_after_a_pause() -> None:
    rig = Rig().drive()
    rig.state = replace(rig.state, driver_override=True, armed=False)
    assert rig.turn(step_ms=101.0).mode is SafetyMode.STOPPED  # such a pause would excuse a board that disarms itself
    rig.state = replace(rig.state, driver_override=False)
    assert rig.turn(arm=True).mode is SafetyMode.STOPPED
    assert rig.turns(60).mode is SafetyMode.STOPPED
    assert rig.turn(arm=True).mode is SafetyMode.ARMING


def test_a_board_that_restarts_while_arming_does_not_drive() -> None:
    rig = Rig()
    rig.turns(52)
    rig.turn(arm=True)
    rig.state = replace(rig.state, boot_id=9, armed=True)
    assert rig.turn().mode is SafetyMode.DISARMED


def test_after_a_stop_a_person_can_arm_again() -> None:
    rig = Rig().drive()
    rig.turn(link_up=False)
    refused = rig.turn(arm=True)
    assert refused.mode is SafetyMode.STOPPED
    assert rig.events[-1][0] == "arm-refused"
    rig.turns(51)
    assert rig.turn(arm=True).mode is SafetyMode.ARMING
    assert rig.turn().mode is SafetyMode.DRIVING


def test_auto_arm_arms_once_when_healthy_and_never_after_a_stop() -> None:
    rig = Rig(auto_arm=True)
    rig.turns(100, status=LaneStatus.LOST)
    rig.turns(50)
    assert rig.turn().mode is SafetyMode.ARMING
    assert rig.turn().mode is SafetyMode.DRIVING
    rig.turn(link_up=False)
    assert rig.turns(500).mode is SafetyMode.STOPPED
    assert rig.turn(arm=True).mode is SafetyMode.ARMING


def test_auto_arm_outlives_an_arming_that_came_to_nothing() -> None:
    rig = Rig(auto_arm=True)
    assert rig.turns(51).mode is SafetyMode.ARMING
    assert rig.turn(status=LaneStatus.LOST).mode is SafetyMode.DISARMED
    assert rig.turns(50).mode is SafetyMode.DISARMED
    rig.turns(2)
    assert rig.safety.mode is SafetyMode.DRIVING


def test_one_event_for_one_change() -> None:
    rig = Rig().hold()
    rig.turns(60, status=LaneStatus.LOST)
    rig.turns(60, link_up=False)
    assert [kind for kind, _ in rig.events] == ["arming", "driving", "hold", "stop"]


def test_frame_due_and_time_fault() -> None:
    safety = Safety(CONFIG)
    assert safety.frame_due_ns() is None
    assert safety.frame_time_fault(0, 0) is None
    seen = Seen(frame_t_ns=1000 * MS, taken_ns=1001 * MS, status=LaneStatus.TRACKING, valid_until_ns=None)
    safety.step(SafetyInputs(seen=seen, state=None), 1001 * MS)
    assert safety.frame_due_ns() == 1060 * MS
    assert safety.frame_time_fault(1001 * MS, 1001 * MS) is None
    assert safety.frame_time_fault(1000 * MS, 1001 * MS) is not None
    assert safety.frame_time_fault(1051 * MS, 1001 * MS) is None
    assert safety.frame_time_fault(1051 * MS + 1, 1001 * MS) is not None


def test_a_stopped_car_rolls_out_for_2_s_and_an_arm_ends_it() -> None:
    rig = Rig().drive()
    assert rig.turn(stop="STOP").action is Action.HOLD_STEERING
    assert rig.turns(199, stop="STOP").action is Action.HOLD_STEERING  # asked for again and again: no longer for it
    assert rig.turn(stop="STOP").action is Action.NEUTRAL
    assert rig.turn(step_ms=-1500.0).action is Action.HOLD_STEERING  # the clock went back
    assert rig.turn(step_ms=-1500.0).action is Action.NEUTRAL  # but never before the stop
    again = Rig().drive()
    again.turn(stop="STOP")
    again.turns(60)
    assert again.turn(arm=True).action is Action.NEUTRAL


def rolled(rig: Rig, turns: int, speed_mps: float | None, **how: object) -> Action:
    """The last action of so many turns of 10 ms, in which the odometry reads this speed."""
    for _ in range(turns):
        rig.state = replace(rig.state, speed_mps=speed_mps)
        decision = rig.turn(**how)  # type: ignore[arg-type]
    return decision.action


def test_a_stopped_car_that_stands_has_straight_wheels() -> None:
    rig = Rig().drive()
    rolled(rig, 30, 1.0)
    assert rolled(rig, 40, 0.5, stop="STOP") is Action.HOLD_STEERING
    assert rolled(rig, 19, 0.0) is Action.HOLD_STEERING
    assert rolled(rig, 1, 0.0) is Action.NEUTRAL
    assert rolled(rig, 5, 0.5) is Action.NEUTRAL  # a person pushes it
    assert rig.safety.mode is SafetyMode.STOPPED


@pytest.mark.parametrize("speed_mps", [None, 0.0])
def test_an_odometry_that_read_nothing_while_the_car_was_driven_ends_no_roll_out(speed_mps: float | None) -> None:
    rig = Rig().drive()
    rolled(rig, 10, 1.0)
    rolled(rig, 60, speed_mps)  # it has failed
    assert rolled(rig, 200, speed_mps, stop="STOP") is Action.HOLD_STEERING
    assert rolled(rig, 1, speed_mps) is Action.NEUTRAL  # the 2 s are over


def test_a_link_that_is_lost_while_the_car_rolls_ends_no_roll_out() -> None:
    rig = Rig().drive()
    rolled(rig, 30, 1.0)
    rolled(rig, 5, 0.0, stop="STOP")
    assert rolled(rig, 100, 0.0, link_up=False) is Action.HOLD_STEERING
    silent = Rig().drive()
    rolled(silent, 30, 1.0)
    rolled(silent, 5, 0.0)
    assert rolled(silent, 100, 0.0, silent=True) is Action.HOLD_STEERING


def test_a_wheel_that_ticks_seldom_is_waited_for() -> None:
    """Every tenth reading has a speed: the car still rolls while the next one may come."""
    rig = Rig().drive()
    for _ in range(5):
        rolled(rig, 1, 1.0)
        rolled(rig, 14, 0.0)
    rolled(rig, 1, 1.0, stop="STOP")
    assert rolled(rig, 44, 0.0) is Action.HOLD_STEERING  # three times 150 ms
    assert rolled(rig, 1, 0.0) is Action.NEUTRAL


def test_a_car_that_has_stood_rolls_out_again_after_the_next_stop() -> None:
    rig = Rig().drive()
    rolled(rig, 30, 1.0)
    rolled(rig, 10, 0.5, stop="STOP")
    assert rolled(rig, 60, 0.0) is Action.NEUTRAL
    rig.turn(arm=True)
    rolled(rig, 30, 1.0)
    assert rig.safety.mode is SafetyMode.DRIVING
    assert rolled(rig, 1, 1.0, stop="STOP") is Action.HOLD_STEERING
    assert rolled(rig, 60, 0.5) is Action.HOLD_STEERING


def test_a_car_that_never_drove_has_straight_wheels() -> None:
    rig = Rig()
    rig.turns(60)
    rig.turn(arm=True)
    assert (rig.safety.mode, rig.turn(status=LaneStatus.LOST).action) == (SafetyMode.ARMING, Action.NEUTRAL)
