"""Lines across the lane: the crossing search of Balbuena Palma et al. 2020, section IV-G."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from automodel.compiled import compiled
from automodel.curves.lanes import LaneShape
from automodel.curves.regression import fit_polynomial
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
    """From which share of the places on a row, of which at least `seen` are in view, in `need` consecutive rows there
    is a crossing (`cover`), and from which share on lines along the lane are not used (`busy`)."""

    need: int
    seen: float
    cover: float
    busy: float


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
        self._need = max(round(0.6 / self.STEP_MARKINGS), 1)  # consecutive grid rows that are covered
        self._limits = _Limits(self._need, self.SEEN * self.COLUMNS, self.COVER, self.BUSY)
        two = np.arange(2.0)  # compiled now: no frame waits for it
        _scanned(np.zeros((1, 1), np.uint8), two, (two, np.zeros((2, 2)), two), two, self._raster, self._limits)

    def step(self, bright: Image, lane: LaneShape, far_m: float) -> CrossingScan:
        """Scan the lane up to arc length `far_m` in the binary view `bright` (h, w)."""
        s = np.arange(0.0, far_m, self._step)
        inner = 0.5 * lane.width_m - 1.5 * self.marking_m
        if inner <= 2 * self.marking_m:
            return CrossingScan(crossing=None, s_m=s, covered=np.zeros(len(s), dtype=bool))
        d = np.linspace(-inner, inner, self.COLUMNS)
        path = lane.s_m, lane.points_m, lane.theta_rad
        white, first, covered, middle_m, theta = _scanned(bright, s, path, d, self._raster, self._limits)
        crossing = None
        if first >= 0:
            across = np.column_stack((-np.sin(theta), np.cos(theta)))
            ground = middle_m[:, None] + across[:, None] * d[:, None]
            crossing = self._edge(white, ground, first, s, float(theta[first]))
        return CrossingScan(crossing=crossing, s_m=s, covered=covered)

    def _edge(self, white: Bools, ground: FloatArray, first: int, s: FloatArray, lane_rad: float) -> Crossing | None:
        """The crossing whose near edge lies about grid row `first`; None where its edge is no straight line."""
        reach = int(math.tan(self.MAX_SKEW_RAD) * self.lane_m / self._step) + 2 * self._need
        low = max(first - reach, 0)
        band = white[low : first + reach + 1]
        hit = band.any(axis=0)
        if hit.sum() < self.COLUMNS // 3:
            return None
        edge = low + band.argmax(axis=0)[hit]
        points = ground[edge, np.flatnonzero(hit)]
        slope = _median_slope(points[:, 1], points[:, 0])
        off = points[:, 0] - slope * points[:, 1]
        keep = np.abs(off - np.median(off)) <= 0.75 * self.marking_m
        if keep.sum() < self.AGREE * len(points) or np.ptp(points[keep, 1]) < 0.4 * self.lane_m:
            return None
        line = fit_polynomial(points[keep, 1], points[keep, 0], 1)
        angle = 0.5 * math.pi - math.atan(line[1])
        if abs(angle - lane_rad - 0.5 * math.pi) > self.MAX_SKEW_RAD:
            return None
        # the edge lies between the first white place of a column and the one before it
        distance_m = float(np.median(s[edge][keep])) - 0.5 * self._step
        return Crossing(distance_m=distance_m, angle_rad=angle)


def _median_slope(x: FloatArray, y: FloatArray) -> float:
    """The median slope between all pairs of points (Theil 1950, Sen 1968), robust to 29 % outliers."""
    i, j = np.triu_indices(len(x), 1)
    apart = np.abs(x[i] - x[j]) > 1e-9
    return float(np.median((y[i] - y[j])[apart] / (x[i] - x[j])[apart])) if apart.any() else 0.0


@compiled
def _scanned(
    bright: Image,
    s_m: FloatArray,
    path: tuple[FloatArray, FloatArray, FloatArray],
    d_m: FloatArray,
    raster: Raster,
    limits: _Limits,
) -> tuple[Bools, int, Bools, FloatArray, FloatArray]:
    """Which places (n, k) of a grid along and across the lane are bright in a view (h, w).

    `path`: the lane's arc lengths (m,), points (m, 2) and headings (m,). Also returns the first row of a crossing (-1:
    there is none), which rows (n,) are covered, and the middles (n, 2) and headings (n,) of the rows at `s_m` (n,);
    `d_m` (k,) counts to the left.
    """
    n = len(s_m)
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
    return white, first, covered, middle_m, theta


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
