"""Lines across the lane: the search of seed 003 (section IV-G) on the view turned by 90 degrees."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from automodel.curves import Curve
from automodel.estimation.regression import fit_polynomial
from automodel.geometry import View
from automodel.signals import Crossing

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]


class CrossingSearch:
    """Finds the first stop line or zebra across the lane's corridor.

    The bright view is sampled on a grid along and across the predicted lane (the paper turns the picture by 90 degrees;
    following the lane keeps it right in bends). The histogram along the lane gives the candidate, one window per
    column the near edge, a straight fit of degree 1 the angle; accepted within 90 +- 15 degrees (eq. (7)-(9)).
    """

    COLUMNS = 24
    STEP_MARKINGS = 1.0 / 3.0
    COVER = 0.42  # share of the corridor that is bright: a stop line 1, a zebra 1/2
    MAX_SKEW_RAD = math.radians(15.0)

    def __init__(self, view: View, lane_width_m: float, marking_width_m: float) -> None:
        self.view, self.lane_m, self.marking_m = view, lane_width_m, marking_width_m
        self._step = marking_width_m * self.STEP_MARKINGS
        self._need = max(round(0.6 / self.STEP_MARKINGS), 1)  # grid rows in a row that are covered

    def step(self, bright: Image, centerline: Curve, start_s_m: float, width_m: float, far_m: float) -> Crossing | None:
        """The first crossing ahead, or None.

        `bright` is the binary view (h, w), `centerline` the lane in the body frame, `start_s_m` the arc length of the
        reference point's foot, `width_m` the lane's width, `far_m` how far to look.
        """
        inner = 0.5 * width_m - 1.5 * self.marking_m
        if inner <= 2 * self.marking_m:
            return None
        s = start_s_m + np.arange(0.0, far_m, self._step)
        d = np.linspace(-inner, inner, self.COLUMNS)
        theta = centerline.heading(s)
        normal = np.stack((-np.sin(theta), np.cos(theta)), axis=-1)
        ground = centerline.position(s)[:, None] + d[None, :, None] * normal[:, None]
        px = np.rint(self.view.to_px(ground)).astype(np.intp)
        inside = (px[..., 0] >= 0) & (px[..., 0] < self.view.width_px) & (px[..., 1] >= 0)
        inside &= px[..., 1] < self.view.height_px
        white = inside & (bright[np.where(inside, px[..., 1], 0), np.where(inside, px[..., 0], 0)] > 0)
        seen = inside.sum(axis=1) >= 0.6 * self.COLUMNS
        covered = seen & (white.sum(axis=1) >= self.COVER * np.maximum(inside.sum(axis=1), 1))
        first = _first_run(covered, self._need)
        if first is None:
            return None
        return self._edge(white, ground, first, float(s[first] - start_s_m), float(theta[first]))

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


def _first_run(covered: NDArray[np.bool_], need: int) -> int | None:
    """Index of the first of `need` True values in a row."""
    run = np.convolve(covered.astype(np.intp), np.ones(need, dtype=np.intp), mode="valid")
    starts = np.flatnonzero(run == need)
    return int(starts[0]) if len(starts) else None
