"""The centerline for the controllers: sampled once per frame, evaluated in plain floats."""

from __future__ import annotations

import math
from bisect import bisect_right

import numpy as np

from automodel.curves.base import Curve
from automodel.curves.foot import Search, nearest_samples, newton_foot

_SPACING_M = 0.05
_SAMPLES = (8, 400)  # at least, at most
_SEARCH = Search(ahead_m=1e-9)


class LanePath:
    """A curve in the body frame by arc length, extended at both ends by arcs of the curvature there.

    An estimate may start ahead of the rear axle and ends where the camera sees no further. Beyond its ends a polynomial
    leaves the road; an arc stays on it.
    """

    def __init__(self, curve: Curve) -> None:
        count = min(max(math.ceil(curve.length_m / _SPACING_M) + 1, _SAMPLES[0]), _SAMPLES[1])
        s = np.linspace(0.0, curve.length_m, count)
        self._points = curve.position(s)
        headings = curve.heading(s)
        self.length_m = curve.length_m
        self._s: list[float] = s.tolist()
        self._x: list[float] = self._points[:, 0].tolist()
        self._y: list[float] = self._points[:, 1].tolist()
        self._theta: list[float] = headings.tolist()
        bends = (np.diff(headings) / np.diff(s)).tolist()
        first, last = curve.curvature(s[[0, -1]]).tolist()
        self._bends: list[float] = [first, *bends, last]  # before the first sample, between, beyond the last

    def heading(self, s_m: float) -> float:
        """The tangent's direction [rad], not wrapped."""
        interval, anchor = self._find(s_m)
        return self._theta[anchor] + (s_m - self._s[anchor]) * self._bends[interval]

    def position(self, s_m: float) -> tuple[float, float]:
        """The point (x, y) [m]."""
        interval, anchor = self._find(s_m)
        length = s_m - self._s[anchor]
        half = 0.5 * length * self._bends[interval]
        chord = length * (math.sin(half) / half) if abs(half) > 1e-9 else length
        middle = self._theta[anchor] + half
        return self._x[anchor] + chord * math.cos(middle), self._y[anchor] + chord * math.sin(middle)

    def mean_curvature(self, start_m: float, end_m: float) -> float:
        """The mean curvature [1/m] between two arc lengths: the turn of the tangent over the distance."""
        return (self.heading(end_m) - self.heading(start_m)) / (end_m - start_m)

    def foot(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Arc length s of a point's foot, also beyond the ends, and the point's distance d to the left [m]."""
        nearest = int(nearest_samples(self._points, np.array([[x_m, y_m]]))[0])
        return newton_foot(self._place, (x_m, y_m), self._s[nearest], _SEARCH)

    def _place(self, s_m: float) -> tuple[float, float, float, float, float]:
        theta = self.heading(s_m)
        return *self.position(s_m), math.cos(theta), math.sin(theta), self._bends[self._find(s_m)[0]]

    def _find(self, s_m: float) -> tuple[int, int]:
        """Index of the interval, and of the sample at its start."""
        interval = bisect_right(self._s, s_m)
        return interval, max(interval - 1, 0)
