"""The limits that every command passes last, before the wire: pure functions of the previous command and the time."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from automodel.config import SafetyConfig, VehicleConfig
from automodel.control.vehicle_model import curvature_per_m, steering_rad
from automodel.signals import Command, Motion

MAX_STEP_S = 0.1  # a longer gap allows no larger step, because the car's motion in it is not known
_STILL_MPS = 1e-3  # below this speed lateral acceleration does not limit the steering

NON_FINITE = "non_finite"
SPEED = "speed"
STEERING = "steering"
STEERING_RATE = "steering_rate"
LATERAL_ACCEL = "lateral_accel"
LATERAL_JERK = "lateral_jerk"


@dataclass(frozen=True, slots=True, kw_only=True)
class LimitResult:
    """A command within all limits, and the names of the limits that changed it."""

    command: Command
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Before:
    """The previous command: steering [rad] and speed [m/s] on the wire, and the time since [s].

    `measured_mps` is the car's measured speed, None where it is not known.
    """

    steering_rad: float = 0.0
    speed_mps: float = 0.0
    dt_s: float = 0.0
    measured_mps: float | None = None


def limit(command: Command, before: Before, safety: SafetyConfig, vehicle: VehicleConfig) -> LimitResult:
    """The nearest command within all limits.

    Speed comes first: |v| <= speed_max. Then the steering, at the largest of the speeds commanded, commanded before and
    measured, because a car does not slow down at once: with kappa = tan(delta) / L,

        |delta| <= steering_max                     |kappa| v^2 <= lateral_accel_max
        |delta - before| <= steering_rate_max dt    |kappa - before| v^2 <= lateral_jerk_max dt

    Where a bend is too sharp for the speed, the steering is reduced: a car that runs wide can still be stopped, one
    that tips or slides cannot. Where the steering rate does not allow that, the speed is reduced. The jerk is the part
    due to steering. A lower speed is always allowed at once, so that a stop is never delayed. A value that is not
    finite gives straight and neutral at once, already expired, so that it keeps no timer alive.
    """
    numbers = (command.steering_rad, command.speed_mps, before.steering_rad, before.speed_mps, before.dt_s)
    measured = before.measured_mps
    if not all(map(math.isfinite, numbers)) or (measured is not None and not math.isfinite(measured)):
        neutral = Command(t_ns=command.t_ns, steering_rad=0.0, speed_mps=0.0, valid_until_ns=command.t_ns)
        return LimitResult(command=neutral, reasons=(NON_FINITE,))
    reasons: list[str] = []
    speed = _clipped(command.speed_mps, safety.speed_max_mps, SPEED, reasons)
    fastest = max(abs(speed), abs(before.speed_mps), abs(measured or 0.0))
    steering = _steering(command.steering_rad, fastest, before, safety, vehicle, reasons)
    speed_max = _speed_in_bend(steering, safety, vehicle)
    if abs(speed) > speed_max:
        speed = math.copysign(speed_max, speed)
        if LATERAL_ACCEL not in reasons:
            reasons.append(LATERAL_ACCEL)
    limited = Command(t_ns=command.t_ns, steering_rad=steering, speed_mps=speed, valid_until_ns=command.valid_until_ns)
    return LimitResult(command=limited, reasons=tuple(reasons))


def _clipped(value: float, limit: float, reason: str, reasons: list[str]) -> float:
    if abs(value) <= limit:
        return value
    reasons.append(reason)
    return math.copysign(limit, value)


def _steering(
    requested: float, speed: float, before: Before, safety: SafetyConfig, vehicle: VehicleConfig, reasons: list[str]
) -> float:
    wheelbase = vehicle.wheelbase_m
    steering = _clipped(requested, safety.steering_max_rad, STEERING, reasons)
    squared = speed * speed
    if speed > _STILL_MPS:
        steepest = steering_rad(safety.lateral_accel_max_mps2 / squared, wheelbase)
        steering = _clipped(steering, steepest, LATERAL_ACCEL, reasons)
    start = min(max(before.steering_rad, -safety.steering_max_rad), safety.steering_max_rad)
    dt = min(max(before.dt_s, 0.0), MAX_STEP_S)
    if abs(steering - start) > safety.steering_rate_max_radps * dt:
        steering = start + math.copysign(safety.steering_rate_max_radps * dt, steering - start)
        reasons.append(STEERING_RATE)
    if speed > _STILL_MPS:
        kappa = curvature_per_m(start, wheelbase)
        change = curvature_per_m(steering, wheelbase) - kappa
        if abs(change) * squared > safety.lateral_jerk_max_mps3 * dt:
            change = math.copysign(safety.lateral_jerk_max_mps3 * dt / squared, change)
            steering = steering_rad(kappa + change, wheelbase)
            reasons.append(LATERAL_JERK)
    return steering


def _speed_in_bend(steering: float, safety: SafetyConfig, vehicle: VehicleConfig) -> float:
    kappa = abs(curvature_per_m(steering, vehicle.wheelbase_m))
    return math.sqrt(safety.lateral_accel_max_mps2 / kappa) if kappa > 1e-12 else math.inf


class Limits:
    """`limit` with a memory of the previous command; the first command starts from straight and neutral."""

    def __init__(self, safety: SafetyConfig, vehicle: VehicleConfig) -> None:
        self._safety, self._vehicle = safety, vehicle
        self._sent: Command | None = None

    def step(self, command: Command, motion: Motion, t_ns: int) -> LimitResult:
        """The nearest command within all limits at `t_ns`."""
        sent = self._sent
        result = limit(
            command,
            Before(
                steering_rad=0.0 if sent is None else sent.steering_rad,
                speed_mps=0.0 if sent is None else sent.speed_mps,
                dt_s=0.0 if sent is None else (t_ns - sent.t_ns) * 1e-9,
                measured_mps=motion.speed_mps if motion.known else None,
            ),
            self._safety,
            self._vehicle,
        )
        self.reset(result.command, t_ns)
        return result

    def reset(self, sent: Command | None = None, t_ns: int | None = None) -> None:
        """Forget all but `sent`, the command on the wire since `t_ns` (its own time where None)."""
        if sent is not None and t_ns is not None and t_ns != sent.t_ns:
            sent = replace(sent, t_ns=t_ns)
        self._sent = sent
