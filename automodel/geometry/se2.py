"""Rigid motions of the plane."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from automodel.types import FloatArray


@dataclass(frozen=True, slots=True)
class SE2:
    """A pose or a transform `a_from_b`: rotate by `yaw_rad`, then translate by (x_m, y_m).

    Names cancel: `world_from_body @ body_from_lane` is world_from_lane, `world_from_body.apply(p_body)` is p_world.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0

    def __matmul__(self, other: SE2) -> SE2:
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return SE2(
            self.x_m + cos * other.x_m - sin * other.y_m,
            self.y_m + sin * other.x_m + cos * other.y_m,
            self.yaw_rad + other.yaw_rad,
        )

    def inverse(self) -> SE2:
        """The transform back: `t @ t.inverse()` is the identity."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return SE2(-cos * self.x_m - sin * self.y_m, sin * self.x_m - cos * self.y_m, -self.yaw_rad)

    def apply(self, points_m: ArrayLike) -> FloatArray:
        """Points (..., 2) [m] of frame b in frame a."""
        points = np.asarray(points_m, dtype=np.float64)
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        x, y = points[..., 0], points[..., 1]
        return np.stack((self.x_m + cos * x - sin * y, self.y_m + sin * x + cos * y), axis=-1)

    @staticmethod
    def arc(distance_m: float, turn_rad: float) -> SE2:
        """`before_from_after` of a motion along a circular arc: the exponential map of (distance, 0, turn)."""
        half = 0.5 * turn_rad
        chord = distance_m * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
        return SE2(chord * math.cos(half), chord * math.sin(half), turn_rad)


def wrap_angle(angle_rad: float) -> float:
    """The same angle [rad] in -pi .. pi."""
    return math.remainder(angle_rad, 2.0 * math.pi)
