"""The foot of the perpendicular from a point to a curve: the arc length s at which (p - c(s)) . t(s) = 0.

Seen along the tangent at s the point lies `ahead` and `left`. A move along the curve changes `ahead` by
-(1 - kappa left) per metre, so Newton's method steps by ahead / (1 - kappa left) (Cudrano et al. 2020, eq. (18)).
Every foot is found here: in closed form on a circle, by Newton's method on a curve, by its first step from a sample.
Signed distances are positive to the left of the curve.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from automodel.types import FloatArray, Ints

LEAST_STRETCH = 0.2  # least 1 - kappa left that a step is divided by: it is 0 at the centre of curvature
_STRAIGHT = 1e-9  # [1/m] curvature of a circle that counts as a line

Place = Callable[[float], tuple[float, float, float, float, float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """Settings of `newton_foot`; it ends when the point is less than `ahead_m` ahead or a step below `step_m`."""

    ahead_m: float = 0.0
    step_m: float = 0.0
    reach_m: float = math.inf  # longest step
    least_stretch: float = LEAST_STRETCH
    rounds: int = 12


def newton_foot(
    place: Place,
    point_m: tuple[float, float],
    start_m: float,
    search: Search,
    bounds_m: tuple[float, float] = (-math.inf, math.inf),
) -> tuple[float, float]:
    """Arc length of a point's foot and the point's distance [m], by Newton's method from `start_m` within the bounds.

    `place(s)` gives the curve's x, y [m], the cosine and sine of its heading, and its curvature [1/m]. A step that
    leaves the interval in which `ahead` changes sign is replaced by bisection. Always finite, also where there is no
    foot because the point lies beyond the centre of curvature.
    """
    s, left, (low, high) = start_m, 0.0, bounds_m
    for _ in range(search.rounds):
        x, y, cos, sin, kappa = place(s)
        step, ahead, left = newton_step(point_m[0] - x, point_m[1] - y, cos, sin, kappa, search.least_stretch)
        step = min(max(step, -search.reach_m), search.reach_m)
        if abs(ahead) < search.ahead_m or abs(step) < search.step_m:
            break
        if ahead > 0.0:
            low = s
        else:
            high = s
        s = s + step if low < s + step < high or high - low == math.inf else 0.5 * (low + high)
    else:
        x, y, cos, sin, _ = place(s)
        left = (point_m[1] - y) * cos - (point_m[0] - x) * sin
    return s, left


def newton_step(
    dx: float, dy: float, cos: float, sin: float, curvature_per_m: float, least_stretch: float = LEAST_STRETCH
) -> tuple[float, float, float]:
    """The step along the curve towards the foot, and how far ahead and left the point lies [m].

    (dx, dy) [m] leads from a place on the curve to the point; (cos, sin) is the tangent there.
    """
    ahead, left = dx * cos + dy * sin, dy * cos - dx * sin
    return ahead / max(1.0 - curvature_per_m * left, least_stretch), ahead, left


def newton_steps(
    away_m: FloatArray, heading_rad: FloatArray, curvature_per_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """`newton_step` for many points: steps along the curve and distances to the left (n,) [m].

    `away_m` (n, 2) leads from places on the curve to the points; heading [rad] and curvature (n,) are those there.
    """
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    ahead = away_m[:, 0] * cos + away_m[:, 1] * sin
    left = away_m[:, 1] * cos - away_m[:, 0] * sin
    return ahead / np.maximum(1.0 - curvature_per_m * left, LEAST_STRETCH), left


def nearest_samples(samples_m: FloatArray, points_m: FloatArray) -> Ints:
    """Index (n,) of the sample (k, 2) nearest to each point (n, 2): where the search for its foot starts."""
    dx, dy = points_m[:, 0, None] - samples_m[:, 0], points_m[:, 1, None] - samples_m[:, 1]
    return np.argmin(dx * dx + dy * dy, axis=1)


def foot_on_circle(
    ahead_m: float, left_m: float, curvature_per_m: float, least_stretch: float = -math.inf
) -> tuple[float, float]:
    """Distance along an arc to the foot of a point's perpendicular, and the point's distance to the left of it [m].

    The point lies `ahead_m` and `left_m` of the arc's start, in its direction there. Finite for any curvature; the foot
    is unique short of the circle's centre.
    """
    a, b = curvature_per_m * ahead_m, max(1.0 - curvature_per_m * left_m, least_stretch)
    along = math.atan2(a, b) / curvature_per_m if abs(curvature_per_m) > _STRAIGHT else ahead_m
    square = left_m * left_m + ahead_m * ahead_m
    return along, (2.0 * left_m - curvature_per_m * square) / (1.0 + math.hypot(a, b))
