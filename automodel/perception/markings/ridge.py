"""Ridges of a marking's width in rows of samples, six to the marking's apparent width.

The filter is the mean of the marking's middle above the brighter of its two sides: an edge (a shadow, a kerb) has one
bright side and gives nothing. A ridge is judged by what is brighter than half: its breadth, and whether it is alone.
The bars of a zebra crossing stand side by side, lines do not.

The best ridges on short runs of single image rows; no other pixel is read.

Marking evidence in a grey picture by a ridge filter as wide as a marking looks (seed 002, marking extraction).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from automodel.compiled import compiled
from automodel.geometry import GroundCamera
from automodel.types import Bools, Float32Array, FloatArray, Floats, Image, Ints

Sums = NDArray[np.int32]

PER_MARKING = 6  # samples
WINDOW = 5  # samples that are averaged: of the marking's middle, and of each side
SIDE = 6  # samples from the middle to a side's; between them lies what may be blurred
MARGIN = SIDE + WINDOW // 2  # samples that the filter needs on each side of a ridge's middle
AROUND = 24  # samples on each side by which a ridge is judged
CHANNELS = {"blue": 0, "green": 1, "red": 2}
LINE, BAR = range(2)

_GREY = (0.114, 0.587, 0.299)  # of blue, green, red: ITU-R BT.601
_BODY = 7  # samples: half of what counts as the marking itself
_NARROWEST, _WIDEST, _WIDEST_BAR = 0.65 * PER_MARKING, 1.4 * PER_MARKING, 2.2 * PER_MARKING
_ALONE, _NOT_ALONE = 2.0 * PER_MARKING, 0.5 * PER_MARKING  # brightness beside a line, at most; beside a bar, at least


class Brightness:
    """Reads single pixels: grey, one channel (`colour` "blue", "green" or "red") or the weighted sum of all ("grey").

    Where `dark` markings are looked for the brightness is turned round.
    """

    def __init__(self, colour: str, dark: bool) -> None:
        self._sign = -1 if dark else 1
        self._channel = CHANNELS.get(colour)
        self._grey: Floats = np.array(_GREY)

    def read(self, image: Image, pixels: Ints) -> NDArray[Any]:
        """The brightness of `pixels`, counted row by row; of the first or the last one where there is none."""
        values: NDArray[Any]
        if image.ndim == 2:
            values = image.reshape(-1).take(pixels, mode="clip")
        elif self._channel is not None:
            values = image.reshape(-1, 3)[:, self._channel].take(pixels, mode="clip")
        else:
            values = np.rint(image.reshape(-1, 3).take(pixels, axis=0, mode="clip") @ self._grey).astype(np.int32)
        return values if self._sign > 0 else -values.astype(np.int32)


@dataclass(slots=True, eq=False)
class Judged:
    """Ridges (n,): `place` [samples] from where they were judged, `height` [sums of `WINDOW` grey levels], and more.

    `edge`: the steepest rise on their less steep side [grey levels a sample]; what is painted has sharp sides, what is
    reflected has not. `flags` (2, n): LINE, a marking; BAR, one of several marks side by side.
    """

    place: Floats
    height: Floats
    edge: Floats
    flags: Bools


def judge(values: Float32Array, row: Ints, at: Ints, contrast: float) -> Judged:
    """The ridges (n,) in the middle of samples `at` of `row` in `values` (r, k), of at least `contrast` [grey levels].

    Beyond its ends a row goes on as it ends.
    """
    return Judged(*judge_ridges(values, row, at, contrast))


@compiled
def judge_ridges(
    values: Float32Array, row: Ints, at: Ints, contrast: float
) -> tuple[Float32Array, Float32Array, Float32Array, Bools]:
    """What `judge` makes a `Judged` of."""
    n, last = len(at), values.shape[1] - 1
    place, height, edge = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    flags = np.empty((2, n), np.bool_)
    around = np.empty(2 * AROUND + 1, np.float32)
    half = WINDOW // 2
    for i in range(n):
        for k in range(2 * AROUND + 1):
            around[k] = values[row[i], min(max(at[i] + k - AROUND, 0), last)]
        middle = one = other = beside = np.float32(0.0)
        for k in range(AROUND - half, AROUND + half + 1):
            middle += around[k]
            one += around[k - SIDE]
            other += around[k + SIDE]
        ground = (one + other) / (2 * WINDOW)
        share = 1.0 / max(middle / WINDOW - ground, 1.0)
        for k in range(AROUND - _BODY):
            beside += (around[k] - ground) + (around[2 * AROUND - k] - ground)
        breadth = moment = rise = fall = 0.0
        for k in range(-_BODY, _BODY + 1):
            # What is brighter than about half; hard steps would hop from sample to sample.
            level = min(max((around[AROUND + k] - ground) * 1.6 * share - 0.3, 0.0), 1.0)
            breadth += level
            moment += k * level
            if k < 0:
                rise = max(rise, around[AROUND + k + 1] - around[AROUND + k])
            elif k < _BODY:
                fall = max(fall, around[AROUND + k] - around[AROUND + k + 1])
        place[i] = moment / max(breadth, 1e-6)
        height[i] = middle - max(one, other)
        edge[i] = min(rise, fall)
        wide = height[i] > contrast * WINDOW and breadth > _NARROWEST
        flags[LINE, i] = wide and breadth < _WIDEST and beside * share < _ALONE
        flags[BAR, i] = wide and breadth < _WIDEST_BAR and beside * share > _NOT_ALONE and not flags[LINE, i]
    return place, height, edge, flags


class RidgeJudge:
    """Filters and judges rows of `samples`, at most `rows` at a time; `contrast` [grey levels] is a ridge's least."""

    def __init__(self, rows: int, samples: int, contrast: float) -> None:
        self._contrast = contrast
        self._sums: Sums = np.zeros((rows, samples + 1), np.int32)

    def heights(self, values: NDArray[Any], first: int, last: int) -> Sums:
        """The filter (n, `last` - `first`) on rows at samples first .. last - 1, which are `MARGIN` from the ends."""
        sums = self._sums[: len(values)]
        np.add.accumulate(values, axis=1, dtype=np.int32, out=sums[:, 1:])
        begin, end = first - MARGIN, last + MARGIN + 1
        means = sums[:, begin + WINDOW : end] - sums[:, begin : end - WINDOW]  # times WINDOW
        height = np.maximum(means[:, : -2 * SIDE], means[:, 2 * SIDE :])
        return np.subtract(means[:, SIDE:-SIDE], height, out=height)

    def judge(self, values: NDArray[Any], row: Ints, at: Ints) -> Judged:
        """The ridges (n,) at sample `at` of `row`."""
        row, at = np.ascontiguousarray(row), np.ascontiguousarray(at)  # one layout, compiled once
        return judge(values.astype(np.float32), row, at, self._contrast)


REACH = 31  # samples to each side of a run's middle
GATE = 15  # and as far from there a ridge may lie


class RowRidges:
    """Reads runs and finds their ridges of at least `contrast` [grey levels]."""

    def __init__(self, brightness: Brightness, contrast: float) -> None:
        self._brightness, self.contrast = brightness, contrast

    def find(self, image: Image, first: Floats, step: Floats) -> Judged:
        """The best ridge of each of n runs, about pixel `first` (n,), counted row by row, `step` (n,) [px] a sample."""
        pixels = np.empty((len(first), 2 * REACH + 1), np.intp)
        for run, middle, width in zip(pixels, first, step, strict=True):
            lay_run(run, middle, width)
        return Judged(*best_ridges(self.read(image, pixels), self.contrast))

    def read(self, image: Image, pixels: Ints) -> Float32Array:
        """The brightness of `pixels`.

        Where a run leaves the picture it reads what lies there in memory: what is found there must not count.
        """
        return self._brightness.read(image, pixels).astype(np.float32)


@compiled
def lay_run(pixels: Ints, middle: float, step: float) -> None:
    """Fill in a run's pixels (2 REACH + 1,) about pixel `middle`, `step` [px] apart."""
    for sample in range(len(pixels)):
        pixels[sample] = int(middle + (sample - REACH) * step)


@compiled
def best_ridges(values: Float32Array, contrast: float) -> tuple[Float32Array, Float32Array, Float32Array, Bools]:
    """The best ridge of each of n runs (n, 2 REACH + 1), as `Judged` has them, by their distance from the middle."""
    best, runs = _best(values), np.arange(len(values))
    place, height, edge, flags = judge_ridges(values, runs, best, contrast)
    for i in range(len(place)):
        place[i] += best[i] - REACH
    return place, height, edge, flags


@compiled
def _best(values: Float32Array) -> Ints:
    """The sample (n,) of each run at which its middle stands out most of the brighter of its two sides."""
    best = np.empty(len(values), np.intp)
    begin, end = REACH - GATE - MARGIN, REACH + GATE + MARGIN + 1
    sums = np.empty(end - begin - WINDOW + 1, np.float32)
    for i in range(len(values)):
        for j in range(len(sums)):
            sums[j] = 0.0
            for k in range(begin + j, begin + j + WINDOW):
                sums[j] += values[i, k]
        most = -np.inf
        for j in range(SIDE, len(sums) - SIDE):
            height = sums[j] - max(sums[j - SIDE], sums[j + SIDE])
            if height > most:
                most, best[i] = height, j - SIDE + REACH - GATE
    return best


def apparent_width_px(camera: GroundCamera, marking_width_m: float) -> FloatArray:
    """How many pixels (h,) broad a marking ahead looks on each row of the picture, over flat ground; 0: no ground."""
    model = camera.camera
    rows = np.arange(model.height_px, dtype=np.float64)
    ground = camera.px_to_ground(np.stack((np.full(len(rows), model.matrix[0, 2]), rows), axis=-1))
    sides = [camera.ground_to_px(ground + np.array([0.0, 0.5 * side * marking_width_m])) for side in (1.0, -1.0)]
    width = np.hypot(*(sides[1] - sides[0]).T)
    return np.where(np.isfinite(width), width, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Band:
    """Neighbouring rows that share their filter: the boxes' widths, and how far aside the outer ones lie."""

    rows: slice
    middle_px: int
    side_px: int
    shift_px: int


class RidgeMarkings:
    """Tells how far each pixel stands above both its sides, as a marking does.

    On each row the mean over half a marking's width is compared with the means over a whole one beyond either side:
    half of twice the middle less left less right, and at most `BALANCE` times what it stands above the brighter side,
    so that the rim of a bright area does not count. The level of a marking is that of equally spaced candidates for
    which the variance within the two classes is least (Otsu), but at least `contrast` grey levels and at most `MOST`
    times that.

    `width_px_per_row` (h,) is the width of a marking on each row of a picture `picture_width_px` broad; 0: no ground.
    `dark`: markings are darker than the ground. A picture broader than `MAX_WIDTH_PX` is reduced to that; `size_px`
    is (width, height) of the evidence.
    """

    MAX_WIDTH_PX = 512
    MIN_WIDTH_PX = 0.75  # of a marking; rows where it is narrower have no evidence
    MIDDLE, SIDE, ASIDE = (
        0.5,
        1.0,
        1.75,
    )  # widths of the middle and of a side, and way from one to the other, in markings
    BALANCE = 2.0
    MOST = 4.0
    CANDIDATES = 32
    NEXT_BAND = 1.1  # a band ends where the width is so much larger than at its far end
    LEVEL = 128  # the evidence of what reaches the level

    def __init__(
        self, width_px_per_row: ArrayLike, picture_width_px: int, contrast: float = 12.0, dark: bool = False
    ) -> None:
        given = np.asarray(width_px_per_row, dtype=np.float64)
        if given.ndim != 1 or not np.isfinite(given).all() or contrast <= 0.0:
            raise ValueError("RidgeMarkings: finite widths (h,) and a positive contrast are wanted")
        scale = min(1.0, self.MAX_WIDTH_PX / picture_width_px)
        self.size_px = (round(scale * picture_width_px), max(round(scale * len(given)), 1))
        self._picture_shape = (len(given), picture_width_px)
        self._contrast, self._dark = contrast, dark
        rows = (np.arange(self.size_px[1]) + 0.5) * len(given) / self.size_px[1] - 0.5
        width = np.interp(rows, np.arange(len(given)), given) * self.size_px[0] / picture_width_px
        self._bands = self._split(width)
        self._ground = slice(min(b.rows.start for b in self._bands), None) if self._bands else slice(0, 0)

    @classmethod
    def of_camera(
        cls, camera: GroundCamera, marking_width_m: float, contrast: float = 12.0, dark: bool = False
    ) -> RidgeMarkings:
        """The filter for a calibrated camera over flat ground."""
        return cls(apparent_width_px(camera, marking_width_m), camera.camera.width_px, contrast, dark)

    def _split(self, width_px: FloatArray) -> list[_Band]:
        bands: list[_Band] = []
        edges = [0]
        for row in range(1, len(width_px)):
            first = width_px[edges[-1]]
            if not max(first, width_px[row]) <= self.NEXT_BAND * max(min(first, width_px[row]), self.MIN_WIDTH_PX):
                edges.append(row)
        for first_row, end in zip(edges, [*edges[1:], len(width_px)], strict=True):
            width = float(width_px[first_row:end].mean())
            if width >= self.MIN_WIDTH_PX:
                bands.append(
                    _Band(
                        rows=slice(first_row, end),
                        middle_px=_odd(self.MIDDLE * width),
                        side_px=_odd(self.SIDE * width),
                        shift_px=max(round(self.ASIDE * width), 2),
                    )
                )
        return bands

    def step(self, grey: Image) -> Image:
        """The evidence (height, width of `size_px`) of a grey picture (h, w); `LEVEL` and more is a marking.

        Raises ValueError for a picture of another size.
        """
        if grey.shape != self._picture_shape:
            raise ValueError(f"RidgeMarkings: a picture {grey.shape} where {self._picture_shape} is wanted")
        if grey.shape[1] != self.size_px[0]:
            little = (
                2 * self.size_px[0] >= grey.shape[1]
            )  # then bilinear sampling leaves nothing out, and costs a tenth
            method = cv2.INTER_LINEAR if little else cv2.INTER_AREA
            grey = np.asarray(cv2.resize(grey, self.size_px, interpolation=method), dtype=np.uint8)
        response = self._response(grey)
        evidence: Image = np.zeros_like(grey)
        cv2.convertScaleAbs(response[self._ground], evidence[self._ground], self.LEVEL / self._level(response))
        return evidence

    def _response(self, grey: Image) -> Image:
        """How far each pixel stands above its sides."""
        middle, left, right = (np.zeros_like(grey) for _ in range(3))
        for band in self._bands:
            rows = cv2.bitwise_not(grey[band.rows]) if self._dark else grey[band.rows]
            cv2.blur(rows, (band.middle_px, 1), middle[band.rows], borderType=cv2.BORDER_REPLICATE)
            reach = band.shift_px
            padded = cv2.copyMakeBorder(rows, 0, 0, reach, reach, cv2.BORDER_REPLICATE)
            sides = cv2.blur(padded, (band.side_px, 1), borderType=cv2.BORDER_REPLICATE)
            left[band.rows], right[band.rows] = sides[:, : grey.shape[1]], sides[:, 2 * reach :]
        above_left, above_right = cv2.subtract(middle, left), cv2.subtract(middle, right)
        mean = cv2.addWeighted(above_left, 0.5, above_right, 0.5, 0.0)
        least = cv2.convertScaleAbs(cv2.min(above_left, above_right), alpha=self.BALANCE)
        return np.asarray(cv2.min(mean, least), dtype=np.uint8)

    def _level(self, response: Image) -> float:
        """The response that tells markings from the rest."""
        counts = cv2.calcHist([response[self._ground][::2]], [0], None, [256], [0, 256]).ravel().astype(np.float64)
        values = np.arange(256.0)
        below = [np.cumsum(counts * values**power) for power in range(3)]
        at = np.unique(
            np.linspace(self._contrast, self.MOST * self._contrast, self.CANDIDATES).astype(np.intp).clip(0, 255)
        )
        within: FloatArray = np.zeros(len(at))
        for number, first, second in ([b[at - 1] for b in below], [b[-1] - b[at - 1] for b in below]):
            within = within + second - first**2 / np.maximum(number, 1.0)
        return float(at[int(within.argmin())])


def _odd(width_px: float) -> int:
    """The nearest odd number of pixels."""
    return 2 * int(0.5 * width_px) + 1
