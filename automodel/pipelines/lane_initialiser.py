"""A lane from a single frame, at the start."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from automodel.curves.regression import fit_polynomial
from automodel.estimation.polynomial.lane_fit import LaneSolution
from automodel.estimation.polynomial.lane_tracker import LaneTracker, Support
from automodel.perception.windows.sliding_windows import HistogramStart, SlidingWindows
from automodel.signals import Observation
from automodel.types import FloatArray, Image


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LaneCandidate:
    """A lane, and the points that support it."""

    seen: Observation
    solution: LaneSolution

    @property
    def support(self) -> Support:
        """The number of points on each line."""
        return Support(left=len(self.seen.left_m), right=len(self.seen.right_m))

    @property
    def pair(self) -> bool:
        """Whether both lines were seen."""
        return self.support.left > 0 and self.support.right > 0


class LaneInitialiser:
    """Histogram, windows, regression and fit of single frames; reads the tracker and does not change it."""

    START_WINDOWS = 4  # windows on a line that starts a lane, alone or with another one
    LINE_WINDOWS = 2  # windows that make a line seen

    def __init__(self, windows: SlidingWindows, tracker: LaneTracker) -> None:
        self._windows, self._tracker, self.view = windows, tracker, windows.view
        config = tracker.fit.config
        self._lane_m, self._reference_x_m = config.lane_width_m, config.reference_x_m
        self._start = HistogramStart(self.view, self._lane_m, windows.marking_m, self._reference_x_m)

    def find(self, lines: Image) -> LaneCandidate | None:
        """A lane from a filtered view (h, w): a pair of lines in `START_WINDOWS` each, or one."""
        best: Observation | None = None
        for start in self._start.step(lines):
            along = start.slope * (self._windows.centre_x_m - self._reference_x_m)
            nowhere = np.full(len(along), np.nan)
            left, right = (nowhere if y is None else y + along for y in (start.left_m, start.right_m))
            seen = self._windows.observe(lines, left, right)
            pair = start.left_m is not None and start.right_m is not None
            counts = (len(seen.left_m), len(seen.right_m))
            enough = (min(counts) if pair else max(counts)) >= self.START_WINDOWS
            if enough and (best is None or sum(counts) > len(best.left_m) + len(best.right_m)):
                best = seen
        if best is None:
            return None
        solution = self._tracker.fit_frame(best, self._initial_parameters(best))
        if solution is None or abs(solution.offset_m) > 0.5 * solution.width_m:
            return None
        return LaneCandidate(seen=best, solution=solution)

    def _initial_parameters(self, seen: Observation) -> FloatArray:
        """Lane parameters at the reference point from the mean arc of the lines' regressions (degree 2)."""
        width, x = self._lane_m, self._reference_x_m
        arcs = []
        for side, points in ((+1, seen.left_m), (-1, seen.right_m)):
            if len(points) == 0:
                continue
            c = np.zeros(3)
            fitted = fit_polynomial(points[:, 0], points[:, 1], 2)
            c[: len(fitted)] = fitted
            theta = math.atan(c[1] + 2.0 * c[2] * x)
            kappa = 2.0 * c[2] * math.cos(theta) ** 3
            offset = side * 0.5 * width - (c[0] + c[1] * x + c[2] * x * x) * math.cos(theta)
            arcs.append((offset, theta, kappa / max(1.0 + side * 0.5 * width * kappa, 0.3)))
        offset, theta, kappa = np.mean(arcs, axis=0)
        return self._tracker.fit.start(offset, theta, kappa, width)
