"""A lane on a road that hardly bends, from worn dashes and dots: rows summed along all lines that could be there.

A dot is one or two rows high, and what else is on a road stands out as much as most of them: no row alone tells.
So rows are laid out by their ground's distance to the left, what stands out of its surroundings is summed along every
line of a table, and the two lines count that stand out most together and are a lane apart. Then both are fitted to
the ridges on short runs of these rows and of as many in between.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from automodel.geometry import GroundCamera
from automodel.perception.laid_out_rows import LaidOutRows
from automodel.perception.lane_guess import LaneGuess, StartConfig
from automodel.perception.line_pair_fit import PairFit, RoughPair
from automodel.perception.ridges import MARGIN, PER_MARKING, WINDOW, Brightness, RidgeJudge
from automodel.types import Float32Array, Image, Ints


class RowSums:
    """Looks for a lane on some rows of single pictures of one camera, on roads of `radius_lanes` and more."""

    ROWS = 40  # that are read, across `ASIDE` lane widths to each side
    AHEAD, ASIDE = 9.0, 1.1  # lane widths of ground
    HEADINGS_RAD = np.linspace(-0.12, 0.12, 33)
    CURVATURES = np.linspace(-1.0, 1.0, 7)  # of the tightest bend's
    WIDTHS = np.geomspace(0.7, 1.0 / 0.7, 41)  # lane widths
    NOISES, MOST, LEAST = (
        2.0,
        10.0,
        -0.3,
    )  # of a sample: what noise takes away, and its largest and smallest part in a sum
    STRONG, BEYOND = 8.0, 0.25  # sigmas of a sum from which on more counts for less
    # What is usual, one sigma: width and offset (lane widths), heading [rad], curvature (of the tightest bend's).
    WIDTH, OFFSET, HEADING_RAD, CURVATURE = 0.1, 0.25, 0.05, 0.75
    FEWEST = 8.0  # rows: a sum of fewer counts as one of so many
    FOUND = 3.5  # that a pair must reach
    LEAST_SPREAD = 0.4  # of sums over a road without anything on it

    def __init__(self, camera: GroundCamera, config: StartConfig, brightness: Brightness) -> None:
        unit = config.lane_width_m
        self._unit, self._brightness = unit, brightness
        self._near = max(camera.first_visible_x_m(), config.reference_x_m)
        self._reference_x_m = config.reference_x_m
        far = self._near + self.AHEAD * unit
        self._step = config.marking_m / PER_MARKING
        self._laid = LaidOutRows(camera, (self._near, far), self.ROWS)
        half = math.ceil(self.ASIDE * unit / self._step)
        self._y = np.arange(-half, half) * self._step
        self._pixels, self._inside = self._laid.pixels(np.broadcast_to(self._y, (len(self._laid.rows), len(self._y))))
        self._judge = RidgeJudge(len(self._pixels), len(self._y), config.contrast)
        self._least_noise = 0.06 * config.contrast * WINDOW
        self._fit = PairFit(camera, config, brightness, (self._near, far), 2 * self.ROWS - 1)
        bend = 1.0 / (config.radius_lanes * unit)
        kappa, theta = np.meshgrid(self.CURVATURES * bend, self.HEADINGS_RAD, indexing="ij")
        self._kappa, self._theta = kappa.ravel(), theta.ravel()
        dx = self._laid.ahead_m - self._near
        shift = np.rint((self._theta[:, None] * dx + 0.5 * self._kappa[:, None] * dx * dx) / self._step)
        self._pad = int(np.abs(shift).max()) + 1
        self._shifts: Ints = shift.astype(np.intp) + self._pad
        counted = self._sums(self._inside.astype(np.float32))
        self._weight: Float32Array = np.float32(1.0) / np.sqrt(np.maximum(counted, np.float32(self.FEWEST)))
        usual = (self._theta / self.HEADING_RAD) ** 2 + (self._kappa / bend / self.CURVATURE) ** 2
        self._unusual: Float32Array = (0.5 * usual).astype(np.float32)[:, None]

    def step(self, image: Image) -> LaneGuess | None:
        """The lane whose lines stand out most; None where none does."""
        evidence, noise = self._evidence(image)
        rough = self._pair(self._sums(evidence) * self._weight)
        if rough is None:
            return None
        of_row = np.interp(self._fit.rows, self._laid.rows, noise)
        fitted = self._fit.step(image, rough, of_row)
        if fitted is None:
            return None
        x = self._reference_x_m
        return LaneGuess(
            offset_m=-fitted.middle_m(x),
            heading_rad=fitted.heading_rad(x),
            width_m=fitted.width_m,
            curvature_per_m=fitted.curvature_per_m,
            sure_m=self._near - x + self._unit,
            pair=fitted.both,
            edge=fitted.edge,
            fitted=fitted.both,
        )

    def _evidence(self, image: Image) -> tuple[Float32Array, Float32Array]:
        """How much samples (r, n) stand out, in noises of their row, less what noise does; and the noises (r,)."""
        values = self._brightness.read(image, self._pixels)
        samples = values.shape[1]
        height = self._judge.heights(values, MARGIN, samples - MARGIN)
        inside = self._inside[:, : -2 * MARGIN] & self._inside[:, 2 * MARGIN :]
        usual = [np.median(np.abs(h[known])) if known.any() else 0.0 for h, known in zip(height, inside, strict=True)]
        noise = np.array(usual, np.float32) + np.float32(self._least_noise)
        excess = height.astype(np.float32) / noise[:, None] - np.float32(self.NOISES)
        evidence = np.zeros(values.shape, np.float32)
        evidence[:, MARGIN:-MARGIN] = np.where(inside, np.clip(excess, self.LEAST, self.MOST), 0.0)
        evidence[:, 1:-1] = np.maximum(np.maximum(evidence[:, :-2], evidence[:, 2:]), evidence[:, 1:-1])
        return evidence, noise

    def _sums(self, values: Float32Array) -> Float32Array:
        """Sums (k, n) of `values` (r, n) along the k curves of the table, by where they begin."""
        count = values.shape[1]
        padded = np.pad(values, ((0, 0), (self._pad, self._pad)))
        sums = np.zeros((len(self._shifts), count), np.float32)
        for row, shift in zip(padded, self._shifts.T, strict=True):
            sums += sliding_window_view(row, count)[shift]
        return sums

    def _pair(self, sums: Float32Array) -> RoughPair | None:
        """The two lines that together stand out most, a lane apart."""
        sample = sums[::3, ::3]
        middle = float(np.median(sample))
        spread = 1.4826 * float(np.median(np.abs(sample - middle)))
        sigmas = (sums - middle) * np.float32(1.0 / max(spread, self.LEAST_SPREAD))
        sigmas = np.minimum(sigmas, self.STRONG + self.BEYOND * (sigmas - self.STRONG))
        best: tuple[float, RoughPair | None] = -math.inf, None
        unit, y = self._unit, self._y
        for width in self.WIDTHS:
            apart = round(width * unit / self._step)
            right, left = sigmas[:, :-apart], sigmas[:, apart:]
            offset = (y[:-apart] + 0.5 * width * unit) / unit
            loss = 0.5 * (offset / self.OFFSET) ** 2 + 0.5 * (math.log(width) / self.WIDTH) ** 2
            total = 0.5 * (np.minimum(left, right) + left + right) - loss.astype(np.float32) - self._unusual
            total[:, np.abs(offset) > 0.5] = -math.inf
            curve, at = np.unravel_index(int(total.argmax()), total.shape)
            if total[curve, at] > max(best[0], self.FOUND):
                middle = float(y[at]) + 0.5 * width * unit
                pair = RoughPair(middle, float(self._theta[curve]), float(self._kappa[curve]), float(width * unit))
                best = float(total[curve, at]), pair
        return best[1]
