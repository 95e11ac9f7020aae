"""The width of the markings, measured: ridges of any width on rows of ground near the car, and their histogram.

The configured width is where the estimate starts. A wrong one costs lines, since every filter looks for one width.
"""

from __future__ import annotations

import math

import numpy as np

from automodel.compiled import compiled
from automodel.config import LaneConfig
from automodel.geometry import GroundCamera
from automodel.perception.markings.ridge_noise import FALSE_SAMPLES, least_ridge, rounding_noise
from automodel.perception.rows.row_ground_lookup import RowGroundLookup
from automodel.perception.rows.row_ridges import Brightness
from automodel.types import Bools, Float32Array, FloatArray, Floats, Image, Ints

PER_MARKING = 8  # samples
SCALES = (PER_MARKING // 2, PER_MARKING, 2 * PER_MARKING)  # of the filters
FAINT = 0.5  # of the highest ridge of a row: what is lower does not count
LOW = 0.7  # scales: the narrowest ridge of a scale; the widest is twice as wide


@compiled
def ridge_widths(
    values: Float32Array, within: Bools, noises: float, rounding: float
) -> tuple[Ints, Ints, Floats, Floats]:
    """The ridges (n,) on rows of samples (r, k), by row: row, sample, width at half height [samples], height.

    A ridge is the mean of a middle half as long as its scale over the brighter of two such means a scale and a half
    away. Its height exceeds `noises` times the median of the row's, which is at least `rounding`, and it has bare
    ground beside it over 1.5 of its own widths: a zebra's bars have not.
    """
    rows, samples = values.shape
    row, at = np.empty(rows * samples, np.intp), np.empty(rows * samples, np.intp)
    widths, heights, count = np.empty(rows * samples), np.empty(rows * samples), 0
    noise, response = np.empty(samples), np.empty(samples)
    sums = np.zeros(samples + 1)
    for r in range(rows):
        begin, highest_of_row = count, 0.0
        for c in range(samples):
            sums[c + 1] = sums[c] + values[r, c]
        for scale in SCALES:
            window, apart = scale // 2, 3 * scale // 2
            margin, known = apart + window, 0
            for c in range(margin, samples - margin):
                first = c - window // 2
                middle = sums[first + window] - sums[first]
                left = sums[first + window - apart] - sums[first - apart]
                right = sums[first + window + apart] - sums[first + apart]
                response[c] = (middle - max(left, right)) / window
                if within[r, c - margin] and within[r, c + margin]:
                    noise[known] = abs(response[c])
                    known += 1
                else:
                    response[c] = 0.0
            if known == 0:
                continue
            least = noises * max(float(np.median(noise[:known])), rounding)
            for c in range(margin, samples - margin):
                if response[c] <= least:
                    continue
                highest = True
                for k in range(max(c - window, margin), min(c + window + 1, samples - margin)):
                    highest = highest and (response[k] < response[c] or (response[k] == response[c] and k >= c))
                if not highest:
                    continue
                width = _width_at(values[r], sums, c, window, apart)
                if LOW * scale < width <= 2.0 * LOW * scale:  # where the scales meet: each ridge counts once
                    row[count], at[count], widths[count], heights[count] = r, c, width, response[c]
                    highest_of_row = max(highest_of_row, response[c])
                    count += 1
        every, count = count, begin
        for i in range(begin, every):  # texture is fainter than paint
            if heights[i] > FAINT * highest_of_row:
                row[count], at[count], widths[count], heights[count] = row[i], at[i], widths[i], heights[i]
                count += 1
    return row[:count], at[:count], widths[:count], heights[:count]


@compiled
def continued(row: Ints, at: Ints, widths: Floats, heights: Floats, ahead: Floats) -> tuple[Floats, Floats]:
    """Those of the ridges (n,) that go on in the next row: widths (m,) across their own direction, and heights (m,).

    `ahead` (r,) [samples] is the distance of the rows' ground. A ridge goes on where the next row has one of about the
    same width at less than 45 degrees.
    """
    across, height, count = np.empty(len(row)), np.empty(len(row)), 0
    for i in range(len(row)):
        nearest, slope = 1.0, 0.0
        for j in range(len(row)):
            if row[j] != row[i] + 1 or not 0.75 * widths[i] < widths[j] < widths[i] / 0.75:
                continue
            lean = (at[j] - at[i]) / (ahead[row[j]] - ahead[row[i]])
            if abs(lean) < nearest:
                nearest, slope = abs(lean), lean
        if nearest < 1.0:
            across[count], height[count] = widths[i] / math.sqrt(1.0 + slope * slope), heights[i]
            count += 1
    return across[:count], height[:count]


@compiled
def _width_at(row: Float32Array, sums: Floats, c: int, window: int, apart: int) -> float:
    """The width at half height of the ridge at sample `c`; 0 where it has no bare ground beside it."""
    first = c - window // 2
    top = (sums[first + window] - sums[first]) / window
    left = (sums[first + window - apart] - sums[first - apart]) / window
    right = (sums[first + window + apart] - sums[first + apart]) / window
    ground = 0.5 * (left + right)
    half, edges = 0.5 * (top + ground), np.empty(2)
    for side in range(2):
        step, at = 2 * side - 1, c
        while 0 < at < len(row) - 1 and row[at] > half:
            at += step
        above, below = row[at - step], row[at]
        share = (above - half) / (above - below) if above > half >= below else 0.0
        edges[side] = at - step + share * step
        if at in (0, len(row) - 1):
            return 0.0
    width = edges[1] - edges[0]
    reach = 1.5 * width
    quarter = ground + 0.25 * (top - ground)
    for side in range(2):
        start = edges[side] + (2 * side - 1) * 0.25 * width
        low, high = (start, start + reach) if side == 1 else (start - reach, start)
        a, b = math.ceil(low), math.floor(high) + 1
        if a < 0 or b > len(row) or (b > a and (sums[b] - sums[a]) / (b - a) > quarter):
            return 0.0
    return width


class MarkingWidth:
    """The running width of the markings; `step` measures it and says when the filters need another one.

    `width_m` is the width in use, `measured_m` the last estimate and `sigma` its relative standard deviation. It is the
    peak of a histogram of the logarithm of the ridges' widths, weighted by the squares of their heights; the start
    value counts as `PRIOR` ridges. What compiles is compiled at construction.
    """

    ROWS = 16
    LATERAL_LANES = 1.2  # to each side of the car, over a lane width ahead
    EVERY = 16  # frames between two measurements once the width is settled
    BIN = 0.07  # relative width of a bin of the histogram
    MEMORY = 0.9  # share of the histogram that is kept at a measurement
    PRIOR = 8.0
    CHANGE = 1.3  # ratio from which on a width is used instead of the last one, and reported
    SETTLED = 0.05  # relative sigma from which on an estimate is used

    def __init__(
        self,
        camera: GroundCamera,
        lane: LaneConfig,
        reference_x_m: float,
        colour: str = "grey",
    ) -> None:
        lane_width_m, marking_width_m = lane.width_m, lane.marking_width_m
        self._start_m, brightness = marking_width_m, Brightness(colour, lane.markings == "dark")
        self._brightness = (brightness, brightness.negative()) if lane.markings == "both" else (brightness,)
        self._step_m = marking_width_m / PER_MARKING
        near = max(camera.first_visible_x_m(), reference_x_m)
        lookup = RowGroundLookup(camera, (near, near + lane_width_m), self.ROWS)
        half = math.ceil(self.LATERAL_LANES * lane_width_m / self._step_m)
        y = np.arange(-half, half) * self._step_m
        self._pixels, self._within = lookup.pixels(np.broadcast_to(y, (len(lookup.rows), len(y))))
        self._ahead = lookup.ahead_m / self._step_m
        self._noises = least_ridge(self._pixels.size / FALSE_SAMPLES)
        self._rounding = rounding_noise(SCALES[0] // 2)
        self._half = math.ceil(math.log(2.0 * LOW * SCALES[-1] / PER_MARKING) / self.BIN)  # bins
        self._bins = 2 * self._half + 1
        ridges = ridge_widths(np.zeros(self._pixels.shape, np.float32), self._within, self._noises, self._rounding)
        continued(*ridges, self._ahead)
        self.reset()

    def reset(self) -> None:
        """Start again with the configured width."""
        self.width_m = self.measured_m = self._start_m
        self.sigma = math.inf
        self._counts: FloatArray = np.zeros(self._bins)
        self._wait = 0

    def step(self, image: Image) -> bool:
        """Measure in an image of the camera's size; whether `width_m` has changed."""
        self._wait -= 1
        if self._wait > 0:
            return False
        self._counts *= self.MEMORY
        for brightness in self._brightness:
            values = brightness.read(image, self._pixels).astype(np.float32)
            self.add(*continued(*ridge_widths(values, self._within, self._noises, self._rounding), self._ahead))
        if self.sigma > self.SETTLED:
            return False
        self._wait = self.EVERY
        if abs(math.log(self.measured_m / self.width_m)) < math.log(self.CHANGE):
            return False
        self.width_m = self.measured_m
        return True

    def add(self, widths: Floats, weights: Floats) -> None:
        """Count ridges of widths (n,) [samples of the configured width / `PER_MARKING`] with weights (n,)."""
        place = np.log(np.maximum(widths, 1e-9) / PER_MARKING) / self.BIN + 0.5 * self._bins
        inside = (place >= 0.0) & (place < self._bins)
        if inside.any():
            share = weights[inside] ** 2 / (weights[inside] ** 2).mean()
            self._counts += np.bincount(place[inside].astype(np.intp), share, self._bins)
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
