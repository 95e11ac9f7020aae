"""The centerline as the controllers look at it: sampled once a frame, then plain floats."""

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
    """A curve in the body frame by arc length, with an arc of the end's curvature beyond each end.

    An estimate may begin ahead of the rear axle and ends where the camera saw no further; polynomials leave the road
    there, arcs stay with it.
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
        way = s_m - self._s[anchor]
        half = 0.5 * way * self._bends[interval]
        chord = way * (math.sin(half) / half) if abs(half) > 1e-9 else way
        middle = self._theta[anchor] + half
        return self._x[anchor] + chord * math.cos(middle), self._y[anchor] + chord * math.sin(middle)

    def mean_curvature(self, begin_m: float, end_m: float) -> float:
        """The curvature [1/m] between two arc lengths: how far the tangent turns, over the way."""
        return (self.heading(end_m) - self.heading(begin_m)) / (end_m - begin_m)

    def foot(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Arc length s of the perpendicular's foot, also beyond the ends, and distance d to the left of it [m]."""
        nearest = int(nearest_samples(self._points, np.array([[x_m, y_m]]))[0])
        return newton_foot(self._place, (x_m, y_m), self._s[nearest], _SEARCH)

    def _place(self, s_m: float) -> tuple[float, float, float, float, float]:
        theta = self.heading(s_m)
        return *self.position(s_m), math.cos(theta), math.sin(theta), self._bends[self._find(s_m)[0]]

    def _find(self, s_m: float) -> tuple[int, int]:
        """The number of the stretch, and of the sample to reckon from."""
        interval = bisect_right(self._s, s_m)
        return interval, max(interval - 1, 0)
