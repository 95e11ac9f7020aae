"""Curves whose heading is a polynomial of arc length: line, arc, clothoid, and the cubic of Cudrano et al."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from automodel.curves.base import Curve
from automodel.types import FloatArray

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_MAX_TURN_PER_STEP_RAD = 0.35  # 8-point Gauss-Legendre is exact to 1e-15 of the length up to here


class ThetaCurve(Curve):
    """theta(s) = w0 + w1 s + w2 s^2 + ..., placed by the anchor (x0, y0) at s = 0.

    `coefficients` are (w0, w1, ...) with w0 [rad], w1 [rad/m] and so on; w1 is the curvature at s = 0. Positions are
    the integral x = int cos(theta) ds, y = int sin(theta) ds (Cudrano et al. 2020, eq. (3), (19)), by quadrature.
    """

    def __init__(self, x_m: float, y_m: float, coefficients: ArrayLike, length_m: float) -> None:
        self.coefficients: FloatArray = np.array(coefficients, dtype=np.float64)
        self.x_m, self.y_m, self.length_m = float(x_m), float(y_m), float(length_m)
        if self.coefficients.ndim != 1 or len(self.coefficients) == 0:
            raise ValueError("coefficients: a list of one number or more is wanted")
        if not (np.isfinite(self.coefficients).all() and math.isfinite(self.x_m) and math.isfinite(self.y_m)):
            raise ValueError("coefficients, x_m, y_m: must be finite")
        if not self.length_m > 0 or not math.isfinite(self.length_m):
            raise ValueError(f"length_m: {length_m} where a positive number is wanted")
        self.coefficients.flags.writeable = False
        ends = self.curvature(np.linspace(0.0, self.length_m, 9))
        steps = math.ceil(float(np.abs(ends).max()) * self.length_m / _MAX_TURN_PER_STEP_RAD)
        self._knots = np.linspace(0.0, self.length_m, min(max(steps, 1), 4096) + 1)
        chords = self._chords(self._knots[:-1], self._knots[1:])
        anchor = np.array([[self.x_m, self.y_m]])
        self._starts = np.vstack((anchor, anchor + np.cumsum(chords, axis=0)))

    def position(self, s_m: ArrayLike) -> FloatArray:
        """Points (..., 2) [m]."""
        s = np.asarray(s_m, dtype=np.float64)
        flat = s.reshape(-1)
        interval = np.clip(np.searchsorted(self._knots, flat, side="right") - 1, 0, len(self._knots) - 2)
        points = self._starts[interval] + self._chords(self._knots[interval], flat)
        return points.reshape((*s.shape, 2))

    def heading(self, s_m: ArrayLike) -> FloatArray:
        """Direction (...,) [rad]."""
        return _horner(self.coefficients, np.asarray(s_m, dtype=np.float64))

    def curvature(self, s_m: ArrayLike) -> FloatArray:
        """Curvature (...,) [1/m]."""
        s = np.asarray(s_m, dtype=np.float64)
        w = self.coefficients
        return _horner(w[1:] * np.arange(1, len(w)), s) if len(w) > 1 else np.zeros_like(s)

    def _chords(self, start: FloatArray, end: FloatArray) -> FloatArray:
        half = 0.5 * (end - start)
        theta = self.heading(half[:, None] * _NODES + (0.5 * (start + end))[:, None])
        return half[:, None] * np.stack((np.cos(theta) @ _WEIGHTS, np.sin(theta) @ _WEIGHTS), axis=-1)


def _horner(w: FloatArray, s: FloatArray) -> FloatArray:
    value = np.full(s.shape, w[-1])
    for coefficient in w[-2::-1]:
        value = value * s + coefficient
    return value


def line(x_m: float, y_m: float, heading_rad: float, length_m: float) -> ThetaCurve:
    """A straight line."""
    return ThetaCurve(x_m, y_m, (heading_rad,), length_m)


def arc(x_m: float, y_m: float, heading_rad: float, curvature_per_m: float, length_m: float) -> ThetaCurve:
    """A circular arc, to the left where the curvature is positive."""
    return ThetaCurve(x_m, y_m, (heading_rad, curvature_per_m), length_m)


def clothoid(
    x_m: float, y_m: float, heading_rad: float, start_per_m: float, end_per_m: float, length_m: float
) -> ThetaCurve:
    """A clothoid: the curvature goes linearly from `start_per_m` to `end_per_m`."""
    rate = (end_per_m - start_per_m) / length_m
    return ThetaCurve(x_m, y_m, (heading_rad, start_per_m, 0.5 * rate), length_m)
