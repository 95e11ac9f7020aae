"""Stripes of one image: ridges as wide as a marking on rows about the predicted lane, linked from row to row.

After the stereo paper's stages 1 and 2 (marking extraction in image space, stripe models). Rows are read as far as the
road about the predicted lane reaches, whatever its direction there: a stripe that runs across the image is the wider on
a row the flatter it lies, and filters of several widths find it. Ridges that continue each other from row to row make
the mid-line of a blob: a stripe. Its width across its own direction is a marking's; what is short or round has too few
ridges.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from automodel.compiled import compiled
from automodel.geometry import CameraModel, GroundCamera
from automodel.geometry.stereo_rig import Eye, bearings, image_of, on_ground
from automodel.perception.line_scan import ScanConfig
from automodel.perception.markings.marking_width import MarkingWidth
from automodel.perception.markings.ridge import RidgeFilter
from automodel.perception.markings.ridge_noise import FALSE_SAMPLES, least_ridge
from automodel.perception.rows.row_ridges import LEVEL, LINE, MARGIN, PER_MARKING, SIDE, WIDEST, WINDOW, measure_ridges
from automodel.perception.rows.row_search import MAX_TURN
from automodel.types import Complexes, Float32Array, FloatArray, Image, Ints

SLANTS = (1.8, 3.2)  # widths of the filters for stripes that lie across, in markings straight ahead
WIDER = WIDEST / PER_MARKING  # a filter finds stripes that are wider than itself by so much
WIDEST_STRIPE = WIDER * MarkingWidth.CHANGE  # across its direction, in markings: the width in use may be wrong itself
WIDTHS = (1 / WIDEST_STRIPE, WIDEST_STRIPE)
WHOLE = 3  # ridges of a stripe beside the first or the last, at least, that tell where its ends are
THIN = WINDOW  # every so many-th sample measures a row's noise: as long as the filter's windows
NARROW_PX = RidgeFilter.MIN_WIDTH_PX  # rows on which a marking is narrower show none
_KNOTS = 33  # columns of a row whose ground is computed; linear in between


@dataclass(slots=True, eq=False)
class Stripes:
    """The stripes of an image: their ridges (n,), stripe by stripe, each from near to far.

    `pixels` (n, 2), `directions` (n, 3) in the level body frame; `width_px` (n,) along the row; `stripe` (n,) counts
    from 0. `eye`: the camera that saw them, over the predicted ground. `traces`: also what is too short for a stripe.
    `field`: where it was looked for.
    """

    pixels: FloatArray
    width_px: FloatArray
    directions: FloatArray
    stripe: Ints
    eye: Eye
    traces: Traces
    field: Field

    @classmethod
    def none(cls, camera: GroundCamera) -> Stripes:
        """Of a camera that shows nothing."""
        nothing = np.empty((0, 2))
        traces, field = Traces(nothing, np.empty(0, np.intp)), Field(np.empty(0), nothing)
        return cls(nothing, np.empty(0), np.empty((0, 3)), np.empty(0, np.intp), Eye.of(camera), traces, field)

    @property
    def count(self) -> int:
        """The number of stripes."""
        return int(self.stripe[-1]) + 1 if len(self.stripe) else 0


class Traces(NamedTuple):
    """All ridges of an image that another one continues: `pixels` (n, 2), and the `chain` (n,) that each is of."""

    pixels: FloatArray
    chain: Ints


class Field(NamedTuple):
    """The part of an image in which a ridge would be found: `rows` (r,), from below, and their `ends` (r, 2) [px]."""

    rows: FloatArray
    ends: FloatArray


class StripeSearch:
    """Finds stripes on `rows` rows in images of `size` (height, width) px.

    It looks up to `half_lanes` lane widths to each side of the predicted lane. `contrast` [grey levels] is a ridge's
    minimum; 0: it follows the noise. `dark`: markings are darker than the ground. `turn_rad`: by which the road turns
    in view, at most.
    """

    def __init__(
        self,
        marking_m: float,
        lane_width_m: float,
        half_lanes: float,
        contrast: float,
        size: tuple[int, int],
        rows: int = 64,
        dark: bool = False,
        turn_rad: float = math.inf,
    ) -> None:
        self._marking_m, self._half_m = marking_m, half_lanes * lane_width_m
        self._contrast, self._size, self._rows, self._dark = contrast, size, rows, dark
        self._least_m = ScanConfig().least_lanes * lane_width_m
        widest = 1.0 / max(math.cos(min(turn_rad + MAX_TURN, 0.5 * math.pi)), 1e-9)  # of a stripe along a row
        wider = [wide for wide, before in zip(SLANTS, (1.0, *SLANTS), strict=False) if WIDER * before < widest]
        self._slants = np.array([1.0, *wider])
        self._noises = least_ridge(rows * 2.0 * self._half_m / marking_m * PER_MARKING / FALSE_SAMPLES)

    def look(self, grey: Image, camera: GroundCamera, place: Complexes) -> Stripes:
        """The stripes of a grey image by a camera over the predicted ground.

        `place` (k,), near to far, is the predicted centerline x + i y [m].
        """
        eye = Eye.of(camera)
        rows = _laid_rows(eye, place, self._half_m, self._size, self._rows)
        apart_px = (self._size[1] - 1.0) / (_KNOTS - 1)
        scale = _scales(eye, _knot_rays(camera.camera), rows, place, self._half_m, apart_px)
        sample_m = self._marking_m / PER_MARKING
        found = _ridges(grey, rows, scale, sample_m, self._noises, self._contrast, self._dark, self._slants)
        row, at, width_px, ends = found
        pixels = np.column_stack((at, rows[row].astype(np.float64)))
        directions = bearings(eye, pixels)
        places = on_ground(eye, directions)
        half = np.column_stack((0.5 * width_px, np.zeros(len(at))))
        wide = on_ground(eye, bearings(eye, pixels + half)) - on_ground(eye, bearings(eye, pixels - half))
        chain = _linked(row, places, wide, self._marking_m)
        order, stripe = _long_ones(chain, places, wide, self._least_m, self._marking_m)
        on_stripes = _with_straight_ends(pixels[order], stripe)
        return Stripes(
            pixels=on_stripes,
            width_px=width_px[order],
            directions=bearings(eye, on_stripes),
            stripe=stripe,
            eye=eye,
            traces=Traces(*_continued(chain, pixels)),
            field=Field(rows.astype(np.float64), ends),
        )


@functools.lru_cache(maxsize=8)
def _knot_rays(camera: CameraModel) -> FloatArray:
    """The rays (h, knots, 3) of the knots of each image row, in the cam frame."""
    rows, columns = np.arange(float(camera.height_px)), np.linspace(0.0, camera.width_px - 1.0, _KNOTS)
    return camera.rays(np.stack(np.meshgrid(columns, rows), axis=-1))


@compiled
def _laid_rows(eye: Eye, place: Complexes, half_m: float, size: tuple[int, int], most: int) -> Ints:
    """The image rows (r,), from below, on which ground is that lies within `half_m` of the centerline.

    Each is read at the far end, where a row is metres of road, and ever fewer towards the car.
    """
    top = size[0]
    for k in range(len(place)):
        before = place[max(k - 1, 0)]
        along = place[min(k + 1, len(place) - 1)] - before
        aside = 1j * along / max(abs(along), 1e-9) * half_m
        for side in (-1.0, 0.0, 1.0):
            point = place[k] + side * aside
            u, v = image_of(eye, point.real, point.imag, 0.0)
            if 0.0 <= u <= size[1] - 1.0 and 0.0 <= v < top:
                top = int(v)
    height = size[0] - 1 - top
    if height < 1:
        return np.empty(0, np.intp)
    count = min(most, height + 1)
    rows = np.empty(count, np.intp)
    more = 2.0 * (height / max(count - 1, 1) - 1.0) / max(count - 2, 1)  # by which a step is longer than the one before
    for k in range(count):
        rows[count - 1 - k] = top + int(np.rint(k + 0.5 * more * k * (k - 1)))
    return rows


@compiled
def _scales(eye: Eye, rays: FloatArray, at_rows: Ints, place: Complexes, half_m: float, apart_px: float) -> FloatArray:
    """Pixels a metre (r, knots) along rows `at_rows` (r,), by the `rays` (h, knots, 3) of all rows' knots.

    0 where their ground is not near the centerline, or farther than that reaches from the foot below the camera.
    """
    turn, centre, rows, knots = eye.rotation, eye.centre_m, len(at_rows), rays.shape[1]
    foot, ground = complex(centre[0], centre[1]), np.full((rows, knots, 2), math.nan)
    for r in range(rows):
        for j in range(knots):
            x, y = rays[at_rows[r], j, 0], rays[at_rows[r], j, 1]
            down = x * turn[0, 2] + y * turn[1, 2] + turn[2, 2]
            if down < 0.0:
                far = -centre[2] / down
                ground[r, j, 0] = centre[0] + far * (x * turn[0, 0] + y * turn[1, 0] + turn[2, 0])
                ground[r, j, 1] = centre[1] + far * (x * turn[0, 1] + y * turn[1, 1] + turn[2, 1])
    found, away = np.zeros((rows, knots)), np.abs(place - foot)
    reach, nearest = away.max(), 0
    for r in range(rows):
        for j in range(knots):
            x, y = ground[r, j]
            far = math.sqrt((x - foot.real) ** 2 + (y - foot.imag) ** 2)  # hypot takes several times as long
            near = (place[nearest].real - x) ** 2 + (place[nearest].imag - y) ** 2 < half_m * half_m and far <= reach
            for k in range(len(place) if far <= reach and not near else 0):
                # A place that is nearer to the foot, or farther from it, by more than that cannot be near.
                if abs(away[k] - far) < half_m and (place[k].real - x) ** 2 + (place[k].imag - y) ** 2 < half_m**2:
                    near, nearest = True, k
                    break
            if near:
                one, other = max(j - 1, 0), min(j + 1, knots - 1)
                dx, dy = ground[r, other, 0] - ground[r, one, 0], ground[r, other, 1] - ground[r, one, 1]
                length = math.sqrt(dx * dx + dy * dy)
                if length > 0.0:  # not beyond the horizon
                    found[r, j] = (other - one) * apart_px / length
    return found


@compiled
def _sampled(
    sums: FloatArray, scale: FloatArray, first: int, last: int, sample_m: float, at: FloatArray, values: Float32Array
) -> int:
    """Fill in samples `values` (1, n) of a row and their columns `at` (n,), between two knots; returns their number.

    `sums` (w + 1,): the row's cumulative sums. A sample is the mean of as many pixels as it is long.
    """
    apart, top = (len(sums) - 2) / (len(scale) - 1), len(sums) - 1.0
    u, count = first * apart, 0
    for knot in range(first, last):
        start, per_px = knot * apart, sample_m * (scale[knot + 1] - scale[knot]) / apart
        while (u < start + apart or (knot == last - 1 and u <= last * apart)) and count < len(at):
            step = sample_m * scale[knot] + per_px * (u - start)
            half = max(0.5 * step, 0.5)
            low, high = max(u + 0.5 - half, 0.0), min(u + 0.5 + half, top)
            a, b = int(low), min(int(high), len(sums) - 2)
            below = sums[a] + (low - a) * (sums[a + 1] - sums[a])
            above = sums[b] + (high - b) * (sums[b + 1] - sums[b])
            at[count], values[0, count] = u, (above - below) / (high - low)
            u += step
            count += 1
    return count


@compiled
def _half_width(values: Float32Array, best: int, count: int) -> tuple[float, float]:
    """Where a ridge falls to half its height [samples], on both sides of sample `best`."""
    half = WINDOW // 2
    top = ground = 0.0
    for k in range(-half, half + 1):
        top += values[0, best + k] / WINDOW
        ground += 0.5 * (values[0, best + k - SIDE] + values[0, best + k + SIDE]) / WINDOW
    level = 0.5 * (top + ground)
    edges = (0.0, 0.0)
    for side in (-1, 1):
        k = best
        while 0 < k < count - 1 and values[0, k] > level:
            k += side
        inner, outer = values[0, k - side], values[0, k]
        edge = k - side + side * ((inner - level) / (inner - outer) if inner > level > outer else 1.0)
        edges = (edge, edges[1]) if side < 0 else (edges[0], edge)
    return edges


@compiled
def _heights(values: Float32Array, window: Float32Array, height: Float32Array) -> None:
    """Fill in the sums `window` about samples (n,), and how far they exceed those beside, `height`, but for `MARGIN`.

    Loops over slices: the compiler makes vector instructions of them.
    """
    n, half = len(values), WINDOW // 2
    about = window[half : n - half]
    about[:] = 0.0
    for i in range(WINDOW):
        one = values[i : i + len(about)]
        for k in range(len(about)):
            about[k] += one[k]
    middle, found = window[MARGIN : n - MARGIN], height[MARGIN : n - MARGIN]
    left, right = window[MARGIN - SIDE : n - MARGIN - SIDE], window[MARGIN + SIDE : n - MARGIN + SIDE]
    for k in range(len(found)):
        found[k] = middle[k] - (left[k] if left[k] > right[k] else right[k])


@compiled
def median(sizes: Float32Array) -> float:
    """A value that half of `sizes` (n,), none below zero, are smaller than; of an odd number (n - 1) / 2.

    By halving where it may be: counting takes vector instructions, which a selection does not.
    """
    half, low, high = len(sizes) // 2, np.float32(0.0), sizes.max()
    while True:
        middle = np.float32(0.5) * (low + high)
        smaller = np.int32(0)
        for k in range(len(sizes)):
            smaller += np.int32(sizes[k] < middle)
        if smaller == half or not low < middle < high:
            return middle
        if smaller > half:
            high = middle
        else:
            low = middle


@compiled
def _ridges(
    grey: Image,
    rows: Ints,
    scale: FloatArray,
    sample_m: float,
    noises: float,
    contrast: float,
    dark: bool,
    slants: FloatArray,
) -> tuple[Ints, FloatArray, FloatArray, FloatArray]:
    """The ridges (n,) of a marking's width, by row: index of the row, column and width [px]; and the field's ends."""
    width = grey.shape[1]
    most = len(rows) * (width // 2)
    found_row, found_at, found_width = np.empty(most, np.intp), np.empty(most), np.empty(most)
    ends = np.full((len(rows), 2), math.nan)
    samples = 8 * width
    at, values = np.empty(samples), np.empty((1, samples), np.float32)
    sums, size = np.empty(width + 1), np.empty(samples, np.float32)
    window, height = np.empty(samples, np.float32), np.empty(samples, np.float32)
    zero, least, place = np.zeros(1, np.intp), np.empty(1, np.float32), np.empty(1, np.intp)
    count, sign, sums[0] = 0, -1 if dark else 1, 0.0
    for r in range(len(rows)):
        first, last = 0, _KNOTS - 1
        while first < _KNOTS and scale[r, first] * sample_m * PER_MARKING < NARROW_PX:
            first += 1
        while last > first and scale[r, last] * sample_m * PER_MARKING < NARROW_PX:
            last -= 1
        within = last > first
        for j in range(first, last + 1):
            within = within and bool(scale[r, j] > 0.0)
        if not within:
            continue
        line, total = grey[rows[r]], 0
        for k in range(width):
            total += sign * np.int64(line[k])
            sums[k + 1] = total
        of_row = count
        for slant in slants:
            n = _sampled(sums, scale[r], first, last, slant * sample_m, at, values)
            if n < 2 * MARGIN + PER_MARKING:
                break
            if slant == 1.0:
                ends[r] = at[MARGIN], at[n - 1 - MARGIN]
            _heights(values[0, :n], window, height)
            sizes = 0
            for k in range(MARGIN, n - MARGIN, THIN):
                size[sizes] = abs(height[k])
                sizes += 1
            if contrast > 0.0:
                least[0] = contrast * WINDOW
            else:
                least[0] = noises * max(median(size[:sizes]), LEVEL)
            k, end = MARGIN, n - MARGIN
            while k < end:
                if height[k] <= least[0]:
                    k += 1
                    continue
                best = k
                while k < end and height[k] > least[0]:  # the middle of a plateau
                    if height[k] > height[best]:
                        best = k
                    k += 1
                place[0] = best
                if not measure_ridges(values[:, :n], zero, place, least)[3][LINE, 0] or count == most:
                    continue
                low, high = _half_width(values, best, n)
                low_u = at[int(low)] + (low - int(low)) * (at[min(int(low) + 1, n - 1)] - at[int(low)])
                high_u = at[int(high)] + (high - int(high)) * (at[min(int(high) + 1, n - 1)] - at[int(high)])
                middle, wide = 0.5 * (low_u + high_u), high_u - low_u
                known = not wide > 0.0  # no ridge, or one that a narrower filter found
                for other_one in range(of_row, count):
                    known = known or abs(found_at[other_one] - middle) < 0.5 * max(wide, found_width[other_one])
                if not known:
                    found_row[count], found_at[count], found_width[count] = r, middle, wide
                    count += 1
    return found_row[:count], found_at[:count], found_width[:count], ends


@compiled
def _linked(row: Ints, ground: FloatArray, wide: FloatArray, marking_m: float) -> Ints:
    """The chain (n,) that each ridge belongs to: it continues one of the row before, or of the one before that.

    It lies within half a marking of where the chain goes on, or in a direction that differs by `MAX_TURN` at most. How
    far aside a chain's second ridge may lie, its width along the row (n, 2) [m] tells. From row to row that changes by
    less than stripes differ: what is much wider is another thing, such as a chevron's arm that ends at a line.
    """
    n = len(row)
    chain, before, tail = np.full(n, -1, np.intp), np.full(n, -1, np.intp), np.empty(n, np.intp)
    chains = 0
    for i in range(n):
        length = math.hypot(wide[i, 0], wide[i, 1])
        best, least = -1, 1.0
        for c in range(chains - 1, -1, -1):
            j = tail[c]
            if row[i] - row[j] > 2 or row[i] <= row[j]:
                continue
            its = math.hypot(wide[j, 0], wide[j, 1])
            if not length > 0.0 or max(length, its) > WIDTHS[1] / WIDTHS[0] * min(length, its):
                continue
            ex, ey = wide[i, 0] / length, wide[i, 1] / length  # along the row
            dx, dy = ground[i, 0] - ground[j, 0], ground[i, 1] - ground[j, 1]
            aside, ahead = dx * ex + dy * ey, abs(dx * ey - dy * ex)
            k = j
            for _ in range(4):  # the direction of the last five ridges
                k = before[k] if before[k] >= 0 else k
            if k == j:
                slope, slant = 0.0, 1.5 * length / marking_m
                room = 0.5 * marking_m + ahead * math.sqrt(max(slant * slant - 1.0, MAX_TURN**2))
            else:
                bx, by = ground[j, 0] - ground[k, 0], ground[j, 1] - ground[k, 1]
                slope = (bx * ex + by * ey) / max(abs(bx * ey - by * ex), 1e-9)
                stretch = 1.0 + slope * slope
                room = 0.5 * marking_m * math.sqrt(stretch) + MAX_TURN * ahead * stretch
            off = abs(aside - slope * ahead) / room
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
def _continued(chain: Ints, pixels: FloatArray) -> tuple[FloatArray, Ints]:
    """The pixels (m, 2) of chains of two ridges and more, chain by chain, and their chains (m,)."""
    n = len(chain)
    chains = chain.max() + 1 if n else 0
    found, its, count = np.empty((n, 2)), np.empty(n, np.intp), 0
    for c in range(chains):
        start = count
        for i in range(n):
            if chain[i] == c:
                found[count], its[count] = pixels[i], c
                count += 1
        if count == start + 1:
            count = start
    return found[:count], its[:count]


@compiled
def _long_ones(
    chain: Ints, ground: FloatArray, wide: FloatArray, least_m: float, marking_m: float
) -> tuple[Ints, Ints]:
    """The ridges (m,) of chains that are long enough and as wide as a marking, chain by chain, and the stripe (m,) that
    each belongs to."""
    n = len(chain)
    chains = chain.max() + 1 if n else 0
    order, stripe, across = np.empty(n, np.intp), np.empty(n, np.intp), np.empty(n)
    count = stripes = 0
    for c in range(chains):
        start = count
        for i in range(n):
            if chain[i] == c:
                order[count], stripe[count] = i, stripes
                count += 1
        along = ground[order[count - 1]] - ground[order[start]]
        length = math.hypot(along[0], along[1])
        good = count - start >= 2 and length >= least_m
        if good:
            for k in range(start, count):
                one, other = order[max(k - 2, start)], order[min(k + 2, count - 1)]
                tx, ty = ground[other, 0] - ground[one, 0], ground[other, 1] - ground[one, 1]
                w = wide[order[k]]
                across[k] = abs(tx * w[1] - ty * w[0]) / max(math.hypot(tx, ty), 1e-9)
            middle = np.median(across[start:count])
            good = bool(WIDTHS[0] * marking_m < middle < WIDTHS[1] * marking_m)
        if not good:
            count = start
            continue
        stripes += 1
    return order[:count], stripe[:count]


@compiled
def _with_straight_ends(pixels: FloatArray, stripe: Ints) -> FloatArray:
    """The ridges (n, 2) of stripes, the first and the last of each where the ones beside them lead to.

    Paint begins and ends within a row, which shows the middle of a part of it: aside, where the stripe leans.
    """
    straight, first = pixels.copy(), 0
    for end in range(1, len(stripe) + 1):
        if end < len(stripe) and stripe[end] == stripe[first]:
            continue
        if end - first > WHOLE + 1:
            for at, step in ((first, 1), (end - 1, -1)):
                one, other = pixels[at + step], pixels[at + step * WHOLE]
                straight[at, 0] = one[0] + (one[0] - other[0]) * (pixels[at, 1] - one[1]) / (one[1] - other[1])
        first = end
    return straight
