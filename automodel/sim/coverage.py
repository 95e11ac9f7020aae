"""The share of each pixel that polygons on the ground cover: exact areas, so that far lines fade and do not flicker.

The border of every polygon is projected into the image as directed edges. Each edge adds the area below it to the
pixels that it crosses; the cumulative sum down the columns gives the covered area of every pixel. This is the scan
conversion of anti-aliased fonts (signed area accumulation, as in font-rs by R. Levien), turned by 90 deg.
Which share of each pixel markings cover, as a moving camera sees them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from automodel.compiled import compiled
from automodel.config.toml_reader import one_of
from automodel.geometry import SE2
from automodel.sim.ground_projection import GroundProjection
from automodel.sim.paint import Paint
from automodel.types import Bools, Float32Array, FloatArray

BLOCK_ROWS = 16
FLAT_PX = 1e-6  # level edges are tilted by this much


class PolygonSet:
    """Polygons (n, 2) [m] of the world frame, made anticlockwise, cut into edges that can be picked by distance."""

    def __init__(self, polygons_m: Sequence[FloatArray]) -> None:
        rings = [_anticlockwise(np.asarray(p, dtype=np.float64)) for p in polygons_m]
        counts = np.array([len(ring) for ring in rings], dtype=np.intp)
        self.count = len(rings)
        self._owner = np.repeat(np.arange(self.count), counts)
        self._start = np.concatenate([*rings, np.zeros((0, 2))])
        self._end = np.concatenate([*(np.roll(ring, -1, axis=0) for ring in rings), np.zeros((0, 2))])
        middles = [0.5 * (ring.min(axis=0) + ring.max(axis=0)) for ring in rings]
        self._middle_m = np.array(middles).reshape(-1, 2)
        self._radius_m = np.array(
            [np.linalg.norm(ring - middle, axis=1).max() for ring, middle in zip(rings, middles, strict=True)]
        )

    def circles(self, body_from_world: SE2) -> tuple[FloatArray, FloatArray]:
        """Centres (p, 2) [m] in the body frame and radii (p,) [m] of circles around the polygons."""
        return body_from_world.apply(self._middle_m), self._radius_m

    def edges(self, picked: Bools, body_from_world: SE2) -> tuple[FloatArray, FloatArray]:
        """Start and end points (n, 2) [m] in the body frame of the edges of the picked polygons (p,)."""
        chosen = np.flatnonzero(picked[self._owner])
        return body_from_world.apply(self._start[chosen]), body_from_world.apply(self._end[chosen])


def _anticlockwise(ring: FloatArray) -> FloatArray:
    if ring.ndim != 2 or ring.shape[0] < 3 or ring.shape[1] != 2 or not np.isfinite(ring).all():
        raise ValueError(f"polygon: expected (n >= 3, 2) finite numbers, got shape {ring.shape}")
    x, y = ring[:, 0], ring[:, 1]
    return ring if float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) >= 0.0 else ring[::-1]


def covered(edges_px: tuple[FloatArray, FloatArray], weight: FloatArray, shape: tuple[int, int]) -> Float32Array:
    """The covered share (h, w) of every pixel, 0 .. 1.

    `edges_px` are the start and end points (n, 2) as (u, v), where pixel (i, j) spans j .. j + 1 and i .. i + 1, of
    closed rings that are anticlockwise as seen in the image. `weight` (n,) is the share that a ring adds to the pixels
    inside it. Rings may lie outside the image.
    """
    height, width = shape
    gained = np.zeros((height + 3, width), np.float32)
    start, end = (np.ascontiguousarray(each) for each in edges_px)
    for below in (False, True):
        _gain(gained, start, end, weight, below)
    _sum_down(gained)
    return gained[1 : height + 1]


@compiled
def _gain(gained: Float32Array, start: FloatArray, end: FloatArray, weight: FloatArray, below: bool) -> None:
    """Add the area that each edge (n, 2) covers to the cells (h + 3, w) that it crosses, or to those `below`.

    Row 0 of the cells collects what lies above the image. The parts of the cells that an edge crosses are added in one
    pass, those of the cells below in another.
    """
    height, width = gained.shape[0] - 3, gained.shape[1]
    for k in range(len(start)):
        du = end[k, 0] - start[k, 0]
        if abs(du) <= 1e-9 or max(start[k, 0], end[k, 0]) <= 0.0 or min(start[k, 0], end[k, 0]) >= width:
            continue
        # anticlockwise in the image: the upper border runs to the left, and the inside lies below it
        left, right, share = (start[k], end[k], -weight[k]) if du > 0.0 else (end[k], start[k], weight[k])
        slope = (right[1] - left[1]) / (right[0] - left[0])
        u0 = max(left[0], 0.0)
        v0 = left[1] + (u0 - left[0]) * slope
        for column in range(int(u0), int(min(math.ceil(right[0]), width))):
            a, b = max(u0, float(column)), min(right[0], column + 1.0)
            va, vb = v0 + (a - u0) * slope, v0 + (b - u0) * slope
            top = min(va, vb)
            bottom = max(va, vb, top + FLAT_PX)
            density = (b - a) * share / (bottom - top)
            # split at the rows; row -1 stands for everything above, row `height` is not used
            first = int(min(max(math.floor(top), -1.0), float(height)))
            last = int(min(max(math.ceil(bottom) - 1.0, float(first)), float(height)))
            for row in range(first, last + 1):
                low, high = top if row < 0 else max(top, float(row)), min(bottom, row + 1.0)
                gain = (high - low) * density
                under = 0.0 if row < 0 else (0.5 * (low + high) - row) * gain
                if below:
                    gained[row + 2, column] += np.float32(under)
                else:
                    gained[row + 1, column] += np.float32(gain - under)


@compiled
def _sum_down(rows: Float32Array) -> None:
    """Cumulative sum down the rows (h, w) in place, at most 1; what blocks of rows add up to is of double precision."""
    carried = np.zeros(rows.shape[1])
    for first in range(0, len(rows), BLOCK_ROWS):
        block = rows[first : first + BLOCK_ROWS]
        for k in range(1, len(block)):
            block[k] += block[k - 1]
        before = carried.astype(np.float32)
        carried += block[-1]
        block[:] = np.minimum(block + before, np.float32(1.0))


def covered_softly(edges_px: tuple[FloatArray, FloatArray], shape: tuple[int, int]) -> Float32Array:
    """As `covered`, computed at half the resolution: faster, with borders that are two pixels wide."""
    half = ((shape[0] + 1) // 2, (shape[1] + 1) // 2)
    share = covered((0.5 * edges_px[0], 0.5 * edges_px[1]), np.ones(len(edges_px[0])), half)
    large = cv2.resize(share, (2 * half[1], 2 * half[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(large[: shape[0], : shape[1]])


# in the order in which they are drawn; asphalt: bare ground without paint; the last six are shades of the ground
COLOURS = ("white", "yellow", "red", "asphalt", "stone", "pale", "gutter", "tar", "crack", "shade")
FAR_ROWS = 1.0  # markings are drawn up to this many rows below the horizon
STEP_PX = 2.0  # motion blur is the mean over poses this far apart
MAX_STEPS = 4


class PaintView:
    """Markings as seen through a `GroundProjection`; raises ValueError for an unknown colour."""

    def __init__(self, projection: GroundProjection, paint: Sequence[Paint]) -> None:
        for p in paint:
            one_of("colour", p.colour, COLOURS)
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

    def shares(self, pose: SE2, travel_m: float = 0.0) -> dict[str, Float32Array]:
        """The covered share (h, w) by colour where any is in view, rows from the projection's `row0` on.

        `pose` is world from body, `travel_m` the distance that the car drives during the exposure (motion blur).
        """
        body_from_world = pose.inverse()
        seen = {}
        for colour, polygons in self._polygons.items():
            picked, distance_m = self._picked(polygons, body_from_world)
            if picked.any():
                seen[colour] = self._blurred(polygons, body_from_world, (picked, distance_m), travel_m)
        return seen

    def _blurred(
        self,
        polygons: PolygonSet,
        body_from_world: SE2,
        picked: tuple[Bools, FloatArray],
        travel_m: float,
    ) -> Float32Array:
        """Near polygons averaged over several poses; far ones, which hardly move, are drawn once."""
        shift_px_m2 = self._lift_px_m * abs(travel_m)
        steps = min(max(math.ceil(shift_px_m2 / self._nearest_m**2 / STEP_PX), 1), MAX_STEPS)
        near = picked[1] <= math.sqrt(shift_px_m2 / 0.7)
        starts, ends, weights = [], [], []
        for chosen, count in ((picked[0] & ~near, 1), (picked[0] & near, steps)):
            if not chosen.any():
                continue
            start, end = polygons.edges(chosen, body_from_world)
            ahead_m = np.repeat(travel_m * ((np.arange(count) + 0.5) / count - 0.5), len(start))
            many = np.tile(start, (count, 1)), np.tile(end, (count, 1))
            start, end = self._projection.edges_px(many, ahead_m)
            starts.append(start)
            ends.append(end)
            weights.append(np.full(len(start), 1.0 / count))
        edges_px = np.concatenate(starts), np.concatenate(ends)
        return covered(edges_px, np.concatenate(weights), self._projection.shape)

    def _picked(self, polygons: PolygonSet, body_from_world: SE2) -> tuple[Bools, FloatArray]:
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
