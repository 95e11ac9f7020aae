"""Stripes of one image: ridges as wide as a marking on rows about the predicted lane, linked from row to row.

After the stereo paper's stages 1 and 2 (marking extraction in image space, stripe models). The filter's width is that
which a marking has on the row by the camera and the predicted ground plane. Rows lie about evenly in the image, so that
ridges that continue each other make the mid-line of a blob: a stripe. What is short, round or lies across the lane has
too few of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from automodel.compiled import compiled
from automodel.geometry import GroundCamera
from automodel.geometry.line_projection import LineProjection
from automodel.geometry.stereo_rig import Eye, bearings, on_ground
from automodel.perception.line_scan import ScanConfig
from automodel.perception.markings.ridge_noise import FALSE_SAMPLES, least_ridge
from automodel.perception.rows.row_ridges import AROUND, LEVEL, LINE, MARGIN, PER_MARKING, SIDE, WINDOW, measure_ridges
from automodel.perception.rows.row_search import MAX_TURN
from automodel.types import Complexes, FloatArray, Floats, Image, Ints

THIN = 4  # every so many-th sample measures a row's noise: as long as the filter's windows


@dataclass(slots=True, eq=False)
class Stripes:
    """The stripes of an image: their ridges (n,), stripe by stripe, each from near to far.

    `pixels` (n, 2), `directions` (n, 3) in the level body frame; `stripe` (n,) counts from 0. `eye`: the camera that
    saw them, over the predicted ground.
    """

    pixels: FloatArray
    directions: FloatArray
    stripe: Ints
    eye: Eye

    @classmethod
    def none(cls, camera: GroundCamera) -> Stripes:
        """Of a camera that shows nothing."""
        return cls(np.empty((0, 2)), np.empty((0, 3)), np.empty(0, np.intp), Eye.of(camera))

    @property
    def count(self) -> int:
        """The number of stripes."""
        return int(self.stripe[-1]) + 1 if len(self.stripe) else 0


class StripeSearch:
    """Finds stripes on up to `rows` rows in images of `size` (height, width) px.

    It looks up to `half_lanes` lane widths to each side of the predicted lane. `contrast` [grey levels] is a ridge's
    minimum; 0: it follows the noise. `dark`: markings are darker than the ground.
    """

    def __init__(
        self,
        marking_m: float,
        lane_width_m: float,
        half_lanes: float,
        contrast: float,
        size: tuple[int, int],
        dark: bool = False,
    ) -> None:
        self._sample_m = marking_m / PER_MARKING
        self._reach = math.ceil(half_lanes * lane_width_m / self._sample_m)
        self._contrast, self._size, self._dark = contrast, size, dark
        self._least_m = ScanConfig().least_lanes * lane_width_m
        self._link_m = 0.5 * marking_m

    def look(self, grey: Image, camera: GroundCamera, place: Complexes, along: Complexes) -> Stripes:
        """The stripes of a grey image by a camera over the predicted ground.

        `place` (k,), near to far, and the unit tangents `along` (k,) are the predicted centerline x + i y [m].
        """
        line = LineProjection(camera).project(place, along, 0.0)
        rows, middle, step = _laid_rows(line.values[:, : len(place)], self._sample_m, self._size)
        eye = Eye.of(camera)
        noises = least_ridge(len(rows) * 2 * self._reach / FALSE_SAMPLES) if len(rows) else math.inf
        row, at = _ridges(grey, rows, middle, step, self._reach, noises, self._contrast, self._dark)
        pixels = np.column_stack((middle[row] + at * step[row], rows[row].astype(np.float64)))
        directions = bearings(eye, pixels)
        ground = on_ground(eye, directions)
        chain = _linked(row, ground, self._link_m)
        order, stripe = _long_ones(chain, ground, self._least_m)
        return Stripes(pixels=pixels[order], directions=directions[order], stripe=stripe, eye=eye)


@compiled
def _laid_rows(line: Floats, sample_m: float, size: tuple[int, int]) -> tuple[Ints, FloatArray, FloatArray]:
    """The image rows (r,) that show the centerline (5, k) of `LineProjection`, near to far; each once.

    With the column (r,) of the centerline, and the columns (r,) by which a sample further to the left lies away.
    """
    rows, middle, step = np.empty(line.shape[1], np.intp), np.empty(line.shape[1]), np.empty(line.shape[1])
    count = 0
    for i in range(line.shape[1]):
        u, v, along_u, along_v, area = line[:, i]
        if not (0.0 <= v <= size[0] - 1.0 and along_v < 0.0):
            continue
        row = int(np.rint(v))
        if count and rows[count - 1] <= row:
            continue
        rows[count], middle[count] = row, u + (row - v) * along_u / along_v
        step[count] = -sample_m * area / along_v
        count += 1
    return rows[:count], middle[:count], step[:count]


@compiled
def _ridges(
    grey: Image,
    rows: Ints,
    middle: FloatArray,
    step: FloatArray,
    reach: int,
    noises: float,
    contrast: float,
    dark: bool,
) -> tuple[Ints, FloatArray]:
    """The ridges (n,) of a marking's width, by row: index of the row, and samples to the left of its middle."""
    samples, width = 2 * (reach + AROUND) + 1, grey.shape[1]
    found_row, found_at = np.empty(len(rows) * (samples // WINDOW + 1), np.intp), np.empty(0)
    found_at = np.empty(len(found_row))
    values = np.empty((1, samples), np.float32)
    sums, height = np.empty(samples + 1), np.zeros(samples)
    size, zero, least = np.empty(samples), np.zeros(1, np.intp), np.empty(1, np.float32)
    count = 0
    for r in range(len(rows)):
        first, last = samples, -1  # of those that lie in the image
        for k in range(samples):
            u = middle[r] + (k - reach - AROUND) * step[r]
            if 0.0 <= u <= width - 1.0:
                first, last = min(first, k), max(last, k)
            u = min(max(u, 0.0), width - 1.001)
            c = int(u)
            share = u - c
            value = (1.0 - share) * grey[rows[r], c] + share * grey[rows[r], min(c + 1, width - 1)]
            values[0, k] = -value if dark else value
        sums[0] = 0.0
        for k in range(samples):
            sums[k + 1] = sums[k] + values[0, k]
        first, last, sizes = first + MARGIN, last - MARGIN, 0
        if last - first < PER_MARKING:
            continue
        half = WINDOW // 2
        for k in range(first, last + 1):
            one = sums[k - SIDE + half + 1] - sums[k - SIDE - half]
            other = sums[k + SIDE + half + 1] - sums[k + SIDE - half]
            height[k] = sums[k + half + 1] - sums[k - half] - max(one, other)
            if k % THIN == 0:
                size[sizes] = abs(height[k])
                sizes += 1
        least[0] = contrast * WINDOW if contrast > 0.0 else noises * max(np.median(size[:sizes]), LEVEL)
        k = first
        while k <= last:
            if height[k] <= least[0]:
                k += 1
                continue
            best = k
            while k <= last and height[k] > least[0]:  # the middle of a plateau
                if height[k] > height[best]:
                    best = k
                k += 1
            at = np.full(1, best, np.intp)
            place, _, _, flags = measure_ridges(values, zero, at, least)
            if flags[LINE, 0]:
                found_row[count], found_at[count] = r, best + place[0] - reach - AROUND
                count += 1
    return found_row[:count], found_at[:count]


@compiled
def _linked(row: Ints, ground: FloatArray, room_m: float) -> Ints:
    """The chain (n,) that each ridge belongs to: it continues one of the row before, or of the one before that.

    It lies within `room_m` of where the chain goes on, or in a direction that differs by `MAX_TURN` at most.
    """
    n = len(row)
    chain, before, tail = np.full(n, -1, np.intp), np.full(n, -1, np.intp), np.empty(n, np.intp)
    chains = 0
    for i in range(n):
        best, least = -1, 1.0
        for c in range(chains - 1, -1, -1):
            j = tail[c]
            if row[i] - row[j] > 2 or row[i] <= row[j]:
                continue
            dx, dy = ground[i, 0] - ground[j, 0], ground[i, 1] - ground[j, 1]
            k, slope = j, 0.0
            for _ in range(4):  # the direction of the last five ridges
                k = before[k] if before[k] >= 0 else k
            if k != j:
                slope = (ground[j, 1] - ground[k, 1]) / max(ground[j, 0] - ground[k, 0], 1e-9)
            off = abs(dy - slope * dx) / (room_m + MAX_TURN * abs(dx))
            if off < least:
                best, least = c, off
        if best < 0:
            best = chains
            chains += 1
        else:
            before[i] = tail[best]
        chain[i], tail[best] = best, i
    return chain


@compiled
def _long_ones(chain: Ints, ground: FloatArray, least_m: float) -> tuple[Ints, Ints]:
    """The ridges (m,) of chains that are long enough, chain by chain, and the stripe (m,) that each belongs to."""
    n = len(chain)
    chains = chain.max() + 1 if n else 0
    order, stripe = np.empty(n, np.intp), np.empty(n, np.intp)
    count = stripes = 0
    for c in range(chains):
        start = count
        for i in range(n):
            if chain[i] == c:
                order[count], stripe[count] = i, stripes
                count += 1
        away = math.hypot(
            ground[order[count - 1], 0] - ground[order[start], 0], ground[order[count - 1], 1] - ground[order[start], 1]
        )
        if count - start >= 3 and away >= least_m:
            stripes += 1
        else:
            count = start
    return order[:count], stripe[:count]
