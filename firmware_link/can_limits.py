"""The last limits before a full-size car's bus: pure functions of the request, the state and the time since the last.

ISO 11270:2014 (lane keeping assistance) bounds what the system may do to the car: 3 m/s^2 of lateral acceleration and
5 m/s^3 of lateral jerk. The acceleration of a steering angle is that of the kinematic bicycle, v^2 tan(delta) / L,
which a car that understeers does not reach.
"""

from __future__ import annotations

import math

LATERAL_ACCEL_MAX_MPS2 = 3.0  # ISO 11270:2014
LATERAL_JERK_MAX_MPS3 = 5.0  # likewise
# g sin of 0.06 rad, an ordinary road's bank (as in commaai/opendbc): it adds to or takes from what the driver feels, so
# that much is left free; without it a turn against the bank would exceed the standard's bound
BANK_TOLERANCE_MPS2 = 0.59
STEERING_RATE_MAX_RADPS = 0.6  # of the road wheels: half a turn of a steering wheel in 0.3 s; above 10 m/s jerk binds
STEERING_MAX_RAD = 0.6  # a passenger car's lock
# Of the asked acceleration, up and down: full braking is there after 0.7 s, 0.5 s for the planner's 2.5 m/s^2, which
# `[control] speed_delay_s` allows for. A smaller one brakes later, a larger one passes the noise of the wanted speed on
ACCEL_JERK_MAX_MPS3 = 5.0
DT_MAX_S = 0.04  # two periods: a loop that was late does not jump by what it missed


def lateral_accel_mps2(steering_rad: float, speed_mps: float, wheelbase_m: float) -> float:
    """Lateral acceleration [m/s^2] of a road-wheel angle [rad] at a speed [m/s]."""
    return speed_mps * speed_mps * math.tan(steering_rad) / wheelbase_m


def limited_steering_rad(
    requested_rad: float, before_rad: float, speed_mps: float, dt_s: float, wheelbase_m: float
) -> float:
    """The road-wheel angle nearest to the request that may follow `before_rad` after `dt_s` at the measured speed.

    Angle rate and jerk bound the change; the acceleration bounds the result, whatever the change. A request that is
    not finite keeps the angle.
    """
    if not math.isfinite(requested_rad):
        requested_rad = before_rad
    dt_s = min(max(dt_s, 0.0), DT_MAX_S)
    rate_step = STEERING_RATE_MAX_RADPS * dt_s
    steering = _clipped(requested_rad, before_rad - rate_step, before_rad + rate_step)
    squared = speed_mps * speed_mps
    if squared > 0.0:
        tangent_step = LATERAL_JERK_MAX_MPS3 * dt_s * wheelbase_m / squared
        tangent = math.tan(_clipped(before_rad, -STEERING_MAX_RAD, STEERING_MAX_RAD))
        steering = _clipped(steering, math.atan(tangent - tangent_step), math.atan(tangent + tangent_step))
    most = steering_max_rad(speed_mps, wheelbase_m)
    return _clipped(steering, -most, most)


def steering_max_rad(speed_mps: float, wheelbase_m: float) -> float:
    """The largest road-wheel angle [rad] at a speed: by lateral acceleration less the bank's share, or the lock."""
    squared = speed_mps * speed_mps
    if squared * math.tan(STEERING_MAX_RAD) <= (LATERAL_ACCEL_MAX_MPS2 - BANK_TOLERANCE_MPS2) * wheelbase_m:
        return STEERING_MAX_RAD
    return math.atan((LATERAL_ACCEL_MAX_MPS2 - BANK_TOLERANCE_MPS2) * wheelbase_m / squared)


def acceleration_mps2(
    wanted_mps: float,
    measured_mps: float,
    gain_per_s: float,
    accel_max_mps2: float,
    decel_max_mps2: float,
    wanted_mps2: float = 0.0,
) -> float:
    """The acceleration [m/s^2] that brings the car to the wanted speed; a speed that is not finite brakes.

    `wanted_mps2` is that of the wanted speed itself: a car that only made good what is missing would trail a ramp by
    its rate over the gain.
    """
    if not (math.isfinite(wanted_mps) and math.isfinite(wanted_mps2)):
        return -decel_max_mps2
    return _clipped(wanted_mps2 + gain_per_s * (wanted_mps - measured_mps), -decel_max_mps2, accel_max_mps2)


def limited_acceleration_mps2(requested_mps2: float, before_mps2: float, dt_s: float) -> float:
    """The acceleration [m/s^2] nearest to the request that may follow `before_mps2` after `dt_s`; it must be finite."""
    step = ACCEL_JERK_MAX_MPS3 * min(max(dt_s, 0.0), DT_MAX_S)
    return _clipped(requested_mps2, before_mps2 - step, before_mps2 + step)


def limited_torque_nm(
    requested_nm: float, before_nm: float, dt_s: float, torque_max_nm: float, rate_max_nmps: float
) -> float:
    """The steering torque [Nm] nearest to the request that may follow `before_nm`; one that is not finite goes to 0."""
    if not math.isfinite(requested_nm):
        requested_nm = 0.0
    step = rate_max_nmps * min(max(dt_s, 0.0), DT_MAX_S)
    return _clipped(_clipped(requested_nm, before_nm - step, before_nm + step), -torque_max_nm, torque_max_nm)


def _clipped(value: float, lowest: float, highest: float) -> float:
    return min(max(value, lowest), highest)
