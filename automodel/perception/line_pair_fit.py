"""Two lines of a lane fitted to the ridges around them, on short runs of many rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from automodel.geometry import GroundCamera
from automodel.perception.laid_out_rows import LaidOutRows
from automodel.perception.lane_guess import StartConfig
from automodel.perception.ridges import MARGIN, PER_MARKING, Brightness, RidgeJudge
from automodel.types import Floats, Image


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


class PairFit:
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
        config: StartConfig,
        brightness: Brightness,
        between_m: tuple[float, float],
        rows: int,
    ) -> None:
        self._near, self._unit, self._marking = between_m[0], config.lane_width_m, config.marking_m
        self._brightness, self._step = brightness, config.marking_m / PER_MARKING
        self._laid = LaidOutRows(camera, between_m, rows)
        self.rows = self._laid.rows
        count = 2 * len(self._laid.rows)
        self._judge = RidgeJudge(count, self._SAMPLES, config.contrast)
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
