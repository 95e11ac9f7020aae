"""The curve y = p(x): what a polynomial regression in a bird's-eye view gives."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from automodel.curves.base import Curve
from automodel.types import FloatArray

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)


class GraphCurve(Curve):
    """y = c0 + c1 x + c2 x^2 + ... [m] for x in x0_m .. x1_m, by arc length from x0_m; frame as the points'."""

    def __init__(self, coefficients: ArrayLike, x0_m: float, x1_m: float) -> None:
        self.coefficients: FloatArray = np.array(coefficients, dtype=np.float64)
        if not np.isfinite(self.coefficients).all():
            raise ValueError("coefficients: must be finite")
        if not x1_m > x0_m:
            raise ValueError(f"x1_m: {x1_m} where more than x0_m = {x0_m} is wanted")
        self.coefficients.flags.writeable = False
        self.x0_m, self.x1_m = float(x0_m), float(x1_m)
        powers = np.arange(1, len(self.coefficients))
        self._slope = self.coefficients[1:] * powers if len(powers) else np.zeros(1)
        self._bend = self._slope[1:] * powers[:-1] if len(powers) > 1 else np.zeros(1)

    @cached_property
    def _table(self) -> tuple[FloatArray, FloatArray]:
        """x and arc length at knots; made when first asked for, as most curves of a run are only recorded."""
        x = np.linspace(self.x0_m, self.x1_m, 33)
        half = 0.5 * (x[1] - x[0])
        inside = half * _NODES + (x[:-1, None] + half)
        steps = half * (np.hypot(1.0, _polynomial(self._slope, inside)) @ _WEIGHTS)
        return x, np.concatenate(([0.0], np.cumsum(steps)))

    @property
    def length_m(self) -> float:  # type: ignore[override]
        """Arc length [m] from x0 to x1."""
        return float(self._table[1][-1])

    def x_of(self, s_m: ArrayLike) -> FloatArray:
        """x [m] at arc length s, by interpolation and two Newton steps."""
        s = np.asarray(s_m, dtype=np.float64)
        knots_x, knots_s = self._table
        x = np.interp(s, knots_s, knots_x)
        ends = _polynomial(self._slope, np.array([self.x0_m, self.x1_m]))
        x = np.where(s < 0, self.x0_m + s / np.hypot(1.0, ends[0]), x)
        x = np.where(s > self.length_m, self.x1_m + (s - self.length_m) / np.hypot(1.0, ends[1]), x)
        for _ in range(2):
            interval = np.clip(np.searchsorted(knots_x, x, side="right") - 1, 0, len(knots_x) - 2)
            start = knots_x[interval]
            half = 0.5 * (x - start)
            speed = np.hypot(1.0, _polynomial(self._slope, half[..., None] * (1.0 + _NODES) + start[..., None]))
            x = x - (knots_s[interval] + half * (speed @ _WEIGHTS) - s) / np.hypot(1.0, _polynomial(self._slope, x))
        return np.asarray(x)

    def position(self, s_m: ArrayLike) -> FloatArray:
        """Points (..., 2) [m]."""
        x = self.x_of(s_m)
        return np.stack((x, _polynomial(self.coefficients, x)), axis=-1)

    def heading(self, s_m: ArrayLike) -> FloatArray:
        """Direction (...,) [rad]."""
        return np.asarray(np.arctan(_polynomial(self._slope, self.x_of(s_m))))

    def curvature(self, s_m: ArrayLike) -> FloatArray:
        """Curvature (...,) [1/m]."""
        x = self.x_of(s_m)
        return np.asarray(_polynomial(self._bend, x) / np.hypot(1.0, _polynomial(self._slope, x)) ** 3)

    def _sample_step(self) -> float:
        return self.length_m / 40.0


def _polynomial(coefficients: FloatArray, x: FloatArray) -> FloatArray:
    value = np.full(x.shape, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value
