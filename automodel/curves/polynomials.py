"""Curves given by a polynomial: heading over arc length (line, arc, clothoid, cubic), and y over x."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from numpy.typing import ArrayLike

from automodel.curves.base import Curve
from automodel.types import FloatArray

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_MAX_TURN_PER_STEP_RAD = 0.35  # 8-point Gauss-Legendre quadrature errs by 1e-15 of the length up to here
_GRAPH_NODES, _GRAPH_WEIGHTS = np.polynomial.legendre.leggauss(4)


class ThetaCurve(Curve):
    """theta(s) = w0 + w1 s + w2 s^2 + ..., placed by the anchor (x0, y0) at s = 0.

    `coefficients` are (w0, w1, ...) with w0 [rad], w1 [rad/m] and so on; w1 is the curvature at s = 0. Positions are
    the integrals x = int cos(theta) ds, y = int sin(theta) ds (Cudrano et al. 2020, eq. (3), (19)), by quadrature.
    Raises ValueError for coefficients, an anchor or a length that are not finite, and for a length of 0 or less.
    """

    def __init__(self, x_m: float, y_m: float, coefficients: ArrayLike, length_m: float) -> None:
        self.coefficients: FloatArray = np.array(coefficients, dtype=np.float64)
        self.x_m, self.y_m, self.length_m = float(x_m), float(y_m), float(length_m)
        if self.coefficients.ndim != 1 or len(self.coefficients) == 0:
            raise ValueError("coefficients: expected a list of one number or more")
        if not (np.isfinite(self.coefficients).all() and math.isfinite(self.x_m) and math.isfinite(self.y_m)):
            raise ValueError("coefficients, x_m, y_m: must be finite")
        if not self.length_m > 0 or not math.isfinite(self.length_m):
            raise ValueError(f"length_m: expected a positive number, got {length_m}")
        self.coefficients.flags.writeable = False
        self._slope = polyder(self.coefficients) + 0.0  # without negative zeros
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
        return np.asarray(polyval(np.asarray(s_m, dtype=np.float64), self.coefficients))

    def curvature(self, s_m: ArrayLike) -> FloatArray:
        """Curvature (...,) [1/m]."""
        return np.asarray(polyval(np.asarray(s_m, dtype=np.float64), self._slope))

    def _chords(self, start: FloatArray, end: FloatArray) -> FloatArray:
        half = 0.5 * (end - start)
        theta = self.heading(half[:, None] * _NODES + (0.5 * (start + end))[:, None])
        return half[:, None] * np.stack((np.cos(theta) @ _WEIGHTS, np.sin(theta) @ _WEIGHTS), axis=-1)


def line(x_m: float, y_m: float, heading_rad: float, length_m: float) -> ThetaCurve:
    """A straight line."""
    return ThetaCurve(x_m, y_m, (heading_rad,), length_m)


def arc(x_m: float, y_m: float, heading_rad: float, curvature_per_m: float, length_m: float) -> ThetaCurve:
    """A circular arc, to the left for a positive curvature."""
    return ThetaCurve(x_m, y_m, (heading_rad, curvature_per_m), length_m)


def clothoid(
    x_m: float, y_m: float, heading_rad: float, start_per_m: float, end_per_m: float, length_m: float
) -> ThetaCurve:
    """A clothoid: the curvature changes linearly from `start_per_m` to `end_per_m`."""
    rate = (end_per_m - start_per_m) / length_m
    return ThetaCurve(x_m, y_m, (heading_rad, start_per_m, 0.5 * rate), length_m)


class GraphCurve(Curve):
    """y = c0 + c1 x + c2 x^2 + ... [m] for x in x0_m .. x1_m, by arc length from x0_m; straight beyond both ends."""

    def __init__(self, coefficients: ArrayLike, x0_m: float, x1_m: float) -> None:
        self.coefficients: FloatArray = np.array(coefficients, dtype=np.float64)
        if not np.isfinite(self.coefficients).all():
            raise ValueError("coefficients: must be finite")
        if not x1_m > x0_m:
            raise ValueError(f"x1_m: expected more than x0_m = {x0_m}, got {x1_m}")
        self.coefficients.flags.writeable = False
        self.x0_m, self.x1_m = float(x0_m), float(x1_m)
        self._slope = polyder(self.coefficients) + 0.0  # without negative zeros
        self._bend = polyder(self._slope) + 0.0

    @cached_property
    def _table(self) -> tuple[FloatArray, FloatArray]:
        """x and arc length at knots [m]; computed at first use, because most curves of a run are only recorded."""
        x = np.linspace(self.x0_m, self.x1_m, 33)
        half = 0.5 * (x[1] - x[0])
        inside = half * _GRAPH_NODES + (x[:-1, None] + half)
        steps = half * (np.hypot(1.0, polyval(inside, self._slope)) @ _GRAPH_WEIGHTS)
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
        ends = polyval(np.array([self.x0_m, self.x1_m]), self._slope)
        x = np.where(s < 0, self.x0_m + s / np.hypot(1.0, ends[0]), x)
        x = np.where(s > self.length_m, self.x1_m + (s - self.length_m) / np.hypot(1.0, ends[1]), x)
        for _ in range(2):
            interval = np.clip(np.searchsorted(knots_x, x, side="right") - 1, 0, len(knots_x) - 2)
            start = knots_x[interval]
            half = 0.5 * (x - start)
            speed = np.hypot(1.0, polyval(half[..., None] * (1.0 + _GRAPH_NODES) + start[..., None], self._slope))
            x = x - (knots_s[interval] + half * (speed @ _GRAPH_WEIGHTS) - s) / np.hypot(1.0, polyval(x, self._slope))
        return np.asarray(x)

    def position(self, s_m: ArrayLike) -> FloatArray:
        """Points (..., 2) [m]."""
        x = self.x_of(s_m)
        return np.stack((x, polyval(x, self.coefficients)), axis=-1)

    def heading(self, s_m: ArrayLike) -> FloatArray:
        """Direction (...,) [rad]."""
        return np.asarray(np.arctan(polyval(self.x_of(s_m), self._slope)))

    def curvature(self, s_m: ArrayLike) -> FloatArray:
        """Curvature (...,) [1/m]."""
        x = self.x_of(s_m)
        return np.asarray(polyval(x, self._bend) / np.hypot(1.0, polyval(x, self._slope)) ** 3)

    def _sample_step(self) -> float:
        return self.length_m / 40.0


class DeferredGraphCurve(GraphCurve):
    """A `GraphCurve` of the arguments that `make` returns: coefficients, x0, x1.

    Most curves of a run are never evaluated. `make` runs once, at the first use, and must not depend on values that
    change until then.
    """

    def __init__(self, make: Callable[[], tuple[FloatArray, float, float]]) -> None:
        self._make = make

    def __getattr__(self, name: str) -> Any:
        if name not in ("coefficients", "x0_m", "x1_m", "_slope", "_bend"):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        super().__init__(*self._make())
        return self.__dict__[name]
