from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from automodel.config import CarConfig, ControlConfig
from automodel.control.controller import LaneController
from automodel.curves import Curve, GraphCurve, arc, line
from automodel.signals import LaneEstimate, LanePose, LaneStatus, Motion, MotionSource, VehicleState

MS = 1_000_000
FRAME_NS = 20 * MS
CAR = CarConfig()
MOVING = Motion(t_ns=0, speed_mps=1.0, yaw_rate_radps=0.0)
POSE = LanePose(offset_m=0.0, heading_rad=0.0, width_m=0.4, curvature_per_m=0.0, covariance=np.eye(3))
LEFT = arc(-0.3, 0.0, 0.0, 0.8, 2.0)


def seen(t_ns: int, curve: Curve = LEFT, status: LaneStatus = LaneStatus.TRACKING) -> LaneEstimate:
    return LaneEstimate(t_ns=t_ns, status=status, centerline=curve, pose=POSE)


def lost(t_ns: int) -> LaneEstimate:
    return LaneEstimate(t_ns=t_ns, status=LaneStatus.LOST)


def state(t_ns: int, steering: float = 0.0, centre_m: float | None = None) -> VehicleState:
    return VehicleState(t_ns=t_ns, speed_mps=1.0, steering_rad=steering, ranges_m=(None, centre_m, None))


@pytest.mark.parametrize("status", [LaneStatus.TRACKING, LaneStatus.ONE_LINE, LaneStatus.COASTING, LaneStatus.LOST])
def test_a_command_lives_from_its_frame(status: LaneStatus) -> None:
    estimate = lost(1000) if status is LaneStatus.LOST else replace(seen(1000, status=status), frame_age_ns=700 * MS)
    command = LaneController(CAR).step(estimate, MOVING, None, 5000)
    assert command.t_ns == 5000
    assert command.valid_until_ns == 1000 + 100 * MS


def test_a_lost_lane_holds_the_steering_and_asks_for_speed_zero() -> None:
    controller = LaneController(CAR)
    steering = [controller.step(seen(k * FRAME_NS), MOVING, None, k * FRAME_NS).steering_rad for k in range(10)][-1]
    assert steering > 0.1
    for k in range(10, 14):
        command = controller.step(lost(k * FRAME_NS), MOVING, None, k * FRAME_NS)
        assert (command.steering_rad, command.speed_mps) == (steering, 0.0)
    again = controller.step(seen(14 * FRAME_NS), MOVING, None, 14 * FRAME_NS)
    assert again.speed_mps == pytest.approx(1.0)  # found again: on from the speed that the car has


def test_lost_from_the_start_holds_the_steering_of_the_vehicle() -> None:
    command = LaneController(CAR).step(lost(0), MOVING, state(0, 0.2), 0)
    assert (command.steering_rad, command.speed_mps) == (0.2, 0.0)
    old = LaneController(CAR).step(lost(0), MOVING, state(-(10**10), 0.2), 0)
    assert old.steering_rad == 0.0


@pytest.mark.parametrize("name", ["pure_pursuit", "stanley"])
def test_the_configured_law_steers_left_in_a_left_bend(name: str) -> None:
    car = replace(CAR, control=ControlConfig(controller=name))
    command = LaneController(car).step(seen(0), MOVING, None, 0)
    assert 0.0 < command.steering_rad <= CAR.safety.steering_max_rad


def test_prediction_counts_the_steering_that_is_under_way() -> None:
    def step(steering: float, delay_s: float) -> float:
        car = replace(CAR, control=ControlConfig(actuator_delay_s=delay_s))
        return LaneController(car).step(seen(0, line(-0.3, 0.0, 0.0, 2.0)), MOVING, state(0, steering), 0).steering_rad

    assert step(0.3, 0.0) == pytest.approx(0.0, abs=1e-9)
    # 80 ms at 1 m/s on the arc of 0.3 rad: the car will point left, and stand left
    assert step(0.3, 0.08) < -0.05
    assert step(-0.3, 0.08) == pytest.approx(-step(0.3, 0.08))


def test_without_a_known_motion_the_commanded_speed_is_taken() -> None:
    unknown = Motion(t_ns=0, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
    controller = LaneController(CAR)
    commands = [controller.step(seen(k * FRAME_NS), unknown, None, k * FRAME_NS) for k in range(60)]
    assert commands[0].speed_mps == 0.0
    assert commands[-1].speed_mps == pytest.approx(1.0)


def test_an_obstacle_stops_the_car() -> None:
    controller = LaneController(CAR)
    commands = [
        controller.step(seen(k * FRAME_NS), MOVING, state(k * FRAME_NS, 0.1, 0.2 if k > 4 else None), k * FRAME_NS)
        for k in range(10)
    ]
    assert commands[4].speed_mps > 0.9
    assert commands[6].speed_mps == 0.0
    assert commands[6].steering_rad > 0.0


def test_reset_makes_it_new() -> None:
    controller = LaneController(CAR)
    first = controller.step(seen(0), MOVING, None, 0)
    for k in range(5):
        controller.step(seen(k * FRAME_NS, line(0.0, 0.1, 0.2, 1.0)), MOVING, state(0, 0.3, 0.1), k * FRAME_NS)
    controller.reset()
    assert controller.step(seen(0), MOVING, None, 0) == first


def test_steering_is_finite_and_bounded_for_odd_lanes() -> None:
    for curve in (GraphCurve((0.5, -2.0, 3.0), 0.2, 0.6), arc(2.0, 1.0, 2.5, -3.0, 1.0), line(-5.0, -3.0, -1.5, 0.1)):
        command = LaneController(CAR).step(seen(0, curve), MOVING, None, 0)
        assert math.isfinite(command.steering_rad)
        assert abs(command.steering_rad) <= CAR.safety.steering_max_rad
        assert 0.0 <= command.speed_mps <= CAR.control.speed_mps
