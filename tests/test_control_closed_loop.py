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
    speed_mps: float,
    car: CarConfig | None = None,
    plant_config: PlantConfig | None = None,
    servo_frames: bool = False,
    behind_m: float = 0.1,
) -> Drive:
    """Drive along `world`; the car is pushed to `speed_mps` and then let go at `start`, on the curve's beginning."""
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
