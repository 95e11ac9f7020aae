"""The histogram start and the sliding windows of Balbuena Palma et al. 2020, sections IV-C and IV-D, in metres.

`HistogramStart` finds where a line starts, `SlidingWindows` follows it through the view; its loops are compiled.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from automodel.compiled import compiled
from automodel.curves.lanes import LaneShape
from automodel.geometry import View
from automodel.signals import Observation
from automodel.types import FloatArray, Image, Ints


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


class Windows(NamedTuple):
    """The stack of windows on a view, near to far, as the compiled loop takes it.

    The first row of each window and the one after its last (n,), its middle row (n,), and that row's x [m] (n,). Sizes
    of the view [px]; of a line, its width [px], the least share of its pixels, of their variance along the rows, and
    the most variance across [px^2]; `sigma_m` of its points near the car, while further out the calibration's error
    dominates. `near_m`, `far_m`, `left_m`, `row_m`, `column_m`: the view's near, far and left edge and its steps.
    """

    first: Ints
    end: Ints
    centre: FloatArray
    x_m: FloatArray
    width_px: int
    marking_px: float
    fill: float
    long: float
    spread_px2: float
    sigma_m: float
    near_m: float
    far_m: float
    left_m: float
    row_m: float
    column_m: float


class SlidingWindows:
    """Follows lines from the near rows to the far ones, each with a stack of windows.

    The paper: 12 windows of 52x24 px, re-centred only if more than 14 px belong to the line. Here a window is `WIDTH`
    markings wide and a twelfth of the view high; its place extrapolates the piece in the window before it, or is where
    the line is expected.
    """

    COUNT = 12
    WIDTH = 4.8
    FILL = 0.4  # share of a full line's pixels that a window needs
    LONG = 0.5  # minimum variance of the pixels along a window, relative to a line that fills it, for a direction
    SPREAD = 0.25  # variance of the pixels about their straight line, in squared markings; that of one line is 1/12

    def __init__(self, view: View, marking_width_m: float) -> None:
        self.view, self.marking_m = view, marking_width_m
        edges = np.linspace(view.height_px, 0, self.COUNT + 1).astype(int)
        first, end = edges[1:], edges[:-1]
        self.centre_rows: FloatArray = 0.5 * (first + end - 1)
        self.centre_x_m: FloatArray = view.to_body(np.column_stack((np.zeros(self.COUNT), self.centre_rows)))[:, 0]
        marking_px = marking_width_m / view.m_per_px
        self._half = int(0.5 * self.WIDTH * marking_px)
        self._windows = Windows(
            first=first.astype(np.intp),
            end=end.astype(np.intp),
            centre=self.centre_rows,
            x_m=self.centre_x_m,
            width_px=view.width_px,
            marking_px=marking_px,
            fill=self.FILL,
            long=self.LONG,
            spread_px2=self.SPREAD * marking_px**2,
            sigma_m=0.12 * marking_width_m,
            near_m=view.x_near_m,
            far_m=view.x_far_m,
            left_m=view.half_width_m,
            row_m=view.m_per_row,
            column_m=view.m_per_px,
        )
        self._warm_up()

    def follow(self, lines: Image, expected_y_m: FloatArray, widening: float = 1.0) -> FloatArray:
        """Line points (n, 2) [m] in a filtered binary view (h, w), near to far.

        `expected_y_m` (12,) is the line's lateral place at `centre_x_m`, NaN where it is not expected in the view.
        `widening` multiplies the windows' width, for a line whose place is uncertain.
        """
        return _followed(lines, expected_y_m, self._windows, round(self._half * widening))

    def observe(
        self,
        lines: Image,
        left_y_m: FloatArray,
        right_y_m: FloatArray,
        widening: float = 1.0,
    ) -> Observation:
        """The points of both lines; all arguments as in `follow`."""
        left, right, left_sigma, right_sigma = _observed(
            lines, left_y_m, right_y_m, self._windows, round(self._half * widening)
        )
        return Observation(left_m=left, right_m=right, left_sigma_m=left_sigma, right_sigma_m=right_sigma)

    def expected(self, lane: LaneShape, side: int) -> FloatArray:
        """y [m] of the line on `side` (+1 left, -1 right) at each window's `centre_x_m`, NaN beyond the line's ends."""
        half_m = 0.5 * side
        return _expected(
            lane.s_m, lane.points_m, lane.theta_rad, half_m * lane.width_m, half_m * lane.taper, self.centre_x_m
        )

    def _warm_up(self) -> None:
        """Compile everything that a frame calls, so that none waits for it."""
        nothing, at = np.zeros((self.view.height_px, self.view.width_px), np.uint8), np.array([0.0, 1.0])
        straight = LaneShape(
            s_m=at, points_m=np.column_stack((at, at)), theta_rad=0.0 * at, kappa_per_m=0.0 * at, width_m=self.marking_m
        )
        at = self.expected(straight, +1)
        self.observe(nothing, at, at)


@compiled
def _observed(
    lines: Image, left_y_m: FloatArray, right_y_m: FloatArray, windows: Windows, half_px: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """The points of both lines, as `_followed`, and their standard deviations."""
    left, right = _followed(lines, left_y_m, windows, half_px), _followed(lines, right_y_m, windows, half_px)
    left_sigma = windows.sigma_m + 0.01 * np.maximum(left[:, 0] - windows.near_m, 0.0)
    return left, right, left_sigma, windows.sigma_m + 0.01 * np.maximum(right[:, 0] - windows.near_m, 0.0)


@compiled
def _followed(lines: Image, expected_y_m: FloatArray, windows: Windows, half_px: int) -> FloatArray:
    """As `SlidingWindows.follow`; windows `half_px` wide to each side, slopes in columns a row."""
    count = len(windows.centre)
    expected = (windows.left_m - expected_y_m) / windows.column_m - 0.5
    points, found = np.empty((count, 2)), 0
    # The last piece: its middle [px], its slope if it has one, its distance [px] to the right of the expected line, and
    # the rows for which the slope holds.
    column = row = slope = beside = reach = 0.0
    sloping = False
    for k in range(count):
        far, near = windows.first[k], windows.end[k]
        if found and sloping and abs(windows.centre[k] - row) <= reach:
            place = round(column + slope * (windows.centre[k] - row))
        elif math.isfinite(expected[k]):
            place = round(expected[k] + beside)
        else:
            continue
        low, high = max(place - half_px, 0), min(place + half_px + 1, windows.width_px)
        if high - low < half_px:
            continue
        area, m10, m01, m20, m11, m02 = moments(lines, far, near, low, high)
        if area < windows.fill * windows.marking_px * (near - far):
            continue
        along = m02 - m01 * m01 / area
        lean = m11 - m10 * m01 / area
        tilt = lean / along if along > 0.0 else 0.0
        if m20 - m10 * m10 / area - tilt * lean > windows.spread_px2 * area:
            continue  # more than one line
        column, row, slope, reach = low + m10 / area, far + m01 / area, tilt, 2.5 * (near - far)
        sloping = along > windows.long * (near - far) ** 2 / 12.0 * area
        beside = column - expected[k] if math.isfinite(expected[k]) else 0.0
        points[found, 0] = windows.far_m - (row + 0.5) * windows.row_m
        points[found, 1] = windows.left_m - (column + 0.5) * windows.column_m
        found += 1
    return points[:found]


@compiled
def moments(lines: Image, far: int, near: int, low: int, high: int) -> tuple[float, float, float, float, float, float]:
    """Number of nonzero pixels in a window, and their sums of column, row, column^2, column row and row^2 in it."""
    m00 = m10 = m01 = m20 = m11 = m02 = 0
    for i in range(near - far):
        count = across = square = 0
        for j in range(high - low):
            if lines[far + i, low + j] != 0:
                count += 1
                across += j
                square += j * j
        m00, m10, m20 = m00 + count, m10 + across, m20 + square
        m01, m11, m02 = m01 + i * count, m11 + i * across, m02 + i * i * count
    return float(m00), float(m10), float(m01), float(m20), float(m11), float(m02)


@compiled
def _expected(
    s_m: FloatArray, points_m: FloatArray, theta_rad: FloatArray, half_m: float, taper: float, wanted_m: FloatArray
) -> FloatArray:
    """As `SlidingWindows.expected`, of the line `half_m` + `taper` s to the left of a centerline."""
    count, first = len(s_m), 0
    x, y = np.empty(count), np.empty(count)
    for i in range(count):
        lateral = half_m + taper * s_m[i]
        if lateral * half_m < 0.0:
            lateral = 0.0
        x[i] = points_m[i, 0] - lateral * math.sin(theta_rad[i])
        y[i] = points_m[i, 1] + lateral * math.cos(theta_rad[i])
        if abs(s_m[i]) < abs(s_m[first]):  # beside the car; in a tight bend the line passes there again
            first = i
    last = first
    while last + 1 < count and x[last + 1] - x[last] > 0.15 * (s_m[1] - s_m[0]):
        last += 1
    out = np.full(len(wanted_m), np.nan)
    if last <= first:
        return out
    i = first
    for k in range(len(wanted_m)):  # near to far
        if not x[first] <= wanted_m[k] <= x[last]:
            continue
        while i + 1 < last and x[i + 1] <= wanted_m[k]:
            i += 1
        out[k] = y[i] + (y[i + 1] - y[i]) / (x[i + 1] - x[i]) * (wanted_m[k] - x[i])
    return out
