"""Lanes given by their curvature over arc length, added up by brute force: truth that shares no code with the fit."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from automodel.geometry import SE2


class WorldLane:
    """A centerline from s = 0 at the world's origin, heading along x."""

    def __init__(self, curvature: Callable[[np.ndarray], np.ndarray], length_m: float, width_m: float) -> None:
        self.curvature, self.width_m = curvature, width_m
        count = 20_000
        step = length_m / count
        self._s = np.arange(count + 1) * step
        turns = curvature(self._s[:-1] + 0.5 * step) * step
        self._theta = np.concatenate(([0.0], np.cumsum(turns)))
        middle = 0.5 * (self._theta[1:] + self._theta[:-1])
        self._x = np.concatenate(([0.0], np.cumsum(np.cos(middle) * step)))
        self._y = np.concatenate(([0.0], np.cumsum(np.sin(middle) * step)))

    def theta(self, s_m: ArrayLike) -> np.ndarray:
        return np.interp(np.asarray(s_m, dtype=np.float64), self._s, self._theta)

    def beside(self, s_m: ArrayLike, lateral_m: float) -> np.ndarray:
        theta = self.theta(s_m)
        s_m = np.asarray(s_m, dtype=np.float64)
        x, y = np.interp(s_m, self._s, self._x), np.interp(s_m, self._s, self._y)
        return np.stack((x - lateral_m * np.sin(theta), y + lateral_m * np.cos(theta)), axis=-1)

    def car(self, s_m: float, offset_m: float, heading_rad: float, reference_x_m: float) -> SE2:
        """`world_from_body` of a car whose reference point has this pose in the lane."""
        yaw = float(self.theta(s_m)) + heading_rad
        x, y = self.beside(s_m, offset_m)
        return SE2(float(x) - reference_x_m * math.cos(yaw), float(y) - reference_x_m * math.sin(yaw), yaw)

    def pose_of(self, car: SE2, reference_x_m: float) -> tuple[float, float, float]:
        """(s, offset, heading) of a car, by search and the foot's definition."""
        x = car.x_m + reference_x_m * math.cos(car.yaw_rad)
        y = car.y_m + reference_x_m * math.sin(car.yaw_rad)
        s = float(self._s[np.argmin((self._x - x) ** 2 + (self._y - y) ** 2)])
        theta = float(self.theta(s))
        px, py = self.beside(s, 0.0)
        offset = float(-(x - px) * math.sin(theta) + (y - py) * math.cos(theta))
        return s, offset, car.yaw_rad - theta

    def seen_from(self, car: SE2, s_m: ArrayLike, side: int) -> np.ndarray:
        """Points (n, 2) of the left (+1) or right (-1) line, body frame."""
        return car.inverse().apply(self.beside(s_m, side * 0.5 * self.width_m))


def arc(curvature_per_m: float, length_m: float = 10.0, width_m: float = 0.4) -> WorldLane:
    return WorldLane(lambda s: np.full(np.shape(s), curvature_per_m), length_m, width_m)
