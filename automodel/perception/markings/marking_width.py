"""The width of the markings, measured: ridges of any width on rows of ground near the car, and their histogram.

The configured width is where the estimate starts. A wrong one costs lines, since every filter looks for one width.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from automodel.config import LaneConfig
from automodel.geometry import GroundCamera
from automodel.perception.markings.ridge import FAINT, ridge_sums
from automodel.perception.markings.ridge_noise import FALSE_SAMPLES, least_ridge, rounding_noise
from automodel.perception.rows.brightness import Brightness
from automodel.perception.rows.row_ground_lookup import RowGroundLookup
from automodel.types import Bools, Float32Array, FloatArray, Floats, Image, Ints

PER_MARKING = 8  # samples
SCALES = (PER_MARKING // 2, PER_MARKING, 2 * PER_MARKING)  # of the filters
STREAK_RAD = 0.15  # from the direction to the camera: a ridge's place in two neighbouring rows is wrong by a sample
LOW = 0.7  # scales: the narrowest ridge of a scale; the widest is twice as wide


def ridge_widths(
    values: Float32Array, within: Bools, noises: float, rounding: float
) -> tuple[Ints, Ints, Floats, Floats]:
    """The ridges (n,) on rows of samples (r, k), by row: row, sample, width at half height [samples], height.

    A ridge is the mean of a middle half as long as its scale over the brighter of two such means a scale and a half
    away. Its height exceeds `noises` times the median of the row's, which is at least `rounding`, and it has bare
    ground beside it over 1.5 of its own widths: a zebra's bars have not.
    """
    sums = np.cumsum(np.pad(values.astype(np.float64), ((0, 0), (1, 0))), axis=1)
    found: list[tuple[int, int, float, float]] = []
    for scale in SCALES:
        window, apart = scale // 2, 3 * scale // 2
        margin = apart + window // 2  # of the responses' first sample
        response = (ridge_sums(sums, window, apart) / window).astype(np.float32)
        end = margin + response.shape[1]
        if response.shape[1] == 0 or end + margin > values.shape[1] + 1:
            continue
        known = within[:, : response.shape[1]] & within[:, -response.shape[1] :]
        response[~known] = 0.0
        size = np.sort(np.where(known, np.abs(response), np.float32(np.inf)), axis=1)
        median = size[np.arange(len(size)), known.sum(axis=1) // 2]
        least = noises * np.maximum(median, rounding)[:, None]
        highest = cv2.dilate(response, np.ones((1, 2 * window + 1), np.uint8))
        for r, c in np.argwhere((response > least) & (response >= highest)).tolist():
            width = _width_at(values[r], sums[r], c + margin, window, apart)
            if LOW * scale < width <= 2.0 * LOW * scale:  # where the scales meet: each ridge counts once
                found.append((r, c + margin, width, float(response[r, c])))
    row, at, widths, heights = np.array(sorted(found)).reshape(-1, 4).T
    row = row.astype(np.intp)
    top = np.zeros(len(values))
    np.maximum.at(top, row, heights)
    plain = heights > FAINT * top[row]  # texture is fainter than paint
    return row[plain], at[plain].astype(np.intp), widths[plain], heights[plain]


def continued(
    row: Ints, at: Ints, widths: Floats, heights: Floats, ahead: Floats, foot: tuple[float, float] | None = None
) -> tuple[Floats, Floats]:
    """Those of the ridges (n,) that go on in the next row: widths (m,) across their own direction, and heights (m,).

    `ahead` (r,) [samples] is the distance of the rows' ground, `foot` (ahead, at) [samples] the ground below the
    camera. A ridge goes on where the next row has one of about the same width at less than 45 degrees. One that points
    to the camera may be the streak of a lamp in a shiny floor, and does not count.
    """
    following = row == row[:, None] + 1
    ratio = widths / widths[:, None]
    following &= (ratio > 0.75) & (ratio < 1.0 / 0.75)
    depth = ahead[row] - ahead[row][:, None]
    slopes = (at - at[:, None]) / np.where(following, depth, 1.0)
    if foot is not None:
        away = np.arctan(slopes) - np.arctan2(at - foot[1], ahead[row] - foot[0])[:, None]
        following &= np.abs(away) > STREAK_RAD
    lean = np.where(following, np.abs(slopes), 1.0)
    slope = lean.min(axis=1, initial=1.0)
    goes_on = slope < 1.0
    return widths[goes_on] / np.sqrt(1.0 + slope[goes_on] ** 2), heights[goes_on]


def _width_at(row: Float32Array, sums: Floats, c: int, window: int, apart: int) -> float:
    """The width at half height of the ridge at sample `c`; 0 where it has no bare ground beside it."""
    first = c - window // 2
    top, left, right = (float(sums[at + window] - sums[at]) / window for at in (first, first - apart, first + apart))
    ground = 0.5 * (left + right)
    half = 0.5 * (top + ground)
    edges = []
    for step in (-1, 1):
        beyond = np.flatnonzero(row[c::step] <= half)
        if len(beyond) == 0:
            return 0.0
        at = c + step * int(beyond[0])
        above, below = float(row[at - step]), float(row[at])
        edges.append(at - step + step * ((above - half) / (above - below) if above > half else 0.0))
    width = edges[1] - edges[0]
    near, far = 0.25 * width, 1.75 * width
    for low, high in ((edges[0] - far, edges[0] - near), (edges[1] + near, edges[1] + far)):
        a, b = math.ceil(low), math.floor(high) + 1
        if a < 0 or b > len(row) or (b > a and float(sums[b] - sums[a]) / (b - a) > ground + 0.25 * (top - ground)):
            return 0.0
    return width


class MarkingWidth:
    """The running width of the markings; `step` measures it and says when the filters need another one.

    `width_m` is the width in use, `measured_m` the last estimate and `sigma` its relative standard deviation. It is the
    peak of a histogram of the logarithm of the ridges' widths; the start value counts as `PRIOR` ridges. Every ridge
    counts once: a lamp's reflection is brighter than any paint, and a line is seen on more rows than a lamp.
    """

    ROWS = 16
    LATERAL_LANES = 1.2  # to each side of the car, over a lane width ahead
    EVERY = 32  # frames between two measurements once the width is settled
    BIN = 0.07  # relative width of a bin of the histogram
    MEMORY = 0.98  # share of the histogram that is kept at a measurement: a crossing shows other widths for seconds
    PRIOR = 20.0
    CHANGE = 1.3  # ratio from which on a width is used instead of the last one, and reported
    SETTLED = 0.05  # relative sigma from which on an estimate is used

    def __init__(
        self,
        camera: GroundCamera,
        lane: LaneConfig,
        reference_x_m: float,
        colour: str = "grey",
    ) -> None:
        self._lane_width_m, self._reference_x_m = lane.width_m, reference_x_m
        self._start_m, brightness = lane.marking_width_m, Brightness(colour, lane.markings == "dark")
        self._brightness = (brightness, brightness.negative()) if lane.markings == "both" else (brightness,)
        self._step_m = lane.marking_width_m / PER_MARKING
        self.see_with(camera)
        self._half = math.ceil(math.log(2.0 * LOW * SCALES[-1] / PER_MARKING) / self.BIN)  # bins
        self._bins = 2 * self._half + 1
        self.reset()

    def see_with(self, camera: GroundCamera) -> None:
        """From now on the camera is set so."""
        near = max(camera.first_visible_x_m(), self._reference_x_m)
        lookup = RowGroundLookup(camera, (near, near + self._lane_width_m), self.ROWS)
        half = math.ceil(self.LATERAL_LANES * self._lane_width_m / self._step_m)
        y = np.arange(-half, half) * self._step_m
        self._pixels, self._within = lookup.pixels(np.broadcast_to(y, (len(lookup.rows), len(y))))
        self._ahead = lookup.ahead_m / self._step_m
        self._foot = (float(camera.centre_m[0]) / self._step_m, half + float(camera.centre_m[1]) / self._step_m)
        self._noises = least_ridge(self._pixels.size / FALSE_SAMPLES)
        self._rounding = rounding_noise(SCALES[0] // 2)

    def reset(self) -> None:
        """Start again with the configured width."""
        self.width_m = self.measured_m = self._start_m
        self.sigma = math.inf
        self._counts: FloatArray = np.zeros(self._bins)
        self._wait = self._tries = 0

    def step(self, image: Image) -> bool:
        """Measure in an image of the camera's size; whether `width_m` has changed."""
        self._wait -= 1
        if self._wait > 0:
            return False
        self._tries += 1
        self._wait = 1 + self._tries // 8  # ever more seldom where nothing is found
        self._counts *= self.MEMORY
        for brightness in self._brightness:
            values = brightness.read(image, self._pixels).astype(np.float32)
            ridges = ridge_widths(values, self._within, self._noises, self._rounding)
            widths, _ = continued(*ridges, self._ahead, self._foot)
            self.add(widths)
        if self.sigma > self.SETTLED:
            return False
        self._wait = self.EVERY
        if abs(math.log(self.measured_m / self.width_m)) < math.log(self.CHANGE):
            return False
        self.width_m = self.measured_m
        return True

    def add(self, widths: Floats) -> None:
        """Count ridges of widths (n,) [samples of the configured width / `PER_MARKING`]."""
        place = np.log(np.maximum(widths, 1e-9) / PER_MARKING) / self.BIN + 0.5 * self._bins
        inside = (place >= 0.0) & (place < self._bins)
        if inside.any():
            self._counts += np.bincount(place[inside].astype(np.intp), minlength=self._bins)
        prior = np.exp(-0.5 * ((np.arange(self._bins) - self._half) * self.BIN / math.log(self.CHANGE)) ** 2)
        counts = self._counts + self.PRIOR / prior.sum() * prior
        smooth = np.convolve(counts, (0.5, 1.0, 0.5), "same")
        peak = int(smooth.argmax())
        about = slice(max(peak - 2, 0), peak + 3)
        number = float(counts[about].sum())
        middles = (np.arange(self._bins)[about] - self._half) * self.BIN
        mean = float((counts[about] * middles).sum() / number)
        spread = math.sqrt(float((counts[about] * (middles - mean) ** 2).sum() / number) + self.BIN**2 / 12.0)
        self.measured_m = self._start_m * math.exp(mean)
        self.sigma = spread / math.sqrt(number) * float(counts.sum() / number)

    @property
    def warning(self) -> str:
        """One line where the measured width differs from the configured one, else empty."""
        if self.sigma > self.SETTLED or abs(math.log(self.measured_m / self._start_m)) < math.log(self.CHANGE):
            return ""
        return (
            f"[lane] marking_width_m = {self._start_m:.3g}: the markings are {self.measured_m:.2g} m wide, which is"
            " used; correct car.toml"
        )
