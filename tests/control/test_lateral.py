from __future__ import annotations

import math
from dataclasses import replace

import pytest

from automodel.config import ControlConfig, VehicleConfig
from automodel.control.lateral import PurePursuit, Stanley, lane_error, lateral_controller
from automodel.control.path import LanePath
from automodel.control.vehicle_model import arc_motion, rear_offset_m
from automodel.curves import arc, line
from automodel.geometry.se2 import SE2

CAR = VehicleConfig()
REAR = replace(CAR, reference_x_m=0.0)  # the rear axle itself is held on the centerline
L = CAR.wheelbase_m
PURE = ControlConfig(controller="pure_pursuit")
STANLEY = ControlConfig(controller="stanley")
STRAIGHT = LanePath(line(-0.5, 0.0, 0.0, 3.0))


def bend(kappa: float) -> LanePath:
    """An arc through the origin along x, from half a metre behind."""
    start = arc(0.0, 0.0, 0.0, kappa, 1.0)
    x, y = start.position(-0.5)
    return LanePath(arc(float(x), float(y), -0.5 * kappa, kappa, 2.2))


@pytest.mark.parametrize("config", [PURE, STANLEY, replace(PURE, feed_forward=False)])
@pytest.mark.parametrize("kappa", [1 / 1.2, -1 / 0.7, 0.0])
@pytest.mark.parametrize("speed", [0.0, 1.0, 2.0])
def test_on_an_arc_the_steering_is_that_of_the_bicycle_model(config: ControlConfig, kappa: float, speed: float) -> None:
    steering = lateral_controller(config, REAR).steer(bend(kappa), SE2(), speed)
    assert steering == pytest.approx(math.atan(L * kappa), abs=1e-6)


@pytest.mark.parametrize("config", [PURE, STANLEY])
@pytest.mark.parametrize("kappa", [1 / 1.2, -1 / 0.6])
def test_the_reference_point_is_held_on_the_centerline(config: ControlConfig, kappa: float) -> None:
    rear_radius = math.sqrt(1.0 / kappa**2 - CAR.reference_x_m**2)
    inside = SE2(0.0, math.copysign(1.0 / abs(kappa) - rear_radius, kappa), 0.0)
    steering = lateral_controller(config, CAR).steer(bend(kappa), inside, 1.0)
    assert steering == pytest.approx(math.copysign(math.atan(L / rear_radius), kappa), abs=1e-6)


def test_textbook_stanley_is_at_rest_with_the_front_axle_on_the_arc() -> None:
    controller = Stanley(replace(STANLEY, feed_forward=False), CAR)
    front_radius = 1.2
    rear_radius = math.sqrt(front_radius**2 - L**2)
    car = SE2(0.0, front_radius - rear_radius, 0.0)
    assert controller.steer(bend(1 / front_radius), car, 1.0) == pytest.approx(math.atan(L / rear_radius), abs=1e-4)


@pytest.mark.parametrize(
    "config", [PURE, STANLEY, replace(PURE, feed_forward=False), replace(STANLEY, feed_forward=False)]
)
def test_signs(config: ControlConfig) -> None:
    controller = lateral_controller(config, CAR)
    assert controller.steer(STRAIGHT, SE2(0.0, 0.05, 0.0), 1.0) < -0.01  # left of the line: steer right
    assert controller.steer(STRAIGHT, SE2(0.0, -0.05, 0.0), 1.0) > 0.01
    assert controller.steer(STRAIGHT, SE2(0.0, 0.0, 0.1), 1.0) < -0.01  # turned to the left: steer right
    assert controller.steer(STRAIGHT, SE2(0.0, 0.0, 0.0), 1.0) == pytest.approx(0.0, abs=1e-12)
    mirrored = (
        controller.steer(bend(0.9), SE2(0.1, 0.04, 0.1), 1.0),
        controller.steer(bend(-0.9), SE2(0.1, -0.04, -0.1), 1.0),
    )
    assert mirrored[0] == pytest.approx(-mirrored[1])


@pytest.mark.parametrize("feed_forward", [True, False])
@pytest.mark.parametrize(("y", "yaw"), [(0.06, 0.0), (-0.1, 0.3), (0.02, -0.6)])
def test_pure_pursuit_steers_the_arc_through_its_target(feed_forward: bool, y: float, yaw: float) -> None:
    config = replace(PURE, feed_forward=feed_forward)
    steering = PurePursuit(config, CAR).steer(STRAIGHT, SE2(0.0, y, yaw), 1.0)
    # drive that arc until the distance from the start is the lookahead: that is on the line, ahead
    kappa = math.tan(steering) / L
    length = 2.0 * math.asin(0.5 * kappa * config.lookahead_s) / kappa
    end = SE2(0.0, y, yaw) @ arc_motion(1.0, steering, L, length)
    assert end.y_m == pytest.approx(0.0, abs=1e-4)
    assert math.hypot(end.x_m, end.y_m - y) == pytest.approx(config.lookahead_s, abs=1e-9)


def test_lookahead_grows_with_the_speed_from_its_least() -> None:
    controller = PurePursuit(PURE, CAR)
    offset = SE2(0.0, 0.01, 0.0)

    def lookahead(speed: float) -> float:
        return math.sqrt(-2.0 * 0.01 * L / math.tan(controller.steer(STRAIGHT, offset, speed)))

    assert lookahead(0.0) == pytest.approx(PURE.lookahead_min_m)
    assert lookahead(2.0) == pytest.approx(2.0 * PURE.lookahead_s)


def test_stanley_law() -> None:
    steering = Stanley(STANLEY, CAR).steer(STRAIGHT, SE2(0.0, 0.05, 0.1), 1.0)
    front = 0.05 + L * math.sin(0.1)
    assert steering == pytest.approx(-0.1 - math.atan(2.5 * front / (1.0 + 0.3)), abs=1e-12)


@pytest.mark.parametrize(
    "config", [PURE, STANLEY, replace(PURE, feed_forward=False), replace(STANLEY, feed_forward=False)]
)
@pytest.mark.parametrize("speed", [0.5, 1.5])
def test_an_ideal_car_converges_to_the_line(config: ControlConfig, speed: float) -> None:
    controller = lateral_controller(config, REAR)
    lane = LanePath(line(-1.0, 0.0, 0.0, 20.0))
    car, crossings, side = SE2(0.0, 0.1, 0.0), 0, 1.0
    for _ in range(600):
        car = car @ arc_motion(speed, controller.steer(lane, car, speed), L, 0.01)
        if car.y_m * side < -2e-3:  # on the other side by more than 2 % of the start
            crossings, side = crossings + 1, -side
    assert abs(car.y_m) < 2e-3
    assert abs(car.yaw_rad) < 2e-3
    assert crossings <= 1


def test_lane_error_recovers_what_was_constructed() -> None:
    curve = arc(0.0, 0.0, 0.0, 0.8, 2.0)
    x, y = curve.offset_position(0.9, 0.07)
    error = lane_error(LanePath(curve), SE2(float(x), float(y), 0.9 * 0.8 - 0.2 + 4 * math.pi), 1.0, CAR)
    assert error.offset_m == pytest.approx(0.07 - rear_offset_m(0.8, 0.13), abs=1e-9)
    assert error.heading_rad == pytest.approx(-0.2)
    assert error.curvature_per_m == pytest.approx(1.0 / (1.0 / 0.8 - 0.07))  # the circle that is 7 cm smaller


@pytest.mark.parametrize(
    "config", [PURE, STANLEY, replace(PURE, feed_forward=False), replace(STANLEY, feed_forward=False)]
)
@pytest.mark.parametrize("car", [SE2(0.0, 3.0, 1.0), SE2(0.5, -0.2, math.pi), SE2(0.0, 0.0, -2.0), SE2(-4.0, 0.9, 0.0)])
def test_a_hopeless_pose_still_gives_a_finite_angle(config: ControlConfig, car: SE2) -> None:
    for lane in (STRAIGHT, bend(1.3), bend(-1.3)):
        assert math.isfinite(lateral_controller(config, CAR).steer(lane, car, 1.0))


def test_the_lane_may_begin_ahead_of_the_car() -> None:
    kappa = 1 / 1.2
    curve = arc(0.0, 0.0, 0.0, kappa, 2.0)
    x, y = curve.position(0.35)
    ahead_only = LanePath(arc(float(x), float(y), 0.35 * kappa, kappa, 0.8))
    for config in (PURE, STANLEY):
        controller = lateral_controller(config, REAR)
        assert controller.steer(ahead_only, SE2(), 1.0) == pytest.approx(math.atan(L * kappa), abs=1e-6)
