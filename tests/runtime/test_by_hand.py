"""A person who drives by hand: in the safety machine, the chain and the run."""

from __future__ import annotations

import pytest

from automodel.config import CarConfig
from automodel.control.limits import Limits
from automodel.control.manual import ManualDriver
from automodel.runtime.loop import Loop
from automodel.runtime.safety import Action, SafetyMode
from automodel.signals import Command, DriverInput, Frame, LaneEstimate, LaneStatus, Motion
from tests.support.runner_fakes import PICTURE
from tests.support.safety_rig import MS, Rig

BLIND = LaneStatus.LOST


def test_a_person_arms_and_drives_where_no_lane_is_seen() -> None:
    rig = Rig()
    rig.turns(52, status=BLIND)
    assert rig.turn(arm=True, status=BLIND).mode is SafetyMode.DISARMED  # the pipeline may not
    assert rig.turn(arm=True, by_hand=True, status=BLIND).mode is SafetyMode.ARMING
    driving = rig.turn(by_hand=True, status=BLIND)
    assert (driving.mode, driving.action) == (SafetyMode.DRIVING, Action.PASS)
    assert rig.events[-2] == ("arming", "by request, to be driven by hand")
    assert rig.turns(500, by_hand=True, lane_faults=("the lane has jumped",)).mode is SafetyMode.DRIVING


def test_half_a_second_of_healthy_input_is_needed_by_hand_too() -> None:
    rig = Rig()
    rig.turns(30, status=BLIND)
    assert rig.turn(arm=True, by_hand=True, status=BLIND).mode is SafetyMode.DISARMED
    assert rig.events[-1][0] == "arm-refused"


@pytest.mark.parametrize("how", [{"age_ms": 70.0}, {"faults": ("the image is blank",)}], ids=["old frame", "bad frame"])
def test_the_freshness_chain_holds_a_person_too(how: dict[str, object]) -> None:
    rig = Rig()
    rig.turns(52, status=BLIND)
    rig.turn(arm=True, by_hand=True, status=BLIND)
    assert rig.turn(by_hand=True, status=BLIND).mode is SafetyMode.DRIVING
    held = rig.turn(by_hand=True, status=BLIND, **how)  # type: ignore[arg-type]
    assert (held.mode, held.action) == (SafetyMode.HOLD, Action.HOLD_STEERING)
    assert rig.turns(31, by_hand=True, status=BLIND, **how).mode is SafetyMode.STOPPED


def test_a_person_takes_over_and_the_car_that_they_let_go_of_stops() -> None:
    rig = Rig().drive()
    assert rig.turn(by_hand=True).mode is SafetyMode.DRIVING
    assert rig.events[-1] == ("take-over", "a person drives by hand")
    rig.turns(50, by_hand=True)
    assert [kind for kind, _ in rig.events].count("take-over") == 1
    stopped = rig.turn()
    assert stopped.mode is SafetyMode.STOPPED
    assert rig.events[-1] == ("stop", "the person who drove let go")
    assert rig.turns(200).mode is SafetyMode.STOPPED  # and stays so


def test_the_lane_counts_again_once_nobody_drives_by_hand() -> None:
    rig = Rig().drive()
    assert rig.turn(lane_faults=("the lane has jumped",)).mode is SafetyMode.HOLD


class Pipeline:
    name = "blind"

    def __init__(self) -> None:
        self.seen = 0

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        self.seen += 1
        return LaneEstimate(t_ns=frame.t_ns, status=LaneStatus.LOST)

    def reset(self) -> None:
        pass


class Controller:
    def step(self, estimate: LaneEstimate, motion: Motion, state: object, t_ns: int) -> Command:
        return Command(t_ns=t_ns, steering_rad=-0.1, speed_mps=0.3, valid_until_ns=t_ns + 100 * MS)

    def reset(self) -> None:
        pass


def drive(steering: float, turns: int, validity_s: float = 0.1) -> list[Command]:
    car, pipeline = CarConfig(), Pipeline()
    limits = Limits(car.safety, car.vehicle)
    loop = Loop(pipeline, Controller(), limits, validity_s=validity_s, driver=ManualDriver(car))
    sent: list[Command] = []
    for turn in range(turns):
        t_ns = (1000 + 16 * turn) * MS
        frame = Frame(t_ns=t_ns - 10 * MS, index=turn, image=PICTURE)
        motion = Motion(t_ns=frame.t_ns, speed_mps=sent[-1].speed_mps if sent else 0.0, yaw_rate_radps=0.0)
        by_hand = DriverInput(t_ns=t_ns, steering=steering, speed=1.0)
        tick = loop.tick(frame, motion, None, t_ns, by_hand)
        assert tick.driver is by_hand
        sent.append(tick.command)
    assert pipeline.seen == turns  # it goes on looking, for the recording
    return sent


def test_what_a_person_wants_passes_the_same_limits() -> None:
    car = CarConfig()
    sent = drive(steering=1.0, turns=120)
    assert sent[-1].speed_mps == pytest.approx(car.control.speed_mps)
    assert max(command.steering_rad for command in sent) == pytest.approx(car.safety.steering_max_rad)
    first = [command.steering_rad for command in sent[:3]]
    rate = car.safety.steering_rate_max_radps * 0.016
    assert first == pytest.approx([0.0, rate, 2 * rate])  # not at once


def test_the_command_lives_no_longer_than_its_frame_allows() -> None:
    (command,) = drive(steering=0.0, turns=1)
    assert command.valid_until_ns == (990 + 100) * MS


def test_the_controller_drives_where_nobody_else_does() -> None:
    car = CarConfig()
    loop = Loop(Pipeline(), Controller(), Limits(car.safety, car.vehicle), validity_s=0.1, driver=ManualDriver(car))
    frame = Frame(t_ns=1000 * MS, index=0, image=PICTURE)
    tick = loop.tick(frame, Motion(t_ns=frame.t_ns, speed_mps=0.0, yaw_rate_radps=0.0), None, 1010 * MS)
    assert (tick.wanted.speed_mps, tick.driver) == (0.3, None)
