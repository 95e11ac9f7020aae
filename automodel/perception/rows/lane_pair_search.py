"""A lane on a road that hardly bends, from worn dashes and dots: rows summed along all lines that could be there.

A dot is one or two rows high, and what else is on a road stands out as much as most of them: no row alone tells.
So rows are laid out by their ground's distance to the left, what stands out of its surroundings is summed along every
line of a table, and the two lines count that stand out most together and are a lane apart. Then both are fitted to
the ridges on short runs of these rows and of as many in between.

Two lines of a lane fitted to the ridges around them, on short runs of many rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from automodel.estimation.clothoid.clothoid_tracker import ArcLane
from automodel.geometry import GroundCamera
from automodel.perception.rows.row_ridges import MARGIN, PER_MARKING, WINDOW, Brightness, RowRidgeFilter
from automodel.types import Bools, Float32Array, Floats, Image, Ints


@dataclass(frozen=True, slots=True, kw_only=True)
class InitialLane:
    """An arc of a lane at the reference point: offset [m] and the lane's heading [rad] in the body frame.

    It fits best `sure_m` of way ahead of the reference point, where it was seen. `pair` tells whether both lines spoke
    for it; `edge` is how sharp markings are in the picture, as `Ridges` has it. `fitted`: it was fitted to many
    rows' ridges on both lines, and is right to some hundredths of a lane's width.
    """

    offset_m: float
    heading_rad: float
    width_m: float
    curvature_per_m: float
    sure_m: float
    pair: bool
    edge: float
    fitted: bool = False

    def rough(self, fitted_share: float) -> ArcLane:
        """The lane for a tracker to start with; `fitted_share` is what is left of its sigmas where it was fitted."""
        return ArcLane(
            offset_m=self.offset_m,
            heading_rad=self.heading_rad,
            width_m=self.width_m,
            curvature_per_m=self.curvature_per_m,
            sure_m=self.sure_m,
            share=fitted_share if self.fitted else 1.0,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneSearchConfig:
    """What lanes are tried; lengths in lane widths; (largest, how many)."""

    lane_width_m: float
    marking_m: float
    reference_x_m: float
    contrast: float = 12.0
    rows: int = 16
    ahead: float = 2.0  # how far ahead of the nearest ground in sight the rows reach
    headings_rad: tuple[float, int] = (0.7, 19)
    curvatures: tuple[float, int] = (0.73, 13)  # shares of the tightest bend's
    radius_lanes: float = 1.1  # of that bend
    lateral: tuple[float, int] = (1.4, 57)
    widths: tuple[float, float] = (0.7, 1.43)  # the narrowest and the widest: 0.7 and 1 / 0.7
    pair_rows: int = 3  # rows that show each line of a pair, at least
    single_rows: int = 6  # and a single line


class RowGroundLookup:
    """Rows evenly spaced in the picture between two distances ahead, `between_m` in body x.

    `rows` (r,) are their numbers, `ahead_m` (r,) body x of the ground on each, straight in front of the car.
    """

    _PLACES = 65

    def __init__(self, camera: GroundCamera, between_m: tuple[float, float], count: int) -> None:
        self._width = camera.camera.width_px
        x = np.linspace(*between_m, 2000)
        v = camera.ground_to_px(np.column_stack((x, np.zeros_like(x))))[:, 1]
        v = v[np.isfinite(v) & (v >= 0.0) & (v <= camera.camera.height_px - 1.0)]
        if len(v) < 2:
            raise ValueError("pitch_rad: the picture shows no ground where the lane's lines begin")
        rows = np.unique(np.rint(np.linspace(v.max(), v.min(), count)).astype(np.intp))
        u = np.linspace(0.0, self._width - 1.0, self._PLACES)
        self._ground: list[tuple[Floats, Floats, Floats]] = []  # y rising, and x and u there
        shown = []
        for row in rows:
            ground = camera.px_to_ground(np.column_stack((u, np.full_like(u, row))))
            known = np.isfinite(ground[:, 0])
            if known.any():  # else rounded to a row above the horizon, in a picture of a few rows
                self._ground.append((ground[known, 1][::-1], ground[known, 0][::-1], u[known][::-1]))
                shown.append(row)
        if not shown:
            raise ValueError("height_px: the picture has no row that shows where the lane's lines begin")
        self.rows: Ints = np.array(shown, np.intp)
        self.ahead_m: Floats = np.array([np.interp(0.0, y, x) for y, x, _ in self._ground])

    def columns(self, y_m: Floats) -> Floats:
        """Columns (r, n) [px] of distances to the left (r, n) on each row, NaN outside the picture."""
        parts = [
            np.interp(at, y, u, left=np.nan, right=np.nan) for at, (y, _, u) in zip(y_m, self._ground, strict=True)
        ]
        return np.array(parts)

    def pixels(self, y_m: Floats) -> tuple[Ints, Bools]:
        """Pixels (r, n), counted row by row, of distances to the left (r, n), and which of them lie in the picture."""
        columns = self.columns(y_m)
        inside = ~np.isnan(columns)
        column = np.rint(np.where(inside, columns, 0.0)).astype(np.intp)
        return self.rows[:, None] * self._width + column, inside

    def x_m(self, y_m: Floats) -> Floats:
        """Body x (r, n) [m] of the ground at distances to the left (r, n) on each row."""
        return np.array([np.interp(at, y, x) for at, (y, x, _) in zip(y_m, self._ground, strict=True)])


@dataclass(frozen=True, slots=True)
class RoughPair:
    """A lane: its middle where the picture begins [m to the left], heading [rad], curvature [1/m] and width [m]."""

    middle_m: float
    heading_rad: float
    curvature_per_m: float
    width_m: float


@dataclass(frozen=True, slots=True, eq=False)
class FittedPair:
    """The lane's middle y = a + b dx + c dx^2 / 2 at dx = x - `near_m`, its width, and how sharp its paint is.

    `both`: each of the lines was seen.
    """

    near_m: float
    middle: tuple[float, float, float]
    width_m: float
    edge: float
    both: bool

    def middle_m(self, x_m: float) -> float:
        """Distance of the lane's middle to the left of body x `x_m`."""
        a, b, c = self.middle
        dx = x_m - self.near_m
        return a + dx * (b + 0.5 * c * dx)

    def heading_rad(self, x_m: float) -> float:
        """The lane's heading there."""
        return self.middle[1] + self.middle[2] * (x_m - self.near_m)

    @property
    def curvature_per_m(self) -> float:
        """The lane's curvature."""
        return self.middle[2]


class LanePairFit:
    """Fits pairs in pictures of one camera."""

    REACH = 9  # samples to each side of a line in which its ridge is looked for
    GATES = (1.6, 1.0, 0.6, 0.5)  # markings: how far a ridge may lie from the line to count, round by round
    LEAST, MOST = 3.0, 12.0  # noises: what a ridge stands out at least; what counts no more
    SIGMA, SIGMA_PX = 0.15, 0.5  # of a ridge's place: markings and pixels
    TAPER = 0.02  # a lane width ahead: how much the lane seems to narrow or widen when the car nods, one sigma
    HITS, HITS_OF_ONE = 7, 5  # rows that show the lines, at least: both together, and the better one
    _SAMPLES = 2 * (REACH + MARGIN) + 1

    def __init__(
        self,
        camera: GroundCamera,
        config: LaneSearchConfig,
        brightness: Brightness,
        between_m: tuple[float, float],
        rows: int,
    ) -> None:
        self._near, self._unit, self._marking = between_m[0], config.lane_width_m, config.marking_m
        self._brightness, self._step = brightness, config.marking_m / PER_MARKING
        self._laid = RowGroundLookup(camera, between_m, rows)
        self.rows = self._laid.rows
        count = 2 * len(self._laid.rows)
        self._judge = RowRidgeFilter(count, self._SAMPLES, config.contrast)
        dx = np.tile(self._laid.ahead_m - self._near, 2)
        self._side = np.repeat((0.5, -0.5), len(self._laid.rows))
        self._design = np.column_stack((np.ones_like(dx), dx, 0.5 * dx * dx, self._side, self._side * dx))
        at = np.stack((self._laid.ahead_m, np.zeros(len(self._laid.rows))), axis=-1)
        beside = np.linalg.norm(camera.ground_to_px(at + np.array((0.0, 0.1))) - camera.ground_to_px(at), axis=1)
        self._sigma = np.tile(np.hypot(self.SIGMA * self._marking, self.SIGMA_PX * 0.1 / beside), 2)
        unit, bend = self._unit, 1.0 / (config.radius_lanes * self._unit)
        sigmas = np.array((unit, 0.2, 0.5 * bend, 0.3 * unit, 2.0 * self.TAPER))
        self._prior = np.diag(sigmas**-2.0)

    def step(self, image: Image, rough: RoughPair, noise: Floats) -> FittedPair | None:
        """The pair near `rough`; None where too few rows show it.

        `noise` (r,): by how much the road of each of `rows` stands out of itself, in sums of `WINDOW` grey levels.
        """
        start = np.array((rough.middle_m, rough.heading_rad, rough.curvature_per_m, rough.width_m, 0.0))
        line = self._design @ start
        place, edge, strength = self._ridges(image, line, np.tile(noise, 2))
        y = line + place * self._step
        pull = self._prior @ np.array((rough.middle_m, 0.0, 0.0, self._unit, 0.0))
        x, weight = start, strength
        for gate in self.GATES:
            away = (y - self._design @ x) / (gate * self._marking)
            weight = strength * np.maximum(1.0 - away * away, 0.0) ** 2
            weighted = (self._design * (weight / self._sigma**2)[:, None]).T
            x = np.linalg.solve(weighted @ self._design + self._prior, weighted @ y + pull)
        seen = weight > 0.1
        rows = [int(np.count_nonzero(seen & (self._side == side))) for side in (0.5, -0.5)]
        if sum(rows) < self.HITS or max(rows) < self.HITS_OF_ONE:
            return None
        middle = float(x[0]), float(x[1]), float(x[2])
        width = float(x[3] + self._unit * x[4])
        return FittedPair(self._near, middle, width, float(np.median(edge[seen])), min(rows) > 0)

    def _ridges(self, image: Image, line: Floats, noise: Floats) -> tuple[Floats, Floats, Floats]:
        """The best ridge of each run about `line` (2 r,): place [samples to the left], edge, and strength 0..1."""
        rows = len(self._laid.rows)
        samples = np.arange(self._SAMPLES) - (self.REACH + MARGIN)
        places = line.reshape(2, rows, 1) + samples * self._step
        pixels, inside = (np.concatenate(part) for part in zip(*map(self._laid.pixels, places), strict=True))
        values = self._brightness.read(image, pixels)
        heights = self._judge.heights(values, MARGIN, self._SAMPLES - MARGIN)
        best = heights.argmax(axis=1)
        judged = self._judge.judge(values, np.arange(len(values)), best + MARGIN)
        stands_out = heights[np.arange(len(heights)), best] / noise
        strength = np.clip((stands_out - self.LEAST) / (self.MOST - self.LEAST), 0.0, 1.0) * inside.all(axis=1)
        return best - self.REACH + judged.place, judged.edge.astype(np.float64), strength


class LineIntegralSearch:
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

    def __init__(self, camera: GroundCamera, config: LaneSearchConfig, brightness: Brightness) -> None:
        unit = config.lane_width_m
        self._unit, self._brightness = unit, brightness
        self._near = max(camera.first_visible_x_m(), config.reference_x_m)
        self._reference_x_m = config.reference_x_m
        far = self._near + self.AHEAD * unit
        self._step = config.marking_m / PER_MARKING
        self._laid = RowGroundLookup(camera, (self._near, far), self.ROWS)
        half = math.ceil(self.ASIDE * unit / self._step)
        self._y = np.arange(-half, half) * self._step
        self._pixels, self._inside = self._laid.pixels(np.broadcast_to(self._y, (len(self._laid.rows), len(self._y))))
        self._judge = RowRidgeFilter(len(self._pixels), len(self._y), config.contrast)
        self._least_noise = 0.06 * config.contrast * WINDOW
        self._fit = LanePairFit(camera, config, brightness, (self._near, far), 2 * self.ROWS - 1)
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

    def step(self, image: Image) -> InitialLane | None:
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
        return InitialLane(
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
