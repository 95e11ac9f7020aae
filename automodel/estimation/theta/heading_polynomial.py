"""A line as a cubic theta(s) beside the car: positions, feet of perpendiculars, and the change of origin.

Cudrano et al. 2020, eq. (3), (18)-(21). The origin s = 0 is the foot of the perpendicular from the car's reference
point, so that one number gives the line's place, its distance to the left: the line passes through
q + lateral n(theta(0)). theta is the cubic within the fitted range (`s_min_m` .. `s_max_m`) and an arc beyond it,
because a cubic runs away where no points hold it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from automodel.curves import DeferredCurve
from automodel.curves.foot import Search, newton_foot
from automodel.curves.sampled import Table, beside
from automodel.geometry import SE2
from automodel.types import FloatArray

ORDER = 4  # coefficients of the cubic
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)
_PLACES, _SHARES = 0.5 + 0.5 * _NODES, 0.5 * _WEIGHTS  # Gauss-Legendre quadrature on 0 .. 1
_PANEL = tuple(zip(_PLACES.tolist(), _SHARES.tolist(), strict=True))
_PANEL_SCALES = 0.2  # [scales] length of a quadrature panel; good to a nanometre per metre
_END_SCALES = 0.25  # [scales] the arc beyond an end has the mean curvature of this length before it
_ROUNDS, _TOLERANCE = 12, 1e-8  # of Newton's method: iterations, least step [scales]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HeadingPolynomial:
    """theta(s) = sum_k w_k (s / scale)^k, lowest power first, in the body frame.

    `lateral_m`: distance of the line to the left of the reference point `reference_m` (x, y), along the normal at
    s = 0. `max_curvature_per_m` bounds the arcs beyond the ends. The far arc is at most `arc_ahead_m` long; beyond it
    the line is straight, as roads are across a crossing.
    """

    coefficients_rad: tuple[float, float, float, float]
    scale_m: float
    reference_m: tuple[float, float]
    lateral_m: float
    s_min_m: float
    s_max_m: float
    max_curvature_per_m: float
    arc_ahead_m: float = math.inf
    _behind: float = field(init=False, repr=False)
    _ahead: float = field(init=False, repr=False)

    def __post_init__(self) -> None:
        span = min(_END_SCALES * self.scale_m, 0.5 * (self.s_max_m - self.s_min_m))
        low, high = self.s_min_m, self.s_max_m
        object.__setattr__(self, "_behind", self._mean_curvature(low, low + span))
        object.__setattr__(self, "_ahead", self._mean_curvature(high - span, high))

    def heading(self, s_m: ArrayLike) -> FloatArray:
        """Direction (...,) [rad] at s."""
        s = np.asarray(s_m, dtype=np.float64)
        inside = np.minimum(np.maximum(s, self.s_min_m), self.s_max_m)
        u = inside / self.scale_m
        w0, w1, w2, w3 = self.coefficients_rad
        beyond = np.minimum(s - inside, self.arc_ahead_m)
        return np.asarray(w0 + u * (w1 + u * (w2 + u * w3)) + beyond * np.where(beyond > 0, self._ahead, self._behind))

    def curvature(self, s_m: ArrayLike) -> FloatArray:
        """Curvature (...,) [1/m] at s."""
        s = np.asarray(s_m, dtype=np.float64)
        u = s / self.scale_m
        _, w1, w2, w3 = self.coefficients_rad
        kappa = (w1 + u * (2.0 * w2 + u * (3.0 * w3))) / self.scale_m
        kappa = np.where(s < self.s_min_m, self._behind, np.where(s > self.s_max_m, self._ahead, kappa))
        return np.where(s > self.s_max_m + self.arc_ahead_m, 0.0, kappa)

    def heading_at(self, s_m: float) -> float:
        """Direction [rad] at one s; faster than `heading`."""
        if s_m > self.s_max_m:
            return self._cubic(self.s_max_m) + min(s_m - self.s_max_m, self.arc_ahead_m) * self._ahead
        if s_m < self.s_min_m:
            return self._cubic(self.s_min_m) + (s_m - self.s_min_m) * self._behind
        return self._cubic(s_m)

    def curvature_at(self, s_m: float) -> float:
        """Curvature [1/m] at one s."""
        if s_m > self.s_max_m:
            return self._ahead if s_m <= self.s_max_m + self.arc_ahead_m else 0.0
        if s_m < self.s_min_m:
            return self._behind
        u = s_m / self.scale_m
        _, w1, w2, w3 = self.coefficients_rad
        return (w1 + u * (2.0 * w2 + u * (3.0 * w3))) / self.scale_m

    def points(self, s_m: FloatArray) -> FloatArray:
        """Positions (n, 2) [m] at s (n,), n >= 1: eq. (19), by quadrature between consecutive s.

        Good to a micrometre where the line turns by less than half a radian per step, to some hundredths of a
        millimetre where a step passes an end of the fitted range.
        """
        s = np.asarray(s_m, dtype=np.float64)
        step = s[1:] - s[:-1]
        theta = self.heading(s[:-1, None] + step[:, None] * _PLACES)
        out = np.empty((len(s), 2))
        out[0] = self.point_at(float(s[0]))
        out[1:, 0] = step * (np.cos(theta) @ _SHARES)
        out[1:, 1] = step * (np.sin(theta) @ _SHARES)
        return out.cumsum(axis=0)

    def point_at(self, s_m: float) -> tuple[float, float]:
        """Position (x, y) [m] at one s."""
        theta = self.heading_at(0.0)
        dx, dy = self._chord(0.0, s_m)
        x, y = self.reference_m
        return x - self.lateral_m * math.sin(theta) + dx, y + self.lateral_m * math.cos(theta) + dy

    def foot(self, point_m: tuple[float, float], near_s_m: float = 0.0) -> tuple[float, float]:
        """Arc length of a point's foot, eq. (18), searched from `near_s_m`, and the line's distance from the point [m].

        The distance, Delta of eq. (21), is positive where the *line* lies to the left of the point. The results are
        finite also for a point beyond the centre of curvature, which has no foot.
        """
        at, (x, y) = near_s_m, self.point_at(near_s_m)

        def place(s: float) -> tuple[float, float, float, float, float]:
            nonlocal at, x, y
            dx, dy = self._chord(at, s)
            at, x, y, theta = s, x + dx, y + dy, self.heading_at(s)
            return x, y, math.cos(theta), math.sin(theta), self.curvature_at(s)

        search = Search(step_m=_TOLERANCE * self.scale_m, reach_m=0.5 * self.scale_m)
        s, left = newton_foot(place, point_m, near_s_m, search)
        return s, -left

    def crossing(self, direction_rad: float) -> tuple[float, float]:
        """Intersection of the line with the perpendicular to a direction through the reference point.

        Returns s [m] and the distance [m] from the reference point, positive to the left of the direction.
        """
        cos, sin = math.cos(direction_rad), math.sin(direction_rad)
        s = 0.0
        x, y = self.point_at(s)
        for _ in range(_ROUNDS):
            ahead = (x - self.reference_m[0]) * cos + (y - self.reference_m[1]) * sin
            step = -ahead / max(math.cos(self.heading_at(s) - direction_rad), 0.2)
            step = min(max(step, -self.scale_m), self.scale_m)
            if abs(step) < _TOLERANCE * self.scale_m:
                break
            dx, dy = self._chord(s, s + step)
            s, x, y = s + step, x + dx, y + dy
        return s, (y - self.reference_m[1]) * cos - (x - self.reference_m[0]) * sin

    def moved(self, after_from_before: SE2) -> tuple[HeadingPolynomial, float]:
        """The line in the body frame after a motion, and the distance [m] by which the origin moved along it.

        With the origin advanced by ds and the body turned by dpsi, theta'(s) = theta(s + ds) - dpsi.
        """
        x, y = self.reference_m
        cos, sin = math.cos(after_from_before.yaw_rad), math.sin(after_from_before.yaw_rad)
        dx, dy = x - after_from_before.x_m, y - after_from_before.y_m
        advance, lateral = self.foot((cos * dx + sin * dy, cos * dy - sin * dx))
        w0, w1, w2, w3 = (shift_matrix(advance / self.scale_m) @ self.coefficients_rad).tolist()
        line = replace(
            self,
            coefficients_rad=(w0 + after_from_before.yaw_rad, w1, w2, w3),
            lateral_m=lateral,
            s_min_m=self.s_min_m - advance,
            s_max_m=self.s_max_m - advance,
        )
        return line, advance

    def ending(self, last_m: float, arc_ahead_m: float) -> HeadingPolynomial:
        """The same line with another length of the far arc; where that is finite the arc starts at `last_m`."""
        last = self.s_max_m if math.isinf(arc_ahead_m) else max(min(last_m, self.s_max_m), self.s_min_m)
        return replace(self, s_max_m=last, arc_ahead_m=arc_ahead_m)

    def curve(self, s_from_m: float, s_to_m: float, lateral_m: float = 0.0, count: int = 33) -> DeferredCurve:
        """The line between two arc lengths, or the curve `lateral_m` to its left between the same perpendiculars.

        It is computed at its first use, from `count` samples: good to a fifth of a millimetre.
        """
        return DeferredCurve(partial(self._samples, s_from_m, s_to_m, count, lateral_m))

    def _samples(self, s_from_m: float, s_to_m: float, count: int, lateral_m: float) -> Table:
        s = np.linspace(s_from_m, s_to_m, count)
        table = s - s_from_m, self.points(s), self.heading(s), self.curvature(s)
        return beside(table, lateral_m) if lateral_m else table

    def _cubic(self, s: float) -> float:
        u = s / self.scale_m
        w0, w1, w2, w3 = self.coefficients_rad
        return w0 + u * (w1 + u * (w2 + u * w3))

    def _mean_curvature(self, low: float, high: float) -> float:
        if high - low > 1e-6 * self.scale_m:
            kappa = (self._cubic(high) - self._cubic(low)) / (high - low)
        else:
            kappa = self.coefficients_rad[1] / self.scale_m
        return min(max(kappa, -self.max_curvature_per_m), self.max_curvature_per_m)

    def _chord(self, start: float, end: float) -> tuple[float, float]:
        """The chord between two s, eq. (19), by quadrature in panels that end where the curvature jumps."""
        for joint in (self.s_min_m, self.s_max_m, self.s_max_m + self.arc_ahead_m):
            if start < joint < end or end < joint < start:
                (x0, y0), (x1, y1) = self._chord(start, joint), self._chord(joint, end)
                return x0 + x1, y0 + y1
        x = y = 0.0
        panels = math.ceil(abs(end - start) / (_PANEL_SCALES * self.scale_m))
        width = (end - start) / max(panels, 1)
        for panel in range(panels):
            low = start + width * panel
            for place, share in _PANEL:
                theta = self.heading_at(low + place * width)
                x += share * math.cos(theta)
                y += share * math.sin(theta)
        return x * width, y * width


def shift_matrix(shift: float) -> FloatArray:
    """The map (4, 4) from the coefficients of a cubic p(u), lowest power first, to those of p(u + shift)."""
    d, d2 = shift, shift * shift
    return np.array(
        (
            (1.0, d, d2, d2 * d),
            (0.0, 1.0, 2.0 * d, 3.0 * d2),
            (0.0, 0.0, 1.0, 3.0 * d),
            (0.0, 0.0, 0.0, 1.0),
        )
    )
