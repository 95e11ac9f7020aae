"""The best ridges on short runs of single image rows; no other pixel is read."""

from __future__ import annotations

import numpy as np

from automodel.compiled import compiled
from automodel.perception.ridges import MARGIN, SIDE, WINDOW, Brightness, Judged, judge_ridges
from automodel.types import Bools, Float32Array, Floats, Image, Ints

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
