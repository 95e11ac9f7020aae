"""Binary images of line markings: from a network's mask, and from a grey bird's-eye view.

`centerline` (Cudrano et al. 2020) uses `adaptive_threshold` and `FeaturePoints`; `windows` (Balbuena Palma et al. 2020)
uses `WhiteAreas`, and `contour` where it looks around.
"""

from __future__ import annotations

import math
from dataclasses import replace
from statistics import NormalDist
from typing import NamedTuple

import cv2
import numpy as np

from automodel.compiled import compiled
from automodel.config import CameraConfig, Intrinsics
from automodel.geometry import BirdsEye, GroundCamera, View
from automodel.perception.markings.ridge import ridge_image
from automodel.perception.markings.ridge_noise import FALSE_ALARMS, MEDIAN, QUARTILE, least_ridge, median
from automodel.types import Image, Int32Array, Ints

ABOVE = 34  # of 255: what exceeds the mean around it by more is a marking, however unlikely
AROUND_PX = 21  # side of the box around it, for a mask 512 px wide
ROUNDED = 2.0  # grey levels that whole numbers may show where there is less than one, which is rounded at both ends
SAMPLED = 7  # every so many pixels tell the noise and what is brightest: thousands
STANDS_OUT = 0.6  # share of a threshold by which a marking exceeds its two sides, and differs from the ground beyond
BEYOND = tuple(1.0 + 0.75 * k for k in range(7))  # marking widths from a line's edge to where the ground is looked at
AS_BRIGHT = 3  # of these places on one side, from which on a line is ground: fewer may be a slope of the light
SPARSE = 4  # every so many pixels of a row tell its median
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

    `paint`: of the lines, those that are no reflections, because they cross the rays from the camera. `least`: what is
    less above its surroundings [grey levels] is no marking beside what is brighter, or by the configuration, however
    sure it is.
    """

    bright: Image
    lines: Image
    paint: Image
    least: float = 0.0


class Run(NamedTuple):
    """Which runs of pixels along a row may be of a line: of `light` or `dark` markings, or of both.

    `reach` [px]: to what is beside a marking, `beyond` (n,) [px]: from its edge to the ground. A run of `narrow` pixels
    and more is wide enough, one of `wide` and more too wide; both are odd.
    """

    reach: int
    beyond: Int32Array
    narrow: int
    wide: int
    light: bool
    dark: bool


class Rays(NamedTuple):
    """Indices (n,) of a flat view's pixels, and of those that lie ahead and behind on the same rays from the camera."""

    at: Int32Array
    ahead: Int32Array
    behind: Int32Array


class WhiteAreas:
    """The white-areas filter of Balbuena Palma et al. 2020, section IV-B: keeps what is about as wide as a marking.

    A pixel is bright relative to the mean of a box five markings wide, so that slow changes of the light have no
    effect. The threshold is a share of the contrast of the brightest pixels, at least `contrast` [grey levels] or,
    where that is 0, what noise exceeds at `FALSE_ALARMS` pixels. Of the bright areas, runs along a row
    between `NARROW` and `WIDE` marking widths are lines (a slanted line is cut wider than it is). `markings` are
    "light" or "dark" against the ground, or "both": then what is darker than its surroundings counts as bright too.

    The road between two dark seams is no line: `AS_BRIGHT` of the places `BEYOND` it on one side are as bright,
    and so is the median of its row: a white wall beside a line is not the ground.

    That does not tell paint in a lamp's beam from the beam, which is as bright and lifts the mean. Along the ground's
    rays from the camera a beam hardly changes, and paint that crosses them is a ridge: such runs are lines, too. The
    noise is that of second differences along the rays, for which a beam's rim is none. Both reach over two rows of the
    image at least: what is seen by the same pixels does not differ.
    """

    NARROW, WIDE = 0.45, 2.4
    SMOOTH = 0.75  # marking widths over which a row is averaged, as three rows are: faint paint stands out of noise
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
            beyond=np.rint(np.array(BEYOND) * marking_px).astype(np.int32),
            narrow=2 * int(0.5 * self.NARROW * marking_px) + 1,
            wide=2 * int(0.5 * self.WIDE * marking_px) + 1,
            light=markings != "dark",
            dark=markings != "light",
        )
        edge = np.ones((3, 2 * int(0.5 * marking_px) + 3), np.uint8)
        padded = cv2.copyMakeBorder(birdseye.mask, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=[0])
        self.mask: Image = np.array(cv2.erode(padded, edge)[1:-1, 1:-1], dtype=np.uint8)
        reach_m = self.run.reach * birdseye.view.m_per_px
        ahead, behind = (birdseye.along_rays(side, reach_m, 2.0) for side in (+1, -1))
        there = (self.mask > 0) & (ahead >= 0) & (behind >= 0)
        self._rays = Rays(at=np.flatnonzero(there).astype(np.int32), ahead=ahead[there], behind=behind[there])
        self._sampled = Rays(*(each[::SAMPLED].copy() for each in self._rays))
        places = max(int(np.count_nonzero(self.mask)), 1)
        self._sigmas = NormalDist().inv_cdf(1.0 - min(FALSE_ALARMS / places, 0.25))
        self._ridge_sigmas = MEDIAN * least_ridge(float(places))
        self.step(self.mask)  # what it calls is compiled now: no frame waits for it

    def step(self, view: Image) -> MarkingViews:
        """The filtered views of a grey view (h, w)."""
        view = np.asarray(cv2.blur(view, (self.smooth, 3)), dtype=np.uint8)
        around = cv2.blur(view, (self._box, self._box), borderType=cv2.BORDER_REPLICATE)
        contrast, ridges = self._contrast(view, np.asarray(around, dtype=np.uint8)), self._ridges(view)
        brightest, noise = _brightest_and_noise(contrast, view, self._sampled)
        least, noisy, noisy_ridge = max(self.SHARE * brightest, self.contrast), 0.0, 0.0
        if not self.contrast:
            noisy, noisy_ridge = (max(sigmas * noise, ROUNDED) for sigmas in (self._sigmas, self._ridge_sigmas))
        level = max(least, noisy)
        bright = cv2.threshold(contrast, level, 255, cv2.THRESH_BINARY)[1]
        across = cv2.bitwise_and(cv2.threshold(ridges, STANDS_OUT * level, 255, cv2.THRESH_BINARY)[1], bright)
        lines = narrow_lines(np.flatnonzero(across > 0), view, level, self.run, self.mask)
        paint = lines_along(view, self._rays, max(least, noisy_ridge), self.run, self.mask, lines)
        bright = cv2.bitwise_or(cv2.bitwise_and(bright, self.mask), lines)
        return MarkingViews(bright=np.asarray(bright, dtype=np.uint8), lines=lines, paint=paint, least=least)

    def _ridges(self, view: Image) -> Image:
        """How far each pixel is above both its sides, or below both for dark markings; else 0."""
        reach = self.run.reach
        light = ridge_image(view, 1, 1, reach) if self.run.light else np.zeros_like(view)
        if not self.run.dark:
            return light
        dark = ridge_image(np.asarray(cv2.bitwise_not(view), dtype=np.uint8), 1, 1, reach)
        return np.asarray(cv2.max(light, dark), dtype=np.uint8)

    def _contrast(self, view: Image, around: Image) -> Image:
        """How far each pixel is above its surroundings, or below them for dark markings; else 0."""
        if self._markings == "both":
            return np.asarray(cv2.absdiff(view, around), dtype=np.uint8)
        light = self._markings == "light"
        return np.asarray(cv2.subtract(view, around) if light else cv2.subtract(around, view), dtype=np.uint8)


@compiled
def _brightest_and_noise(contrast: Image, view: Image, rays: Rays) -> tuple[float, float]:
    """From which contrast (h, w) on the brightest 1 % of a view's pixels (h, w) are, and the noise of one.

    That is its standard deviation by the median of second differences along the rays.
    """
    contrasts, pixels = contrast.reshape(-1), view.reshape(-1)
    counts, differences = np.zeros(256, np.int64), np.zeros(4 * 256, np.int64)
    for k in range(len(rays.at)):
        counts[contrasts[rays.at[k]]] += 1
        beside = np.int64(pixels[rays.ahead[k]]) + np.int64(pixels[rays.behind[k]])
        differences[abs(2 * np.int64(pixels[rays.at[k]]) - beside)] += 1
    brightest = float(np.searchsorted(np.cumsum(counts) / max(counts.sum(), 1), 0.99))
    return brightest, median(differences) / (QUARTILE * math.sqrt(6.0))


@compiled
def lines_along(view: Image, rays: Rays, least: float, run: Run, visible: Image, lines: Image) -> Image:
    """Runs of pixels of a view (h, w) that are above those ahead and behind by `least`: 0 or 255; added to its `lines`.

    They are runs along the rows, as long as a line is wide. One that touches a line of its row is the same paint, which
    tells the place better: the far side of what crosses the rays is blurred more than the near one.
    """
    pixels, shown, known, width = view.reshape(-1), visible.reshape(-1), lines.reshape(-1), view.shape[1]
    found, step, first, end = np.zeros_like(view), np.int64(least) + 1, 0, 0
    out = found.reshape(-1)
    for k in range(len(rays.at) + 1):
        at, is_ridge = 0, False
        if k < len(rays.at):
            at = np.int64(rays.at[k])
            here, one, other = np.int64(pixels[at]), np.int64(pixels[rays.ahead[k]]), np.int64(pixels[rays.behind[k]])
            is_ridge = (run.light and here - max(one, other) >= step) or (run.dark and min(one, other) - here >= step)
        if is_ridge and at == end and at % width != 0:
            end += 1
            continue
        if run.narrow <= end - first < run.wide:
            start, stop = first - first % width, first - first % width + width  # of its row
            alone = True
            for j in range(first, end):
                alone = alone and known[j] == 0
            if alone:
                known[first:end] = shown[first:end]
            else:
                while first > start and known[first - 1] != 0:
                    first -= 1
                while end < stop and known[end] != 0:
                    end += 1
            for j in range(first, end):
                out[j] = min(known[j], shown[j])
        first, end = at, at + int(is_ridge)
    return found


@compiled
def is_ground(
    view: Image, at: tuple[int, int, int], skew: float, half: int, least: float, run: Run, visible: Image
) -> bool:
    """Whether the ground to one side of a run of pixels, `at` (row, first, end), is as bright, but for `least`.

    What lies between two dark seams is above its sides, as paint is, but not above the ground beyond them. `half` rows
    to both sides are averaged, `skew` columns aside for each.
    """
    row, first, end = at
    rows, columns = view.shape
    middle = (first + end - 1) // 2
    for edge, side in ((first, -1), (end - 1, 1)):
        alike = 0
        for beyond in run.beyond:
            aside, apart, count = edge + side * beyond - middle, 0, 0
            for r in range(max(row - half, 0), min(row + half + 1, rows)):
                here = middle + round(skew * (r - row))
                there = here + aside
                if min(here, there) >= 0 and max(here, there) < columns and visible[r, there] != 0:
                    apart, count = apart + np.int64(view[r, here]) - np.int64(view[r, there]), count + 1
            alike += count > half and abs(apart) <= least * count
        if alike >= AS_BRIGHT:
            return True
    return False


@compiled
def is_usual(view: Image, row: int, column: int, level: float, visible: Image) -> bool:
    """Whether a pixel is as bright as the ground of its row is by the median, but for `level`: a white wall is not."""
    seen = view[row, ::SPARSE][visible[row, ::SPARSE] != 0]
    return len(seen) == 0 or abs(np.median(seen) - view[row, column]) <= level


@compiled
def narrow_lines(ridges: Ints, view: Image, level: float, run: Run, visible: Image) -> Image:
    """Runs of pixels along the rows of a view (h, w) that are as long as a line is wide: 0 or 255, where `visible`.

    The pixels are `ridges` (n,), indices of the flat view, in their order, found by a threshold `level` [grey levels];
    a run as bright as the ground beyond its sides is none. Masked only at the end: an area cut by the image's edge is
    replicated beyond it and counts as wide, not as narrow.
    """
    width, lines, k = visible.shape[1], np.zeros_like(visible), 0
    while k < len(ridges):
        first = end = ridges[k]
        row, start = first // width, first - first % width  # and where the row starts
        while k < len(ridges) and ridges[k] == end and end < start + width:
            k, end = k + 1, end + 1
        if run.narrow <= end - first < run.wide:
            at, middle = (row, first - start, end - start), (first + end - 1) // 2 - start
            ground = is_ground(view, at, 0.0, 0, STANDS_OUT * level, run, visible)
            if ground and is_usual(view, row, middle, level, visible):
                continue
            lines[row, first - start : end - start] = visible[row, first - start : end - start]
    return lines
