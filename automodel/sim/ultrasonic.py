"""Three HC-SR04 ultrasonic sensors on the front bumper of the simulated car."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from automodel.sim.plant import CarState, Ranges

MAX_M = 4.0
MIN_M = 0.02
CONE_HALF_RAD = math.radians(15.0)
MOUNT_YAWS_RAD = (math.radians(30.0), 0.0, math.radians(-30.0))  # left, centre, right

Segment = tuple[float, float, float, float]  # x0, y0, x1, y1 [m]


class UltrasonicRanges:
    """Ranges (left, centre, right) [m] to convex obstacles, each (n, 2) [m] in the world; None without an echo.

    A sensor hears the nearest point within its cone, 15 deg to each side. All three sit at `bumper_x_m` ahead of the
    rear axle, the outer two `spacing_m` to the sides. What is nearer than 0.02 m reads as 0.02 m.
    Whatever lies behind the nearest point cannot be heard, so that hiding needs no care.
    """

    def __init__(self, obstacles_m: Sequence[ArrayLike], bumper_x_m: float, spacing_m: float = 0.06) -> None:
        self._obstacles = tuple(_closed(obstacle) for obstacle in obstacles_m)
        self._mounts = tuple(
            (bumper_x_m, y_m, yaw_rad)
            for y_m, yaw_rad in zip((spacing_m, 0.0, -spacing_m), MOUNT_YAWS_RAD, strict=True)
        )

    def __call__(self, car: CarState) -> Ranges:
        """What the sensors of a car in this state read."""
        left, centre, right = (self._range(car, *mount) for mount in self._mounts)
        return left, centre, right

    def _range(self, car: CarState, x_m: float, y_m: float, yaw_rad: float) -> float | None:
        cos, sin = math.cos(car.yaw_rad), math.sin(car.yaw_rad)
        x = car.x_m + cos * x_m - sin * y_m
        y = car.y_m + sin * x_m + cos * y_m
        cos, sin = math.cos(car.yaw_rad + yaw_rad), math.sin(car.yaw_rad + yaw_rad)
        nearest = math.inf
        for obstacle in self._obstacles:
            if _holds(obstacle, x, y):
                return MIN_M
            for x0, y0, x1, y1 in obstacle:
                dx0, dy0, dx1, dy1 = x0 - x, y0 - y, x1 - x, y1 - y
                segment = (
                    cos * dx0 + sin * dy0,
                    cos * dy0 - sin * dx0,
                    cos * dx1 + sin * dy1,
                    cos * dy1 - sin * dx1,
                )
                nearest = min(nearest, distance_in_cone(segment, CONE_HALF_RAD))
        return max(nearest, MIN_M) if nearest <= MAX_M else None


def distance_in_cone(segment: Segment, half_rad: float) -> float:
    """Distance [m] from the origin to a segment's part in the cone |angle| <= `half_rad` about x; inf where none is."""
    x0, y0, x1, y1 = segment
    cos, sin = math.cos(half_rad), math.sin(half_rad)
    low, high = 0.0, 1.0
    for side in (1.0, -1.0):  # a point is in the cone where x sin -+ y cos >= 0 on both sides
        begin, end = x0 * sin - side * y0 * cos, x1 * sin - side * y1 * cos
        if begin < 0 and end < 0:
            return math.inf
        if begin < 0:
            low = max(low, begin / (begin - end))
        elif end < 0:
            high = min(high, begin / (begin - end))
    if low > high:
        return math.inf
    dx, dy = x1 - x0, y1 - y0
    length2 = dx * dx + dy * dy
    foot = -(x0 * dx + y0 * dy) / length2 if length2 > 0 else 0.0
    share = min(max(foot, low), high)
    return math.hypot(x0 + share * dx, y0 + share * dy)


def _closed(obstacle_m: ArrayLike) -> tuple[Segment, ...]:
    corners = np.asarray(obstacle_m, dtype=np.float64)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
        raise ValueError(f"obstacles_m: shape {corners.shape} where (n >= 3, 2) is wanted")
    if not np.isfinite(corners).all():
        raise ValueError("obstacles_m: must be finite")
    points: list[tuple[float, float]] = [(float(x), float(y)) for x, y in corners]
    return tuple((*begin, *end) for begin, end in pairwise([*points, points[0]]))


def _holds(obstacle: tuple[Segment, ...], x: float, y: float) -> bool:
    sides = [(x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) for x0, y0, x1, y1 in obstacle]
    return all(side > 0 for side in sides) or all(side < 0 for side in sides)
