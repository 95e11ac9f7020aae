"""Lines across the lane: the crossing search of Balbuena Palma et al. 2020, section IV-G."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from automodel.compiled import compiled
from automodel.curves.lanes import LaneShape
from automodel.geometry import View
from automodel.signals import Crossing
from automodel.types import Bools, FloatArray, Image, IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CrossingScan:
    """The first crossing, if any, and at which arc lengths `s_m` (n,) [m] paint covers the lane: `covered` (n,).

    A line along the lane there may be a zebra's bar.
    """

    crossing: Crossing | None
    s_m: FloatArray
    covered: Bools

    def free(self, s_m: FloatArray) -> Bools:
        """Which arc lengths (k,) [m] lie where the lane is not covered."""
        step = self.s_m[1] - self.s_m[0]
        index = np.clip(np.rint((s_m - self.s_m[0]) / step), 0, len(self.s_m) - 1).astype(np.intp)
        return np.asarray(~self.covered[index])


class Raster(NamedTuple):
    """The pixels of a view, whose far edge lies at x = `far_m` and whose left edge at y = `left_m`; steps [m]."""

    far_m: float
    left_m: float
    row_m: float
    column_m: float


class _Limits(NamedTuple):
    """What a crossing is like on a grid of `columns` across the lane.

    There is one from a share `cover` of the places on a row on, of which at least `seen` are in view, in `need`
    consecutive rows; from a share `busy` on lines along the lane are not used. Its near edge lies up to `reach` rows
    from the first one. `agree`: share of the columns whose edge lies on one line, up to `off_m` from it and over at
    least `least_m`, turned by at most `skew_rad`.
    """

    columns: int
    need: int
    seen: float
    cover: float
    busy: float
    reach: int
    agree: float
    least_m: float
    off_m: float
    skew_rad: float


class CrossingSearch:
    """Finds the first stop line or zebra across the lane.

    The bright view is sampled on a grid along and across the predicted lane (the paper turns the image by 90 degrees;
    following the lane also holds in bends). The histogram along the lane gives the candidate, one window per column
    its near edge, and a fit of degree 1 the angle (eq. (7)-(9)). The paper accepts 90 +- 15 degrees. Here the
    predicted lane may be wrong by more before a bend's end is visible, so `MAX_SKEW_RAD` is larger; the pipeline
    decides which crossings are reported.
    """

    COLUMNS = 20
    STEP_MARKINGS = 0.4
    COVER = 0.42  # minimum bright share of the lane's width: a stop line has 1, a zebra 1/2
    BUSY = 0.2  # share from which on lines along the lane are not used
    SEEN = 0.6  # minimum share of the lane's width in view
    AGREE = 0.6  # minimum share of the columns whose near edge lies on one line
    MAX_SKEW_RAD = math.radians(40.0)

    def __init__(self, view: View, lane_width_m: float, marking_width_m: float) -> None:
        self.lane_m, self.marking_m = lane_width_m, marking_width_m
        self._raster = Raster(view.x_far_m, view.half_width_m, view.m_per_row, view.m_per_px)
        self._step = marking_width_m * self.STEP_MARKINGS
        need = max(round(0.6 / self.STEP_MARKINGS), 1)  # consecutive grid rows that are covered
        self._limits = _Limits(
            columns=self.COLUMNS,
            need=need,
            seen=self.SEEN * self.COLUMNS,
            cover=self.COVER,
            busy=self.BUSY,
            reach=int(math.tan(self.MAX_SKEW_RAD) * lane_width_m / self._step) + 2 * need,
            agree=self.AGREE,
            least_m=0.4 * lane_width_m,
            off_m=0.75 * marking_width_m,
            skew_rad=self.MAX_SKEW_RAD,
        )
        two = np.arange(2.0)  # compiled now: no frame waits for it
        _scanned(np.zeros((1, 1), np.uint8), two, (two, np.zeros((2, 2)), two), 1.0, self._raster, self._limits)

    def step(self, bright: Image, lane: LaneShape, far_m: float) -> CrossingScan:
        """Scan the lane up to arc length `far_m` in the binary view `bright` (h, w)."""
        s = np.arange(0.0, far_m, self._step)
        inner = 0.5 * lane.width_m - 1.5 * self.marking_m
        if inner <= 2 * self.marking_m:
            return CrossingScan(crossing=None, s_m=s, covered=np.zeros(len(s), dtype=bool))
        path = lane.s_m, lane.points_m, lane.theta_rad
        covered, edge_m, angle_rad = _scanned(bright, s, path, inner, self._raster, self._limits)
        # The edge lies between the first white place of a column and the one before it.
        found = math.isfinite(edge_m)
        crossing = Crossing(distance_m=edge_m - 0.5 * self._step, angle_rad=angle_rad) if found else None
        return CrossingScan(crossing=crossing, s_m=s, covered=covered)


@compiled
def _scanned(
    bright: Image,
    s_m: FloatArray,
    path: tuple[FloatArray, FloatArray, FloatArray],
    inner_m: float,
    raster: Raster,
    limits: _Limits,
) -> tuple[Bools, float, float]:
    """At which arc lengths (n,) the lane is covered; arc length [m] and angle [rad] of a crossing, NaN: there is none.

    `path`: the lane's arc lengths (m,), points (m, 2) and headings (m,). A view (h, w) is sampled up to `inner_m` to
    both sides of it.
    """
    n, d_m = len(s_m), np.linspace(-inner_m, inner_m, limits.columns)
    middle_m, theta = np.empty((n, 2)), np.empty(n)
    theta[:] = np.interp(s_m, path[0], path[2])
    for axis in range(2):
        middle_m[:, axis] = np.interp(s_m, path[0], np.ascontiguousarray(path[1][:, axis]))
    white, inside = _sampled(bright, middle_m, theta, d_m, raster)
    covered, first, run = np.zeros(n, np.bool_), -1, 0
    for i in range(n):
        share = white[i].sum() / max(inside[i], 1)
        run = run + 1 if inside[i] >= limits.seen and share >= limits.cover else 0
        if run == limits.need and first < 0:
            first = i - limits.need + 1
        if share >= limits.busy:  # and up to `need` rows before and after it
            covered[max(i - limits.need, 0) : i + limits.need + 1] = True
    if first < 0:
        return covered, math.nan, math.nan
    edge = _near_edge(white, (s_m, middle_m, theta), d_m, first, limits.reach)
    distance_m, angle = _straight(edge, limits) if len(edge) >= limits.columns // 3 else (math.nan, math.nan)
    if not abs(angle - theta[first] - 0.5 * math.pi) <= limits.skew_rad:
        return covered, math.nan, math.nan
    return covered, distance_m, angle


@compiled
def _near_edge(
    white: Bools, rows: tuple[FloatArray, FloatArray, FloatArray], d_m: FloatArray, first: int, reach: int
) -> FloatArray:
    """s, x, y [m] (n, 3) of the first bright place in each column of a grid (m, k), up to `reach` rows about a row.

    `rows`: arc lengths (m,), middles (m, 2) and headings (m,) of the rows; `d_m` (k,) counts to the left.
    """
    (s_m, middle_m, theta), edge, count = rows, np.empty((len(d_m), 3)), 0
    for k in range(len(d_m)):
        for i in range(max(first - reach, 0), min(first + reach + 1, len(white))):
            if white[i, k]:
                edge[count, 0] = s_m[i]
                edge[count, 1] = middle_m[i, 0] - math.sin(theta[i]) * d_m[k]
                edge[count, 2] = middle_m[i, 1] + math.cos(theta[i]) * d_m[k]
                count += 1
                break
    return edge[:count]


@compiled
def _straight(edge: FloatArray, limits: _Limits) -> tuple[float, float]:
    """Median s [m] and the angle [rad] of an edge (n, 3) of s, x, y [m], NaN where it is no straight line."""
    slope = _median_slope(edge[:, 2], edge[:, 1])
    off = edge[:, 1] - slope * edge[:, 2]
    line = edge[np.abs(off - np.median(off)) <= limits.off_m]
    if len(line) < limits.agree * len(edge) or line[:, 2].max() - line[:, 2].min() < limits.least_m:
        return math.nan, math.nan
    y = line[:, 2] - line[:, 2].mean()
    return np.median(line[:, 0]), 0.5 * math.pi - math.atan((y * line[:, 1]).sum() / (y * y).sum())


@compiled
def _median_slope(x: FloatArray, y: FloatArray) -> float:
    """The median slope between all pairs of points (Theil 1950, Sen 1968), robust to 29 % outliers."""
    slopes, count = np.empty(len(x) * (len(x) - 1) // 2), 0
    for i in range(len(x)):
        for j in range(i + 1, len(x)):
            if abs(x[i] - x[j]) > 1e-9:
                slopes[count] = (y[i] - y[j]) / (x[i] - x[j])
                count += 1
    return np.median(slopes[:count]) if count else 0.0


@compiled
def _sampled(
    bright: Image, middle_m: FloatArray, theta_rad: FloatArray, d_m: FloatArray, raster: Raster
) -> tuple[Bools, IntArray]:
    """Which places of a grid (n, k) are bright in a view (h, w), and how many of each row lie in the view (n,).

    Row i of the grid crosses the lane at `middle_m` (n, 2), square to `theta_rad` (n,); `d_m` (k,) counts to the left.
    """
    white = np.zeros((len(middle_m), len(d_m)), np.bool_)
    inside = np.zeros(len(middle_m), np.int64)
    for i in range(len(middle_m)):
        sin, cos = math.sin(theta_rad[i]), math.cos(theta_rad[i])
        for k in range(len(d_m)):
            row = (raster.far_m - middle_m[i, 0] + sin * d_m[k]) / raster.row_m - 0.5
            column = (raster.left_m - middle_m[i, 1] - cos * d_m[k]) / raster.column_m - 0.5
            if -0.5 < row < bright.shape[0] - 0.5 and -0.5 < column < bright.shape[1] - 0.5:
                inside[i] += 1
                white[i, k] = bright[round(row), round(column)] > 0
    return white, inside
