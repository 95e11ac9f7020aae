"""Lines across the lane: the search of seed 003 (section IV-G) on the view turned by 90 degrees."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.estimation.polynomial.lane_fit import LaneShape
from automodel.estimation.polynomial.regression import fit_polynomial
from automodel.geometry import View
from automodel.signals import Crossing
from automodel.types import FloatArray, Image


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Crossed:
    """The first crossing, if any, and where along the lane (arc lengths `s_m`) the corridor is `covered` with paint.

    There, what looks like a line along the lane may be a zebra's bar.
    """

    crossing: Crossing | None
    s_m: FloatArray
    covered: NDArray[np.bool_]

    def free(self, s_m: FloatArray) -> NDArray[np.bool_]:
        """Which arc lengths lie where the corridor is not covered."""
        step = self.s_m[1] - self.s_m[0]
        index = np.clip(np.rint((s_m - self.s_m[0]) / step), 0, len(self.s_m) - 1).astype(np.intp)
        return np.asarray(~self.covered[index])


class CrossingSearch:
    """Finds the first stop line or zebra across the lane's corridor.

    The bright view is sampled on a grid along and across the predicted lane (the paper turns the picture by 90 degrees;
    following the lane keeps it right in bends). The histogram along the lane gives the candidate, one window per
    column the near edge, a straight fit of degree 1 the angle (eq. (7)-(9)). The paper accepts 90 +- 15 degrees; here
    the predicted lane may still be wrong by more before a bend's end is seen, so `MAX_SKEW_RAD` is wider, and what is
    told to the outside is for the pipeline to decide.
    """

    COLUMNS = 20
    STEP_MARKINGS = 1.0 / 2.5
    COVER = 0.42  # share of the corridor that is bright: a stop line 1, a zebra 1/2
    BUSY = 0.2  # share from which lines there are not trusted
    SEEN = 0.6  # share of the corridor that must be in view for a crossing
    AGREE = 0.6  # share of the columns whose near edge lies on one line
    MAX_SKEW_RAD = math.radians(40.0)

    def __init__(self, view: View, lane_width_m: float, marking_width_m: float) -> None:
        self.view, self.lane_m, self.marking_m = view, lane_width_m, marking_width_m
        self._step = marking_width_m * self.STEP_MARKINGS
        self._need = max(round(0.6 / self.STEP_MARKINGS), 1)  # grid rows in a row that are covered

    def step(self, bright: Image, lane: LaneShape, far_m: float) -> Crossed:
        """What lies across the lane up to `far_m` ahead, in the binary view `bright` (h, w)."""
        s = np.arange(0.0, far_m, self._step)
        inner = 0.5 * lane.width_m - 1.5 * self.marking_m
        if inner <= 2 * self.marking_m:
            return Crossed(crossing=None, s_m=s, covered=np.zeros(len(s), dtype=bool))
        d = np.linspace(-inner, inner, self.COLUMNS)
        theta = np.interp(s, lane.s_m, lane.theta_rad)
        x = np.interp(s, lane.s_m, lane.points_m[:, 0])[:, None] - np.sin(theta)[:, None] * d
        y = np.interp(s, lane.s_m, lane.points_m[:, 1])[:, None] + np.cos(theta)[:, None] * d
        column, row = self.view.columns(y), self.view.rows(x)
        inside = (column > -0.5) & (column < self.view.width_px - 0.5) & (row > -0.5)
        inside &= row < self.view.height_px - 0.5
        maps = column.astype(np.float32), row.astype(np.float32)
        sampled = cv2.remap(bright, *maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        white = np.asarray(sampled) > 0
        count = inside.sum(axis=1)
        share = white.sum(axis=1) / np.maximum(count, 1)
        first = _first_run((count >= self.SEEN * self.COLUMNS) & (share >= self.COVER), self._need)
        crossing = None
        if first is not None:
            ground = np.stack((x, y), axis=-1)
            crossing = self._edge(white, ground, first, s, float(theta[first]))
        return Crossed(crossing=crossing, s_m=s, covered=_widened(share >= self.BUSY, self._need))

    def _edge(
        self, white: NDArray[np.bool_], ground: FloatArray, first: int, s: FloatArray, lane_rad: float
    ) -> Crossing | None:
        reach = int(math.tan(self.MAX_SKEW_RAD) * self.lane_m / self._step) + 2 * self._need
        low = max(first - reach, 0)
        band = white[low : first + reach + 1]
        hit = band.any(axis=0)
        if hit.sum() < self.COLUMNS // 3:
            return None
        begins = low + band.argmax(axis=0)[hit]
        points = ground[begins, np.flatnonzero(hit)]
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
        distance_m = float(np.median(s[begins][keep])) - 0.5 * self._step
        return Crossing(distance_m=distance_m, angle_rad=angle)


def _median_slope(x: FloatArray, y: FloatArray) -> float:
    """The median of the slopes between all pairs of points (Theil 1950, Sen 1968): a third may be wrong."""
    i, j = np.triu_indices(len(x), 1)
    apart = np.abs(x[i] - x[j]) > 1e-9
    return float(np.median((y[i] - y[j])[apart] / (x[i] - x[j])[apart])) if apart.any() else 0.0


def _widened(flags: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """True also up to `by` places before and after each True."""
    return np.convolve(flags, np.ones(2 * by + 1), mode="same") > 0


def _first_run(covered: NDArray[np.bool_], need: int) -> int | None:
    """Index of the first of `need` True values in a row."""
    run = np.convolve(covered.astype(np.intp), np.ones(need, dtype=np.intp), mode="valid")
    starts = np.flatnonzero(run == need)
    return int(starts[0]) if len(starts) else None
