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

import numpy as np
from numpy.typing import NDArray

from automodel.compiled import compiled
from automodel.types import Bools, Float32Array, Floats, Image, Ints

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
class Ridges:
    """Ridges (n,): `place` [samples] from where they were judged, `height` [sums of `WINDOW` grey levels], and more.

    `edge`: the steepest rise on their less steep side [grey levels a sample]; what is painted has sharp sides, what is
    reflected has not. `flags` (2, n): LINE, a marking; BAR, one of several marks side by side.
    """

    place: Floats
    height: Floats
    edge: Floats
    flags: Bools


def judge(values: Float32Array, row: Ints, at: Ints, contrast: float) -> Ridges:
    """The ridges (n,) in the middle of samples `at` of `row` in `values` (r, k), of at least `contrast` [grey levels].

    Beyond its ends a row goes on as it ends.
    """
    return Ridges(*judge_ridges(values, row, at, contrast))


@compiled
def judge_ridges(
    values: Float32Array, row: Ints, at: Ints, contrast: float
) -> tuple[Float32Array, Float32Array, Float32Array, Bools]:
    """What `judge` makes a `Ridges` of."""
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


class RowRidgeFilter:
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

    def judge(self, values: NDArray[Any], row: Ints, at: Ints) -> Ridges:
        """The ridges (n,) at sample `at` of `row`."""
        row, at = np.ascontiguousarray(row), np.ascontiguousarray(at)  # one layout, compiled once
        return judge(values.astype(np.float32), row, at, self._contrast)


REACH = 31  # samples to each side of a run's middle
GATE = 15  # and as far from there a ridge may lie


class RunRidges:
    """Reads runs and finds their ridges of at least `contrast` [grey levels]."""

    def __init__(self, brightness: Brightness, contrast: float) -> None:
        self._brightness, self.contrast = brightness, contrast

    def find(self, image: Image, first: Floats, step: Floats) -> Ridges:
        """The best ridge of each of n runs, about pixel `first` (n,), counted row by row, `step` (n,) [px] a sample."""
        pixels = np.empty((len(first), 2 * REACH + 1), np.intp)
        for run, middle, width in zip(pixels, first, step, strict=True):
            lay_run(run, middle, width)
        return Ridges(*best_ridges(self.read(image, pixels), self.contrast))

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
    """The best ridge of each of n runs (n, 2 REACH + 1), as `Ridges` has them, by their distance from the middle."""
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
