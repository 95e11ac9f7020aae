"""Binary images of line markings: from a network's mask, and from a grey bird's-eye view.

`centerline` (Cudrano et al. 2020) uses `adaptive_threshold` and `FeaturePoints`; `windows` (Balbuena Palma et al. 2020)
uses `WhiteAreas`, and `contour` where it looks around.
"""

from __future__ import annotations

from dataclasses import replace
from statistics import NormalDist
from typing import NamedTuple

import cv2
import numpy as np

from automodel.compiled import compiled
from automodel.config import CameraConfig, Intrinsics
from automodel.geometry import BirdsEye, GroundCamera, View
from automodel.perception.markings.ridge_noise import FALSE_ALARMS
from automodel.types import Image, Ints

ABOVE = 34  # of 255: what exceeds the mean around it by more is a marking, however unlikely
AROUND_PX = 21  # side of the box around it, for a mask 512 px wide
MAX_ROWS = 240  # of a bird's-eye view; a long view is coarser along the road than across


def road_view(camera: GroundCamera, ahead_m: float, half_width_m: float, m_per_px: float) -> View:
    """The bird's-eye view from the first visible ground to `ahead_m` beyond it."""
    near = camera.first_visible_x_m()
    return View(
        x_near_m=near,
        x_far_m=near + ahead_m,
        half_width_m=half_width_m,
        m_per_px=m_per_px,
        m_per_row=max(m_per_px, ahead_m / MAX_ROWS),
    )


def share_above(camera: GroundCamera, view: View) -> float:
    """The share of the image's height, from its top, of which `FeaturePoints` needs no mask for that view.

    It is what lies above the view's ground, less what `adaptive_threshold` and the warp look at around a pixel of a
    mask that is twice as wide as it is high.
    """
    rows, columns = (np.linspace(-0.5, size - 0.5, 100) for size in (view.height_px, view.width_px))
    pixels = camera.ground_to_px(view.to_body(np.stack(np.meshgrid(columns, rows), axis=-1)))
    seen = pixels[camera.camera.inside(pixels)]
    if not len(seen):
        return 0.0
    around = (0.5 * AROUND_PX + 2.0) / 256.0
    return max((float(seen[:, 1].min()) + 0.5) / camera.camera.height_px - around, 0.0)


def adaptive_threshold(probability: Image) -> Image:
    """The mask (h, w), 0 .. 255, with markings raised to 128 or more, and the rest lowered to 127 or less.

    Worn lines have a low probability with a sharp peak, while light strips of road, kerbs and edges have a low one over
    a wide area.
    """
    scale = probability.shape[1] / 512.0
    side = 2 * round(0.5 * (AROUND_PX * scale - 1.0)) + 1
    above = cv2.subtract(cv2.blur(probability, (3, 3)), cv2.blur(probability, (side, side)))
    raised = cv2.threshold(above, ABOVE, 128, cv2.THRESH_BINARY)[1]
    return np.asarray(cv2.max(probability, raised), dtype=np.uint8)


def resized_camera(camera: CameraConfig, width_px: int, height_px: int) -> CameraConfig:
    """The camera of the resized image: pixel centres move from u to (u + 1/2) scale - 1/2."""
    across, down = width_px / camera.width_px, height_px / camera.height_px
    given = camera.intrinsics
    intrinsics = Intrinsics(
        fx_px=given.fx_px * across,
        fy_px=given.fy_px * down,
        cx_px=(given.cx_px + 0.5) * across - 0.5,
        cy_px=(given.cy_px + 0.5) * down - 0.5,
        distortion=given.distortion,
    )
    return replace(camera, width_px=width_px, height_px=height_px, intrinsics=intrinsics)


class FeaturePoints:
    """Warps a line mask into the bird's-eye view, thresholds and cleans it (Cudrano et al. 2020, section IV).

    The mask covers the camera's image at any size; the maps of a size are computed at its first use. `visible` (h, w)
    is 255 where the view shows ground that the camera sees.
    """

    KERNEL = 0.6  # side of the kernel that opens and closes, in marking widths

    def __init__(self, camera: CameraConfig, view: View, marking_width_m: float, threshold: float = 0.5) -> None:
        if not 0.0 < threshold < 1.0:
            raise ValueError(f"FeaturePoints: expected a threshold between 0 and 1, got {threshold}")
        self.view, self._camera, self._level = view, camera, 255.0 * threshold
        self._cleaning = self._kernel(self.KERNEL * marking_width_m)
        self._birdseyes: dict[tuple[int, int], BirdsEye] = {}
        self.visible: Image = BirdsEye(GroundCamera.from_config(camera), view).mask

    def step(self, mask: Image) -> Image:
        """The binary view (h, w), 0 or 255, of a mask (rows, columns), 0 .. 255."""
        rows, columns = mask.shape
        return self._clean(self._birdseye((columns, rows)).warp(mask))

    def of_view(self, mask: Image) -> Image:
        """The binary view (h, w), 0 or 255, of a mask 0 .. 255 of the view at any size."""
        size = (self.view.width_px, self.view.height_px)
        return self._clean(np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8))

    def _clean(self, mask: Image) -> Image:
        """The binary view (h, w), 0 or 255, of a mask (h, w), 0 .. 255."""
        lines = cv2.threshold(mask, self._level, 255, cv2.THRESH_BINARY)[1]
        if self._cleaning is not None:
            lines = cv2.morphologyEx(lines, cv2.MORPH_CLOSE, self._cleaning)
            lines = cv2.morphologyEx(lines, cv2.MORPH_OPEN, self._cleaning)
        return np.asarray(cv2.bitwise_and(lines, self.visible), dtype=np.uint8)

    def _birdseye(self, size_px: tuple[int, int]) -> BirdsEye:
        if size_px not in self._birdseyes:
            camera = GroundCamera.from_config(resized_camera(self._camera, *size_px))
            self._birdseyes[size_px] = BirdsEye(camera, self.view)
        return self._birdseyes[size_px]

    def _kernel(self, side_m: float) -> Image | None:
        """A kernel with odd sides (an even one shifts the result by a pixel); None where it would do nothing."""
        rows, columns = (2 * int(0.5 * side_m / m + 0.25) + 1 for m in (self.view.m_per_row, self.view.m_per_px))
        return np.ones((rows, columns), np.uint8) if max(rows, columns) > 1 else None


class MarkingViews(NamedTuple):
    """A grey bird's-eye view (h, w) filtered: all bright areas and those as wide as a line, 0 or 255.

    `least`: what is less above its surroundings [grey levels] is no marking beside what is brighter, or by the
    configuration, however sure it is.
    """

    bright: Image
    lines: Image
    least: float = 0.0


class Run(NamedTuple):
    """Which runs of pixels along a row may be of a line: of `light` or `dark` markings, or of both.

    `reach` [px]: to what is beside a marking. A run of `narrow` pixels and more is wide enough, one of `wide` and more
    too wide; both are odd.
    """

    reach: int
    narrow: int
    wide: int
    light: bool
    dark: bool


class WhiteAreas:
    """The white-areas filter of Balbuena Palma et al. 2020, section IV-B: keeps what is about as wide as a marking.

    A pixel is bright relative to the mean of a box five markings wide, so that slow changes of the light have no
    effect. The threshold is a share of the contrast of the brightest pixels, at least `contrast` [grey levels] or,
    where that is 0, what noise exceeds at `FALSE_ALARMS` pixels. Of the bright areas, runs along a row
    between `NARROW` and `WIDE` marking widths are lines (a slanted line is cut wider than it is). `markings` are
    "light" or "dark" against the ground, or "both": then what is darker than its surroundings counts as bright too.
    """

    NARROW, WIDE = 0.45, 2.4
    SMOOTH = 0.75  # marking widths over which a row is averaged, as three rows are: faint paint stands out of noise
    SIDES = 0.6  # share of the threshold by which a marking exceeds its two sides
    SHARE = 0.35  # minimum contrast of a marking, as a share of that of the brightest 1 % of the pixels

    def __init__(
        self, birdseye: BirdsEye, marking_width_m: float, contrast: float = 0.0, markings: str = "light"
    ) -> None:
        self.contrast, self._markings = contrast, markings
        marking_px = marking_width_m / birdseye.view.m_per_px
        self._box = 2 * int(2.5 * marking_px) + 1
        self.smooth = 2 * int(0.5 * self.SMOOTH * marking_px) + 1
        self.run = Run(
            reach=round(1.6 * marking_px),
            narrow=2 * int(0.5 * self.NARROW * marking_px) + 1,
            wide=2 * int(0.5 * self.WIDE * marking_px) + 1,
            light=markings != "dark",
            dark=markings != "light",
        )
        edge = np.ones((3, 2 * int(0.5 * marking_px) + 3), np.uint8)
        padded = cv2.copyMakeBorder(birdseye.mask, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=[0])
        self.mask: Image = np.array(cv2.erode(padded, edge)[1:-1, 1:-1], dtype=np.uint8)
        thinned = np.zeros_like(self.mask)
        thinned[::3] = self.mask[::3]
        self._sampled = np.flatnonzero(thinned)
        normal, rate = NormalDist(), min(FALSE_ALARMS / (3.0 * max(len(self._sampled), 1)), 0.25)
        self._quartiles = normal.inv_cdf(1.0 - rate) / normal.inv_cdf(0.75)
        self.step(self.mask)  # what it calls is compiled now: no frame waits for it

    def step(self, view: Image) -> MarkingViews:
        """The filtered views of a grey view (h, w)."""
        view = np.asarray(cv2.blur(view, (self.smooth, 3)), dtype=np.uint8)
        around = cv2.blur(view, (self._box, self._box), borderType=cv2.BORDER_REPLICATE)
        contrast = self._contrast(view, np.asarray(around, dtype=np.uint8))
        least, level = self._levels(contrast)
        lines = narrow_lines(view, np.flatnonzero(contrast > int(level)), self.SIDES * level, self.run, self.mask)
        bright = cv2.bitwise_and(cv2.threshold(contrast, level, 255, cv2.THRESH_BINARY)[1], self.mask)
        return MarkingViews(np.asarray(bright, dtype=np.uint8), lines, least)

    def _levels(self, contrast: Image) -> tuple[float, float]:
        """The contrast [grey levels] that a marking has at least, and that from which on a single pixel is bright."""
        # The third quartile of symmetric noise is the median of its absolute values; the rest of `contrast` is cut off
        # at 0 where one polarity counts.
        quartile = 0.5 if self._markings == "both" else 0.75
        brightest, noise = _brightest_and_noise(contrast.ravel(), self._sampled, quartile)
        least = max(self.SHARE * brightest, self.contrast)
        return least, max(least, 0.0 if self.contrast else self._quartiles * noise)

    def _contrast(self, view: Image, around: Image) -> Image:
        """How far each pixel is above its surroundings, or below them for dark markings; else 0."""
        if self._markings == "both":
            return np.asarray(cv2.absdiff(view, around), dtype=np.uint8)
        light = self._markings == "light"
        return np.asarray(cv2.subtract(view, around) if light else cv2.subtract(around, view), dtype=np.uint8)


@compiled
def _brightest_and_noise(values: Image, sampled: Ints, quartile: float) -> tuple[float, float]:
    """Of the values of an image (n,) at `sampled` (k,): from which on they are the brightest 1 %, and a quantile."""
    counts = np.zeros((4, 256), np.int64)  # four, because one that is counted up again and again is waited for
    for k in range(len(sampled)):
        counts[k % 4, values[sampled[k]]] += 1
    shares = np.cumsum(counts.sum(axis=0)) / max(len(sampled), 1)
    # A grey level stands for all values half a level around it.
    return float(np.searchsorted(shares, 0.99)), np.interp(quartile, shares, np.arange(256.0) + 0.5)


@compiled
def _is_ridge(view: Image, row: int, column: int, sides: float, run: Run) -> bool:
    """Whether a pixel of a view (h, w) exceeds both its neighbours on its row by more than `sides`, or is as far below.

    The rim of a bright patch exceeds one side only; the first and the last pixel of a row, none.
    """
    value, left = float(view[row, column]), float(view[row, max(column - run.reach, 0)])  # int() would be unsigned
    right = float(view[row, min(column + run.reach, view.shape[1] - 1)])
    return (run.light and value - max(left, right) > sides) or (run.dark and min(left, right) - value > sides)


@compiled
def narrow_lines(view: Image, bright: Ints, sides: float, run: Run, visible: Image) -> Image:
    """Runs of pixels along the rows of a view (h, w) that are as long as a line is wide: 0 or 255, where `visible`.

    The pixels are those of `bright` (n,), indices of the flat view, that are ridges by `sides`. Masked only at the end:
    an area cut by the image's edge is replicated beyond it and counts as wide, not as narrow.
    """
    width, lines, k = view.shape[1], np.zeros_like(view), 0
    while k < len(bright):
        first = end = bright[k]
        row, start = first // width, first - first % width  # and where the row starts
        while k < len(bright) and bright[k] == end and _is_ridge(view, row, end - start, sides, run):
            k, end = k + 1, end + 1
        if run.narrow <= end - first < run.wide:
            lines[row, first - start : end - start] = visible[row, first - start : end - start]
        k += end == first
    return lines
