"""A curve kept as samples: position, heading and curvature at rising arc lengths."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from automodel.curves.base import Curve
from automodel.types import FloatArray

Table = tuple[FloatArray, FloatArray, FloatArray, FloatArray]

_FIELDS = ("s_m", "points_m", "headings_rad", "curvatures_per_m", "length_m")


class TabulatedCurve(Curve):
    """Samples of a smooth curve at arc lengths 0 = s_0 < s_1 < ...: cubic in between, an arc beyond the ends.

    `points_m` (n, 2), `headings_rad` (n,) continuous, `curvatures_per_m` (n,). Positions are cubic Hermite with the
    headings as tangents: the error is about (curvature rate) ds^4 / 384, micrometres at a tenth of a lane width.
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
            raise ValueError(f"points_m: {self.points_m.shape} for {n} arc lengths; (n >= 2, 2) is wanted")
        if self.curvatures_per_m.shape != (n,):
            raise ValueError(f"curvatures_per_m: {self.curvatures_per_m.shape} for {n} arc lengths")
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
    """The curve of the samples that `make` gives: arc lengths, points, headings, curvatures as in `TabulatedCurve`.

    Most curves of a run are only handed on; a fast pipeline makes three a frame. `make` runs once, at the first use,
    and must not depend on anything that changes until then.
    """

    def __init__(self, make: Callable[[], Table]) -> None:
        self._make = make

    def __getattr__(self, name: str) -> Any:
        if name not in _FIELDS:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        super().__init__(*self._make())
        return self.__dict__[name]


def _arc_chord(heading: FloatArray, curvature: FloatArray, length: FloatArray) -> FloatArray:
    """The way (..., 2) from an end along its circle."""
    turn = curvature * length
    chord = length * np.sinc(turn / (2.0 * np.pi))
    return np.stack((chord * np.cos(heading + 0.5 * turn), chord * np.sin(heading + 0.5 * turn)), axis=-1)
