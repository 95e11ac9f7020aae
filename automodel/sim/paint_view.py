"""Which share of each pixel markings cover, as a moving camera sees them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from automodel.geometry import SE2
from automodel.sim.coverage import PolygonSet, covered
from automodel.sim.ground_projection import GroundProjection
from automodel.types import FloatArray

Float32Array = NDArray[np.float32]

COLOURS = ("white", "yellow", "red", "asphalt")  # asphalt: bare ground, on which nothing is painted
FAR_ROWS = 1.0  # markings are drawn as far as this many rows below the horizon
STEP_PX = 2.0  # motion blur is an average over poses so far apart
MOST_STEPS = 4


class Painted(Protocol):
    """A painted polygon (n, 2) [m] of the world frame; `colour` is one of COLOURS."""

    @property
    def polygon_m(self) -> FloatArray:
        """Outline."""
        ...

    @property
    def colour(self) -> str:
        """Colour."""
        ...


class PaintView:
    """Markings, seen through a `GroundProjection`; raises ValueError for a colour that is not known."""

    def __init__(self, projection: GroundProjection, paint: Sequence[Painted]) -> None:
        for p in paint:
            if p.colour not in COLOURS:
                raise ValueError(f"colour: {p.colour!r} is none of {', '.join(COLOURS)}")
        self._projection = projection
        self._polygons = {
            colour: PolygonSet([p.polygon_m for p in paint if p.colour == colour])
            for colour in COLOURS
            if any(p.colour == colour for p in paint)
        }
        camera, height = projection.camera, float(projection.camera.centre_m[2])
        self._eye_m = camera.centre_m[:2]
        self._lift_px_m = float(camera.camera.matrix[1, 1]) * height  # rows that a metre takes, times distance squared
        self._far_m = self._lift_px_m / FAR_ROWS
        ground = projection.ground_m[projection.seen] - self._eye_m
        distance = np.linalg.norm(ground, axis=1)
        self._nearest_m = max(float(distance.min()), 1e-3) if len(ground) else math.inf
        azimuth = np.arctan2(ground[:, 1], ground[:, 0]) if len(ground) else np.zeros(1)
        self._wedge = float(azimuth.min()) - 0.02, float(azimuth.max()) + 0.02

    def shares(self, pose: SE2, way_m: float = 0.0) -> dict[str, Float32Array]:
        """The covered share (h, w) by colour where any is in view, rows from the projection's `row0` on.

        `pose` is world from body, `way_m` how far the car goes ahead during the exposure, which blurs.
        """
        body_from_world = pose.inverse()
        seen = {}
        for colour, polygons in self._polygons.items():
            picked, distance_m = self._picked(polygons, body_from_world)
            if picked.any():
                seen[colour] = self._blurred(polygons, body_from_world, (picked, distance_m), way_m)
        return seen

    def _blurred(
        self,
        polygons: PolygonSet,
        body_from_world: SE2,
        picked: tuple[NDArray[np.bool_], FloatArray],
        way_m: float,
    ) -> Float32Array:
        """Near polygons averaged over several poses; far ones, which hardly move, drawn once."""
        shift_px_m2 = self._lift_px_m * abs(way_m)
        steps = min(max(math.ceil(shift_px_m2 / self._nearest_m**2 / STEP_PX), 1), MOST_STEPS)
        near = picked[1] <= math.sqrt(shift_px_m2 / 0.7)
        begins, ends, weights = [], [], []
        for chosen, count in ((picked[0] & ~near, 1), (picked[0] & near, steps)):
            if not chosen.any():
                continue
            begin, end = polygons.edges(chosen, body_from_world)
            ahead_m = np.repeat(way_m * ((np.arange(count) + 0.5) / count - 0.5), len(begin))
            many = np.tile(begin, (count, 1)), np.tile(end, (count, 1))
            begin, end = self._projection.edges_px(many, ahead_m)
            begins.append(begin)
            ends.append(end)
            weights.append(np.full(len(begin), 1.0 / count))
        edges_px = np.concatenate(begins), np.concatenate(ends)
        return covered(edges_px, np.concatenate(weights), self._projection.shape)

    def _picked(self, polygons: PolygonSet, body_from_world: SE2) -> tuple[NDArray[np.bool_], FloatArray]:
        """Which polygons the camera may see, and their distances [m] from it."""
        middles, radii = polygons.circles(body_from_world)
        middles = middles - self._eye_m
        distance = np.linalg.norm(middles, axis=1) - radii
        picked = distance < self._far_m
        low, high = self._wedge
        if high - low < 3.0:  # a wider view is no wedge
            picked &= middles[:, 1] * math.cos(low) - middles[:, 0] * math.sin(low) > -radii
            picked &= middles[:, 0] * math.sin(high) - middles[:, 1] * math.cos(high) > -radii
        return picked, distance
