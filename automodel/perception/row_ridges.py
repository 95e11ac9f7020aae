"""The best ridges on short runs of single image rows; no other pixel is read."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from automodel.compiled import compiled
from automodel.perception.ridges import MARGIN, SIDE, WINDOW, Brightness, Judged, judge
from automodel.signals import Image

Floats = NDArray[np.floating[Any]]
Single = NDArray[np.float32]
Ints = NDArray[np.intp]

REACH = 31  # samples to each side of a run's middle
GATE = 15  # and as far from there a ridge may lie


class RowRidges:
    """Reads runs, at most `runs` at a time, and finds their ridges of at least `contrast` [grey levels]."""

    def __init__(self, runs: int, brightness: Brightness, contrast: float) -> None:
        self._brightness, self._contrast = brightness, contrast
        self._pixels: Ints = np.empty((runs, 2 * REACH + 1), np.intp)
        self._runs: Ints = np.arange(runs)

    def find(self, image: Image, first: Floats, step: Floats) -> Judged:
        """The best ridge of each of a k runs, about pixel `first` (a, k), counted row by row; run by run.

        `step` (k,) [px] is the way from sample to sample. Where a run leaves the picture it reads what lies there in
        memory: what is found there must not count.
        """
        pixels = self._pixels[: first.size]
        _lay(first, step, pixels)
        values = self._brightness.read(image, pixels).astype(np.float32)
        best = _best(values)
        judged = judge(values, self._runs[: first.size], best, self._contrast)
        judged.place += best
        judged.place -= REACH
        return judged


@compiled
def _lay(first: Floats, step: Floats, pixels: Ints) -> None:
    """Fill in the runs' pixels (a k, 2 REACH + 1)."""
    k = first.shape[1]
    for i in range(first.size):
        for sample in range(pixels.shape[1]):
            pixels[i, sample] = int(first[i // k, i % k] + (sample - REACH) * step[i % k])


@compiled
def _best(values: Single) -> Ints:
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
