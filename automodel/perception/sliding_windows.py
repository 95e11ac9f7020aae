"""The histogram start and the sliding windows of seed 003 (sections IV-C, IV-D), in metres of the bird's-eye view."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.geometry import View

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """Where the two lines begin: lateral places [m] at the reference point, and their common slope dy/dx."""

    left_m: float
    right_m: float
    slope: float


class HistogramStart:
    """Peaks of the column histogram over the near part, left and right of the car.

    The paper takes columns straight up the picture, which smears when the car stands askew; here the columns are
    sheared by a few headings and the one with the sharpest pair of peaks counts. A pair must stand about a lane's
    width apart and have the car between its lines.
    """

    SLOPES = tuple(np.tan(np.radians((0.0, -10.0, 10.0, -20.0, 20.0, -30.0, 30.0, -40.0, 40.0))))
    NEAR_LANES = 1.5  # depth of the near part
    WIDTH_TOLERANCE = 0.3

    def __init__(self, view: View, lane_width_m: float, marking_width_m: float, reference_x_m: float) -> None:
        self.view, self.lane_m, self.marking_m, self.reference_x_m = view, lane_width_m, marking_width_m, reference_x_m
        self._first_row = max(view.height_px - int(self.NEAR_LANES * lane_width_m / view.m_per_row), 0)
        self._bin_m = 0.5 * marking_width_m
        self._half = 1.2 * lane_width_m
        self._bins = int(2 * self._half / self._bin_m)

    def step(self, lines: Image) -> Start | None:
        """The best pair in a filtered binary view (h, w), or None."""
        found = cv2.findNonZero(lines[self._first_row :])
        if found is None or len(found) < 20:
            return None
        px = found.reshape(-1, 2).astype(np.float64)  # OpenCV 4 gives (n, 1, 2), OpenCV 5 (n, 2)
        px[:, 1] += self._first_row
        points = self.view.to_body(px)
        # a row of line pixels counts one line's width; so many rows are needed for a peak
        wanted = 0.2 * (self.view.height_px - self._first_row) * self.marking_m / self.view.m_per_px
        best, best_score = None, 2.0 * wanted
        for slope in self.SLOPES:
            lateral = points[:, 1] - (points[:, 0] - self.reference_x_m) * slope
            counts = np.histogram(lateral, self._bins, (-self._half, self._half))[0].astype(np.float64)
            peaks = np.convolve(counts, (0.5, 1.0, 0.5), mode="same")
            pair = self._pair(peaks, wanted)
            if pair is not None and pair[0] > best_score * 1.02:
                best_score, best = pair[0], Start(left_m=pair[1], right_m=pair[2], slope=float(slope))
        return best

    def _pair(self, peaks: FloatArray, wanted: float) -> tuple[float, float, float] | None:
        places = (np.arange(self._bins) + 0.5) * self._bin_m - self._half
        top = np.flatnonzero((peaks >= wanted) & (peaks >= np.roll(peaks, 1)) & (peaks > np.roll(peaks, -1)))
        left, right = top[places[top] > 0.02 * self.lane_m], top[places[top] < -0.02 * self.lane_m]
        if len(left) == 0 or len(right) == 0:
            return None
        width = places[left][:, None] - places[right][None, :]
        error = np.abs(width / self.lane_m - 1.0)
        near, far = peaks[left][:, None], peaks[right][None, :]
        strength = np.minimum(near, 2 * far) + np.minimum(far, 2 * near)
        score = np.where(error <= self.WIDTH_TOLERANCE, strength * (1.0 - error), -1.0)
        i, j = np.unravel_index(int(np.argmax(score)), score.shape)
        if score[i, j] <= 0:
            return None
        return float(score[i, j]), float(places[left[i]]), float(places[right[j]])


class SlidingWindows:
    """Follows one line from the near rows to the far ones by a stack of windows.

    The paper: 12 windows of 52x24 px, re-centred only if more than 14 px carry the line. Here a window is `BREADTH`
    markings broad and a twelfth of the view high, and goes where the line is expected: along the prediction, shifted by
    what the windows before it found.
    """

    COUNT = 12
    BREADTH = 4.8
    FILL = 0.22  # share of a full line's pixels that a window needs

    def __init__(self, view: View, marking_width_m: float) -> None:
        self.view = view
        edges = np.linspace(view.height_px, 0, self.COUNT + 1).astype(int)
        self._rows = [(int(far), int(near)) for near, far in itertools.pairwise(edges)]
        self.centre_rows: FloatArray = np.array([0.5 * (far + near - 1) for far, near in self._rows])
        self.centre_x_m: FloatArray = view.to_body(np.column_stack((np.zeros(self.COUNT), self.centre_rows)))[:, 0]
        self._marking_px = marking_width_m / view.m_per_px
        self._half = int(0.5 * self.BREADTH * self._marking_px)

    def follow(self, lines: Image, expected_y_m: FloatArray) -> FloatArray:
        """Line points (n, 2) [m] in a filtered binary view, near to far.

        `expected_y_m` (12,) is the line's lateral place at `centre_x_m`, NaN where it is not expected in the view.
        """
        expected = (self.view.half_width_m - expected_y_m) / self.view.m_per_px - 0.5
        slope = np.gradient(expected, self.centre_rows)
        points: list[tuple[float, float]] = []
        shift = 0.0
        for k, (far, near) in enumerate(self._rows):
            if not np.isfinite(expected[k]):
                continue
            centre = round(float(expected[k]) + shift)
            low, high = max(centre - self._half, 0), min(centre + self._half + 1, self.view.width_px)
            if high - low < self._half:
                continue
            m = cv2.moments(lines[far:near, low:high], True)
            if m["m00"] < self.FILL * self._marking_px * (near - far):
                continue
            column, row = m["m10"] / m["m00"], m["m01"] / m["m00"]
            lean = (float(slope[k]) if np.isfinite(slope[k]) else 0.0) * (near - far)
            if m["mu20"] / m["m00"] > 0.25 * self._marking_px**2 + 0.2 * lean**2:
                continue  # two things in one window
            found_row = far + row
            points.append((low + column, found_row))
            shift = low + column - float(expected[k]) - (lean / (near - far)) * (found_row - self.centre_rows[k])
        return self.view.to_body(np.array(points).reshape(-1, 2))
