"""A lane without prediction on a road with large radii, from worn dashes and dots: line integrals over many rows.

A dot is one or two rows high, and other things on a road are as bright as most dots, so no single row is evidence. Rows
are therefore sampled at equal lateral distances on the ground (`RowGroundLookup`), the ridge filter's response is
summed along every line of a table, and the two lines with the largest sums about a lane width apart are chosen
(`LineIntegralSearch`). Then both are fitted by robust least squares to the ridges on short runs of twice as many rows
(`LanePairLsq`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from automodel.geometry import GroundCamera
from automodel.perception.rows.brightness import Brightness
from automodel.perception.rows.row_ground_lookup import RowGroundLookup
from automodel.perception.rows.row_ridges import LEVEL, MARGIN, PER_MARKING, WIDEST, RowRidgeFilter
from automodel.types import Float32Array, FloatArray, Floats, Image, Ints


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneSearchConfig:
    """The searched lanes; lengths in lane widths.

    `taper` [1 / lane width]: apparent change of the lane's width with distance when the car pitches, one sigma.
    `narrowest`: the least width; the largest is its inverse. `sigma`: of the prior's relative width, and of its offset;
    twice as large it loses a line of the lane in two of ten labelled highway images (`bench tusimple`).
    """

    lane_width_m: float
    marking_m: float
    reference_x_m: float
    radius_lanes: float  # of the tightest bend
    taper: float
    narrowest: float = 0.7
    sigma: float = 0.1


class FittedLane(NamedTuple):
    """An arc of a lane at the reference point's foot, with covariance (4, 4).

    `mean` (4,): offset [m], the lane's heading [rad], curvature [1/m] and width [m]; this as it is seen a lane width
    beyond where the image starts, where a camera that pitches makes it another than beside the car: parallel lines that
    are put there lie on what is seen.
    """

    mean: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class RoughPair:
    """A lane: its middle where the image starts [m to the left], heading [rad], curvature [1/m] and width [m]."""

    middle_m: float
    heading_rad: float
    curvature_per_m: float
    width_m: float


class LineIntegralSearch:
    """Searches a lane in single images of one camera, on roads with radii of `radius_lanes` and more."""

    ROWS = 40
    AHEAD, LATERAL = 9.0, 1.1  # lane widths of ground: depth, and reach to each side
    HEADING_RAD, CURVATURES, WIDTHS = 0.12, 7, 41  # the largest heading; values of the table
    CURVATURE = 0.6  # one sigma of the prior, of the tightest bend's
    NOISE_LEVEL, MAX_EXCESS, MIN_EXCESS = 2.0, 10.0, -0.3  # noises: subtracted from a sample, then its limits
    STRONG, BEYOND = 8.0, 0.25  # sigmas above which a sum counts less, and how much of the rest counts
    FOUND = 3.5  # minimum score of a pair

    def __init__(self, camera: GroundCamera, config: LaneSearchConfig) -> None:
        unit = config.lane_width_m
        self._unit = unit
        self._near = max(camera.first_visible_x_m(), config.reference_x_m)
        far = self._near + self.AHEAD * unit
        self._step = config.marking_m / PER_MARKING
        self._lookup = RowGroundLookup(camera, (self._near, far), self.ROWS)
        half = math.ceil(self.LATERAL * unit / self._step)
        self._y = np.arange(-half, half) * self._step
        self._pixels, self._inside = self._lookup.pixels(
            np.broadcast_to(self._y, (len(self._lookup.rows), len(self._y)))
        )
        self._filter = RowRidgeFilter(len(self._pixels), len(self._y))
        self._fit = LanePairLsq(camera, config, (self._near, far), 2 * self.ROWS - 1)
        tightest = 1.0 / (config.radius_lanes * unit)
        # Lines with neighbouring headings part by two markings at the far end.
        half = math.floor(self.HEADING_RAD * (far - self._near) / (2.0 * config.marking_m))
        headings = np.linspace(-self.HEADING_RAD, self.HEADING_RAD, 2 * half + 1)
        self._widths = np.geomspace(config.narrowest, 1.0 / config.narrowest, self.WIDTHS)
        kappa, theta = np.meshgrid(np.linspace(-tightest, tightest, self.CURVATURES), headings, indexing="ij")
        self._kappa, self._theta = kappa.ravel(), theta.ravel()
        dx = self._lookup.ahead_m - self._near
        shift = np.rint((self._theta[:, None] * dx + 0.5 * self._kappa[:, None] * dx * dx) / self._step)
        self._pad = int(np.abs(shift).max()) + 1
        self._shifts: Ints = shift.astype(np.intp) + self._pad
        rows = self._sums(self._inside.astype(np.float32))
        self._weight: Float32Array = np.float32(1.0) / np.sqrt(np.maximum(rows, np.float32(1.0)))
        prior = (2.0 * self._theta / self.HEADING_RAD) ** 2 + (self._kappa / tightest / self.CURVATURE) ** 2
        self._sigma = config.sigma
        self._prior_loss: Float32Array = (0.5 * prior).astype(np.float32)[:, None]

    def step(self, image: Image, brightness: Brightness) -> FittedLane | None:
        """The lane with the largest line integrals; None where none is large enough."""
        evidence, noise = self._evidence(image, brightness)
        rough = self._pair(self._sums(evidence) * self._weight)
        if rough is None:
            return None
        return self._fit.step(image, brightness, rough, np.interp(self._fit.rows, self._lookup.rows, noise))

    def _evidence(self, image: Image, brightness: Brightness) -> tuple[Float32Array, Float32Array]:
        """The filter's response (r, n) above the noise, in noises of the row, limited; and the noises (r,)."""
        values = brightness.read(image, self._pixels)
        samples = values.shape[1]
        height = self._filter.heights(values, MARGIN, samples - MARGIN)
        inside = self._inside[:, : -2 * MARGIN] & self._inside[:, 2 * MARGIN :]
        median = [np.median(np.abs(h[known])) if known.any() else 0.0 for h, known in zip(height, inside, strict=True)]
        noise = np.array(median, np.float32) + np.float32(LEVEL)
        excess = height.astype(np.float32) / noise[:, None] - np.float32(self.NOISE_LEVEL)
        evidence = np.zeros(values.shape, np.float32)
        evidence[:, MARGIN:-MARGIN] = np.where(inside, np.clip(excess, self.MIN_EXCESS, self.MAX_EXCESS), 0.0)
        evidence[:, 1:-1] = np.maximum(np.maximum(evidence[:, :-2], evidence[:, 2:]), evidence[:, 1:-1])
        return evidence, noise

    def _sums(self, values: Float32Array) -> Float32Array:
        """Sums (k, n) of `values` (r, n) along the k curves of the table, by their lateral place in the first row."""
        count = values.shape[1]
        padded = np.pad(values, ((0, 0), (self._pad, self._pad)))
        sums = np.zeros((len(self._shifts), count), np.float32)
        for row, shift in zip(padded, self._shifts.T, strict=True):
            sums += sliding_window_view(row, count)[shift]
        return sums

    def _pair(self, sums: Float32Array) -> RoughPair | None:
        """The two lines about a lane width apart with the largest sums."""
        sample = sums[::3, ::3]
        middle = float(np.median(sample))
        spread = 1.4826 * float(np.median(np.abs(sample - middle)))
        sigmas = (sums - middle) * np.float32(1.0 / max(spread, 1e-6))
        sigmas = np.minimum(sigmas, self.STRONG + self.BEYOND * (sigmas - self.STRONG))
        best: tuple[float, RoughPair | None] = -math.inf, None
        unit, y = self._unit, self._y
        for width in self._widths:
            apart = round(width * unit / self._step)
            right, left = sigmas[:, :-apart], sigmas[:, apart:]
            offset = (y[:-apart] + 0.5 * width * unit) / unit
            loss = 0.5 * (offset / self._sigma) ** 2 + 0.5 * (math.log(width) / self._sigma) ** 2
            total = 0.5 * (np.minimum(left, right) + left + right) - loss.astype(np.float32) - self._prior_loss
            total[:, np.abs(offset) > 0.5] = -math.inf
            curve, at = np.unravel_index(int(total.argmax()), total.shape)
            if total[curve, at] > max(best[0], self.FOUND):
                middle = float(y[at]) + 0.5 * width * unit
                pair = RoughPair(middle, float(self._theta[curve]), float(self._kappa[curve]), float(width * unit))
                best = float(total[curve, at]), pair
        return best[1]


class LanePairLsq:
    """Fits a lane by iteratively reweighted least squares, with a prior, in images of one camera."""

    REACH = math.ceil(WIDEST)  # samples to each side of a line in which its ridge is searched
    GATES = REACH / PER_MARKING / 2 ** np.arange(3)  # markings: a ridge's largest distance from the line, in turns
    MIN_HEIGHT, FULL_HEIGHT = 3.0, 12.0  # noises: a ridge's height at weight 0, and at full weight
    _SAMPLES = 2 * (REACH + MARGIN) + 1

    def __init__(
        self,
        camera: GroundCamera,
        config: LaneSearchConfig,
        between_m: tuple[float, float],
        rows: int,
    ) -> None:
        self._near, self._unit, self._marking = between_m[0], config.lane_width_m, config.marking_m
        self._reference_x_m = config.reference_x_m
        self._step = config.marking_m / PER_MARKING
        self._lookup = RowGroundLookup(camera, between_m, rows)
        self.rows = self._lookup.rows
        count = 2 * len(self._lookup.rows)
        self._filter = RowRidgeFilter(count, self._SAMPLES)
        dx = np.tile(self._lookup.ahead_m - self._near, 2)
        self._side = np.repeat((0.5, -0.5), len(self._lookup.rows))
        self._design = np.column_stack((np.ones_like(dx), dx, 0.5 * dx * dx, self._side, self._side * dx))
        at = np.stack((self._lookup.ahead_m, np.zeros(len(self._lookup.rows))), axis=-1)
        beside = np.linalg.norm(camera.ground_to_px(at + np.array((0.0, 0.1))) - camera.ground_to_px(at), axis=1)
        # A ridge is measured to a sample, and samples to the pixel whose middle is nearest.
        self._sigma = np.tile(np.hypot(self._step, math.sqrt(1.0 / 12.0) * 0.1 / beside), 2)
        unit, kappa = self._unit, 1.0 / (config.radius_lanes * self._unit)
        sigmas = np.array((unit, 0.2, 0.5 * kappa, 0.3 * unit, 2.0 * config.taper))
        self._prior = np.diag(sigmas**-2.0)

    def step(self, image: Image, brightness: Brightness, rough: RoughPair, noise: Floats) -> FittedLane | None:
        """The lane near `rough`; None where too few rows show it, or one of its lines alone.

        `noise` (r,): the ridge filter's usual response to the road on each of `rows` [sums of `WINDOW` grey levels].
        """
        start = np.array((rough.middle_m, rough.heading_rad, rough.curvature_per_m, rough.width_m, 0.0))
        line = self._design @ start
        place, strength = self._ridges(image, brightness, line, np.tile(noise, 2))
        y = line + place * self._step
        prior = self._prior @ np.array((rough.middle_m, 0.0, 0.0, self._unit, 0.0))
        x, weight, covariance = start, strength, self._prior
        for gate in self.GATES:
            error = (y - self._design @ x) / (gate * self._marking)
            weight = strength * np.maximum(1.0 - error * error, 0.0) ** 2  # Tukey's biweight
            weighted = (self._design * (weight / self._sigma**2)[:, None]).T
            covariance = np.linalg.solve(weighted @ self._design + self._prior, np.eye(len(start)))
            x = covariance @ (weighted @ y + prior)
        seen = weight > 0.1
        rows = [int(np.count_nonzero(seen & (self._side == side))) for side in (0.5, -0.5)]
        if sum(rows) <= len(x) or min(rows) == 0:
            return None
        dx = self._reference_x_m - self._near  # from where the image starts
        there = np.array(  # the width: see `FittedLane`
            ((-1.0, -dx, -0.5 * dx * dx, 0, 0), (0, 1.0, dx, 0, 0), (0, 0, 1.0, 0, 0), (0, 0, 0, 1.0, self._unit))
        )
        return FittedLane(there @ x, there @ covariance @ there.T)

    def _ridges(self, image: Image, brightness: Brightness, line: Floats, noise: Floats) -> tuple[Floats, Floats]:
        """The best ridge of each run about `line` (2 r,): place [samples to the left] and weight 0 .. 1."""
        rows = len(self._lookup.rows)
        samples = np.arange(self._SAMPLES) - (self.REACH + MARGIN)
        places = line.reshape(2, rows, 1) + samples * self._step
        pixels, inside = (np.concatenate(part) for part in zip(*map(self._lookup.pixels, places), strict=True))
        values = brightness.read(image, pixels)
        heights = self._filter.heights(values, MARGIN, self._SAMPLES - MARGIN)
        best = heights.argmax(axis=1)
        ridges = self._filter.measure(values, np.arange(len(values)), best + MARGIN, noise.astype(np.float32))
        height = heights[np.arange(len(heights)), best] / noise
        strength = np.clip((height - self.MIN_HEIGHT) / (self.FULL_HEIGHT - self.MIN_HEIGHT), 0.0, 1.0)
        return best - self.REACH + ridges.place, strength * inside.all(axis=1)
