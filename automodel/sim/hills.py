"""A road that is not flat: its height along the road, and where a camera on it sees the ground."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from automodel.geometry import GroundCamera
from automodel.types import FloatArray

# Of the ground a car sees heights (n,) [m] over the plane on which it stands, at places (n,) [m] ahead of its origin.
HeightAhead = Callable[[FloatArray], FloatArray]

FAR = 2000.0  # camera heights up to which ground is seen
STEPS = 4000  # of the way there


class Hills:
    """Slopes of a road and the vertical curves between them, which are parabolas as on real roads.

    The slope [m/m] is linear in the arc length [m] between the given (s_m, slope), constant before and after them.
    """

    def __init__(self, slopes: Sequence[tuple[float, float]]) -> None:
        self._s, self._slope = np.array(slopes, dtype=np.float64).reshape(-1, 2).T
        if len(self._s) and (np.diff(self._s) <= 0.0).any():
            raise ValueError("slopes: expected arc lengths that increase")
        means = 0.5 * (self._slope[1:] + self._slope[:-1])
        self._height = np.concatenate(((0.0,), np.cumsum(means * np.diff(self._s))))[: len(self._s)]

    def slope(self, s_m: ArrayLike) -> FloatArray:
        """The slope [m/m] at arc lengths (n,)."""
        s = np.asarray(s_m, dtype=np.float64)
        return np.asarray(np.interp(s, self._s, self._slope)) if len(self._s) else np.zeros(s.shape)

    def height_m(self, s_m: ArrayLike) -> FloatArray:
        """The height [m] at arc lengths (n,), over that at the first given place."""
        s = np.asarray(s_m, dtype=np.float64)
        if not len(self._s):
            return np.zeros(s.shape)
        first = np.clip(np.searchsorted(self._s, s, side="right") - 1, 0, len(self._s) - 1)
        along = s - self._s[first]
        return np.asarray(self._height[first] + 0.5 * along * (self._slope[first] + self.slope(s)))

    def ahead(self, s_m: float) -> HeightAhead:
        """The ground that a car at `s_m` sees: it stands on the slope there, and what bends away lies ahead."""
        here, slope = float(self.height_m(s_m)), float(self.slope(s_m))
        return lambda x_m: self.height_m(s_m + x_m) - here - slope * x_m


def seen_ground(camera: GroundCamera, rays: FloatArray, height_m: HeightAhead | None) -> FloatArray:
    """Where rays (..., 3) of the cam frame first meet the ground: (..., 2) [m] of the body frame; NaN: nowhere.

    Ground ahead has a height that depends on the way ahead alone; without one it is z = 0.
    """
    turned = rays @ camera.cam_from_body
    centre, forward = camera.centre_m, turned[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        if height_m is None:
            far = np.where(turned[..., 2] < 0.0, -centre[2] / turned[..., 2], np.nan)
        else:
            # The ray of a slope meets the ground where that, seen from the camera, first reaches the slope.
            x = np.geomspace(0.1, FAR, STEPS) * centre[2]
            highest = np.maximum.accumulate((height_m(centre[0] + x) - centre[2]) / x)
            slope = turned[..., 2] / forward
            ahead = np.interp(slope, highest, x, left=x[0], right=np.nan)
            far = np.where((forward > 0.0) & (slope < highest[-1]), ahead / forward, np.nan)
    return np.asarray(centre[:2] + far[..., None] * turned[..., :2])
