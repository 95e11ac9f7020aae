"""Where a road crosses itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from automodel.curves import Curve
from automodel.types import FloatArray

_MAX_SAMPLES = 1000


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadCrossing:
    """Two passes of one road over the same ground.

    `s_first_m` < `s_second_m` are their arc lengths [m] on the reference line, `angle_rad` is the angle between the
    two lines, 0 .. pi/2.
    """

    s_first_m: float
    s_second_m: float
    angle_rad: float


def find_crossings(road: Curve, step_m: float) -> tuple[RoadCrossing, ...]:
    """The places where the reference line crosses itself, found on chords of about `step_m`, exact afterwards."""
    count = min(max(int(np.ceil(road.length_m / step_m)), 8), _MAX_SAMPLES)
    s = np.linspace(0.0, road.length_m, count + 1)
    points = road.position(s)
    first, second = _crossing_chords(points, road.closed)
    found: list[RoadCrossing] = []
    for i, j in zip(first, second, strict=True):
        crossing = _refine(road, 0.5 * (s[i] + s[i + 1]), 0.5 * (s[j] + s[j + 1]))
        if not any(abs(crossing.s_first_m - other.s_first_m) < step_m for other in found):
            found.append(crossing)
    return tuple(sorted(found, key=lambda c: c.s_first_m))


def _crossing_chords(points: FloatArray, closed: bool) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Index pairs i < j of the chords that cross, neighbours left out."""
    start, along = points[:-1], np.diff(points, axis=0)
    first, second = np.triu_indices(len(start), 2)
    if closed:
        apart = (first > 0) | (second < len(start) - 1)
        first, second = first[apart], second[apart]
    between = start[second] - start[first]
    a, b = along[first], along[second]
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    crosses = np.abs(cross) > 1e-3 * np.hypot(a[:, 0], a[:, 1]) * np.hypot(b[:, 0], b[:, 1])  # not parallel
    safe = np.where(crosses, cross, np.inf)
    u = (between[:, 0] * b[:, 1] - between[:, 1] * b[:, 0]) / safe
    v = (between[:, 0] * a[:, 1] - between[:, 1] * a[:, 0]) / safe
    hit = crosses & (u >= 0.0) & (u < 1.0) & (v >= 0.0) & (v < 1.0)
    return first[hit], second[hit]


def _refine(road: Curve, s_first: float, s_second: float) -> RoadCrossing:
    s = np.array([s_first, s_second])
    for _ in range(8):
        (a, b), theta = road.position(s), road.heading(s)
        tangents = np.array([[np.cos(theta[0]), -np.cos(theta[1])], [np.sin(theta[0]), -np.sin(theta[1])]])
        s = s + np.linalg.solve(tangents, b - a)
    s = np.sort(s % road.length_m if road.closed else s)
    turn = float(np.diff(road.heading(s))[0])
    return RoadCrossing(
        s_first_m=float(s[0]), s_second_m=float(s[1]), angle_rad=float(np.arcsin(min(abs(np.sin(turn)), 1.0)))
    )


def distance_beside(curve: Curve, points_m: ArrayLike, near_s_m: float) -> FloatArray:
    """Signed distance d (n,) [m], left positive, of points (n, 2) from the stretch of a curve around `near_s_m`."""
    points = np.asarray(points_m, dtype=np.float64)
    s = np.full(len(points), near_s_m)
    for _ in range(6):  # Newton for all points at once: they lie within a road's width of the stretch
        theta, away = curve.heading(s), points - curve.position(s)
        ahead = away[:, 0] * np.cos(theta) + away[:, 1] * np.sin(theta)
        left = away[:, 1] * np.cos(theta) - away[:, 0] * np.sin(theta)
        s = s + ahead / np.maximum(1.0 - curve.curvature(s) * left, 0.2)
    theta, away = curve.heading(s), points - curve.position(s)
    return np.asarray(away[:, 1] * np.cos(theta) - away[:, 0] * np.sin(theta))
