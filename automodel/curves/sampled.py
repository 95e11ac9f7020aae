"""Curves given by samples: a spline through points, and a table of points, headings and curvatures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from automodel.curves.base import Curve
from automodel.types import FloatArray

_LEAST_STRETCH = 0.05  # least 1 - kappa d of a curve beside another: it is 0 at the centre of curvature
_SPLIT = 16  # intervals of the table of arc lengths per interval of the spline

Table = tuple[FloatArray, FloatArray, FloatArray, FloatArray]  # arguments of `TabulatedCurve`

_FIELDS = ("s_m", "points_m", "headings_rad", "curvatures_per_m", "length_m")


class SplineCurve(Curve):
    """A cubic spline through points (n, 2) [m] with continuous curvature, by arc length; periodic where `closed`.

    The closing point is not repeated in `points_m`. An open spline is straight beyond its ends. Raises ValueError for
    fewer than three points, repeated ones, and such that are not finite.
    """

    def __init__(self, points_m: ArrayLike, closed: bool = False) -> None:
        from scipy.interpolate import CubicHermiteSpline, CubicSpline  # takes 0.3 s to import

        points = np.asarray(points_m, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3:
            raise ValueError(f"points_m: expected shape (n >= 3, 2), got {points.shape}")
        if not np.isfinite(points).all():
            raise ValueError("points_m: must be finite")
        if closed:
            points = np.vstack((points, points[:1]))
        lengths = np.hypot(*np.diff(points, axis=0).T)
        if not (lengths > 0).all():
            raise ValueError(f"points_m: point {int(np.argmin(lengths)) + 1} repeats the one before")
        bc = "periodic" if closed else "natural"
        for _ in range(3):  # chord lengths -> arc lengths at the points
            knots = np.concatenate(([0.0], np.cumsum(lengths)))
            spline = CubicSpline(knots, points, bc_type=bc)
            lengths = _arc_lengths(spline.derivative(), knots)
        self._spline, self._speed, self._accel = spline, spline.derivative(), spline.derivative(2)
        # between the points the speed of the parameter u varies by a few percent: tabulate u(s)
        self._u = np.interp(np.arange(_SPLIT * (len(knots) - 1) + 1) / _SPLIT, np.arange(len(knots)), knots)
        s = np.concatenate(([0.0], np.cumsum(_arc_lengths(self._speed, self._u))))
        slope = 1.0 / np.hypot(*self._speed(self._u).T)
        self._u_of_s = CubicHermiteSpline(s, self._u, slope)
        self.knots_m: FloatArray = s[::_SPLIT]  # arc length of each point, and of the first again where closed
        self.closed, self.length_m = closed, float(s[-1])
        self._dense, self._dense_heading = s, np.unwrap(_direction(self._speed(self._u)))
        self._turn = float(self._dense_heading[-1] - self._dense_heading[0])

    def position(self, s_m: ArrayLike) -> FloatArray:
        """Points (..., 2) [m]."""
        s, ahead = self._inside(s_m)
        u = self._u_of_s(s)
        d = self._speed(u)
        ahead = ahead / np.hypot(d[..., 0], d[..., 1])
        return np.asarray(self._spline(u) + ahead[..., None] * d, dtype=np.float64)

    def heading(self, s_m: ArrayLike) -> FloatArray:
        """Direction (...,) [rad]."""
        s, _ = self._inside(s_m)
        coarse = np.interp(s, self._dense, self._dense_heading)
        fine = _direction(self._speed(self._u_of_s(s)))
        heading = coarse + np.remainder(fine - coarse + np.pi, 2 * np.pi) - np.pi
        return np.asarray(heading + (np.floor(np.asarray(s_m) / self.length_m) * self._turn if self.closed else 0.0))

    def curvature(self, s_m: ArrayLike) -> FloatArray:
        """Curvature (...,) [1/m]."""
        s, ahead = self._inside(s_m)
        u = self._u_of_s(s)
        d, dd = self._speed(u), self._accel(u)
        cross = d[..., 0] * dd[..., 1] - d[..., 1] * dd[..., 0]
        return np.asarray(np.where(ahead == 0.0, cross / np.maximum(np.hypot(d[..., 0], d[..., 1]), 1e-12) ** 3, 0.0))

    def _inside(self, s_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """s on the spline, and the distance beyond its end where it is open."""
        s = np.asarray(s_m, dtype=np.float64)
        inside = s % self.length_m if self.closed else np.clip(s, 0.0, self.length_m)
        return inside, np.zeros_like(s) if self.closed else s - inside

    def breaks_m(self) -> FloatArray:
        """Arc lengths (n,) of the points: the curvature's rate jumps there."""
        return self.knots_m[1:-1]

    def _sample_step(self) -> float:
        return min(self.length_m / 200.0, float(np.median(np.diff(self.knots_m))))


def _direction(d: FloatArray) -> FloatArray:
    return np.asarray(np.arctan2(d[..., 1], d[..., 0]))


def _arc_lengths(speed: Callable[[FloatArray], FloatArray], knots: FloatArray) -> FloatArray:
    nodes, weights = np.polynomial.legendre.leggauss(5)
    half = 0.5 * np.diff(knots)
    d = speed(half[:, None] * nodes + (0.5 * (knots[1:] + knots[:-1]))[:, None])
    return np.asarray(half * (np.hypot(d[..., 0], d[..., 1]) @ weights))


class TabulatedCurve(Curve):
    """Samples of a smooth curve at arc lengths 0 = s_0 < s_1 < ...: cubic in between, arcs beyond the ends.

    `points_m` (n, 2), continuous `headings_rad` (n,), `curvatures_per_m` (n,). Positions are interpolated by cubic
    Hermite polynomials with the headings as tangents; the error is about (curvature rate) ds^4 / 384, micrometres at a
    tenth of a lane width. Raises ValueError for shapes that do not match and arc lengths that do not rise from 0.
    """

    def __init__(
        self, s_m: ArrayLike, points_m: ArrayLike, headings_rad: ArrayLike, curvatures_per_m: ArrayLike
    ) -> None:
        self.s_m: FloatArray = np.array(s_m, dtype=np.float64)
        self.points_m: FloatArray = np.array(points_m, dtype=np.float64)
        self.headings_rad: FloatArray = np.array(headings_rad, dtype=np.float64)
        self.curvatures_per_m: FloatArray = np.array(curvatures_per_m, dtype=np.float64)
        n = len(self.s_m)
        if n < 2 or self.points_m.shape != (n, 2) or self.headings_rad.shape != (n,):
            raise ValueError(f"points_m: expected shape (n >= 2, 2), got {self.points_m.shape} for {n} arc lengths")
        if self.curvatures_per_m.shape != (n,):
            raise ValueError(f"curvatures_per_m: expected {n}, one per arc length, got {self.curvatures_per_m.shape}")
        if self.s_m[0] != 0.0 or not (np.diff(self.s_m) > 0).all():
            raise ValueError("s_m: must rise from 0")
        for array in (self.s_m, self.points_m, self.headings_rad, self.curvatures_per_m):
            array.flags.writeable = False
        self.length_m = float(self.s_m[-1])

    def position(self, s_m: ArrayLike) -> FloatArray:
        """Points (..., 2) [m]."""
        s = np.asarray(s_m, dtype=np.float64)
        inside = np.clip(s, 0.0, self.length_m)
        i, t, h = self._interval(inside)
        t, h = t[..., None], h[..., None]
        tangents = np.stack((np.cos(self.headings_rad), np.sin(self.headings_rad)), axis=-1)
        p0, p1 = self.points_m[i], self.points_m[i + 1]
        points = (
            (1.0 + 2.0 * t) * (1.0 - t) ** 2 * p0
            + t * (1.0 - t) ** 2 * h * tangents[i]
            + t * t * (3.0 - 2.0 * t) * p1
            - t * t * (1.0 - t) * h * tangents[i + 1]
        )
        beyond = s - inside
        if np.any(beyond):
            points = points + _arc_chord(self.heading(inside), self.curvature(inside), beyond)
        return np.asarray(points)

    def heading(self, s_m: ArrayLike) -> FloatArray:
        """Direction (...,) [rad]."""
        s = np.asarray(s_m, dtype=np.float64)
        inside = np.clip(s, 0.0, self.length_m)
        heading = np.interp(inside, self.s_m, self.headings_rad)
        return np.asarray(heading + (s - inside) * self.curvature(inside))

    def curvature(self, s_m: ArrayLike) -> FloatArray:
        """Curvature (...,) [1/m]."""
        return np.asarray(np.interp(np.asarray(s_m, dtype=np.float64), self.s_m, self.curvatures_per_m))

    def _sample_step(self) -> float:
        return self.length_m / 40.0

    def _interval(self, s: FloatArray) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.intp]], FloatArray, FloatArray]:
        i = np.clip(np.searchsorted(self.s_m, s, side="right") - 1, 0, len(self.s_m) - 2)
        h = self.s_m[i + 1] - self.s_m[i]
        return i, (s - self.s_m[i]) / h, h


class DeferredCurve(TabulatedCurve):
    """A `TabulatedCurve` of the arguments that `make` returns: arc lengths, points, headings, curvatures.

    Most curves of a run are never evaluated, and a fast pipeline makes three per frame. `make` runs once, at the first
    use, and must not depend on values that change until then.
    """

    def __init__(self, make: Callable[[], Table]) -> None:
        self._make = make

    def __getattr__(self, name: str) -> Any:
        if name not in _FIELDS:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        super().__init__(*self._make())
        return self.__dict__[name]


def beside(table: Table, lateral_m: float) -> Table:
    """The table of the curve `lateral_m` to the left of that of a table, between the same perpendiculars."""
    s, points, theta, kappa = table
    stretch = np.maximum(1.0 - kappa * lateral_m, _LEAST_STRETCH)
    steps = 0.5 * (stretch[1:] + stretch[:-1]) * np.diff(s)
    normal = np.column_stack((-np.sin(theta), np.cos(theta)))
    return np.concatenate(([0.0], np.cumsum(steps))), points + lateral_m * normal, theta, kappa / stretch


def _arc_chord(heading: FloatArray, curvature: FloatArray, length: FloatArray) -> FloatArray:
    """The chord (..., 2) of an arc."""
    turn = curvature * length
    chord = length * np.sinc(turn / (2.0 * np.pi))
    return np.stack((chord * np.cos(heading + 0.5 * turn), chord * np.sin(heading + 0.5 * turn)), axis=-1)
