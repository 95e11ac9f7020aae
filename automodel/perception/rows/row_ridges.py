"""Ridges of a marking's width in rows of samples, six to the marking's apparent width.

The filter is the mean of the marking's middle minus the brighter of its two sides: an edge (a shadow, a kerb) has one
bright side and gives nothing. What bare ground makes of the filter is its noise; a ridge exceeds what noise does at one
place of a frame (`ridge_noise`). A ridge is classified by the samples above half of its height: their width, and
whether it is alone. The bars of a zebra crossing lie side by side, lines do not.

`RowRidgeFilter` filters whole rows; `lay_run` and `best_ridges` find the best ridge of short runs of samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from automodel.compiled import compiled
from automodel.perception.markings.ridge import ridge_sums
from automodel.perception.markings.ridge_noise import MEDIAN
from automodel.types import Bools, Float32Array, Floats, Ints

Sums = NDArray[np.int32]

PER_MARKING = 6  # samples
WINDOW = PER_MARKING - 1  # samples that are averaged, of the marking's middle and of each side: all but the edges
SIDE = PER_MARKING  # samples from the middle of the marking to that of a side, which lies next to the marking
MARGIN = SIDE + WINDOW // 2  # samples that the filter needs on each side of a ridge's middle
AROUND = 4 * PER_MARKING  # samples on each side by which a ridge is classified: zebra bars are two to three wide
GATE = 2 * PER_MARKING  # samples on each side of a run's middle among which its ridge is searched, at least
REACH = GATE + 2 * MARGIN  # samples on each side of a run's middle; bare ground is measured where the gate's ends are
BLURRED = 0.5  # of the usual edge of paint: a blurrier ridge is a reflection
LINE, BAR = range(2)
WIDEST = 1.4 * PER_MARKING  # samples of a line
LEVEL = WINDOW * MEDIAN  # least noise of a filter's sum: a grey level (rounding, compression) in all of a window alike

_NARROWEST, _WIDEST_BAR = 0.65 * PER_MARKING, 2.2 * PER_MARKING
_BODY = math.ceil(_WIDEST_BAR / 2)  # samples: half of what counts as the marking itself
_MAX_BESIDE, _MIN_BESIDE = 2.0 * PER_MARKING, 0.5 * PER_MARKING  # brightness beside a line, and beside a bar


@dataclass(slots=True, eq=False)
class Ridges:
    """Ridges (n,): `place` [samples] relative to where they were measured, `height` [sums of `WINDOW` grey levels].

    `edge`: the steepest rise on the less steep side [grey levels a sample]: paint has sharp edges, a reflection has
    not. `flags` (2, n): LINE, a marking; BAR, one of several marks side by side.
    """

    place: Floats
    height: Floats
    edge: Floats
    flags: Bools


@compiled
def measure_ridges(
    values: Float32Array, row: Ints, at: Ints, least: Float32Array
) -> tuple[Float32Array, Float32Array, Float32Array, Bools]:
    """The fields of `Ridges` at samples `at` (n,) of rows `row` (n,) in `values` (r, k).

    A marking's height exceeds the `least` (r,) of its row. Beyond its ends a row is continued with its last value.
    """
    n, last, half = len(at), values.shape[1] - 1, WINDOW // 2
    place, height, edge = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    flags = np.empty((2, n), np.bool_)
    around = np.empty(2 * AROUND + 1, np.float32)
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
        width = moment = rise = fall = 0.0
        for k in range(-_BODY, _BODY + 1):
            # A soft threshold at about half the height; with a hard one places would jump from sample to sample.
            level = min(max((around[AROUND + k] - ground) * 1.6 * share - 0.3, 0.0), 1.0)
            width += level
            moment += k * level
            if k < 0:
                rise = max(rise, around[AROUND + k + 1] - around[AROUND + k])
            elif k < _BODY:
                fall = max(fall, around[AROUND + k] - around[AROUND + k + 1])
        place[i] = moment / max(width, 1e-6)
        height[i] = middle - max(one, other)
        edge[i] = min(rise, fall)
        marked = height[i] > least[row[i]] and width > _NARROWEST
        flags[LINE, i] = marked and width < WIDEST and beside * share < _MAX_BESIDE
        flags[BAR, i] = marked and width < _WIDEST_BAR and beside * share > _MIN_BESIDE and not flags[LINE, i]
    return place, height, edge, flags


@compiled
def run_thresholds(values: Float32Array, noises: float) -> Float32Array:
    """The height (2 k,) that a ridge exceeds, in runs (2 k, s) on two rows about each of k places.

    It is `noises` times the median of |height| at the ends of a run, beyond the reach of a line in its middle; the mean
    over the runs about five neighbouring places.
    """
    k = len(values) // 2
    count = REACH - MARGIN - GATE + 1
    medians, ends = np.empty(len(values), np.float32), np.empty(count + 1, np.float32)  # the smaller half of them
    sums = np.empty(values.shape[1] - WINDOW + 1, np.float32)
    for i in range(len(values)):
        sums[0] = 0.0
        for j in range(WINDOW):
            sums[0] += values[i, j]
        for j in range(1, len(sums)):
            sums[j] = sums[j - 1] + values[i, j + WINDOW - 1] - values[i, j - 1]
        for j in range(count):
            for end in range(2):
                at = SIDE + j if end == 0 else len(sums) - 1 - SIDE - j
                value = abs(sums[at] - max(sums[at - SIDE], sums[at + SIDE]))
                place = min(2 * j + end, count + 1)  # insertion sort
                if place > count:
                    if value >= ends[count]:
                        continue
                    place = count
                while place > 0 and ends[place - 1] > value:
                    ends[place] = ends[place - 1]
                    place -= 1
                ends[place] = value
        medians[i] = 0.5 * (ends[count - 1] + ends[count])
    least = np.empty(len(values), np.float32)
    for i in range(k):
        total, used = np.float32(0.0), 0
        for j in range(max(i - 2, 0), min(i + 3, k)):
            total += medians[j] + medians[k + j]
            used += 2
        least[i] = least[k + i] = noises * max(total / used, LEVEL)
    return least


class RowRidgeFilter:
    """Filters up to `rows` rows of up to `samples` samples."""

    def __init__(self, rows: int, samples: int) -> None:
        self._sums: Sums = np.zeros((rows, samples + 1), np.int32)

    def heights(self, values: NDArray[Any], first: int, last: int) -> Sums:
        """The filter (n, `last` - `first`) at samples first .. last - 1, which are `MARGIN` from the rows' ends."""
        sums = self._sums[: len(values)]
        np.add.accumulate(values, axis=1, dtype=np.int32, out=sums[:, 1:])
        low, high = first - MARGIN, last + MARGIN + 1
        return ridge_sums(sums[:, low:high], WINDOW, SIDE)

    def measure(self, values: NDArray[Any], row: Ints, at: Ints, least: Float32Array) -> Ridges:
        """The ridges (n,) at samples `at` (n,) of rows `row` (n,); `least` (r,) as in `measure_ridges`."""
        row, at = np.ascontiguousarray(row), np.ascontiguousarray(at)  # one memory layout is compiled once
        return Ridges(*measure_ridges(values.astype(np.float32), row, at, least))


@compiled
def lay_run(pixels: Ints, middle: float, step: float) -> None:
    """Fill in a run's pixels (s,), flat indices, about pixel `middle`, `step` [px] apart."""
    reach = len(pixels) // 2
    for sample in range(len(pixels)):
        pixels[sample] = int(middle + (sample - reach) * step)


@compiled
def best_ridges(
    values: Float32Array, least: Float32Array, gates: Ints
) -> tuple[Float32Array, Float32Array, Float32Array, Bools]:
    """The fields of `Ridges` for the best ridge of each of n runs (n, s) among `gates` (n,) samples on each side of
    its middle; places relative to that."""
    best, runs = _best(values, gates), np.arange(len(values))
    place, height, edge, flags = measure_ridges(values, runs, best, least)
    for i in range(len(place)):
        place[i] += best[i] - values.shape[1] // 2
    return place, height, edge, flags


@compiled
def _best(values: Float32Array, gates: Ints) -> Ints:
    """The sample (n,) of each run with the largest filter response."""
    best = np.empty(len(values), np.intp)
    reach = values.shape[1] // 2
    sums = np.empty(values.shape[1], np.float32)
    for i in range(len(values)):
        begin, count = reach - gates[i] - MARGIN, 2 * (gates[i] + MARGIN) + 2 - WINDOW
        for j in range(count):
            sums[j] = 0.0
            for k in range(begin + j, begin + j + WINDOW):
                sums[j] += values[i, k]
        most = -np.inf
        for j in range(SIDE, count - SIDE):
            height = sums[j] - max(sums[j - SIDE], sums[j + SIDE])
            if height > most:
                most, best[i] = height, j - SIDE + reach - gates[i]
    return best
