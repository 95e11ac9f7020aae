"""Curves known by points: a smooth spline through them, and one at a varying distance beside another curve."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from automodel.curves.base import Curve, FloatArray


class SplineCurve(Curve):
    """A C2 cubic spline through points (n, 2) [m], by (refined) arc length; periodic where `closed`.

    The closing point is not repeated in `points_m`.
    """

    def __init__(self, points_m: ArrayLike, closed: bool = False) -> None:
        from scipy.interpolate import CubicSpline  # 0.3 s of import that only this class needs

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
        for _ in range(3):  # chord lengths -> arc lengths: |dp/ds| = 1 to about 1e-6
            knots = np.concatenate(([0.0], np.cumsum(lengths)))
            spline = CubicSpline(knots, points, bc_type=bc)
            lengths = _arc_lengths(spline.derivative(), knots)
        self._spline, self._speed, self._accel = spline, spline.derivative(), spline.derivative(2)
        self.knots_m: FloatArray = knots  # arc length of each point, and of the first again where closed
        self.closed, self.length_m = closed, float(knots[-1])
        dense = np.linspace(0.0, self.length_m, 20 * len(knots))
        self._dense, self._dense_heading = dense, np.unwrap(_direction(self._speed(dense)))
        self._turn = float(self._dense_heading[-1] - self._dense_heading[0])

    def position(self, s_m: ArrayLike) -> FloatArray:
        """Points (..., 2) [m]."""
        return np.asarray(self._spline(self._wrap(s_m)), dtype=np.float64)

    def heading(self, s_m: ArrayLike) -> FloatArray:
        """Direction (...,) [rad]."""
        s = np.asarray(s_m, dtype=np.float64)
        wrapped = self._wrap(s)
        coarse = np.interp(wrapped, self._dense, self._dense_heading)
        fine = _direction(self._speed(wrapped))
        heading = coarse + np.remainder(fine - coarse + np.pi, 2 * np.pi) - np.pi
        return np.asarray(heading + (np.floor(s / self.length_m) * self._turn if self.closed else 0.0))

    def curvature(self, s_m: ArrayLike) -> FloatArray:
        """Curvature (...,) [1/m]."""
        s = self._wrap(s_m)
        d, dd = self._speed(s), self._accel(s)
        cross = d[..., 0] * dd[..., 1] - d[..., 1] * dd[..., 0]
        return np.asarray(cross / np.maximum(np.hypot(d[..., 0], d[..., 1]), 1e-12) ** 3)

    def _wrap(self, s_m: ArrayLike) -> FloatArray:
        s = np.asarray(s_m, dtype=np.float64)
        return s % self.length_m if self.closed else s

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
        self._base_s = np.linspace(0.0, base.length_m, count)
        nodes, weights = np.polynomial.legendre.leggauss(3)
        half = 0.5 * np.diff(self._base_s)
        s = half[:, None] * nodes + (0.5 * (self._base_s[1:] + self._base_s[:-1]))[:, None]
        stretch, slope = self._rates(s)
        if (stretch <= 0).any():
            raise ValueError(f"offset_m: folds back at s = {float(s[stretch <= 0][0]):.2f} m of the base curve")
        self._s = np.concatenate(([0.0], np.cumsum(half * (np.hypot(stretch, slope) @ weights))))
        self.length_m = float(self._s[-1])

    def base_s(self, s_m: ArrayLike) -> FloatArray:
        """Arc length on the base curve of this curve's arc length."""
        s = np.asarray(s_m, dtype=np.float64)
        laps = np.floor(s / self.length_m) if self.closed else np.zeros_like(s)
        local = s - laps * self.length_m
        inside = np.interp(local, self._s, self._base_s)
        if not self.closed:  # extrapolate on open curves
            inside = (
                inside + np.where(local < 0, local, 0.0) + np.where(local > self.length_m, local - self.length_m, 0)
            )
        return np.asarray(inside + laps * self.base.length_m)

    def s_of(self, base_s_m: ArrayLike) -> FloatArray:
        """Arc length on this curve of the base curve's arc length; the inverse of `base_s`."""
        base_s = np.asarray(base_s_m, dtype=np.float64)
        laps = np.floor(base_s / self.base.length_m) if self.closed else np.zeros_like(base_s)
        return np.asarray(np.interp(base_s - laps * self.base.length_m, self._base_s, self._s) + laps * self.length_m)

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
