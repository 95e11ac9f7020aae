"""Light and texture of the ground: gradient, shadows and reflections; floor grain and wear as periodic patterns."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.geometry import SE2
from automodel.sim.appearance import Appearance
from automodel.sim.background import TURN, directions
from automodel.sim.coverage import PolygonSet, covered_softly
from automodel.sim.ground_projection import GroundProjection
from automodel.types import Float32Array, FloatArray, Image

SIDE_PX = 1024  # texels of a pattern's period
LEVELS = 7
NO_MAP: Any = None  # both coordinates are in the first map of cv2.remap
NEUTRAL = 128.0  # texture value that leaves the floor's grey as it is


def periodic_noise(rng: np.random.Generator, size_px: float, power: float = 0.0) -> FloatArray:
    """Smooth periodic noise (SIDE_PX, SIDE_PX) of unit variance.

    Features are about `size_px` texels large; `power` > 0 adds larger ones, as in clouds.
    """
    spectrum = np.fft.rfft2(rng.standard_normal((SIDE_PX, SIDE_PX)))
    fy, fx = np.fft.fftfreq(SIDE_PX)[:, None], np.fft.rfftfreq(SIDE_PX)[None, :]
    radius2 = fx * fx + fy * fy
    shape = np.exp(-0.5 * radius2 * size_px**2) / np.maximum(radius2, 1.0 / SIDE_PX**2) ** (0.5 * power)
    shape[0, 0] = 0.0
    noise = np.fft.irfft2(spectrum * shape, s=(SIDE_PX, SIDE_PX))
    return np.asarray(noise / noise.std())


def floor_pattern(kind: str, contrast: float, seed: int) -> Image:
    """One period of a floor, `NEUTRAL` on average; the kinds are `appearance.FLOORS` and "grass"."""
    rng = np.random.default_rng(seed)
    relief = {
        "plain": lambda: 0.05 * periodic_noise(rng, 2.0, 0.6),
        "plastic": lambda: 0.06 * periodic_noise(rng, 3.0, 1.2) + _joints(1, 1, 4, 0.5) + _scratches(rng, 40),
        "tiles": lambda: 0.06 * periodic_noise(rng, 2.0, 1.0) + _joints(6, 6, 8, -0.4) + _patches(rng, 6, 6, 0.08),
        "wood": lambda: _wood(rng),
        "asphalt": lambda: 0.20 * periodic_noise(rng, 1.2) + 0.06 * periodic_noise(rng, 4.0, 1.2),
        "grass": lambda: 0.22 * periodic_noise(rng, 2.0) + 0.12 * periodic_noise(rng, 12.0, 1.2),
        "carpet": lambda: 0.14 * periodic_noise(rng, 1.6) + 0.05 * periodic_noise(rng, 6.0, 1.0),
        "concrete": lambda: 0.10 * periodic_noise(rng, 2.0, 1.4) + 0.05 * periodic_noise(rng, 1.0),
    }[kind]()
    relief -= relief.mean()
    return np.clip(NEUTRAL * (1.0 + contrast * relief), 0, 255).round().astype(np.uint8)


def wear_pattern(wear: float, dirt: float, seed: int) -> Image:
    """One period of the share of the paint that is left, 0 .. 255; `wear` is the share that has flaked off."""
    rng = np.random.default_rng(seed)
    flakes = periodic_noise(rng, 3.0, 0.8) + 0.35 * periodic_noise(rng, 30.0)
    edge = np.quantile(flakes, wear) if wear > 0.0 else flakes.min() - 1.0
    left = np.clip((flakes - edge) / 0.12, 0.0, 1.0)
    stains = np.clip(0.5 + 0.35 * periodic_noise(rng, 4.0, 1.4), 0.0, 1.0)
    return np.asarray((255.0 * left * (1.0 - dirt * stains)).round().astype(np.uint8))


def _joints(across: int, along: int, width_px: int, depth: float) -> FloatArray:
    joints = np.zeros((SIDE_PX, SIDE_PX))
    for k in range(across):
        at = round(k * SIDE_PX / across)
        joints[:, at : at + width_px] = depth
    for k in range(along):
        at = round(k * SIDE_PX / along)
        joints[at : at + width_px, :] = depth
    return joints


def _patches(rng: np.random.Generator, across: int, along: int, spread: float) -> FloatArray:
    column = np.arange(SIDE_PX) * across // SIDE_PX
    row = np.arange(SIDE_PX) * along // SIDE_PX
    return np.asarray(spread * rng.standard_normal((along, across))[row[:, None], column[None, :]])


def _wood(rng: np.random.Generator) -> FloatArray:
    """Planks along x, each of its own brightness, with a long grain."""
    grain = periodic_noise(rng, 2.0, 0.5)
    long = cv2.blur(np.tile(grain, (1, 3)), (81, 1))[:, SIDE_PX : 2 * SIDE_PX]
    return np.asarray(0.10 * long / long.std() + _patches(rng, 2, 10, 0.14) + _joints(0, 10, 2, -0.35))


def _scratches(rng: np.random.Generator, count: int) -> FloatArray:
    canvas = np.zeros((SIDE_PX, SIDE_PX), np.float32)
    for _ in range(count):
        x, y = rng.integers(60, SIDE_PX - 60, 2).tolist()
        angle, length = rng.uniform(0.0, math.pi), rng.uniform(10.0, 55.0)
        tip = (round(x + length * math.cos(angle)), round(y + length * math.sin(angle)))
        cv2.line(canvas, (x, y), tip, float(rng.uniform(0.1, 0.4)), 1)
    return canvas.astype(np.float64)


class MipPattern:
    """A periodic pattern (SIDE_PX, SIDE_PX) as a mip pyramid, each level tiled to SIDE_PX or two periods."""

    def __init__(self, pattern: Image) -> None:
        self.levels: list[Image] = []
        for level in range(LEVELS):
            side = SIDE_PX >> level
            small = cv2.resize(pattern, (side, side), interpolation=cv2.INTER_AREA)
            copies = max(2, SIDE_PX // side)
            self.levels.append(np.tile(small, (copies, copies)))


class GroundSampler:
    """Looks up patterns at the ground point of every pixel; rows are grouped by the mip level of their footprint.

    `ground_m` (h, w, 2) [m] is in the body frame, NaN where there is no ground; `texel_m` is that of the finest level.
    """

    def __init__(self, ground_m: FloatArray, texel_m: float) -> None:
        self.texel_m = texel_m
        self.shape = ground_m.shape[:2]
        self._far_m = 400.0 * texel_m * (1 << LEVELS)
        levels = _row_levels(ground_m, texel_m)
        filled = np.clip(np.nan_to_num(ground_m, nan=self._far_m), -self._far_m, self._far_m)
        edges = [0, *(np.flatnonzero(np.diff(levels)) + 1).tolist(), len(levels)]
        self._bands: list[tuple[int, int, int, Float32Array, FloatArray]] = []
        for first, end in itertools.pairwise(edges if len(levels) else []):
            band = np.ascontiguousarray(filled[first:end], dtype=np.float32)
            middle = 0.5 * (band.reshape(-1, 2).min(axis=0) + band.reshape(-1, 2).max(axis=0))
            self._bands.append((first, end, int(levels[first]), band, middle.astype(np.float64)))

    def sample(self, patterns: Mapping[str, MipPattern], pose: SE2) -> dict[str, Image]:
        """Each pattern (h, w) as the camera at `pose` (world from body) sees it."""
        seen = {name: np.empty(self.shape, np.uint8) for name in patterns}
        cos, sin = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
        for first, end, level, ground, middle in self._bands:
            scale = 1.0 / (self.texel_m * (1 << level))
            turn = scale * np.array([[cos, -sin], [sin, cos]])
            # whole periods are subtracted so that the band's centre lies at the centre of the tiled pattern
            period = SIDE_PX >> level
            middle_px = turn @ middle + scale * np.array([pose.x_m, pose.y_m])
            shift = scale * np.array([pose.x_m, pose.y_m]) - 0.5
            shift -= period * np.round((middle_px - (period if level == 0 else SIDE_PX // 2)) / period)
            maps = cv2.transform(ground, np.column_stack((turn, shift)))
            for name, pattern in patterns.items():
                seen[name][first:end] = cv2.remap(
                    pattern.levels[level], maps, NO_MAP, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
                )
        return seen


def _row_levels(ground_m: FloatArray, texel_m: float) -> NDArray[np.intp]:
    """Mip level of every row, from the geometric mean of a pixel's length and width on the ground."""
    if min(ground_m.shape[:2]) < 2:
        return np.zeros(len(ground_m), np.intp)
    down = np.linalg.norm(np.gradient(ground_m, axis=0), axis=-1)
    across = np.linalg.norm(np.gradient(ground_m, axis=1), axis=-1)
    size = np.sqrt(down * across)
    size[~np.isfinite(size)] = np.inf
    footprint = np.maximum(np.median(size, axis=1), 1e-9)
    levels = np.clip(np.ceil(np.log2(footprint / texel_m)), 0, LEVELS - 1)
    return np.asarray(levels.astype(np.intp))


COARSE = 4  # smooth light is computed for one pixel of 4 x 4
MIRROR_PER_RAD = 1024 / TURN
MIRROR_TOP_RAD = 1.2
SHADOW_PERIOD = 18.0  # period of the shadows [scene units]


class GroundLight:
    """Light factors and reflections for the rows of a `GroundProjection` from `row0` on; `unit_m`: the scene unit."""

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
        """Factor (h, w) on the ground's brightness at `pose` (world from body); None if it is 1 everywhere."""
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
        """Grey levels (h, w) that reflections add for a car with heading `yaw_rad`; None if there are none."""
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
        """The share of the light that the shadows leave."""
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
    """Ground [scene units] ahead and to the left of the car, compressed to a few units so that light stays finite."""
    ground = np.nan_to_num(projection.camera.px_to_ground(pixels), nan=1e6) / unit_m
    reach = np.maximum(np.linalg.norm(ground, axis=-1, keepdims=True), 1e-9)
    bounded = ground / reach * (6.0 * np.tanh(reach / 6.0))
    return bounded[..., 0].astype(np.float32), bounded[..., 1].astype(np.float32)


def _mirror(look: Appearance, surroundings: Image | None) -> Float32Array | None:
    """The reflection in the floor [grey levels]: columns by azimuth from 0, rows by elevation from 0."""
    if not look.lamps and not (look.shine and surroundings is not None):
        return None
    columns = round(TURN * MIRROR_PER_RAD)
    elevation = (np.arange(math.ceil(MIRROR_TOP_RAD * MIRROR_PER_RAD)) + 0.5) / MIRROR_PER_RAD
    azimuth = (np.arange(columns) + 0.5) / MIRROR_PER_RAD
    mirror = np.zeros((len(elevation), columns))
    for lamp in look.lamps:
        lateral = (azimuth - lamp.azimuth_rad + math.pi) % TURN - math.pi
        # an uneven floor stretches reflections towards the viewer
        profile = (
            np.exp(-((lateral / lamp.width_rad) ** 2)),
            np.exp(-(np.abs((elevation - lamp.elevation_rad) / (1.6 * lamp.height_rad)) ** 3)),
        )
        mirror += lamp.strength * np.outer(profile[1], profile[0])
    if look.shine and surroundings is not None:
        grazing = look.shine * (1.0 - np.sin(elevation)) ** 5
        mirror += grazing[:, None] * _blurred(surroundings, mirror.shape)
    return mirror.astype(np.float32)


def _blurred(surroundings: Image, shape: tuple[int, int]) -> FloatArray:
    """The blurred panorama from the horizon upwards at the mirror's resolution; its top row is repeated above it."""
    grey = cv2.cvtColor(surroundings, cv2.COLOR_BGR2GRAY)[::-1]
    rows = max(round(grey.shape[0] * shape[1] / grey.shape[1]), 1)
    small = cv2.resize(grey, (shape[1], rows), interpolation=cv2.INTER_AREA)[: shape[0]]
    filled = np.concatenate((small, np.repeat(small[-1:], shape[0] - len(small), axis=0)))
    three = np.concatenate((filled, filled, filled), axis=1)
    return cv2.GaussianBlur(three, (0, 0), 3.0, sigmaY=5.0)[:, shape[1] : 2 * shape[1]].astype(np.float64)


def _shadow_polygons(look: Appearance, unit_m: float) -> list[FloatArray]:
    """Random quadrilaterals over one period, with copies in the adjacent periods."""
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
