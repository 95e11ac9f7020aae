"""The interface of all curves: in the plane, by arc length."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import ArrayLike

from automodel.curves.foot import Search, nearest_samples, newton_foot
from automodel.types import FloatArray

_SEARCH = Search(ahead_m=1e-12, step_m=1e-12, least_stretch=1e-6, rounds=30)


class Curve(ABC):
    """A plane curve by arc length s in 0 .. length_m; other s are extrapolated, or wrap where `closed`.

    All methods are vectorised: they take a number or an array s [m] of any shape (...,).
    """

    length_m: float
    closed: bool = False

    @abstractmethod
    def position(self, s_m: ArrayLike) -> FloatArray:
        """Points (..., 2) [m] at arc length s."""

    @abstractmethod
    def heading(self, s_m: ArrayLike) -> FloatArray:
        """The tangent's direction (...,) [rad], continuous along the curve, not wrapped."""

    @abstractmethod
    def curvature(self, s_m: ArrayLike) -> FloatArray:
        """Curvature (...,) [1/m], positive where the curve bends left."""

    def breaks_m(self) -> FloatArray:
        """Arc lengths (n,) at which the curvature or its rate jumps; the curve is smooth in between."""
        return np.empty(0)

    def offset_position(self, s_m: ArrayLike, d_m: ArrayLike) -> FloatArray:
        """Points (..., 2) [m] at arc length s and distance d to the left."""
        theta = self.heading(s_m)
        normal = np.stack((-np.sin(theta), np.cos(theta)), axis=-1)
        return self.position(s_m) + np.asarray(d_m, dtype=np.float64)[..., None] * normal

    def project(
        self, point_m: ArrayLike, near_s_m: float | None = None, reach_m: float | None = None
    ) -> tuple[float, float]:
        """Arc length s and signed distance d (left positive) [m] of the foot of a point's perpendicular.

        Without `near_s_m` this is the closest foot on the whole curve; with it, the closest within `reach_m` (default:
        a tenth of the curve) of that s, so that self-crossings are resolved by continuity. On an open curve s is
        clamped to 0 .. length_m, and d is then the distance along the normal at the end.
        """
        x, y = np.asarray(point_m, dtype=np.float64)
        step = self._sample_step()
        if near_s_m is None:
            overlap = step if self.closed else 0.0  # so that a foot beside the seam lies between two samples
            low, high = -overlap, self.length_m + overlap
        else:
            reach = 0.1 * self.length_m if reach_m is None else reach_m
            low, high = near_s_m - reach, near_s_m + reach
            if not self.closed:
                low, high = max(low, 0.0), min(high, self.length_m)
                if high <= low:
                    low, high = (
                        (0.0, min(reach, self.length_m))
                        if near_s_m < 0
                        else (max(self.length_m - reach, 0.0), self.length_m)
                    )
        grid = np.linspace(low, high, max(int(np.ceil((high - low) / step)) + 1, 3))
        nearest = int(nearest_samples(self.position(grid), np.array([[x, y]]))[0])
        bounds = grid[max(nearest - 1, 0)], grid[min(nearest + 1, len(grid) - 1)]
        s, d = newton_foot(self._place, (x, y), grid[nearest], _SEARCH, bounds)
        return float(s % self.length_m if self.closed else s), float(d)

    def _place(self, s_m: float) -> tuple[float, float, float, float, float]:
        x, y = self.position(s_m)
        theta = float(self.heading(s_m))
        return x, y, np.cos(theta), np.sin(theta), float(self.curvature(s_m))

    def _sample_step(self) -> float:
        """Spacing [m] of the samples from which the search for a foot starts."""
        return max(self.length_m / 200.0, 1e-3)
