"""One window on a line: what of it lies there, and whether it is a line at all."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np

from automodel.geometry import View
from automodel.types import Image


class Glimpse(NamedTuple):
    """The piece of a line in a window: its middle (x, y) [m], and its own direction [rad] if it is long enough.

    Of the direction's two senses it is the one nearer to where the window was headed.
    """

    x_m: float
    y_m: float
    direction_rad: float | None


class Surroundings(NamedTuple):
    """What lies about a piece: the share of the window's length on which it is seen, and in shares of a whole line what
    is to its left and right."""

    covered: float
    flanks: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Box:
    """A window in pixels; across the line lie its columns and along it its rows, or the other way round."""

    across_px: int
    along_px: int
    aside: bool
    full: float  # share of a whole line's pixels that is too much for one
    spread_px2: float  # variance across the line, likewise
    long_px2: float  # variance along the window from which on a line's direction can be told
    rows: int = field(init=False)
    columns: int = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "rows", self.across_px if self.aside else self.along_px)
        object.__setattr__(self, "columns", self.along_px if self.aside else self.across_px)


class LineWindows:
    """Windows on a binary bird's-eye view, square to the view, broad across the line that they look for.

    A line that leaves by the two broad sides has the centroid of its pixels on its middle, whatever its slant, and
    that holds up to 45 deg; lines that go more aside than ahead get the window turned by 90 deg. `visible` (h, w) is
    nonzero where the view shows what the camera sees; None: everywhere.
    """

    ACROSS, ALONG = 4.5, 2.8  # markings
    FULL = 1.9  # share of a whole line's pixels from which on it is an area
    SPREAD = 0.3  # variance across the line in squared markings, at most; that of one line is 1/12
    SLICE_ACROSS, SLICE_ALONG, SLICE_FULL, SLICE_SPREAD = 2.4, 1.0, 1.5, 0.16  # where a window shows more than a line
    FILL = 0.35  # share of a whole line's pixels, at least
    LONG = 0.5  # variance along the window, in that of a line that fills it, to tell the direction; no disc has it
    FLANK = (1.5, 4.5)  # markings from a piece to what is beside it
    TRIES = 3  # times that a window is moved onto what it shows
    RIM = 1.3  # markings that a point lies inside the visible part, at least

    def __init__(self, view: View, marking_width_m: float, visible: Image | None = None) -> None:
        self._far_m, self._left_m = view.x_far_m, view.half_width_m
        self._row_m, self._column_m = view.m_per_row, view.m_per_px
        self._height, self._width = view.height_px, view.width_px
        self._marking_px = (marking_width_m / view.m_per_px, marking_width_m / view.m_per_row)  # across, by `aside`
        self._aspect = (view.m_per_px / view.m_per_row, view.m_per_row / view.m_per_px)
        self._boxes = tuple((self._window(aside), self._slice(aside)) for aside in (False, True))
        if visible is None:
            visible = np.full((self._height, self._width), 255, np.uint8)
        self._inner = self._inner_part(visible).tobytes()

    def _window(self, aside: bool) -> _Box:
        across_px, along_px = self._size(aside, self.ACROSS, self.ALONG)
        return _Box(
            across_px=across_px,
            along_px=along_px,
            aside=aside,
            full=self.FULL,
            spread_px2=self.SPREAD * self._marking_px[aside] ** 2,
            long_px2=self.LONG * along_px**2 / 12.0,
        )

    def _slice(self, aside: bool) -> _Box:
        across_px, along_px = self._size(aside, self.SLICE_ACROSS, self.SLICE_ALONG)
        return _Box(
            across_px=across_px,
            along_px=along_px,
            aside=aside,
            full=self.SLICE_FULL,
            spread_px2=self.SLICE_SPREAD * self._marking_px[aside] ** 2,
            long_px2=math.inf,
        )

    def _size(self, aside: bool, across: float, along: float) -> tuple[int, int]:
        return max(round(across * self._marking_px[aside]), 3), max(round(along * self._marking_px[not aside]), 2)

    def _inner_part(self, visible: Image) -> Image:
        """The visible part less a rim."""
        y, x = (int(self.RIM * px) for px in (self._marking_px[1], self._marking_px[0]))
        padded = cv2.copyMakeBorder(visible, y, y, x, x, cv2.BORDER_CONSTANT, value=[0])
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * x + 1, 2 * y + 1))
        return np.asarray(cv2.erode(padded, disc)[y : y + self._height, x : x + self._width], dtype=np.uint8)

    def in_sight(self, x_m: float, y_m: float) -> bool:
        """Whether a line through (x, y) [m] would be seen there in its whole breadth."""
        row, column = int((self._far_m - x_m) / self._row_m), int((self._left_m - y_m) / self._column_m)
        inside = 0 <= row < self._height and 0 <= column < self._width
        return inside and self._inner[row * self._width + column] != 0

    def is_bare(self, features: Image, x_m: float, y_m: float, reach_m: float) -> bool:
        """Whether a binary view (h, w) shows nothing in windows up to `reach_m` about (x, y) [m]."""
        row, column = (self._far_m - x_m) / self._row_m, (self._left_m - y_m) / self._column_m
        high, broad = (
            reach_m / self._row_m + self._boxes[1][0].rows,
            reach_m / self._column_m + self._boxes[0][0].columns,
        )
        rows = slice(max(int(row - high), 0), max(int(row + high), 0))
        columns = slice(max(int(column - broad), 0), max(int(column + broad), 0))
        return cv2.countNonZero(features[rows, columns]) == 0

    def around(self, features: Image, x_m: float, y_m: float, heading_rad: float) -> Surroundings:
        """What lies about a line's piece in a binary view (h, w)."""
        aside = abs(math.sin(heading_rad)) > abs(math.cos(heading_rad))
        row, column = (self._far_m - x_m) / self._row_m, (self._left_m - y_m) / self._column_m
        if aside:
            features, row, column = features.T, column, row
        along, broad = self._boxes[aside][0].along_px, self._marking_px[aside]
        first = int(row - 0.5 * along)
        rows = features[max(first, 0) : max(first + along, 0)]
        cuts = [max(int(column + markings * broad), 0) for markings in (-self.FLANK[1], -self.FLANK[0], *self.FLANK)]
        left, middle, right = (rows[:, cuts[i] : cuts[i + 1]] for i in range(3))
        flanks = [np.count_nonzero(flank) / (broad * along) for flank in (left, right)]
        return Surroundings(np.count_nonzero(middle.any(axis=1)) / along, (flanks[0], flanks[1]))

    def look(self, features: Image, x_m: float, y_m: float, heading_rad: float) -> Glimpse | None:
        """The line about a place (x, y) [m] of a binary view (h, w), headed there; None where there is none.

        Where a window shows more than one line, a slice of it about the place itself counts alone.
        """
        row, column = (self._far_m - x_m) / self._row_m - 0.5, (self._left_m - y_m) / self._column_m - 0.5
        ahead, left = abs(math.cos(heading_rad)), abs(math.sin(heading_rad))
        aside = left > ahead
        tilt = ahead / left if aside else left / ahead
        broad = self._marking_px[aside] * math.sqrt(1.0 + tilt * tilt)  # of the line, as rows or columns cut it
        for box in self._boxes[aside]:
            whole = broad * box.along_px
            room = max(0.5 * (box.across_px - broad - box.along_px * tilt / self._aspect[aside]), 0.75)
            found = self._centred(features, row, column, box, (self.FILL * whole, room))
            if found is None:
                return None
            at_row, at_column, m = found
            pixels = m["m00"]
            along, across = (m["mu20"], m["mu02"]) if aside else (m["mu02"], m["mu20"])
            lean = m["mu11"] / along if along > 0.0 else 0.0
            slope = lean * self._aspect[aside]  # on the ground
            spread = (across - lean * m["mu11"]) / (1.0 + slope * slope)
            if pixels <= box.full * whole and spread <= box.spread_px2 * pixels:
                break
        else:
            return None
        x_m, y_m = self._far_m - (at_row + 0.5) * self._row_m, self._left_m - (at_column + 0.5) * self._column_m
        if not self.in_sight(x_m, y_m):
            return None
        if along <= box.long_px2 * pixels:
            return Glimpse(x_m, y_m, None)
        direction = math.atan2(1.0, slope) if aside else math.atan(slope)
        return Glimpse(x_m, y_m, heading_rad + math.remainder(direction - heading_rad, math.pi))

    def _centred(
        self, features: Image, row: float, column: float, box: _Box, wanted: tuple[float, float]
    ) -> tuple[float, float, dict[str, float]] | None:
        """Row, column and moments of what a window shows once it is moved across onto it; None for less than the least.

        `wanted`: the least number of pixels, and how far off the middle a line may lie and still leave by both broad
        sides.
        """
        least, room = wanted
        for _ in range(self.TRIES):
            bottom, high = round(row + 0.5 * (box.rows + 1)), round(column + 0.5 * (box.columns + 1))
            top, low = max(bottom - box.rows, 0), max(high - box.columns, 0)
            m = cv2.moments(features[top : max(bottom, 0), low : max(high, 0)], True)
            count = m["m00"]
            if count < least:
                return None
            at_row, at_column = top + m["m01"] / count, low + m["m10"] / count
            if abs(at_row - row if box.aside else at_column - column) <= room:
                break
            row, column = (at_row, column) if box.aside else (row, at_column)
        return at_row, at_column, m
