"""Every line-like thing in a bird's-eye view, whatever lane it may belong to.

The pipelines follow two lines from where they expect them. Where that may be the wrong place (at a start, after a
crossing, where one line alone was seen) the whole view is looked at: pieces of paint as wide as a marking are found as
connected areas, and pieces that continue each other are joined to lines, across the gaps of a dashed one. The loops
over pixels and pairs of pieces are compiled.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from automodel.compiled import compiled
from automodel.geometry import View
from automodel.geometry.elimination import solve
from automodel.perception.markings.binary_views import WhiteAreas
from automodel.types import Bools, Float32Array, FloatArray, Image, IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SightedLine:
    """One line of a frame: points (n, 2) [m] on its middle, body frame, near to far.

    `span_m` is the length from the first to the last paint, 0: unknown; `painted_m` that without the gaps between
    dashes, but with what is worn off. `reflection`: if it is no line, how many times as likely as
    another thing it is a reflection.
    """

    points_m: FloatArray
    painted_m: float
    span_m: float
    reflection: float = 0.0

    def looks_dashed(self, lane_width_m: float) -> float:
        """How much likelier [nats] the paint is as dashes than as one stroke; 0 where its length is not known."""
        if self.span_m <= 0.0:
            return 0.0
        painted, model = min(self.painted_m / self.span_m, 1.0), PaintedShares()
        stroke = model.density(painted, 1.0, model.worn)
        dashes = model.density(painted, model.dashed, model.spread)
        dash = math.exp(-((self.span_m / lane_width_m) ** 2))  # that what is in view is a single one
        return math.log(dash * stroke + (1.0 - dash) * dashes) - math.log(stroke)


@dataclass(frozen=True, slots=True, kw_only=True)
class PaintedShares:
    """Shares of a line's length that are painted.

    Of a solid line all, with a spread of what is `worn`; `dashed`: of a dashed one, with its `spread`. Measured on six
    drives with worn paint: from 0.52 to 0.72, and 1 (dashes as long as the gaps). `otherwise`: probability of any
    share: things that hide a part, dashes of other roads. A dash is about as long as a lane is wide.
    """

    worn: float = 0.07
    dashed: float = 0.55
    spread: float = 0.12
    otherwise: float = 0.1

    def density(self, share: float, mean: float, spread: float) -> float:
        """The likelihood of a share, but for a factor."""
        normal = math.exp(-0.5 * ((share - mean) / spread) ** 2) / spread
        return (1.0 - self.otherwise) * normal + self.otherwise


@dataclass(slots=True)
class _Piece:
    """Middles (n,) of the painted rows of a piece, or of several joined ones: x rising, y [m]; a parabola's fit."""

    x: FloatArray
    y: FloatArray
    fit: FloatArray  # y(x - middle), lowest power first
    middle: float


class _Scales(NamedTuple):
    """The numbers of `ScanConfig` in metres, and the steps of a view, as the compiled loops take them."""

    marking_m: float
    lane_m: float
    gap_m: float
    turn_rad: float
    bend: float
    row_m: float
    column_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanConfig:
    """Scales of `LineScan`; lengths in lane widths where the name says so.

    `least_lanes`: a shorter piece is a speck. `gap_lanes`: between two dashes of one line, at most: the Carolo-Cup's
    are half a lane apart, a motorway's (9 m on 3.75 m) 2.4. `turn_rad`: direction by which a dash may be wrong; `bend`:
    by how much the line may turn besides [rad] over a lane width of gap. `wide`: a piece as many markings wide is an
    area. `worn_lanes`: a shorter gap is none between dashes, paint is worn off there. `bars` pieces next to each other,
    `bar_lanes` apart, are a zebra crossing: where lanes are divided, two double lines make four, but no three next to
    each other. `spacing_lanes`: of the points. `reflection`: that of all lines: how many times as likely as
    another thing a reflection is; 0 where there are none.
    """

    least_lanes: float = 0.15
    gap_lanes: float = 1.2
    turn_rad: float = 0.06
    bend: float = 0.6
    wide: float = WhiteAreas.WIDE
    worn_lanes: float = 0.25
    bars: int = 3
    bar_lanes: tuple[float, float] = (0.12, 0.4)
    spacing_lanes: float = 0.2
    reflection: float = 0.0


class LineScan:
    """Finds lines in binary views (h, w), 0 or 255, of a `View`; lanes are about `lane_width_m` wide."""

    SLOPE = 1.7  # steepest piece, dy/dx: 60 degrees across the view; a view's rows cut what lies flatter too rarely

    def __init__(self, view: View, lane_width_m: float, marking_width_m: float, config: ScanConfig | None = None):
        self.view, self.config = view, config or ScanConfig()
        self._unit, self._marking_m = lane_width_m, marking_width_m
        scan = self.config
        self._scales = _Scales(
            marking_m=marking_width_m,
            lane_m=lane_width_m,
            gap_m=scan.gap_lanes * lane_width_m,
            turn_rad=scan.turn_rad,
            bend=scan.bend,
            row_m=view.m_per_row,
            column_m=view.m_per_px,
        )
        width, height = (2 * max(round(marking_width_m / step), 1) + 1 for step in (view.m_per_px, view.m_per_row))
        self._around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, height))
        self._warm_up()

    def step(self, lines: Image, paint: Image | None = None, apart: Image | None = None) -> tuple[SightedLine, ...]:
        """The lines of a view, in no order; `paint` (h, w): all that may be paint, also what is worn or too wide.

        Pixels that paint connects within a marking's width are of one piece: worn paint leaves specks. What of the
        lines is also in `apart` (h, w) may be a streak that crosses the rest, and is then of no piece with it.
        """
        paint = lines if paint is None else paint
        parts = [lines] if apart is None else self._parts(lines, apart)
        pieces = [piece for part in parts for piece in self._pieces(part, self._connected(part, paint))]
        return tuple(self._line(piece, paint) for piece in self._joined(pieces))

    def _parts(self, lines: Image, apart: Image) -> list[Image]:
        """The lines (h, w) less what of `apart` (h, w) has some beside it on its rows, within a marking's width; and
        that. What goes on alone is of the same line.
        """
        rest = cv2.subtract(lines, apart)
        beside = cv2.bitwise_and(cv2.dilate(rest, np.ones((1, self._around.shape[1]), np.uint8)), apart)
        if not beside.any():
            return [lines]
        count, labels = cv2.connectedComponents(apart, connectivity=8)
        crossing = np.zeros(count, np.uint8)
        crossing[labels[beside > 0]] = 255
        streaks = crossing[labels]
        return [np.asarray(cv2.subtract(lines, streaks), dtype=np.uint8), streaks]

    def _connected(self, lines: Image, paint: Image) -> Image:
        """The lines (h, w), and the paint within a marking's width of them."""
        near = cv2.bitwise_and(cv2.dilate(lines, self._around), paint)
        return np.asarray(cv2.bitwise_or(near, lines), dtype=np.uint8)

    def of_stripes(self, stripes: Iterable[FloatArray]) -> tuple[SightedLine, ...]:
        """The lines of stripes (n, 2) [m] that were found otherwise: points in the body frame, near to far."""
        pieces = [_fitted(points[:, 0], points[:, 1]) for points in stripes if len(points) > 1]
        return tuple(self._line(piece, None) for piece in self._joined(pieces))

    def _warm_up(self) -> None:
        """Compile everything that a frame calls, so that none waits for it."""
        two = np.zeros((self.view.height_px, self.view.width_px), np.uint8)
        two[:, : two.shape[1] // 2 : two.shape[1] // 2 - 1] = 255  # lines, one column each
        self.step(two)

    def _pieces(self, lines: Image, connected: Image) -> list[_Piece]:
        """Areas that are longer than wide, each with the middles of its rows; `connected` tells what is one area."""
        rows, middles, sizes, ends = _areas(lines, connected)
        least = max(self.config.least_lanes * self._unit / self.view.m_per_row, 3)
        bars = self._bars(lines)
        pieces, start = [], 0
        for end in ends.tolist():
            there = slice(start, end)
            start = end
            if there.stop == there.start:  # paint beside a line
                continue
            if rows[there.stop - 1] - rows[there.start] + 1 < least or 2 * bars[rows[there]].sum() > end - there.start:
                continue
            pieces += self._line_pieces(rows[there], middles[there], sizes[there], int(least))
        return pieces

    def _line_pieces(self, rows: IntArray, middles: FloatArray, sizes: IntArray, least: int) -> list[_Piece]:
        """The pieces of an area of `rows` (n,), with the `middles` and numbers of pixels of each; none of no line's.

        One that bends more than a parabola is cut, as long as its halves are longer than `least` rows.
        """
        view = self.view
        x = np.asarray(view.x_far_m - (rows[::-1] + 0.5) * view.m_per_row, dtype=np.float64)
        y: FloatArray = view.half_width_m - (middles[::-1] + 0.5) * view.m_per_px
        fit, middle, off = _parabola(x, y)
        slope = abs(float(fit[1]))
        across = float(sizes.mean()) * view.m_per_px / math.hypot(1.0, slope)
        if off >= self._marking_m and len(rows) >= 2 * least:
            half = len(rows) // 2
            halves = (slice(half), slice(half, None))
            return [one for part in halves for one in self._line_pieces(rows[part], middles[part], sizes[part], least)]
        narrow = across < self.config.wide * self._marking_m and off < self._marking_m
        return [_Piece(x=x, y=y, fit=fit, middle=middle)] if slope < self.SLOPE and narrow else []

    def _bars(self, lines: Image) -> Bools:
        """The rows (h,) of a zebra crossing: several bars next to each other, at least in most of the rows around."""
        config = self.config
        pairs = _neighbours(lines, *(lanes * self._unit / self.view.m_per_px for lanes in config.bar_lanes))
        around = 2 * round(0.5 * config.least_lanes * self._unit / self.view.m_per_row) + 1
        return np.asarray(cv2.blur(pairs, (1, around)).ravel() >= config.bars - 1.0)

    def _joined(self, pieces: list[_Piece]) -> list[_Piece]:
        """Pieces that continue each other, as one; the best fitting ends first."""
        pieces = sorted(pieces, key=lambda piece: float(piece.x[0]))
        while len(pieces) > 1:
            ends = np.array([(piece.x[0], piece.x[-1], piece.middle, *piece.fit) for piece in pieces])
            i, j = _best_pair(ends, self._scales)
            if i < 0:
                break
            both = _fitted(np.concatenate((pieces[i].x, pieces[j].x)), np.concatenate((pieces[i].y, pieces[j].y)))
            pieces = [piece for k, piece in enumerate(pieces) if k not in (i, j)] + [both]
        return pieces

    def _line(self, piece: _Piece, paint: Image | None) -> SightedLine:
        view = self.view
        step = max(round(self.config.spacing_lanes * self._unit / view.m_per_row), 1)
        cuts = np.arange(0, len(piece.x), step)
        counts = np.diff(np.append(cuts, len(piece.x)))
        x, y = (np.add.reduceat(values, cuts) / counts for values in (piece.x, piece.y))
        stretch = math.hypot(1.0, float(piece.fit[1]))
        painted = np.unique(np.rint(piece.x / view.m_per_row)) if paint is None else self._painted(piece, paint)
        gaps_m = (np.diff(painted) - 1.0) * view.m_per_row * stretch
        span_m = float(piece.x[-1] - piece.x[0] + view.m_per_row) * stretch
        return SightedLine(
            points_m=np.column_stack((x, y)),
            painted_m=span_m - float(gaps_m[gaps_m > self.config.worn_lanes * self._unit].sum()),
            span_m=span_m,
            reflection=self.config.reflection,
        )

    def _painted(self, piece: _Piece, paint: Image) -> IntArray:
        """The rows (n,) of a view between a piece's ends in which there is paint where the piece runs."""
        view = self.view
        ends = (view.x_far_m - piece.x[[-1, 0]]) / view.m_per_row - 0.5
        rows = np.arange(max(round(ends[0]), 0), min(round(ends[1]) + 1, view.height_px))
        y = np.interp(view.x_far_m - (rows + 0.5) * view.m_per_row, piece.x, piece.y)
        middle = np.rint((view.half_width_m - y) / view.m_per_px - 0.5).astype(np.intp)
        half = max(round(0.5 * self._marking_m / view.m_per_px), 1)
        columns = (middle[:, None] + np.arange(-half, half + 1)).clip(0, view.width_px - 1)
        return np.asarray(rows[(paint[rows[:, None], columns] > 0).any(axis=1)])


def _fitted(x: FloatArray, y: FloatArray) -> _Piece:
    """A piece with a parabola through its rows' middles; a straight line through few."""
    order = np.argsort(x, kind="stable")
    x, y = x[order], y[order]
    fit, middle, _ = _parabola(x, y)
    return _Piece(x=x, y=y, fit=fit, middle=middle)


@compiled
def _areas(lines: Image, connected: Image) -> tuple[IntArray, FloatArray, IntArray, IntArray]:
    """The areas of a binary image (h, w), whose pixels touch at sides or corners in `connected`, which holds them all.

    Their rows (n,), all of the first area from above, then those of the next; the middle column and the number of
    pixels of each (n,); and the index at which each area ends (k,). Areas come in the order of their first pixels.
    """
    height, width = lines.shape
    count, size = 0, height * (width // 2 + 1)
    row, first, end = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64)
    root = np.empty(size, np.int64)  # of each run of pixels: a run above it of the same area
    held_px, summed = np.empty(size, np.int64), np.empty(size)  # its pixels of `lines`, and the sum of their columns
    above, here = 0, 0  # the first runs of the row above, and of this one
    for r in range(height):
        if here < count and row[here] == r - 1:
            above, here = here, count
        else:
            above = here = count
        touching, c = above, 0
        while c < width:
            if connected[r, c] == 0:
                c += 1
                continue
            row[count], first[count], root[count] = r, c, count
            pixels, total = 0, 0.0
            while c < width and connected[r, c] != 0:
                if lines[r, c] != 0:
                    pixels, total = pixels + 1, total + c
                c += 1
            end[count], held_px[count], summed[count] = c, pixels, total
            while touching < here and end[touching] < first[count]:
                touching += 1
            at = touching
            while at < here and first[at] <= c:
                a, b = _root(root, at), _root(root, count)
                root[max(a, b)] = min(a, b)
                at += 1
            count += 1
    area = np.empty(count, np.int64)
    areas = 0
    for k in range(count):
        if root[k] == k:
            area[k] = areas
            areas += 1
        else:
            area[k] = area[_root(root, k)]
    # Each area's rows: runs come row by row.
    last, held = np.full(areas, -1, np.int64), np.zeros(areas, np.int64)
    for k in range(count):
        if held_px[k] > 0:
            held[area[k]] += row[k] != last[area[k]]
            last[area[k]] = row[k]
    ends = np.cumsum(held)
    fill = ends - held - 1
    total_rows = int(ends[-1]) if areas else 0
    rows, sums, sizes = np.full(total_rows, -1, np.int64), np.zeros(total_rows), np.zeros(total_rows, np.int64)
    last[:] = -1
    for k in range(count):
        if held_px[k] > 0:
            fill[area[k]] += row[k] != last[area[k]]
            at, last[area[k]] = fill[area[k]], row[k]
            rows[at] = row[k]
            sizes[at] += held_px[k]
            sums[at] += summed[k]
    return rows, sums / sizes, sizes, ends


@compiled
def _neighbours(lines: Image, least_px: float, most_px: float) -> Float32Array:
    """In each row (h,) of a binary image, the left edges of pieces that follow another one so many pixels apart."""
    height, width = lines.shape
    pairs = np.zeros(height, np.float32)
    for r in range(height):
        last = -math.inf
        for c in range(1, width):
            if lines[r, c] != 0 and lines[r, c - 1] == 0:
                if least_px < c - last < most_px:
                    pairs[r] += 1.0
                last = float(c)
    return pairs


@compiled
def _root(root: IntArray, k: int) -> int:
    """The first run of the area of a run."""
    while root[k] != k:
        root[k] = root[root[k]]
        k = root[k]
    return k


@compiled
def _parabola(x: FloatArray, y: FloatArray) -> tuple[FloatArray, float, float]:
    """The parabola y(x - middle) through points (n,), lowest power first, a straight line through few; and `middle`.

    Last the standard deviation of the points' distances from it, along y.
    """
    middle = 0.5 * (x[0] + x[-1])
    matrix, right = np.zeros((3, 3)), np.zeros((3, 1))
    for k in range(len(x)):
        t = x[k] - middle
        powers = (1.0, t, t * t)
        for i in range(3):
            right[i, 0] += powers[i] * y[k]
            for j in range(3):
                matrix[i, j] += powers[i] * powers[j]
    matrix[2, 2] += 1e-6 + (x[-1] - x[0]) ** 4 * 1e-3  # a short piece is straight
    fit = solve(matrix, right)[:, 0].copy()
    total = square = 0.0
    for k in range(len(x)):
        t = x[k] - middle
        off = y[k] - (fit[0] + t * (fit[1] + t * fit[2]))
        total, square = total + off, square + off * off
    mean = total / len(x)
    return fit, middle, math.sqrt(max(square / len(x) - mean * mean, 0.0))


@compiled
def _at(piece: FloatArray, x: float) -> tuple[float, float]:
    """y [m] and slope of a piece's parabola at x."""
    t = x - piece[2]
    return piece[3] + piece[4] * t + piece[5] * t * t, piece[4] + 2.0 * piece[5] * t


@compiled
def _misfit(first: FloatArray, second: FloatArray, scales: _Scales) -> float:
    """How badly `second` continues `first`, 1 at the limit; of each: ends, middle and fit of a `_Piece` (6,)."""
    gap = second[0] - first[1]
    if not -2.0 * scales.row_m < gap < scales.gap_m:
        return math.inf
    x = 0.5 * (second[0] + first[1])
    (y1, slope1), (y2, slope2) = _at(first, x), _at(second, x)
    if gap > 0.0:  # the chord between the ends, against both directions: a parabola is too free for a dash
        (end, slope1), (start, slope2) = _at(first, first[1]), _at(second, second[0])
        y1, y2 = end + 0.5 * gap * slope1, start - 0.5 * gap * slope2
    lateral = abs(y2 - y1) / math.hypot(1.0, slope1)
    turn = abs(math.atan(slope2) - math.atan(slope1))
    room = scales.marking_m + scales.turn_rad * max(gap, 0.0) * 2.0
    bend = 2.0 * scales.turn_rad + max(gap, 0.0) / scales.lane_m * scales.bend
    return max(lateral / room, turn / bend)


@compiled
def _best_pair(pieces: FloatArray, scales: _Scales) -> tuple[int, int]:
    """The piece (of n, as in `_misfit`) that the other continues best, and that other; -1 where there are none."""
    least, best = 1.0, (-1, -1)
    for i in range(len(pieces)):
        for j in range(len(pieces)):
            cost = _misfit(pieces[i], pieces[j], scales) if i != j else math.inf
            if cost < least:
                least, best = cost, (i, j)
    return best
