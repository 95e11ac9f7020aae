"""Every line-like thing in a bird's-eye view, whatever lane it may belong to.

The pipelines follow two lines from where they expect them. Where that may be the wrong place (at a start, after a
crossing, where one line alone was seen) the whole view is looked at: pieces of paint as wide as a marking are found as
connected areas, and pieces that continue each other are joined to lines, across the gaps of a dashed one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from automodel.geometry import View
from automodel.perception.markings.binary_views import WhiteAreas
from automodel.types import Bools, FloatArray, Image


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SightedLine:
    """One line of a frame: points (n, 2) [m] on its middle, body frame, near to far.

    `painted_m` is the length on which there is paint, `span_m` the length from the first to the last of it; 0: unknown.
    """

    points_m: FloatArray
    painted_m: float
    span_m: float


@dataclass(slots=True)
class _Piece:
    """Middles (n,) of the painted rows of a piece, or of several joined ones: x rising, y [m]; a parabola's fit."""

    x: FloatArray
    y: FloatArray
    fit: FloatArray  # y(x - middle), lowest power first
    middle: float

    def at(self, x: float) -> tuple[float, float]:
        """y [m] and slope of the parabola at x."""
        t = x - self.middle
        a, b, c = self.fit
        return float(a + b * t + c * t * t), float(b + 2.0 * c * t)


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanConfig:
    """Scales of `LineScan`; lengths in lane widths where the name says so.

    `least_lanes`: a shorter piece is a speck. `gap_lanes`: between two dashes of one line, at most: the Carolo-Cup's
    are half a lane apart, a motorway's (9 m on 3.75 m) 2.4. `turn_rad`: direction by which a dash may be wrong; `bend`:
    by how much the line may turn besides [rad] over a lane width of gap. `wide`: a piece as many markings wide is an
    area. `bars` pieces next to each other, `bar_lanes` apart, are a zebra crossing: where lanes are divided, two double
    lines make four, but no three next to each other. `spacing_lanes`: of the points.
    """

    least_lanes: float = 0.15
    gap_lanes: float = 1.2
    turn_rad: float = 0.06
    bend: float = 0.6
    wide: float = WhiteAreas.WIDE
    bars: int = 3
    bar_lanes: tuple[float, float] = (0.12, 0.4)
    spacing_lanes: float = 0.2


class LineScan:
    """Finds lines in binary views (h, w), 0 or 255, of a `View`; lanes are about `lane_width_m` wide."""

    _SLOPE = 1.7  # steepest piece, dy/dx: 60 degrees across the view; a view's rows cut what lies flatter too rarely

    def __init__(self, view: View, lane_width_m: float, marking_width_m: float, config: ScanConfig | None = None):
        self.view, self.config = view, config or ScanConfig()
        self._unit, self._marking_m = lane_width_m, marking_width_m
        rows, columns = np.arange(view.height_px), np.arange(view.width_px)
        self._x = view.to_body(np.stack((rows, rows), axis=-1))[:, 0]  # of each row [m]
        self._y = view.to_body(np.stack((columns, columns), axis=-1))[:, 1]  # of each column [m]

    def step(self, lines: Image) -> tuple[SightedLine, ...]:
        """The lines of a view, in no order."""
        return tuple(self._line(piece) for piece in self._joined(self._pieces(lines)))

    def _pieces(self, lines: Image) -> list[_Piece]:
        """Connected areas that are longer than wide, each with the middles of its rows."""
        count, labels, stats, _ = cv2.connectedComponentsWithStats(lines, connectivity=8)
        least = self.config.least_lanes * self._unit / self.view.m_per_row
        bars = self._bars(lines)
        pieces = []
        for label in range(1, count):
            left, top, width, height, area = stats[label].tolist()
            if height < max(least, 3):
                continue
            part = labels[top : top + height, left : left + width] == label
            per_row = part.sum(axis=1)
            there = np.flatnonzero(per_row)
            if 2 * np.count_nonzero(bars[top + there]) > len(there):
                continue
            middle = (part @ np.arange(width))[there] / per_row[there]
            mean_m = area / len(there) * self.view.m_per_px
            x = self._x[top + there][::-1]
            y = np.interp(left + middle, np.arange(len(self._y)), self._y)[::-1]
            piece = _fitted(x, y)
            slope = abs(piece.fit[1])
            across = mean_m / math.hypot(1.0, slope)
            off = y - np.polynomial.polynomial.polyval(x - piece.middle, piece.fit)
            narrow = across < self.config.wide * self._marking_m and float(off.std()) < self._marking_m
            if slope < self._SLOPE and narrow:
                pieces.append(piece)
        return pieces

    def _bars(self, lines: Image) -> Bools:
        """The rows (h,) of a zebra crossing: several bars next to each other, at least in most of the rows around."""
        config = self.config
        rows, columns = np.nonzero((lines[:, 1:] > 0) & (lines[:, :-1] == 0))  # left edges
        apart = np.diff(columns) * self.view.m_per_px / self._unit
        beside = (np.diff(rows) == 0) & (apart > config.bar_lanes[0]) & (apart < config.bar_lanes[1])
        pairs = np.bincount(rows[:-1][beside], minlength=len(lines)).astype(np.float32)
        around = 2 * round(0.5 * config.least_lanes * self._unit / self.view.m_per_row) + 1
        return np.asarray(cv2.blur(pairs, (1, around)).ravel() >= config.bars - 1.0)

    def _joined(self, pieces: list[_Piece]) -> list[_Piece]:
        """Pieces that continue each other, as one; the best fitting ends first."""
        pieces = sorted(pieces, key=lambda piece: float(piece.x[0]))
        while True:
            best: tuple[float, int, int] | None = None
            for i, first in enumerate(pieces):
                for j, second in enumerate(pieces):
                    cost = self._misfit(first, second) if i != j else math.inf
                    if cost < 1.0 and (best is None or cost < best[0]):
                        best = (cost, i, j)
            if best is None:
                return pieces
            _, i, j = best
            both = _fitted(np.concatenate((pieces[i].x, pieces[j].x)), np.concatenate((pieces[i].y, pieces[j].y)))
            pieces = [piece for k, piece in enumerate(pieces) if k not in (i, j)] + [both]

    def _misfit(self, first: _Piece, second: _Piece) -> float:
        """How badly `second` continues `first`, 1 at the limit."""
        gap = float(second.x[0] - first.x[-1])
        most = self.config.gap_lanes * self._unit
        if not -2.0 * self.view.m_per_row < gap < most:
            return math.inf
        x = 0.5 * float(second.x[0] + first.x[-1])
        (y1, slope1), (y2, slope2) = first.at(x), second.at(x)
        if gap > 0.0:  # the chord between the ends, against both directions: a parabola is too free for a dash
            (end, s1), (start, s2) = first.at(float(first.x[-1])), second.at(float(second.x[0]))
            y1, y2 = end + 0.5 * gap * s1, start - 0.5 * gap * s2
            slope1, slope2 = s1, s2
        lateral = abs(y2 - y1) / math.hypot(1.0, slope1)
        turn = abs(math.atan(slope2) - math.atan(slope1))
        room = self._marking_m + self.config.turn_rad * max(gap, 0.0) * 2.0
        bend = 2.0 * self.config.turn_rad + max(gap, 0.0) / self._unit * self.config.bend
        return max(lateral / room, turn / bend)

    def _line(self, piece: _Piece) -> SightedLine:
        step = max(round(self.config.spacing_lanes * self._unit / self.view.m_per_row), 1)
        cuts = np.arange(0, len(piece.x), step)
        counts = np.diff(np.append(cuts, len(piece.x)))
        x, y = (np.add.reduceat(values, cuts) / counts for values in (piece.x, piece.y))
        stretch = math.hypot(1.0, float(piece.fit[1]))
        rows = np.unique(np.rint(piece.x / self.view.m_per_row))
        return SightedLine(
            points_m=np.column_stack((x, y)),
            painted_m=len(rows) * self.view.m_per_row * stretch,
            span_m=float(piece.x[-1] - piece.x[0] + self.view.m_per_row) * stretch,
        )


def _fitted(x: FloatArray, y: FloatArray) -> _Piece:
    """A piece with a parabola through its rows' middles; a straight line through few."""
    order = np.argsort(x, kind="stable")
    x, y = x[order], y[order]
    middle = 0.5 * float(x[0] + x[-1])
    t = x - middle
    design = np.column_stack((np.ones_like(t), t, t * t))
    ridge = np.diag((0.0, 0.0, 1e-6 + (x[-1] - x[0]) ** 4 * 1e-3))  # a short piece is straight
    fit = np.linalg.solve(design.T @ design + ridge, design.T @ y)
    return _Piece(x=x, y=y, fit=fit, middle=middle)
