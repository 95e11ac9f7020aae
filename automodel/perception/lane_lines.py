"""Both lines of a lane, followed by sliding windows from where they are expected."""

from __future__ import annotations

import math

import numpy as np

from automodel.estimation.lane_fit import LaneShape
from automodel.estimation.lane_tracker import Observation
from automodel.geometry import View
from automodel.perception.sliding_windows import SlidingWindows
from automodel.types import FloatArray, Image


class LaneLines:
    """The windows of the left and the right line of one view."""

    def __init__(self, view: View, marking_width_m: float) -> None:
        self.view, self.marking_m = view, marking_width_m
        self.windows = SlidingWindows(view, marking_width_m)

    def observe(
        self,
        lines: Image,
        left_y_m: FloatArray,
        right_y_m: FloatArray,
        breadth: float = 1.0,
        turn: float = math.inf,
    ) -> Observation:
        """The points of both lines; the expected places, `breadth` and `turn` as in `SlidingWindows.follow`."""
        left, right = (self.windows.follow(lines, y_m, breadth, turn) for y_m in (left_y_m, right_y_m))
        return Observation(left_m=left, right_m=right, left_sigma_m=self._sigma(left), right_sigma_m=self._sigma(right))

    def expected(self, lane: LaneShape, side: int) -> FloatArray:
        """y [m] of the line on `side` (+1 left, -1 right) at each window's `centre_x_m`, NaN where it does not go."""
        points = lane.beside(side * 0.5 * lane.width_m)
        x = points[:, 0]
        first = int(np.argmin(np.abs(lane.s_m)))  # beside the car; in a tight bend the line comes by there again
        folds = np.flatnonzero(np.diff(x[first:]) <= 0.15 * (lane.s_m[1] - lane.s_m[0]))
        last = first + int(folds[0]) if len(folds) else len(x) - 1
        wanted = self.windows.centre_x_m
        if last <= first:
            return np.full(len(wanted), np.nan)
        along, aside = x[first : last + 1], points[first : last + 1, 1]
        return np.asarray(np.interp(wanted, along, aside, left=np.nan, right=np.nan))

    def _sigma(self, points_m: FloatArray) -> FloatArray:
        """A window's point is good to a tenth of the marking's width near the car; further out calibration counts."""
        ahead = points_m[:, 0] - self.view.x_near_m
        return np.asarray(0.12 * self.marking_m + 0.01 * np.maximum(ahead, 0.0))
