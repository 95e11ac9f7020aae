"""Lines that are too faint for single pixels: a bird's-eye view added up along every direction.

A person sees a faint line because it is long. Along a line the noise of the pixels averages out, and the line's height
does not. What is added up is as long as the tightest bend stays within the marking, and the directions lie as close as
that length asks for: a line between two of them stays within the marking, too. So there is nothing to tune.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.compiled import compiled
from automodel.geometry import BirdsEye
from automodel.perception.markings.binary_views import STANDS_OUT, MarkingViews, Run, WhiteAreas, is_ground
from automodel.perception.markings.ridge_noise import MEDIAN, QUARTILE, least_ridge, median
from automodel.signals import EXCEEDED
from automodel.types import FloatArray, Image

_BINS = 16  # of a histogram, to a standard deviation


class FaintLines:
    """Finds what is above both its sides along pieces of straight lines of a view (h, w), where single pixels are not.

    How far beside a marking its sides are, how wide it may be, and whether it is light or dark is that of `areas`.
    `radius_m` is that of the tightest bend, `slope` the steepest line's dy/dx. What a single pixel shows counts so
    little that a bright speck, no longer than two markings are wide, makes no line.
    """

    def __init__(self, birdseye: BirdsEye, areas: WhiteAreas, marking_m: float, radius_m: float, slope: float) -> None:
        view = birdseye.view
        self._run, self._smooth, self._visible = areas.run, areas.smooth, areas.mask
        length_m = math.sqrt(4.0 * marking_m * radius_m)  # on which such a bend moves by half a marking
        apart = 2.0 * marking_m / length_m
        count = int(slope / apart)
        directions = apart * np.arange(-count, count + 1)
        self._skews = directions * view.m_per_row / view.m_per_px  # columns per row
        self._halves = (0.5 * length_m / np.hypot(1.0, directions) / view.m_per_row).astype(np.int64)
        self._alike = birdseye.rows_per_row
        # A false line in as many views as a bound may be exceeded in.
        self._height = MEDIAN * least_ridge(float(np.count_nonzero(self._visible)) / EXCEEDED)
        self._clip = min(self._height, self._height * math.sqrt(length_m * view.m_per_row) / (2.0 * marking_m))
        width, height = (2 * max(round(marking_m / step), 1) + 1 for step in (view.m_per_px, view.m_per_row))
        self._around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, height))
        self._beside = np.ones((1, 2 * self._run.reach + 1), np.uint8)
        self._found(np.zeros_like(self._visible), self._visible, 0.0)  # compiled now: no frame waits for it

    def step(self, view: Image, areas: MarkingViews) -> MarkingViews:
        """The filtered views of a grey view (h, w) with the faint lines, where nothing else is bright around them."""
        view = np.asarray(cv2.blur(view, (self._smooth, 1)), dtype=np.uint8)
        quiet = self._visible & ~np.asarray(cv2.dilate(areas.bright, self._beside), dtype=np.uint8)
        faint = np.zeros_like(view)
        if self._run.light:
            faint |= self._found(view, quiet, areas.least)
        if self._run.dark:
            faint |= self._found(np.asarray(cv2.bitwise_not(view), dtype=np.uint8), quiet, areas.least)
        if not faint.any():
            return areas
        faint &= ~np.asarray(cv2.dilate(self._others(areas.bright, faint), self._around), dtype=np.uint8)
        return areas._replace(lines=areas.lines | faint, bright=areas.bright | faint)

    def _others(self, bright: Image, faint: Image) -> Image:
        """The bright areas (h, w), 0 or 255, that are no specks of faint lines: larger, or as long as one."""
        near = np.asarray(cv2.dilate(faint, self._around), dtype=np.uint8)
        _, labels, sizes, _ = cv2.connectedComponentsWithStats(bright)
        other = sizes[:, cv2.CC_STAT_HEIGHT] > 2 * int(self._halves.max())
        other[labels[(bright & ~near) > 0]] = True
        other[0] = False
        return np.where(other, 255, 0).astype(np.uint8)[labels]

    def _found(self, view: Image, quiet: Image, least: float) -> Image:
        """The lines (h, w), 0 or 255, that are above both their sides by `least` grey levels and out of the noise.

        `quiet` (h, w) is 255 where nothing bright is, nor beside it: there the noise is measured.
        """
        found, visible, height = np.zeros_like(view), self._visible, self._height
        left, right, noise = _above_sides(view, visible, quiet, self._run.reach, self._clip)
        for skew, half in zip(self._skews.tolist(), self._halves.tolist(), strict=True):
            _find(found, view, left, right, visible, quiet, skew, half, self._alike, noise, height, least, self._run)
        return found


@compiled
def _above_sides(
    view: Image, visible: Image, quiet: Image, reach: int, clip: float
) -> tuple[NDArray[np.int16], NDArray[np.int16], float]:
    """How far each pixel is above what is to its left and to its right (h, w), and the standard deviation of a pixel.

    What is more than `clip` of these above or below counts as so much, what is not `visible` as 0. The noise is that
    of second differences where it is `quiet`: no slope of the light is noise.
    """
    rows, columns = view.shape
    left, right = np.zeros((rows, columns), np.int16), np.zeros((rows, columns), np.int16)
    counts = np.zeros(4 * 256, np.int64)
    for r in range(rows):
        for c in range(reach, columns - reach):
            if visible[r, c] != 0:
                here = np.int16(view[r, c])
                left[r, c], right[r, c] = here - np.int16(view[r, c - reach]), here - np.int16(view[r, c + reach])
                if r % 3 == 0 and quiet[r, c] != 0:
                    counts[abs(left[r, c] + right[r, c])] += 1
    noise = median(counts) / (QUARTILE * math.sqrt(6.0))
    most = np.int16(math.ceil(clip * noise))
    for r in range(rows):
        for c in range(columns):
            left[r, c] = min(max(left[r, c], -most), most)
            right[r, c] = min(max(right[r, c], -most), most)
    return left, right, noise


@compiled
def _find(
    found: Image,
    view: Image,
    above_left: NDArray[np.int16],
    above_right: NDArray[np.int16],
    visible: Image,
    quiet: Image,
    skew: float,
    half: int,
    alike: FloatArray,
    noise: float,
    height: float,
    least: float,
    run: Run,
) -> None:
    """Mark in `found` (h, w) the lines in one direction, `skew` columns per row.

    What is added up for each pixel are `half` rows to both sides. The noise of these sums is what most `quiet` ones
    show, which includes the ground's texture, and at least that of as many pixels as there are witnesses: `alike` rows
    (h,) are one. A line is above both its sides by `height` of that noise, and on average by `least`; from the ground
    beyond them it differs by the share `STANDS_OUT` of that.
    """
    rows, columns = found.shape
    count = 2 * half + 1
    starts = np.empty(rows, np.int64)  # where a row's first column lies among the sums
    for r in range(rows):
        starts[r] = round(skew * ((rows - 1 if skew > 0.0 else 0) - r))
    size = columns + max(starts[0], starts[rows - 1])
    left, right = np.zeros(size, np.int32), np.zeros(size, np.int32)
    over, most = np.empty((rows, columns), np.int32), np.zeros(rows, np.int32)
    bin_width = max(math.sqrt(6.0 * count) * noise / _BINS, 1.0)
    counts = np.zeros(64 * _BINS, np.int64)
    for r in range(-half, rows):
        if r + half < rows:
            there = slice(starts[r + half], starts[r + half] + columns)
            _add(left[there], above_left[r + half], np.int32(1))
            _add(right[there], above_right[r + half], np.int32(1))
        if r > half:
            there = slice(starts[r - half - 1], starts[r - half - 1] + columns)
            _add(left[there], above_left[r - half - 1], np.int32(-1))
            _add(right[there], above_right[r - half - 1], np.int32(-1))
        if r < 0:
            continue
        here_left, here_right = left[starts[r] : starts[r] + columns], right[starts[r] : starts[r] + columns]
        most[r] = _less(over[r], here_left, here_right)
        if r % 3 == 0 and half <= r < rows - half:
            for c in range(0, columns, 3):
                if quiet[r, c] != 0:
                    both = abs(here_left[c] + here_right[c])
                    counts[min(int(both / bin_width), len(counts) - 1)] += 1
    shown = median(counts) * bin_width / (QUARTILE * math.sqrt(6.0))
    for r in range(rows):
        summed = min(r + half, rows - 1) - max(r - half, 0) + 1
        sigma = max(shown * math.sqrt(summed / count), noise * math.sqrt(summed * min(alike[r], summed)))
        level = max(height * sigma, least * summed)
        if most[r] <= level:
            continue
        c = 0
        while c < columns:
            first = c
            while c < columns and over[r, c] > level:
                c += 1
            at, apart = (r, first, c), STANDS_OUT * level / summed
            if run.narrow <= c - first < run.wide and not is_ground(view, at, skew, half, apart, run, visible):
                for k in range(first, c):
                    found[r, k] = max(found[r, k], visible[r, k])
            c += c == first


@compiled
def _add(sums: NDArray[np.int32], row: NDArray[np.int16], sign: np.int32) -> None:
    """Add a row to sums, or take it away."""
    for c in range(len(row)):
        sums[c] += sign * np.int32(row[c])


@compiled
def _less(out: NDArray[np.int32], one: NDArray[np.int32], other: NDArray[np.int32]) -> np.int32:
    """Write the smaller of two sums at each pixel of a row; the largest of those."""
    most = np.int32(0)
    for c in range(len(out)):
        out[c] = min(one[c], other[c])
        most = max(most, out[c])
    return most
