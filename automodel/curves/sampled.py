"""Curves known by points: a smooth spline through them, and one at a varying distance beside another curve."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from automodel.curves.base import Curve
from automodel.types import FloatArray

_SPLIT = 16  # parts of a spline's interval in the table of arc lengths


class SplineCurve(Curve):
    """A cubic spline through points (n, 2) [m] with continuous curvature, by arc length; periodic where `closed`.

    The closing point is not repeated in `points_m`.
    """

    def __init__(self, points_m: ArrayLike, closed: bool = False) -> None:
        from scipy.interpolate import CubicHermiteSpline, CubicSpline  # 0.3 s of import that only this class needs

        points = np.asarray(points_m, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3:
            raise ValueError(f"points_m: shape {points.shape} where (n >= 3, 2) is wanted")
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
        # between the points the spline's parameter u runs unevenly by up to a few percent: u(s) mends that
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
        """s on the spline, and how far beyond its end the point lies (straight on) where it is open."""
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


class OffsetCurve(Curve):
    """The curve at distance d(s) to the left of another, by its own arc length.

    `offset_m` is a number, or a function of the base curve's s (vectorised; smooth, and periodic where the base is
    closed). Raises ValueError where the distance reaches the centre of curvature (the curve would fold back).
    """

    def __init__(self, base: Curve, offset_m: float | Callable[[FloatArray], FloatArray], step_m: float = 0.0) -> None:
        self.base, self.closed = base, base.closed
        self._offset: Callable[[FloatArray], FloatArray]
        if callable(offset_m):
            self._offset = offset_m
        else:
            constant = float(offset_m)
            self._offset = lambda s: np.full_like(s, constant)
        count = max(int(np.ceil(base.length_m / (step_m or base._sample_step() / 4))), 16) + 1
        self._base_s = np.union1d(np.linspace(0.0, base.length_m, count), base.breaks_m())
        nodes, weights = np.polynomial.legendre.leggauss(3)
        half = 0.5 * np.diff(self._base_s)
        s = half[:, None] * nodes + (0.5 * (self._base_s[1:] + self._base_s[:-1]))[:, None]
        stretch, slope = self._rates(s)
        if (stretch <= 0).any():
            raise ValueError(f"offset_m: folds back at s = {float(s[stretch <= 0][0]):.2f} m of the base curve")
        speed = np.hypot(stretch, slope)
        self._s = np.concatenate(([0.0], np.cumsum(half * (speed @ weights))))
        self.length_m = float(self._s[-1])
        # at the intervals' ends from inside, since the curvature of the base may jump there
        self._speed = speed @ np.array([_lagrange(nodes, -1.0), _lagrange(nodes, 1.0)]).T

    def base_s(self, s_m: ArrayLike) -> FloatArray:
        """Arc length on the base curve of this curve's arc length."""
        s = np.asarray(s_m, dtype=np.float64)
        laps = np.floor(s / self.length_m) if self.closed else np.zeros_like(s)
        return _hermite(s - laps * self.length_m, self._s, self._base_s, 1.0 / self._speed) + laps * self.base.length_m

    def s_of(self, base_s_m: ArrayLike) -> FloatArray:
        """Arc length on this curve of the base curve's arc length; the inverse of `base_s`."""
        s = np.asarray(base_s_m, dtype=np.float64)
        laps = np.floor(s / self.base.length_m) if self.closed else np.zeros_like(s)
        return _hermite(s - laps * self.base.length_m, self._base_s, self._s, self._speed) + laps * self.length_m

    def breaks_m(self) -> FloatArray:
        """Arc lengths (n,) at which the curvature or its rate jumps."""
        return self.s_of(self.base.breaks_m())

    def position(self, s_m: ArrayLike) -> FloatArray:
        """Points (..., 2) [m]."""
        s = self.base_s(s_m)
        return self.base.offset_position(s, self._offset(s))

    def heading(self, s_m: ArrayLike) -> FloatArray:
        """Direction (...,) [rad]."""
        s = self.base_s(s_m)
        stretch, slope = self._rates(s)
        return np.asarray(self.base.heading(s) + np.arctan2(slope, stretch))

    def curvature(self, s_m: ArrayLike) -> FloatArray:
        """Curvature (...,) [1/m]."""
        s = np.asarray(s_m, dtype=np.float64)
        base_s = self.base_s(s)
        stretch, slope = self._rates(base_s)
        if not np.any(slope):
            return np.asarray(self.base.curvature(base_s) / stretch)
        h = 1e-3 * max(self._base_s[1], 1e-3)
        before, after = self._rates(base_s - h), self._rates(base_s + h)
        turn = np.arctan2(after[1], after[0]) - np.arctan2(before[1], before[0])
        return np.asarray((self.base.curvature(base_s) + turn / (2 * h)) / np.hypot(stretch, slope))

    def _rates(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        h = 1e-4 * max(self.base.length_m / 100.0, 1e-2)
        slope = (self._offset(s + h) - self._offset(s - h)) / (2 * h)
        return 1.0 - self.base.curvature(s) * self._offset(s), slope

    def _sample_step(self) -> float:
        return self.base._sample_step()


def _lagrange(nodes: FloatArray, at: float) -> FloatArray:
    """Weights with which values at `nodes` give the value at `at`."""
    return np.array(
        [np.prod((at - np.delete(nodes, i)) / (node - np.delete(nodes, i))) for i, node in enumerate(nodes)]
    )


def _hermite(x: FloatArray, knots: FloatArray, values: FloatArray, slopes: FloatArray) -> FloatArray:
    """Cubic interpolation with the slopes (n - 1, 2) at both ends of each interval; straight on beyond the ends."""
    inside = np.clip(x, knots[0], knots[-1])
    i = np.clip(np.searchsorted(knots, inside, side="right") - 1, 0, len(knots) - 2)
    width = knots[i + 1] - knots[i]
    t = (inside - knots[i]) / width
    rise, first, last = values[i + 1] - values[i], width * slopes[i, 0], width * slopes[i, 1]
    cubic = values[i] + t * (first + t * (3.0 * rise - 2.0 * first - last + t * (first + last - 2.0 * rise)))
    return np.asarray(cubic + (x - inside) * np.where(x < inside, slopes[0, 0], slopes[-1, 1]))
