"""Lines across the lane: the search of seed 003 (section IV-G) on the view turned by 90 degrees."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from automodel.curves import Curve
from automodel.estimation.regression import fit_polynomial
from automodel.geometry import View
from automodel.signals import Crossing

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]


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
    column the near edge, a straight fit of degree 1 the angle (eq. (7)-(9)). The paper accepts 90 +- 15 degrees; here the
    predicted lane may still be wrong by more before a bend's end is seen, so `MAX_SKEW_RAD` is wider, and what is told
    to the outside is for the pipeline to decide.
    """

    COLUMNS = 24
    STEP_MARKINGS = 1.0 / 3.0
    COVER = 0.42  # share of the corridor that is bright: a stop line 1, a zebra 1/2
    BUSY = 0.2  # share from which lines there are not trusted
    SEEN = 0.6  # share of the corridor that must be in view for a crossing
    MAX_SKEW_RAD = math.radians(40.0)

    def __init__(self, view: View, lane_width_m: float, marking_width_m: float) -> None:
        self.view, self.lane_m, self.marking_m = view, lane_width_m, marking_width_m
        self._step = marking_width_m * self.STEP_MARKINGS
        self._need = max(round(0.6 / self.STEP_MARKINGS), 1)  # grid rows in a row that are covered

    def step(self, bright: Image, centerline: Curve, start_s_m: float, width_m: float, far_m: float) -> Crossed:
        """What lies across the lane.

        `bright` is the binary view (h, w), `centerline` the lane in the body frame, `start_s_m` the arc length of the
        reference point's foot, `width_m` the lane's width, `far_m` how far to look.
        """
        s = start_s_m + np.arange(0.0, far_m, self._step)
        inner = 0.5 * width_m - 1.5 * self.marking_m
        if inner <= 2 * self.marking_m:
            return Crossed(crossing=None, s_m=s, covered=np.zeros(len(s), dtype=bool))
        d = np.linspace(-inner, inner, self.COLUMNS)
        theta = centerline.heading(s)
        normal = np.stack((-np.sin(theta), np.cos(theta)), axis=-1)
        ground = centerline.position(s)[:, None] + d[None, :, None] * normal[:, None]
        px = np.rint(self.view.to_px(ground)).astype(np.intp)
        inside = (px[..., 0] >= 0) & (px[..., 0] < self.view.width_px) & (px[..., 1] >= 0)
        inside &= px[..., 1] < self.view.height_px
        white = inside & (bright[np.where(inside, px[..., 1], 0), np.where(inside, px[..., 0], 0)] > 0)
        share = white.sum(axis=1) / np.maximum(inside.sum(axis=1), 1)
        seen = inside.sum(axis=1) >= self.SEEN * self.COLUMNS
        first = _first_run(seen & (share >= self.COVER), self._need)
        crossing = None
        if first is not None:
            crossing = self._edge(white, ground, first, float(s[first] - start_s_m), float(theta[first]))
        return Crossed(crossing=crossing, s_m=s, covered=_widened(share >= self.BUSY, self._need))

    def _edge(
        self, white: NDArray[np.bool_], ground: FloatArray, first: int, distance_m: float, lane_rad: float
    ) -> Crossing | None:
        reach = int(math.tan(self.MAX_SKEW_RAD) * self.lane_m / self._step) + 2 * self._need
        low = max(first - reach, 0)
        band = white[low : first + reach + 1]
        hit = band.any(axis=0)
        if hit.sum() < self.COLUMNS // 3:
            return None
        points = ground[low + band.argmax(axis=0)[hit], np.flatnonzero(hit)]
        line = fit_polynomial(points[:, 1], points[:, 0], 1)
        off = np.abs(points[:, 0] - line[0] - line[1] * points[:, 1])
        keep = off <= max(2.0 * float(np.median(off)), 0.5 * self.marking_m)
        line = fit_polynomial(points[keep, 1], points[keep, 0], 1)
        angle = 0.5 * math.pi - (math.atan(line[1]) if len(line) > 1 else 0.0)
        if abs(angle - lane_rad - 0.5 * math.pi) > self.MAX_SKEW_RAD:
            return None
        return Crossing(distance_m=distance_m, angle_rad=angle)


def _widened(flags: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """True also up to `by` places before and after each True."""
    return np.convolve(flags, np.ones(2 * by + 1), mode="same") > 0


def _first_run(covered: NDArray[np.bool_], need: int) -> int | None:
    """Index of the first of `need` True values in a row."""
    run = np.convolve(covered.astype(np.intp), np.ones(need, dtype=np.intp), mode="valid")
    starts = np.flatnonzero(run == need)
    return int(starts[0]) if len(starts) else None
