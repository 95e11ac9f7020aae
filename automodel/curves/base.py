"""The interface of all curves: plane, parameterised by arc length."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import ArrayLike

from automodel.types import FloatArray


class Curve(ABC):
    """A plane curve by arc length s in 0 .. length_m; s outside is extrapolated, or wraps where `closed`.

    All methods take s of any shape (n,) or a number, and are vectorised.
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
        """Points (..., 2) at arc length s and distance d to the left."""
        theta = self.heading(s_m)
        normal = np.stack((-np.sin(theta), np.cos(theta)), axis=-1)
        return self.position(s_m) + np.asarray(d_m, dtype=np.float64)[..., None] * normal

    def project(
        self, point_m: ArrayLike, near_s_m: float | None = None, reach_m: float | None = None
    ) -> tuple[float, float]:
        """Arc length s and signed distance d (left positive) of a point: the foot of its perpendicular.

        Without `near_s_m` the closest foot on the whole curve counts; with it, the closest within `reach_m` (default: a
        tenth of the curve) of that s, so that self-crossings are resolved by continuity. Safeguarded Newton on s
        (Cudrano et al. 2020, eq. (18)); on an open curve s is clamped to 0 .. length_m and d is then the distance
        along the end's normal.
        """
        x, y = np.asarray(point_m, dtype=np.float64)
        step = self._sample_step()
        if near_s_m is None:
            overlap = step if self.closed else 0.0  # a foot just beside the seam lies between two samples too
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
        points = self.position(grid)
        nearest = int(np.argmin((points[:, 0] - x) ** 2 + (points[:, 1] - y) ** 2))
        s = self._foot(x, y, grid[max(nearest - 1, 0)], grid[min(nearest + 1, len(grid) - 1)], grid[nearest])
        px, py = self.position(s)
        theta = float(self.heading(s))
        d = float(-(x - px) * np.sin(theta) + (y - py) * np.cos(theta))
        return (s % self.length_m if self.closed else s), d

    def _foot(self, x: float, y: float, low: float, high: float, start: float) -> float:
        """Root of f(s) = (p - c(s)) . t(s) in low .. high, where f falls through 0."""
        s = start
        for _ in range(30):
            px, py = self.position(s)
            theta = float(self.heading(s))
            cos, sin = np.cos(theta), np.sin(theta)
            ahead = (x - px) * cos + (y - py) * sin
            if abs(ahead) < 1e-12:
                break
            if ahead > 0:
                low = s
            else:
                high = s
            left = -(x - px) * sin + (y - py) * cos
            slope = 1.0 - float(self.curvature(s)) * left
            new = s + ahead / slope if slope > 1e-6 else low - 1.0
            if not low < new < high:
                new = 0.5 * (low + high)
            if abs(new - s) < 1e-12:
                break
            s = float(new)
        return float(s)

    def _sample_step(self) -> float:
        """Spacing [m] of the samples in which the nearest foot is looked for."""
        return max(self.length_m / 200.0, 1e-3)
