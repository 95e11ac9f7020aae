"""Windows of the window line following (Cudrano et al. 2020, section IV): the piece of a line that one window shows."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from automodel.geometry import View
from automodel.types import Image


class WindowHit(NamedTuple):
    """The piece of a line in a window: its centroid (x, y) [m], body frame, and its direction [rad] if long enough.

    Of the direction's two senses it is the one nearer to the window's heading.
    """

    x_m: float
    y_m: float
    direction_rad: float | None


class Surroundings(NamedTuple):
    """The share of the window's length that a piece covers, and the line areas to its left and right, as shares of a
    whole line."""

    covered: float
    flanks: tuple[float, float]


class _WindowShape(NamedTuple):
    """A window in pixels. Its columns lie across the line and its rows along it; `sideways`: the other way round."""

    rows: int
    columns: int
    across_px: int
    along_px: int
    sideways: bool
    full: float  # share of a whole line's pixels above which it is no single line
    spread_px2: float  # variance across the line, likewise
    long_px2: float  # variance along the window from which on a line's direction is defined


class LineWindows:
    """Windows on a binary bird's-eye view (h, w), aligned with the view and wide across the line.

    The pixels of a line that leaves by the two long sides have their centroid on its middle, whatever its slant, up to
    45 deg. For lines that run more across the view than ahead the window is turned by 90 deg. `visible` (h, w) is
    nonzero where the view shows ground that the camera sees; None: everywhere.
    """

    ACROSS, ALONG = 4.5, 2.8  # size in marking widths
    FULL = 1.9  # share of a whole line's pixels from which on it is an area
    SPREAD = 0.3  # maximum variance across the line in squared markings; that of one line is 1/12
    FILL = 0.35  # minimum share of a whole line's pixels
    LONG = 0.5  # minimum variance along the window, relative to a line that fills it, for a direction; no disc has it
    FLANK = (1.5, ACROSS)  # markings from a piece to what is beside it
    TRIES = 3  # iterations of centring a window
    RIM = 1.3  # markings that a point lies inside the visible part, at least

    def __init__(self, view: View, marking_width_m: float, visible: Image | None = None) -> None:
        self._far_m, self._left_m = view.x_far_m, view.half_width_m
        self._row_m, self._column_m = view.m_per_row, view.m_per_px
        self._height, self._width = view.height_px, view.width_px
        self._marking_px = (marking_width_m / view.m_per_px, marking_width_m / view.m_per_row)  # index: `sideways`
        self._aspect = (view.m_per_px / view.m_per_row, view.m_per_row / view.m_per_px)
        whole = self.ACROSS, self.ALONG, self.FULL, self.SPREAD, self.LONG
        part = 0.5 * self.ACROSS, 0.5 * self.ALONG, self.FULL, 0.5 * self.SPREAD, math.inf
        self._shapes = tuple(tuple(self._shape(sideways, *of) for of in (whole, part)) for sideways in (False, True))
        if visible is None:
            visible = np.full((self._height, self._width), 255, np.uint8)
        self._inner = self._inner_part(visible).tobytes()

    def _shape(
        self, sideways: bool, across: float, along: float, full: float, spread: float, long: float
    ) -> _WindowShape:
        across_px = max(round(across * self._marking_px[sideways]), 3)
        along_px = max(round(along * self._marking_px[not sideways]), 2)
        rows, columns = (across_px, along_px) if sideways else (along_px, across_px)
        spread_px2, long_px2 = spread * self._marking_px[sideways] ** 2, long * along_px**2 / 12.0
        return _WindowShape(rows, columns, across_px, along_px, sideways, full, spread_px2, long_px2)

    def _inner_part(self, visible: Image) -> Image:
        """The visible part less a rim."""
        y, x = (int(self.RIM * px) for px in (self._marking_px[1], self._marking_px[0]))
        padded = cv2.copyMakeBorder(visible, y, y, x, x, cv2.BORDER_CONSTANT, value=[0])
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * x + 1, 2 * y + 1))
        return np.asarray(cv2.erode(padded, disc)[y : y + self._height, x : x + self._width], dtype=np.uint8)

    def in_sight(self, x_m: float, y_m: float) -> bool:
        """Whether a line through (x, y) [m] would be visible there over its whole width."""
        row, column = int((self._far_m - x_m) / self._row_m), int((self._left_m - y_m) / self._column_m)
        inside = 0 <= row < self._height and 0 <= column < self._width
        return inside and self._inner[row * self._width + column] != 0

    def is_empty(self, features: Image, x_m: float, y_m: float, reach_m: float) -> bool:
        """Whether a binary view (h, w) is empty in all windows up to `reach_m` around (x, y) [m]."""
        row, column = (self._far_m - x_m) / self._row_m, (self._left_m - y_m) / self._column_m
        high = reach_m / self._row_m + self._shapes[1][0].rows
        wide = reach_m / self._column_m + self._shapes[0][0].columns
        rows = slice(max(int(row - high), 0), max(int(row + high), 0))
        columns = slice(max(int(column - wide), 0), max(int(column + wide), 0))
        return cv2.countNonZero(features[rows, columns]) == 0

    def surroundings(self, features: Image, x_m: float, y_m: float, heading_rad: float) -> Surroundings:
        """The surroundings of a line's piece in a binary view (h, w)."""
        sideways = abs(math.sin(heading_rad)) > abs(math.cos(heading_rad))
        row, column = (self._far_m - x_m) / self._row_m, (self._left_m - y_m) / self._column_m
        if sideways:
            features, row, column = features.T, column, row
        along, width = self._shapes[sideways][0].along_px, self._marking_px[sideways]
        first = int(row - 0.5 * along)
        rows = features[max(first, 0) : max(first + along, 0)]
        cuts = [max(int(column + markings * width), 0) for markings in (-self.FLANK[1], -self.FLANK[0], *self.FLANK)]
        left, middle, right = (rows[:, cuts[i] : cuts[i + 1]] for i in range(3))
        flanks = [np.count_nonzero(flank) / (width * along) for flank in (left, right)]
        return Surroundings(np.count_nonzero(middle.any(axis=1)) / along, (flanks[0], flanks[1]))

    def look(self, features: Image, x_m: float, y_m: float, heading_rad: float) -> WindowHit | None:
        """The line about a place (x, y) [m] and a heading in a binary view (h, w); None where there is none.

        Where a window shows more than one line, only the half of it about the place itself counts.
        """
        row, column = (self._far_m - x_m) / self._row_m - 0.5, (self._left_m - y_m) / self._column_m - 0.5
        ahead, left = abs(math.cos(heading_rad)), abs(math.sin(heading_rad))
        sideways = left > ahead
        tilt = ahead / left if sideways else left / ahead
        width = self._marking_px[sideways] * math.sqrt(1.0 + tilt * tilt)  # of the line, along a row or column
        for shape in self._shapes[sideways]:
            whole = width * shape.along_px
            room = max(0.5 * (shape.across_px - width - shape.along_px * tilt / self._aspect[sideways]), 0.75)
            found = self._centred(features, row, column, shape, (self.FILL * whole, room))
            if found is None:
                return None
            at_row, at_column, m = found
            pixels = m["m00"]
            along, across = (m["mu20"], m["mu02"]) if sideways else (m["mu02"], m["mu20"])
            lean = m["mu11"] / along if along > 0.0 else 0.0
            slope = lean * self._aspect[sideways]  # on the ground
            spread = (across - lean * m["mu11"]) / (1.0 + slope * slope)
            if pixels <= shape.full * whole and spread <= shape.spread_px2 * pixels:
                break
        else:
            return None
        x_m, y_m = self._far_m - (at_row + 0.5) * self._row_m, self._left_m - (at_column + 0.5) * self._column_m
        if not self.in_sight(x_m, y_m):
            return None
        if along <= shape.long_px2 * pixels:
            return WindowHit(x_m, y_m, None)
        direction = math.atan2(1.0, slope) if sideways else math.atan(slope)
        return WindowHit(x_m, y_m, heading_rad + math.remainder(direction - heading_rad, math.pi))

    def _centred(
        self, features: Image, row: float, column: float, shape: _WindowShape, wanted: tuple[float, float]
    ) -> tuple[float, float, dict[str, float]] | None:
        """Row, column and moments of a window's content once the window is centred on it; None for too few pixels.

        `wanted`: the minimum number of pixels, and how far off the middle a line may lie and still leave by both long
        sides.
        """
        least, room = wanted
        for _ in range(self.TRIES):
            bottom, high = round(row + 0.5 * (shape.rows + 1)), round(column + 0.5 * (shape.columns + 1))
            top, low = max(bottom - shape.rows, 0), max(high - shape.columns, 0)
            m = cv2.moments(features[top : max(bottom, 0), low : max(high, 0)], True)
            count = m["m00"]
            if count < least:
                return None
            at_row, at_column = top + m["m01"] / count, low + m["m10"] / count
            if abs(at_row - row if shape.sideways else at_column - column) <= room:
                break
            row, column = (at_row, column) if shape.sideways else (row, at_column)
        return at_row, at_column, m
