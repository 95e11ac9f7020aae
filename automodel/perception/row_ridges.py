"""The best ridges on short runs of single image rows; no other pixel is read."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from automodel.perception.ridges import AROUND, MARGIN, SIDE, WINDOW, Brightness, Judged, judge
from automodel.signals import Image

Floats = NDArray[np.floating[Any]]
Ints = NDArray[np.intp]

REACH = 33
GATE = 15  # and as far from there a ridge may lie

_SAMPLES, _PLACES = 2 * REACH + 1, 2 * GATE + 1
_FIRST = REACH - GATE


class RowRidges:
    """Reads runs, at most `runs` at a time, and finds their ridges of at least `contrast` [grey levels].

    Runs stand side by side, samples one below the other: so every operation goes along whole rows of memory.
    """

    def __init__(self, runs: int, brightness: Brightness, contrast: float) -> None:
        self._brightness, self._contrast = brightness, contrast
        self._line: NDArray[np.float64] = np.stack((np.arange(-REACH, REACH + 1), np.ones(_SAMPLES)), axis=1)
        self._ends: NDArray[np.float64] = np.empty((2, runs))
        at = np.arange(_SAMPLES)
        begin = np.arange(_FIRST - MARGIN, _FIRST + _PLACES + MARGIN - WINDOW + 1)[:, None]
        self._window = ((at >= begin) & (at < begin + WINDOW)).astype(np.float32)
        around = np.arange(_FIRST, _FIRST + _PLACES) + np.arange(-AROUND, AROUND + 1)[:, None]
        self._around: Ints = np.clip(around, 0, _SAMPLES - 1)
        self._runs: Ints = np.arange(runs)

    def find(self, image: Image, first: Floats, step: Floats) -> Judged:
        """The best ridge of each of a k runs, about pixel `first` (a, k), counted row by row; run by run.

        `step` (k,) [px] is the way from sample to sample. Where a run leaves the picture it reads what lies there in
        memory: what is found there must not count.
        """
        n = first.size
        ends = self._ends[:, :n]
        ends[0].reshape(first.shape)[:] = step
        ends[1].reshape(first.shape)[:] = first
        values = self._brightness.read(image, (self._line @ ends).astype(np.intp)).astype(np.float32)
        sums = self._window @ values
        height = np.maximum(sums[: -2 * SIDE], sums[2 * SIDE :])
        best = np.subtract(sums[SIDE:-SIDE], height, out=height).argmax(axis=0)
        around = self._around.take(best, axis=1)
        around *= n
        around += self._runs[:n]
        judged = judge(values.take(around), self._contrast)
        judged.place += best
        judged.place -= GATE
        return judged
