"""Windows of the window line following (Cudrano et al. 2020, section IV): the piece of a line that one window shows."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from automodel.compiled import compiled
from automodel.geometry import View
from automodel.perception.markings.ridge import BESIDE
from automodel.perception.windows.sliding_windows import SlidingWindows, moments
from automodel.types import Image


class WindowHit(NamedTuple):
    """The piece of a line in a window: its centroid (x, y) [m], body frame, and its direction [rad]; NaN: no piece.

    The direction is NaN where the piece is too short for one; of its two senses it is the one nearer to the window's
    heading.
    """

    x_m: float
    y_m: float
    direction_rad: float


class _WindowShape(NamedTuple):
    """A window in pixels. Its columns lie across the line and its rows along it; `sideways`: the other way round."""

    rows: int
    columns: int
    across_px: int
    along_px: int
    sideways: bool
    spread_px2: float  # variance across the line above which it is no single line
    long_px2: float  # variance along the window from which on a line's direction is defined


class Layout(NamedTuple):
    """The windows on a view, compiled: of two values the second is that of `sideways` ones.

    The view's far and left edge and its steps [m]; a marking's width [px]; how much longer a pixel is along a window
    than across; whole windows and their middle parts. `fill`, `flank`, `tries`: constants of `LineWindows`. `sight`
    (h, w) is not 0 where a line would be visible over its whole width.
    """

    far_m: float
    left_m: float
    row_m: float
    column_m: float
    marking_px: tuple[float, float]
    aspect: tuple[float, float]
    shapes: tuple[tuple[_WindowShape, _WindowShape], tuple[_WindowShape, _WindowShape]]
    fill: float
    flank: tuple[float, float]
    tries: int
    sight: Image


class LineWindows:
    """Windows on a binary bird's-eye view (h, w), aligned with the view and wide across the line.

    The pixels of a line that leaves by the two long sides have their centroid on its middle, whatever its slant, up to
    45 deg. For lines that run more across the view than ahead the window is turned by 90 deg. `visible` (h, w) is
    nonzero where the view shows ground that the camera sees; None: everywhere.
    """

    ACROSS, FILL, LONG, SPREAD = SlidingWindows.WIDTH, SlidingWindows.FILL, SlidingWindows.LONG, SlidingWindows.SPREAD
    ALONG = 2.8  # length in marking widths
    FLANK = (BESIDE, ACROSS)  # markings from a piece to what is beside it
    TRIES = 10  # iterations of centring a window, at most
    RIM = BESIDE  # markings that a point lies inside the visible part, at least: so that what is beside it is visible

    def __init__(self, view: View, marking_width_m: float, visible: Image | None = None) -> None:
        self._marking_px = (marking_width_m / view.m_per_px, marking_width_m / view.m_per_row)  # index: `sideways`
        whole = self.ACROSS, self.ALONG, self.SPREAD, self.LONG
        part = 0.5 * self.ACROSS, 0.5 * self.ALONG, 0.5 * self.SPREAD, math.inf
        if visible is None:
            visible = np.full((view.height_px, view.width_px), 255, np.uint8)
        self.layout = Layout(
            far_m=view.x_far_m,
            left_m=view.half_width_m,
            row_m=view.m_per_row,
            column_m=view.m_per_px,
            marking_px=self._marking_px,
            aspect=(view.m_per_px / view.m_per_row, view.m_per_row / view.m_per_px),
            shapes=(
                (self._shape(False, *whole), self._shape(False, *part)),
                (self._shape(True, *whole), self._shape(True, *part)),
            ),
            fill=self.FILL,
            flank=self.FLANK,
            tries=self.TRIES,
            sight=self._inner_part(visible),
        )

    def _shape(self, sideways: bool, across: float, along: float, spread: float, long: float) -> _WindowShape:
        across_px = max(round(across * self._marking_px[sideways]), 3)
        along_px = max(round(along * self._marking_px[not sideways]), 2)
        rows, columns = (across_px, along_px) if sideways else (along_px, across_px)
        spread_px2, long_px2 = spread * self._marking_px[sideways] ** 2, long * along_px**2 / 12.0
        return _WindowShape(rows, columns, across_px, along_px, sideways, spread_px2, long_px2)

    def _inner_part(self, visible: Image) -> Image:
        """The visible part less a rim."""
        y, x = (int(self.RIM * px) for px in (self._marking_px[1], self._marking_px[0]))
        padded = cv2.copyMakeBorder(visible, y, y, x, x, cv2.BORDER_CONSTANT, value=[0])
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * x + 1, 2 * y + 1))
        height, width = visible.shape
        return np.array(cv2.erode(padded, disc)[y : y + height, x : x + width], dtype=np.uint8)


@compiled
def in_sight(layout: Layout, x_m: float, y_m: float) -> bool:
    """Whether a line through (x, y) [m] would be visible there over its whole width."""
    row, column = int((layout.far_m - x_m) / layout.row_m), int((layout.left_m - y_m) / layout.column_m)
    inside = 0 <= row < layout.sight.shape[0] and 0 <= column < layout.sight.shape[1]
    return inside and layout.sight[row, column] != 0


@compiled
def is_empty(features: Image, layout: Layout, x_m: float, y_m: float, reach_m: float) -> bool:
    """Whether a binary view (h, w) is empty in all windows up to `reach_m` around (x, y) [m]."""
    row, column = (layout.far_m - x_m) / layout.row_m, (layout.left_m - y_m) / layout.column_m
    high = reach_m / layout.row_m + layout.shapes[1][0].rows
    wide = reach_m / layout.column_m + layout.shapes[0][0].columns
    for i in range(max(int(row - high), 0), min(int(row + high), features.shape[0])):
        for j in range(max(int(column - wide), 0), min(int(column + wide), features.shape[1])):
            if features[i, j] != 0:
                return False
    return True


@compiled
def beside_piece(features: Image, layout: Layout, x_m: float, y_m: float, heading_rad: float) -> tuple[float, float]:
    """The areas to the left and right of a line's piece in a binary view (h, w), as shares of a whole line."""
    sideways = int(abs(math.sin(heading_rad)) > abs(math.cos(heading_rad)))
    place = (layout.far_m - x_m) / layout.row_m, (layout.left_m - y_m) / layout.column_m
    length, width = layout.shapes[sideways][0].along_px, layout.marking_px[sideways]
    first, middle, (near, far) = int(place[sideways] - 0.5 * length), place[1 - sideways], layout.flank
    left = right = 0
    for along in range(max(first, 0), min(first + length, features.shape[sideways])):
        for across in range(
            max(int(middle - far * width), 0), min(int(middle + far * width), features.shape[1 - sideways])
        ):
            if (features[across, along] if sideways else features[along, across]) == 0:
                continue
            if across < int(middle - near * width):
                left += 1
            elif across >= int(middle + near * width):
                right += 1
    return left / (width * length), right / (width * length)


@compiled
def look(features: Image, layout: Layout, x_m: float, y_m: float, heading_rad: float) -> WindowHit:
    """The line about a place (x, y) [m] and a heading in a binary view (h, w).

    Where a window shows more than one line, only the half of it about the place itself counts.
    """
    nothing = WindowHit(math.nan, math.nan, math.nan)
    row, column = (layout.far_m - x_m) / layout.row_m - 0.5, (layout.left_m - y_m) / layout.column_m - 0.5
    ahead, left = abs(math.cos(heading_rad)), abs(math.sin(heading_rad))
    sideways = int(left > ahead)
    tilt = ahead / left if sideways else left / ahead
    width = layout.marking_px[sideways] * math.sqrt(1.0 + tilt * tilt)  # of the line, along a row or column
    for shape in layout.shapes[sideways]:
        whole = width * shape.along_px
        room = max(0.5 * (shape.across_px - width - shape.along_px * tilt / layout.aspect[sideways]), 0.75)
        at_row, at_column, pixels, along, across, lean = _centred(features, layout, row, column, shape, whole, room)
        if pixels == 0.0:
            return nothing
        steep = lean / along if along > 0.0 else 0.0
        slope = steep * layout.aspect[sideways]  # on the ground
        spread = (across - steep * lean) / (1.0 + slope * slope)
        if spread <= shape.spread_px2 * pixels:
            x, y = layout.far_m - (at_row + 0.5) * layout.row_m, layout.left_m - (at_column + 0.5) * layout.column_m
            if not in_sight(layout, x, y):
                return nothing
            if along <= shape.long_px2 * pixels:
                return WindowHit(x, y, math.nan)
            direction = math.atan2(1.0, slope) if sideways else math.atan(slope)
            return WindowHit(x, y, heading_rad + remainder(direction - heading_rad, math.pi))
    return nothing


@compiled
def _centred(
    features: Image, layout: Layout, row: float, column: float, shape: _WindowShape, whole: float, room: float
) -> tuple[float, float, float, float, float, float]:
    """Row, column and pixels of a window's content once the window is centred on it; no pixels where they are too few.

    Then its central moments: along the window, across it, and mixed. `whole`: pixels of a whole line; `room`: how far
    off the middle a line may lie and still leave by both long sides.
    """
    at_row = at_column = area = m20 = m11 = m02 = 0.0
    for _ in range(layout.tries):
        bottom, high = round(row + 0.5 * (shape.rows + 1)), round(column + 0.5 * (shape.columns + 1))
        top, low = max(bottom - shape.rows, 0), max(high - shape.columns, 0)
        end = min(bottom, features.shape[0]), min(high, features.shape[1])
        area, m10, m01, m20, m11, m02 = moments(features, top, end[0], low, end[1])
        if area < layout.fill * whole:
            return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        at_row, at_column = top + m01 / area, low + m10 / area
        m20, m11, m02 = m20 - m10 * m10 / area, m11 - m10 * m01 / area, m02 - m01 * m01 / area
        if abs(at_row - row if shape.sideways else at_column - column) <= room:
            break
        row, column = (at_row, column) if shape.sideways else (row, at_column)
    return (at_row, at_column, area, m20, m02, m11) if shape.sideways else (at_row, at_column, area, m02, m20, m11)


@compiled
def remainder(value: float, period: float) -> float:
    """`math.remainder`, which is not compiled: from -1/2 to 1/2 of a period."""
    return value - period * np.rint(value / period)
