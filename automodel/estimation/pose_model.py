"""The model behind the lane-pose filter: how the pose changes with the car's motion, and what is measured of it.

Cudrano et al. 2020, eq. (22)-(25). State (theta, rho, w): the centerline's direction seen from the car [rad], the car's
offset in half lane widths (left positive), the lane's width [m]. Measured are the points P_L, P_R in which the lane's
lines meet the perpendicular to the centerline through the reference point.

The paper's state is a random walk, which lags in every turn. Here the car's motion is the control: relative to the foot
of the perpendicular the reference point goes from (0, d) to (X, Y), and on a centerline of curvature kappa

    d'     = (2 Y - kappa (X^2 + Y^2)) / (1 + h),   h = |(kappa X, 1 - kappa Y)|
    theta' = theta + atan2(kappa X, 1 - kappa Y) - dpsi

which is exact on arcs and has no exception for the straight.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from automodel.geometry.se2 import wrap_angle
from automodel.types import FloatArray

_LEAST_RADIUS = 0.05  # of the centerline's: nearer to its centre of curvature the Jacobian is cut off


class State(IntEnum):
    """Places in the state's vector."""

    THETA = 0  # [rad]
    RHO = 1  # [half lane widths]
    WIDTH = 2  # [m]


def expectation(state: FloatArray, reference_x_m: float) -> tuple[FloatArray, FloatArray]:
    """h (5,), eq. (25), and its Jacobian (5, 3): P_L and P_R in the body frame, and the centerline's direction."""
    theta, rho, width = (float(value) for value in state)
    cos, sin, half = math.cos(theta), math.sin(theta), 0.5 * width
    left, right = 0.5 * (1.0 - rho), 0.5 * (1.0 + rho)  # [lane widths]
    a, b = width * left, width * right
    h = np.array((reference_x_m - a * sin, a * cos, reference_x_m + b * sin, -b * cos, theta))
    jacobian = np.array(
        (
            (-a * cos, half * sin, -left * sin),
            (-a * sin, -half * cos, left * cos),
            (b * cos, half * sin, right * sin),
            (b * sin, -half * cos, -right * cos),
            (1.0, 0.0, 0.0),
        )
    )
    return h, jacobian


def carried(
    state: FloatArray, shift_m: tuple[float, float], turn_rad: float, kappa_per_m: float
) -> tuple[FloatArray, FloatArray]:
    """State (3,) after a motion, and its Jacobian (3, 3).

    `shift_m` is the reference point's way in the body frame before the motion, `turn_rad` the body's turn.
    """
    theta, rho, width = (float(value) for value in state)
    cos, sin, kappa = math.cos(theta), math.sin(theta), kappa_per_m
    along, aside = shift_m[0] * cos + shift_m[1] * sin, shift_m[1] * cos - shift_m[0] * sin
    y = 0.5 * rho * width + aside
    u, v = 1.0 - kappa * y, kappa * along
    h = max(math.hypot(u, v), _LEAST_RADIUS)
    offset = (2.0 * y - kappa * (along * along + y * y)) / (1.0 + h)
    turned = math.atan2(v, u)
    offset_along, offset_aside = -v / h, u / h
    turned_along, turned_aside = kappa * u / (h * h), kappa * v / (h * h)
    jacobian = np.array(
        (
            (1.0 + turned_along * aside - turned_aside * along, 0.5 * width * turned_aside, 0.5 * rho * turned_aside),
            (
                2.0 / width * (offset_along * aside - offset_aside * along),
                offset_aside,
                rho / width * offset_aside - 2.0 * offset / width**2,
            ),
            (0.0, 0.0, 1.0),
        )
    )
    return np.array((wrap_angle(theta + turned - turn_rad), 2.0 * offset / width, width)), jacobian
