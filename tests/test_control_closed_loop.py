"""Controller, limits and plant in a loop, with estimates made from the truth."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from automodel.config import CarConfig, ControlConfig
from automodel.control.controller import LaneController
from automodel.control.limits import Limits
from automodel.curves import Curve, JoinedCurve, TabulatedCurve, arc, line
from automodel.geometry.se2 import SE2
from automodel.signals import LaneEstimate, LanePose, LaneStatus, Motion, VehicleState
from automodel.sim.plant import Plant, PlantConfig

FRAME_NS = 16_666_667
LATENCY_NS = 4_000_000
SERVO_FRAME_NS = 20_000_000


@dataclass(frozen=True, kw_only=True)
class Drive:
    """A test drive: columns of time, true offset at the reference point, speed, steering command."""

    t_s: np.ndarray
    offset_m: np.ndarray
    speed_mps: np.ndarray
    wanted_rad: np.ndarray
    sent_rad: np.ndarray
    true_rad: np.ndarray
    limited: list[tuple[str, ...]]

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


def drive(
    world: Curve,
    *,
    control: ControlConfig,
    seconds: float,
    start: SE2,
    car: CarConfig | None = None,
    plant_config: PlantConfig | None = None,
    servo_frames: bool = False,
    behind_m: float = 0.1,
) -> Drive:
    """Drive along `world`; the car stands at `start`, near the curve's beginning."""
    car = replace(car or CarConfig(), control=control)
    plant = Plant(plant_config or PlantConfig(), start, start_ns=0)
    controller, limits = LaneController(car), Limits(car.safety, car.vehicle)
    servo, motor = car.link.servo, car.link.motor

    def set_pulses(t_ns: int, steering: float, speed: float) -> None:
        plant.set_pulses(
            t_ns,
            float(np.interp(-steering, [-v for v in servo.steering_rad], servo.pulse_us)),
            float(np.interp(speed, motor.speed_mps, motor.pulse_us)),
        )

    rows, limited, sent, s, pulse_ns = [], [], None, 0.0, 0
    for index in itertools.count():
        t = index * FRAME_NS
        if t > seconds * 1e9:
            break
        if servo_frames and sent is not None:
            while pulse_ns <= t:
                if pulse_ns >= sent.t_ns:
                    set_pulses(pulse_ns, sent.steering_rad, sent.speed_mps)
                pulse_ns += SERVO_FRAME_NS
        plant.advance(t)
        state = plant.state
        pose = SE2(state.x_m, state.y_m, state.yaw_rad)
        reference = pose @ SE2(car.vehicle.reference_x_m, 0.0, 0.0)
        s, offset = world.project((reference.x_m, reference.y_m), s, 0.3)
        heading = pose.yaw_rad - float(world.heading(s))
        estimate = LaneEstimate(
            t_ns=t,
            status=LaneStatus.TRACKING,
            centerline=seen_lane(world, pose, s, behind_m, 1.4),
            pose=LanePose(
                offset_m=offset,
                heading_rad=heading,
                width_m=0.4,
                curvature_per_m=float(world.curvature(s)),
                covariance=np.eye(3) * 1e-6,
            ),
        )
        motion = Motion(t_ns=t, speed_mps=state.speed_mps, yaw_rate_radps=state.yaw_rate_radps)
        told = VehicleState(t_ns=t, speed_mps=state.speed_mps, steering_rad=0.0 if sent is None else sent.steering_rad)
        wanted = controller.step(estimate, motion, told, t + LATENCY_NS)
        result = limits.step(wanted, motion, t + LATENCY_NS)
        sent = result.command
        if not servo_frames:
            set_pulses(t + LATENCY_NS, sent.steering_rad, sent.speed_mps)
        limited.append(result.reasons)
        rows.append((t * 1e-9, offset, state.speed_mps, wanted.steering_rad, sent.steering_rad, state.steering_rad))
    columns = np.array(rows).T
    return Drive(
        t_s=columns[0],
        offset_m=columns[1],
        speed_mps=columns[2],
        wanted_rad=columns[3],
        sent_rad=columns[4],
        true_rad=columns[5],
        limited=limited,
    )


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
    run = drive(world, control=control, seconds=4.5, start=SE2(0.0, 0.05, 0.0))
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
@pytest.mark.parametrize("speed", [1.0, 2.0])
def test_s_bends_with_jumps_of_curvature(law: str, servo_frames: bool, speed: float) -> None:
    world = bends(
        (1 / 1.2, 1.0), (-1 / 1.2, 1.2), (1 / 0.6, 0.9), (-1 / 0.6, 1.0), (1 / 0.8, 1.0), (0.0, 0.5), (-1 / 0.6, 2.5)
    )
    control = ControlConfig(controller=law, speed_mps=speed)
    run = drive(world, control=control, seconds=8.0, start=SE2(), servo_frames=servo_frames)
    assert np.abs(run.offset_m).max() <= (0.035 if servo_frames else 0.025)
    # the speed that the bends allow: sqrt(1.5 / kappa), and the motor's lag
    assert run.speed_mps[run.t_s > 3.0].max() <= math.sqrt(1.5 * 1.2) + 0.05
    assert run.speed_mps[run.t_s > 1.5].min() >= min(speed, math.sqrt(1.5 * 0.6)) - 0.06


@pytest.mark.parametrize("law", LAWS)
def test_without_feed_forward_bends_are_cut_but_kept(law: str) -> None:
    world = bends((1 / 1.2, 1.2), (-1 / 0.8, 1.2), (1 / 0.6, 2.0))
    control = ControlConfig(controller=law, feed_forward=False)
    run = drive(world, control=control, seconds=5.5, start=SE2())
    assert 0.02 <= np.abs(run.offset_m).max() <= 0.06


@pytest.mark.parametrize("law", LAWS)
def test_prediction_makes_good_the_delay(law: str) -> None:
    world = bends((-1 / 1.2, 1.2), (1 / 0.6, 1.0), (-1 / 0.6, 1.0), (1 / 1.2, 3.0))
    slow = PlantConfig(servo_dead_s=0.08)

    def worst(delay_s: float) -> float:
        control = ControlConfig(controller=law, speed_mps=1.5, actuator_delay_s=delay_s)
        run = drive(world, control=control, seconds=5.5, start=SE2(), plant_config=slow)
        return float(np.abs(run.offset_m).max())

    assert worst(0.12) < 0.035
    assert worst(0.0) > 2.0 * worst(0.12)


@pytest.mark.parametrize("law", LAWS)
def test_a_crooked_servo_with_play_stays_in_the_lane(law: str) -> None:
    crooked = PlantConfig(servo_bias_rad=0.03, servo_play_rad=0.02)
    run = drive(
        bends((1 / 1.2, 1.5), (-1 / 0.8, 3.0)),
        control=ControlConfig(controller=law),
        seconds=5.0,
        start=SE2(0.0, 0.05, 0.2),
        plant_config=crooked,
        servo_frames=True,
    )
    assert np.abs(run.after(2.5)).max() <= 0.05


@pytest.mark.parametrize("law", LAWS)
def test_a_lane_that_begins_ahead_of_the_car_does(law: str) -> None:
    world = arc(0.0, 0.0, 0.0, 1 / 1.2, 6.0)
    control = ControlConfig(controller=law)
    run = drive(world, control=control, seconds=4.0, start=SE2(0.0, 0.05, 0.0), behind_m=-0.25)
    assert np.abs(run.after(3.0)).max() <= REST_M
