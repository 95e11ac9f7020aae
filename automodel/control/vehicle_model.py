"""The kinematic bicycle: wheels roll without slip, the reference is the rear axle's centre.

With L the wheelbase, delta the road-wheel angle, kappa the curvature of the rear axle's path, v its speed and r the yaw
rate (Rajamani 2012, section 2.2, with the reference at the rear axle):

    kappa = tan(delta) / L        r = v kappa        x' = v cos(psi)   y' = v sin(psi)   psi' = r

Left and anticlockwise are positive throughout.
"""

from __future__ import annotations

import math

from automodel.geometry.se2 import SE2


def curvature_per_m(steering_rad: float, wheelbase_m: float) -> float:
    """Curvature [1/m] of the rear axle's path: tan(delta) / L."""
    return math.tan(steering_rad) / wheelbase_m


def steering_rad(curvature_per_m: float, wheelbase_m: float) -> float:
    """Road-wheel angle [rad] that drives a curvature: atan(L kappa)."""
    return math.atan(wheelbase_m * curvature_per_m)


def yaw_rate_radps(speed_mps: float, steering_rad: float, wheelbase_m: float) -> float:
    """Yaw rate [rad/s]: v tan(delta) / L."""
    return speed_mps * curvature_per_m(steering_rad, wheelbase_m)


def arc_motion(speed_mps: float, steering_rad: float, wheelbase_m: float, duration_s: float) -> SE2:
    """`before_from_after` of a motion at constant speed and steering: an arc of length v t that turns by v t kappa."""
    distance_m = speed_mps * duration_s
    return SE2.arc(distance_m, distance_m * curvature_per_m(steering_rad, wheelbase_m))


def rear_offset_m(curvature_per_m: float, reference_x_m: float) -> float:
    """Offset [m] of the rear axle from the circle of the point `reference_x_m` ahead of it, left positive.

    The radius R of the reference point, that of the rear axle and the distance l between them make a right triangle:
    the rear axle is R - sqrt(R^2 - l^2) nearer to the centre, (1 - sqrt(1 - (kappa l)^2)) / kappa to the left.
    """
    bend = min(abs(curvature_per_m * reference_x_m), 1.0)
    # (1 - root) / kappa = kappa l^2 / (1 + root), which is defined on a straight, too
    return curvature_per_m * reference_x_m**2 / (1.0 + math.sqrt(1.0 - bend * bend))
