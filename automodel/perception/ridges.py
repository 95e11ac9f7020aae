"""Ridges of a marking's width in rows of samples, six to the marking's apparent width.

The filter is the mean of the marking's middle above the brighter of its two sides: an edge (a shadow, a kerb) has one
bright side and gives nothing. A ridge is judged by what is brighter than half: its breadth, and whether it is alone.
The bars of a zebra crossing stand side by side, lines do not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from automodel.signals import Image

Floats = NDArray[np.floating[Any]]
Single = NDArray[np.float32]
Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]
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


def _filters() -> Single:
    """Rows (6, 2 AROUND + 1) that make of brightness: the sums of the middle and of both sides, and three more.

    Those are the sides' mean (the ground), how far the middle's mean is above it, and the sum of all beside the marking
    above it.
    """
    at = np.arange(-AROUND, AROUND + 1)
    middle, one, other = (np.abs(at - place) <= WINDOW // 2 for place in (0, -SIDE, SIDE))
    ground = (one + other.astype(float)) / (2 * WINDOW)
    beside = np.abs(at) > _BODY
    return np.stack(
        (middle, one, other, ground, middle / WINDOW - ground, beside - np.count_nonzero(beside) * ground)
    ).astype(np.float32)


_FILTERS = _filters()
_MOMENTS: Single = np.stack((np.ones(2 * _BODY + 1), np.arange(-_BODY, _BODY + 1))).astype(np.float32)


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
    """Ridges (n,): `place` [samples] from where they were judged, `height` [sums of `WINDOW` grey levels], and `flags`.

    `flags` (2, n): LINE, a marking; BAR, one of several marks side by side.
    """

    place: Floats
    height: Floats
    flags: Bools


def judge(around: Single, contrast: float) -> Judged:
    """The ridges (n,) in the middle of brightness `around` (2 AROUND + 1, n), of at least `contrast` [grey levels]."""
    middle, one, other, ground, above, beside = _FILTERS @ around
    height = middle - np.maximum(one, other)
    share = 1.0 / np.maximum(above, 1.0)
    # Breadth and centroid are those of what is brighter than about half; hard steps would hop from sample to sample.
    scale = share * 1.6
    level = around[AROUND - _BODY : AROUND + _BODY + 1] * scale
    level -= ground * scale + 0.3
    np.maximum(level, 0.0, out=level)
    np.minimum(level, 1.0, out=level)
    breadth, moment = _MOMENTS @ level
    beside = beside * share
    wide = (height > contrast * WINDOW) & (breadth > _NARROWEST)
    flags = np.empty((2, len(height)), np.bool_)
    line = np.logical_and(breadth < _WIDEST, beside < _ALONE, out=flags[LINE])
    line &= wide
    bar = np.greater(beside, _NOT_ALONE, out=flags[BAR])
    bar &= wide
    bar &= breadth < _WIDEST_BAR
    bar &= ~line
    return Judged(place=moment / np.maximum(breadth, 1e-6), height=height, flags=flags)


class RidgeJudge:
    """Filters and judges rows of `samples`, at most `rows` at a time; `contrast` [grey levels] is a ridge's least."""

    def __init__(self, rows: int, samples: int, contrast: float) -> None:
        self._samples, self._contrast = samples, contrast
        self._around = np.arange(-AROUND, AROUND + 1)[:, None]
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
        columns = np.minimum(np.maximum(self._around + at, 0), self._samples - 1)
        return judge(values.take(columns + row * self._samples).astype(np.float32), self._contrast)
