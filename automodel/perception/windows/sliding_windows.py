"""The histogram start and the sliding windows of Balbuena Palma et al. 2020, sections IV-C and IV-D, in metres.

`HistogramStart` finds where a line starts, `SlidingWindows` follows it through the view.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import cv2
import numpy as np

from automodel.curves.lanes import LaneShape
from automodel.geometry import View
from automodel.signals import Observation
from automodel.types import FloatArray, Image


class HistogramStart:
    """The peak of the column histogram over the near half of the view, beside where a line is expected.

    The paper takes columns straight up the image, which smears when the car is not aligned with the lane or the lane
    bends; here they follow the expected line.
    """

    def __init__(self, view: View, marking_width_m: float) -> None:
        self.view, self._bin_m = view, 0.5 * marking_width_m
        self._first_row = view.height_px // 2

    def step(self, lines: Image, x_m: FloatArray, expected_y_m: FloatArray, reach_m: float) -> float:
        """How far [m] the line lies to the left of its expected places (n,) at x (n,), near to far, NaN: not expected.

        It is searched up to `reach_m` to each side in a filtered binary view (h, w); 0 where nothing is there.
        """
        found, known = cv2.findNonZero(lines[self._first_row :]), np.isfinite(expected_y_m)
        if found is None or not known.any():
            return 0.0
        px = found.reshape(-1, 2).astype(np.float64)  # OpenCV 4 gives (n, 1, 2), OpenCV 5 (n, 2)
        px[:, 1] += self._first_row
        x, y = self.view.to_body(px).T
        lateral = y - np.interp(x, x_m[known], expected_y_m[known])
        half = math.ceil(reach_m / self._bin_m)
        counts = np.histogram(lateral, 2 * half + 1, ((-half - 0.5) * self._bin_m, (half + 0.5) * self._bin_m))[0]
        peaks = np.convolve(counts, (0.5, 1.0, 0.5), mode="same")
        return float(peaks.argmax() - half) * self._bin_m if peaks.any() else 0.0


@dataclass(frozen=True, slots=True)
class _Piece:
    """The piece of the line in a window: its centroid [px], its slope, and its offset from the expected line [px]."""

    column: float
    row: float
    slope: float | None  # columns a row; None for a piece too short to have one
    offset: float
    reach: float  # rows for which the slope holds


class SlidingWindows:
    """Follows lines from the near rows to the far ones, each with a stack of windows.

    The paper: 12 windows of 52x24 px, re-centred only if more than 14 px belong to the line. Here a window is `WIDTH`
    markings wide and a twelfth of the view high; its place extrapolates the piece in the window before it, or is where
    the line is expected.
    """

    COUNT = 12
    WIDTH = 4.8
    FILL = 0.4  # share of a full line's pixels that a window needs
    LONG = 0.3  # minimum variance of the pixels along the rows, relative to a line that fills the window, for a slope
    SPREAD = 0.25  # variance of the pixels about their straight line, in squared markings; that of one line is 1/12

    def __init__(self, view: View, marking_width_m: float) -> None:
        self.view, self.marking_m = view, marking_width_m
        edges = np.linspace(view.height_px, 0, self.COUNT + 1).astype(int)
        self._rows = [(int(far), int(near)) for near, far in itertools.pairwise(edges)]
        self.centre_rows: FloatArray = np.array([0.5 * (far + near - 1) for far, near in self._rows])
        self._centres: list[float] = self.centre_rows.tolist()
        self.centre_x_m: FloatArray = view.to_body(np.column_stack((np.zeros(self.COUNT), self.centre_rows)))[:, 0]
        self._marking_px = marking_width_m / view.m_per_px
        self._half = int(0.5 * self.WIDTH * self._marking_px)

    def follow(
        self, lines: Image, expected_y_m: FloatArray, widening: float = 1.0, max_turn: float = math.inf
    ) -> FloatArray:
        """Line points (n, 2) [m] in a filtered binary view (h, w), near to far.

        `expected_y_m` (12,) is the line's lateral place at `centre_x_m`, NaN where it is not expected in the view.
        `widening` multiplies the windows' width, for a line whose place is uncertain. A line whose slope dy/dx differs
        from the expected one by more than `max_turn` is not extrapolated.
        """
        expected = self.view.columns(expected_y_m)
        columns, half, width = expected.tolist(), round(self._half * widening), self.view.width_px
        slopes = _slopes(expected, self.centre_rows).tolist() if max_turn < math.inf else None
        max_turn_px = max_turn * self.view.m_per_row / self.view.m_per_px
        spread_px2 = self.SPREAD * self._marking_px**2
        points: list[tuple[float, float]] = []
        last: _Piece | None = None
        for k, (far, near) in enumerate(self._rows):
            place = self._place(columns[k], self._centres[k], last)
            if place is None:
                continue
            low, high = max(place - half, 0), min(place + half + 1, width)
            if high - low < half:
                continue
            m = cv2.moments(lines[far:near, low:high], True)
            count, along = m["m00"], m["mu02"]
            if count < self.FILL * self._marking_px * (near - far):
                continue
            slope = m["mu11"] / along if along > 0 else 0.0
            if m["mu20"] - slope * m["mu11"] > spread_px2 * count:
                continue  # more than one line
            column, row = low + m["m10"] / count, far + m["m01"] / count
            usable = along > self.LONG * (near - far) ** 2 / 12.0 * count
            if usable and slopes is not None:
                usable = not abs(slope - slopes[k]) > max_turn_px  # NaN: nothing is expected there
            points.append((column, row))
            offset = column - columns[k] if math.isfinite(columns[k]) else 0.0
            last = _Piece(column, row, slope if usable else None, offset, 2.5 * (near - far))
        return self.view.to_body(np.array(points).reshape(-1, 2))

    def _place(self, expected: float, row: float, last: _Piece | None) -> int | None:
        """The next window's middle column: extrapolated from the last piece where it has a slope, else as expected."""
        if last is not None and last.slope is not None and abs(row - last.row) <= last.reach:
            return round(last.column + last.slope * (row - last.row))
        if not math.isfinite(expected):
            return None
        return round(expected + (last.offset if last is not None else 0.0))

    def observe(
        self,
        lines: Image,
        left_y_m: FloatArray,
        right_y_m: FloatArray,
        widening: float = 1.0,
        max_turn: float = math.inf,
    ) -> Observation:
        """The points of both lines; all arguments as in `follow`."""
        left, right = (self.follow(lines, y_m, widening, max_turn) for y_m in (left_y_m, right_y_m))
        return Observation(left_m=left, right_m=right, left_sigma_m=self._sigma(left), right_sigma_m=self._sigma(right))

    def expected(self, lane: LaneShape, side: int) -> FloatArray:
        """y [m] of the line on `side` (+1 left, -1 right) at each window's `centre_x_m`, NaN beyond the line's ends."""
        points = lane.line(side)
        x = points[:, 0]
        first = int(np.argmin(np.abs(lane.s_m)))  # beside the car; in a tight bend the line passes there again
        folds = np.flatnonzero(np.diff(x[first:]) <= 0.15 * (lane.s_m[1] - lane.s_m[0]))
        last = first + int(folds[0]) if len(folds) else len(x) - 1
        wanted = self.centre_x_m
        if last <= first:
            return np.full(len(wanted), np.nan)
        part = points[first : last + 1]
        return np.asarray(np.interp(wanted, part[:, 0], part[:, 1], left=np.nan, right=np.nan))

    def _sigma(self, points_m: FloatArray) -> FloatArray:
        """Standard deviations (n,): 0.12 markings near the car; further out the calibration's error dominates."""
        ahead = points_m[:, 0] - self.view.x_near_m
        return np.asarray(0.12 * self.marking_m + 0.01 * np.maximum(ahead, 0.0))


def _slopes(expected: FloatArray, rows: FloatArray) -> FloatArray:
    """The expected line's slope at each window [columns a row], NaN where it is not known."""
    slope = np.empty(len(rows))
    slope[1:-1] = (expected[2:] - expected[:-2]) / (rows[2:] - rows[:-2])
    slope[0], slope[-1] = slope[1], slope[-2]
    return slope
