"""The light on the ground: a gradient across the room, hard shadows, reflections in a shiny floor."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.geometry import SE2
from automodel.sim.appearance import Appearance
from automodel.sim.background import TURN, directions
from automodel.sim.coverage import PolygonSet, covered_softly
from automodel.sim.ground_projection import GroundProjection
from automodel.types import FloatArray, Image

Float32Array = NDArray[np.float32]

COARSE = 4  # smooth light is computed for one pixel in 4 x 4
MIRROR_PER_RAD = 1024 / TURN
MIRROR_TOP_RAD = 1.2
SHADOW_PERIOD = 18.0  # scene units after which the pattern of shadows repeats


class GroundLight:
    """Factors and reflections for the rows of a `GroundProjection`, from `row0` on. `unit_m` is the scene's unit."""

    def __init__(
        self, projection: GroundProjection, look: Appearance, unit_m: float, surroundings: Image | None
    ) -> None:
        self._projection, self._look, self._unit_m = projection, look, unit_m
        height, width = projection.seen.shape
        self.shape = (height - projection.row0, width)
        rows = np.arange(math.ceil(self.shape[0] / COARSE)) * COARSE + 0.5 * (COARSE - 1) + projection.row0
        columns = np.arange(math.ceil(width / COARSE)) * COARSE + 0.5 * (COARSE - 1)
        pixels = np.stack(np.meshgrid(columns, rows), axis=-1)
        self._ahead, self._left = _bounded_ground(projection, pixels, unit_m)
        azimuth, elevation = directions(projection.camera, pixels)
        self._mirror_u = (np.nan_to_num(azimuth) * MIRROR_PER_RAD - 0.5).astype(np.float32)
        below = np.clip(np.nan_to_num(-elevation), 0.0, MIRROR_TOP_RAD)
        self._mirror_v = (below * MIRROR_PER_RAD - 0.5).astype(np.float32)
        self._mirror = _mirror(look, surroundings)
        self._shadows = PolygonSet(_shadow_polygons(look, unit_m)) if look.shadow > 0.0 else None

    def factor(self, pose: SE2) -> Float32Array | None:
        """Factor (h, w) on the ground's brightness at `pose` (world from body); None where it is 1 everywhere."""
        light: Float32Array | None = None
        if self._look.gradient:
            turn = self._look.gradient_direction_rad - pose.yaw_rad
            steep = self._look.gradient
            coarse = cv2.addWeighted(self._ahead, steep * math.cos(turn), self._left, steep * math.sin(turn), 1.0)
            light = self._enlarged(np.clip(coarse, 0.35, 1.8))
        if self._shadows is not None:
            lit = self._lit(self._shadows, pose)
            light = lit if light is None else light * lit
        return light

    def reflection(self, yaw_rad: float) -> Float32Array | None:
        """Grey levels (h, w) that reflections add for a car heading `yaw_rad`; None where there are none."""
        if self._mirror is None:
            return None
        columns = self._mirror_u + np.float32((yaw_rad % TURN) * MIRROR_PER_RAD)
        seen = cv2.remap(self._mirror, columns, self._mirror_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        return self._enlarged(seen)

    def _enlarged(self, coarse: NDArray[Any]) -> Float32Array:
        height, width = coarse.shape
        large = cv2.resize(coarse, (width * COARSE, height * COARSE), interpolation=cv2.INTER_LINEAR)
        return np.asarray(large[: self.shape[0], : self.shape[1]])

    def _lit(self, shadows: PolygonSet, pose: SE2) -> Float32Array:
        """The light that shadows leave."""
        period_m = SHADOW_PERIOD * self._unit_m
        near = SE2(pose.x_m % period_m, pose.y_m % period_m, pose.yaw_rad).inverse()
        middles, radii = shadows.circles(near)
        picked = (np.linalg.norm(middles, axis=1) - radii < 0.8 * period_m) & (middles[:, 0] + radii > 0.0)
        edges_px = self._projection.edges_px(shadows.edges(picked, near))
        dark = covered_softly(edges_px, self.shape)
        return np.asarray(cv2.addWeighted(dark, -self._look.shadow, dark, 0.0, 1.0))


def _bounded_ground(
    projection: GroundProjection, pixels: FloatArray, unit_m: float
) -> tuple[Float32Array, Float32Array]:
    """Ground [scene units] ahead and to the left of the car, drawn in to a few units so that light stays finite."""
    ground = np.nan_to_num(projection.camera.px_to_ground(pixels), nan=1e6) / unit_m
    reach = np.maximum(np.linalg.norm(ground, axis=-1, keepdims=True), 1e-9)
    bounded = ground / reach * (6.0 * np.tanh(reach / 6.0))
    return bounded[..., 0].astype(np.float32), bounded[..., 1].astype(np.float32)


def _mirror(look: Appearance, surroundings: Image | None) -> Float32Array | None:
    """What a floor mirrors, by azimuth from 0 to the right and elevation from 0 down, in grey levels."""
    if not look.lamps and not (look.shine and surroundings is not None):
        return None
    columns = round(TURN * MIRROR_PER_RAD)
    elevation = (np.arange(math.ceil(MIRROR_TOP_RAD * MIRROR_PER_RAD)) + 0.5) / MIRROR_PER_RAD
    azimuth = (np.arange(columns) + 0.5) / MIRROR_PER_RAD
    mirror = np.zeros((len(elevation), columns))
    for lamp in look.lamps:
        aside = (azimuth - lamp.azimuth_rad + math.pi) % TURN - math.pi
        # a floor that is not quite flat draws reflections out towards the viewer
        profile = (
            np.exp(-((aside / lamp.width_rad) ** 2)),
            np.exp(-(np.abs((elevation - lamp.elevation_rad) / (1.6 * lamp.height_rad)) ** 3)),
        )
        mirror += lamp.strength * np.outer(profile[1], profile[0])
    if look.shine and surroundings is not None:
        grazing = look.shine * (1.0 - np.sin(elevation)) ** 5
        mirror += grazing[:, None] * _blurred(surroundings, mirror.shape)
    return mirror.astype(np.float32)


def _blurred(surroundings: Image, shape: tuple[int, int]) -> FloatArray:
    """The panorama from the horizon upwards at the mirror's resolution, smeared; above its top its top row goes on."""
    grey = cv2.cvtColor(surroundings, cv2.COLOR_BGR2GRAY)[::-1]
    rows = max(round(grey.shape[0] * shape[1] / grey.shape[1]), 1)
    small = cv2.resize(grey, (shape[1], rows), interpolation=cv2.INTER_AREA)[: shape[0]]
    filled = np.concatenate((small, np.repeat(small[-1:], shape[0] - len(small), axis=0)))
    three = np.concatenate((filled, filled, filled), axis=1)
    return cv2.GaussianBlur(three, (0, 0), 3.0, sigmaY=5.0)[:, shape[1] : 2 * shape[1]].astype(np.float64)


def _shadow_polygons(look: Appearance, unit_m: float) -> list[FloatArray]:
    """Quadrilaterals strewn over one period, and copies of them on all sides."""
    rng = np.random.default_rng(look.shadow_seed)
    period_m = SHADOW_PERIOD * unit_m
    polygons = []
    for _ in range(26):
        middle, turn = rng.uniform(0.0, period_m, 2), rng.uniform(0.0, TURN)
        size = unit_m * np.array([rng.uniform(0.3, 3.0), rng.uniform(0.05, 0.7)])
        corners = 0.5 * size * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * rng.uniform(0.6, 1.0, (4, 1))
        polygons.append(SE2(middle[0], middle[1], turn).apply(corners))
    shifts = [np.array([i, j]) * period_m for i in (-1, 0, 1) for j in (-1, 0, 1)]
    return [polygon + shift for shift in shifts for polygon in polygons]
