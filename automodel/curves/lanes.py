"""Lanes as values: what estimation expects perception to look for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from automodel.curves.foot import nearest_samples
from automodel.curves.sampled import DeferredCurve, Table, beside
from automodel.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LaneShape:
    """A lane's centerline on the fit's grid, body frame.

    `s_m` (n,) counts from the reference point's foot; `points_m` (n, 2), `theta_rad` (n,), `kappa_per_m` (n,).
    """

    s_m: FloatArray
    points_m: FloatArray
    theta_rad: FloatArray
    kappa_per_m: FloatArray
    width_m: float
    taper: float = 0.0  # its change per metre ahead

    def line(self, side: int) -> FloatArray:
        """Points (n, 2) [m] of the lane's line on `side` (+1 left, -1 right)."""
        return self.beside(side * 0.5 * np.maximum(self.width_m + self.taper * self.s_m, 0.0))

    def beside(self, lateral_m: float | FloatArray) -> FloatArray:
        """Points (n, 2) [m] at a distance, one or (n,), to the left of the centerline."""
        out = np.empty_like(self.points_m)
        out[:, 0] = self.points_m[:, 0] - lateral_m * np.sin(self.theta_rad)
        out[:, 1] = self.points_m[:, 1] + lateral_m * np.cos(self.theta_rad)
        return out

    def curve(self, lateral_m: float = 0.0, stride: int = 2) -> DeferredCurve:
        """The centerline, or the curve `lateral_m` to its left, over the whole grid."""
        return DeferredCurve(partial(self._table, lateral_m, stride))

    def _table(self, lateral_m: float, stride: int) -> Table:
        table = self.s_m - self.s_m[0], self.points_m, self.theta_rad, self.kappa_per_m
        s, points, theta, kappa = beside(table, lateral_m) if lateral_m else table
        return s[::stride], points[::stride], theta[::stride], kappa[::stride]

    def nearest_s(self, points_m: FloatArray) -> FloatArray:
        """Arc length (n,) of the grid point nearest to each of `points_m` (n, 2)."""
        return self.s_m[nearest_samples(self.points_m, points_m)]
