"""Controller, limits and plant in a loop, with estimates made from the truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from automodel.config import CarConfig, ControlConfig
from automodel.control.controller import LaneController
from automodel.control.limits import Limits
from automodel.curves import Curve, JoinedCurve, TabulatedCurve, arc, line
from automodel.geometry.se2 import SE2
from automodel.signals import NEUTRAL, Command, LaneEstimate, LanePose, LaneStatus, Motion, VehicleState
from automodel.sim.plant import Plant, PlantConfig
from tests.support.slow_lane import rest_slow

CAR = CarConfig()
FRAME_NS = 16_666_667
LATENCY_NS = 4_000_000
SERVO_FRAME_NS = 20_000_000


@dataclass(frozen=True, kw_only=True)
class Drive:
    """A test drive: time, true offset at the reference point, speed, steering as sent; each (n,)."""

    t_s: np.ndarray
    offset_m: np.ndarray
    speed_mps: np.ndarray
    sent_rad: np.ndarray

    def after(self, t_s: float) -> np.ndarray:
        return self.offset_m[self.t_s >= t_s]


def seen_lane(world: Curve, world_from_body: SE2, near_s_m: float, behind_m: float, ahead_m: float) -> TabulatedCurve:
    """The part of a curve in the world that a perfect camera would give, in the body frame."""
    s = np.linspace(near_s_m - behind_m, near_s_m + ahead_m, 61)
    return TabulatedCurve(
        s - s[0],
        world_from_body.inverse().apply(world.position(s)),
        world.heading(s) - world_from_body.yaw_rad,
        world.curvature(s),
    )


def perfect_estimate(world: Curve, pose: SE2, near_s_m: float, behind_m: float, t_ns: int) -> LaneEstimate:
    """What a pipeline without any error says at `pose`; `near_s_m` is the reference point's arc length."""
    reference = pose @ SE2(CAR.vehicle.reference_x_m, 0.0, 0.0)
    s, offset = world.project((reference.x_m, reference.y_m), near_s_m, 0.3)
    lane_pose = LanePose(
        offset_m=offset,
        heading_rad=pose.yaw_rad - float(world.heading(s)),
        width_m=0.4,
        curvature_per_m=float(world.curvature(s)),
        covariance=np.eye(3) * 1e-6,
    )
    lane = seen_lane(world, pose, s, behind_m, 1.4)
    return LaneEstimate(t_ns=t_ns, status=LaneStatus.TRACKING, centerline=lane, pose=lane_pose)


class Pins:
    """Commands as pulses at the plant: at once, or with the next servo frame (50 Hz) as a board gives them."""

    def __init__(self, plant: Plant, servo_frames: bool) -> None:
        self.plant, self.servo_frames = plant, servo_frames
        self.command, self.next_ns = NEUTRAL, 0

    def send(self, command: Command) -> None:
        self.command = command
        if not self.servo_frames:
            self._set(command.t_ns)

    def advance(self, t_ns: int) -> None:
        while self.servo_frames and self.next_ns <= t_ns:
            if self.next_ns >= self.command.t_ns:
                self._set(self.next_ns)
            self.next_ns += SERVO_FRAME_NS
        self.plant.advance(t_ns)

    def _set(self, t_ns: int) -> None:
        servo, motor = CAR.link.servo, CAR.link.motor
        self.plant.set_pulses(
            t_ns,
            float(np.interp(-self.command.steering_rad, [-angle for angle in servo.steering_rad], servo.pulse_us)),
            float(np.interp(self.command.speed_mps, motor.speed_mps, motor.pulse_us)),
        )


def drive(
    world: Curve,
    control: ControlConfig,
    seconds: float,
    *,
    start: SE2,
    plant_config: PlantConfig | None = None,
    servo_frames: bool = False,
    behind_m: float = 0.1,
) -> Drive:
    """Drive along `world`; the car stands at `start`, near the curve's beginning."""
    pins = Pins(Plant(plant_config or PlantConfig(), start, start_ns=0), servo_frames)
    controller, limits = LaneController(replace(CAR, control=control)), Limits(CAR.safety, CAR.vehicle)
    rows, way_m = [], 0.0
    for t in range(0, round(seconds * 1e9), FRAME_NS):
        pins.advance(t)
        car = pins.plant.state
        estimate = perfect_estimate(world, SE2(car.x_m, car.y_m, car.yaw_rad), way_m, behind_m, t)
        way_m = car.distance_m + CAR.vehicle.reference_x_m
        motion = Motion(t_ns=t, speed_mps=car.speed_mps, yaw_rate_radps=car.yaw_rate_radps)
        state = VehicleState(t_ns=t, speed_mps=car.speed_mps, steering_rad=pins.command.steering_rad)
        requested = controller.step(estimate, motion, state, t + LATENCY_NS)
        pins.send(limits.step(requested, motion, t + LATENCY_NS).command)
        assert estimate.pose is not None
        rows.append((t * 1e-9, estimate.pose.offset_m, car.speed_mps, pins.command.steering_rad))
    t_s, offset_m, speed_mps, sent_rad = np.array(rows).T
    return Drive(t_s=t_s, offset_m=offset_m, speed_mps=speed_mps, sent_rad=sent_rad)


LAWS = ("pure_pursuit", "stanley")
REST_M = 0.01  # what remains of an offset after two seconds, play of the servo included


def bends(*pieces: tuple[float, float]) -> JoinedCurve:
    """A straight of 1.5 m, then arcs (curvature, length) end to end: the curvature jumps."""
    curves: list[Curve] = [line(0.0, 0.0, 0.0, 1.5)]
    for kappa, length in pieces:
        x, y = curves[-1].position(curves[-1].length_m)
        curves.append(arc(float(x), float(y), float(curves[-1].heading(curves[-1].length_m)), kappa, length))
    return JoinedCurve(curves)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("speed", [1.0, 1.5])
@pytest.mark.parametrize("kappa", [0.0, 1 / 1.2, -1 / 1.2])
def test_an_offset_dies_out_without_oscillation(law: str, speed: float, kappa: float) -> None:
    world = arc(0.0, 0.0, 0.0, kappa, 12.0)
    control = ControlConfig(controller=law, speed_mps=speed, lateral_accel_mps2=2.0)
    run = drive(world, control, 4.5, start=SE2(0.0, 0.05, 0.0))
    moving = run.t_s >= 0.7
    assert run.speed_mps[-1] == pytest.approx(speed, abs=0.01)
    assert np.abs(run.offset_m).max() <= abs(run.offset_m[0]) + 0.005  # it starts with straight wheels
    assert np.abs(run.after(2.0)).max() <= 0.03
    assert np.abs(run.after(2.5)).max() <= REST_M
    assert run.offset_m[moving].min() >= -REST_M  # no swing to the other side beyond the rest
    # the wheels come to rest: what is left of their motion is the play of the servo
    assert np.ptp(run.sent_rad[run.t_s > 3.0]) <= 0.03


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("servo_frames", [False, True])
@pytest.mark.parametrize("speed", rest_slow((1.0, 2.0), 2.0))
def test_s_bends_with_jumps_of_curvature(law: str, servo_frames: bool, speed: float) -> None:
    world = bends(
        (1 / 1.2, 1.0), (-1 / 1.2, 1.2), (1 / 0.6, 0.9), (-1 / 0.6, 1.0), (1 / 0.8, 1.0), (0.0, 0.5), (-1 / 0.6, 2.5)
    )
    control = ControlConfig(controller=law, speed_mps=speed)
    run = drive(world, control, 8.0, start=SE2(), servo_frames=servo_frames)
    assert np.abs(run.offset_m).max() <= (0.035 if servo_frames else 0.025)
    # the speed that the bends allow: sqrt(1.5 / kappa), and the motor's lag
    assert run.speed_mps[run.t_s > 3.0].max() <= math.sqrt(1.5 * 1.2) + 0.05
    assert run.speed_mps[run.t_s > 1.5].min() >= min(speed, math.sqrt(1.5 * 0.6)) - 0.06


@pytest.mark.parametrize("law", LAWS)
def test_without_feed_forward_bends_are_cut_but_kept(law: str) -> None:
    world = bends((1 / 1.2, 1.2), (-1 / 0.8, 1.2), (1 / 0.6, 2.0))
    control = ControlConfig(controller=law, feed_forward=False)
    run = drive(world, control, 5.5, start=SE2())
    assert 0.02 <= np.abs(run.offset_m).max() <= 0.06


@pytest.mark.parametrize("law", LAWS)
def test_prediction_makes_good_the_delay(law: str) -> None:
    world = bends((-1 / 1.2, 1.2), (1 / 0.6, 1.0), (-1 / 0.6, 1.0), (1 / 1.2, 3.0))
    slow = PlantConfig(servo_dead_s=0.08)

    def worst(delay_s: float) -> float:
        control = ControlConfig(controller=law, speed_mps=1.5, actuator_delay_s=delay_s)
        run = drive(world, control, 5.5, start=SE2(), plant_config=slow)
        return float(np.abs(run.offset_m).max())

    assert worst(0.12) < 0.035
    assert worst(0.0) > 2.0 * worst(0.12)


@pytest.mark.parametrize("law", LAWS)
def test_a_crooked_servo_with_play_stays_in_the_lane(law: str) -> None:
    crooked = PlantConfig(servo_bias_rad=0.03, servo_play_rad=0.02)
    run = drive(
        bends((1 / 1.2, 1.5), (-1 / 0.8, 3.0)),
        ControlConfig(controller=law),
        5.0,
        start=SE2(0.0, 0.05, 0.2),
        plant_config=crooked,
        servo_frames=True,
    )
    assert np.abs(run.after(2.5)).max() <= 0.05


@pytest.mark.parametrize("law", LAWS)
def test_a_lane_that_begins_ahead_of_the_car_does(law: str) -> None:
    world = arc(0.0, 0.0, 0.0, 1 / 1.2, 6.0)
    control = ControlConfig(controller=law)
    run = drive(world, control, 4.0, start=SE2(0.0, 0.05, 0.0), behind_m=-0.25)
    assert np.abs(run.after(3.0)).max() <= REST_M
