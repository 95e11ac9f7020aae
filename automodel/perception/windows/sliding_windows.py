"""The histogram start and the sliding windows of Balbuena Palma et al. 2020, sections IV-C and IV-D, in metres.

`HistogramStart` finds where the lines start, `SlidingWindows` follows them through the view.
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
from automodel.types import FloatArray, Image, Ints


@dataclass(frozen=True, slots=True, kw_only=True)
class StartCandidate:
    """Lateral places [m] of the lines at the reference point, None for a line not found, and their slope dy/dx."""

    left_m: float | None
    right_m: float | None
    slope: float


class HistogramStart:
    """Peaks of the column histogram over the near part, left and right of the car.

    The paper takes columns straight up the image, which smears when the car is not aligned with the lane; here the
    columns are sheared by a few headings, and the one with the sharpest peaks counts. A pair must be about a lane width
    apart with the car between its lines. Without a pair, a single line within a lane width is taken: in a tight bend
    the inner line is out of view.
    """

    HEADING_RAD, HEADINGS = math.radians(40.0), 9  # the largest that is tried, and how many are
    NEAR_LANES = 1.5  # depth of the near part
    WIDTH_TOLERANCE = 0.3
    SINGLES = 4
    FILL = 0.2  # minimum share of the near part's rows that a peak's line fills: it may be dashed and bent

    def __init__(self, view: View, lane_width_m: float, marking_width_m: float, reference_x_m: float) -> None:
        self.view, self.lane_m, self.reference_x_m = view, lane_width_m, reference_x_m
        self._first_row = max(view.height_px - int(self.NEAR_LANES * lane_width_m / view.m_per_row), 0)
        headings = np.linspace(-self.HEADING_RAD, self.HEADING_RAD, self.HEADINGS)
        self._slopes = np.tan(headings[np.argsort(np.abs(headings), kind="stable")]).tolist()
        self._bin_m = 0.5 * marking_width_m
        self._half = 1.2 * lane_width_m
        self._bins = int(2 * self._half / self._bin_m)
        self._places = (np.arange(self._bins) + 0.5) * self._bin_m - self._half
        self._full = (view.height_px - self._first_row) * marking_width_m / view.m_per_px  # pixels of a whole line

    def step(self, lines: Image) -> list[StartCandidate]:
        """Candidates in a filtered binary view (h, w), the best first: one pair, or up to `SINGLES` single lines."""
        found = cv2.findNonZero(lines[self._first_row :])
        if found is None:
            return []
        px = found.reshape(-1, 2).astype(np.float64)  # OpenCV 4 gives (n, 1, 2), OpenCV 5 (n, 2)
        px[:, 1] += self._first_row
        points = self.view.to_body(px)
        pairs: list[tuple[float, StartCandidate]] = []
        singles: list[tuple[float, StartCandidate]] = []
        for slope in self._slopes:
            lateral = points[:, 1] - (points[:, 0] - self.reference_x_m) * slope
            counts = np.histogram(lateral, self._bins, (-self._half, self._half))[0].astype(np.float64)
            peaks = np.convolve(counts, (0.5, 1.0, 0.5), mode="same") / self._full
            pairs += self._pairs(peaks, float(slope))
            singles += self._singles(peaks, float(slope))
        ranked = [start for _, start in sorted(pairs or singles, key=lambda scored: -scored[0])]
        return ranked[: 1 if pairs else self.SINGLES]

    def _pairs(self, peaks: FloatArray, slope: float) -> list[tuple[float, StartCandidate]]:
        top = self._tops(peaks)
        left = top[self._places[top] > 0.02 * self.lane_m]
        right = top[self._places[top] < -0.02 * self.lane_m]
        width = (self._places[left][:, None] - self._places[right][None, :]) / np.hypot(1.0, slope)
        error = np.abs(width / self.lane_m - 1.0)
        near, far = peaks[left][:, None], peaks[right][None, :]
        score = (np.minimum(near, 2 * far) + np.minimum(far, 2 * near)) * (1.0 - error)
        return [
            (
                float(score[i, j]) - 0.02 * abs(slope),  # among equals the straightest wins
                StartCandidate(left_m=float(self._places[left[i]]), right_m=float(self._places[right[j]]), slope=slope),
            )
            for i, j in np.argwhere(error <= self.WIDTH_TOLERANCE)
        ]

    def _singles(self, peaks: FloatArray, slope: float) -> list[tuple[float, StartCandidate]]:
        out = []
        for place, peak in ((float(self._places[i]), float(peaks[i])) for i in self._tops(peaks)):
            if 0.1 * self.lane_m < abs(place) < 0.9 * self.lane_m:
                left, right = (place, None) if place > 0 else (None, place)
                out.append((peak - 0.02 * abs(slope), StartCandidate(left_m=left, right_m=right, slope=slope)))
        return out

    def _tops(self, peaks: FloatArray) -> Ints:
        return np.flatnonzero((peaks >= self.FILL) & (peaks >= np.roll(peaks, 1)) & (peaks > np.roll(peaks, -1)))


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
