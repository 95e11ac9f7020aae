"""Synthetic images for training the marking network: `make_sample(seed)` gives an image and its mask.

An image is composed of a backdrop, the ground (floor, roadside, stains, paint) as a random camera sees it, light and
shadow, and objects on the ground; then lens and sensor effects are applied. Lengths are in lane widths, so that one
generator covers scale cars and highways.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from automodel.geometry import GroundCamera
from automodel.training import noise
from automodel.training.augmentation import augment
from automodel.training.backdrops import backdrop
from automodel.training.cameras import Kind, random_camera
from automodel.training.distractors import random_distractors
from automodel.training.layouts import random_road
from automodel.training.lighting import light
from automodel.training.objects import draw_objects
from automodel.training.roads import Road
from automodel.training.shapes import UNKNOWN, Canvas, Ink, Patch, Stripe, worn
from automodel.training.textures import floor_tile, roadside_tile
from automodel.types import FloatImage, Image

Rng = np.random.Generator

_CELL_PX = 8  # rays are computed at this spacing and interpolated
_TILE_PX = 512
_LEVELS = 6  # mip levels of a tile
_TILES = 160  # number of different floors; each is used with random size, rotation and tone
_FAINT = 2.2  # grey levels that paint must add to be visible,
_ROUGH_SHARE = 0.6  # plus this share of the roughness around it
_SURE = 40  # mask value (of 255) from which a pixel counts as marking
_DARK = 0.18  # share of the floors of scale cars with dark tape on a light floor; their images are negatives

Layers = tuple[Image, Image, FloatImage, FloatImage]  # image, mask, and what worn and whole paint add


class GroundView:
    """The ground point of each pixel (h, w) of a camera.

    `share` is the share of ground in the pixel (1 below the horizon), `distance` the distance along the ground and
    `rise` the tangent of the ray's elevation. Lengths are in the camera's unit.
    """

    def __init__(self, camera: GroundCamera, farthest: float) -> None:
        width, height = camera.camera.width_px, camera.camera.height_px
        self.height = float(camera.centre_m[2])
        rays = _ray_grid(camera, width, height)
        level = cv2.magnitude(rays[..., 0], rays[..., 1])
        self.rise: FloatImage = np.asarray(rays[..., 2] / np.maximum(level, 1e-6), dtype=np.float32)
        focal = float(camera.camera.matrix[1, 1])
        lowest = np.float32(self.height / farthest)
        self.share: FloatImage = np.clip(0.5 - (self.rise + lowest) * focal, 0.0, 1.0)
        down = np.maximum(-self.rise, lowest)
        self.distance: FloatImage = self.height / down
        scale = self.distance / np.maximum(level, 1e-6)
        self._x: FloatImage = rays[..., 0] * scale
        self._y: FloatImage = rays[..., 1] * scale
        across = math.sqrt(float(camera.camera.matrix[0, 0]) * focal)
        # a pixel's size on the ground is distance / f across and distance^2 / (height f) along: the geometric mean
        self._log_size: FloatImage = np.log2(
            np.maximum(self.distance, self.height) ** 1.5 / (math.sqrt(self.height) * across)
        )

    def laid(self, atlas: Image, size: float, turn_rad: float, shift: tuple[float, float]) -> Image:
        """The camera's view (h, w) of the `atlas` of a tile with side length `size`, repeated over the ground."""
        cos, sin = math.cos(turn_rad) / size, math.sin(turn_rad) / size
        u = self._x * np.float32(cos) + self._y * np.float32(sin) + np.float32(shift[0])
        v = self._y * np.float32(cos) - self._x * np.float32(sin) + np.float32(shift[1])
        level = np.clip(self._log_size + np.float32(math.log2(_TILE_PX / size) + 0.3), 0.0, _LEVELS - 1)
        index = level.astype(np.intp)
        side = _SIDES[index]
        u = (u - np.floor(u)) * side + _LEFTS[index]
        v = (v - np.floor(v)) * side + _TOPS[index]
        return np.asarray(cv2.remap(atlas, u, v, cv2.INTER_LINEAR), dtype=np.uint8)


def _ray_grid(camera: GroundCamera, width: int, height: int) -> FloatImage:
    """Ray directions (h, w, 3) of the pixels in the body frame, not normalised."""
    columns = np.arange(-1, width // _CELL_PX + 3) * float(_CELL_PX)
    rows = np.arange(-1, height // _CELL_PX + 3) * float(_CELL_PX)
    grid = np.stack(np.meshgrid(columns, rows), axis=-1)
    rays = camera.camera.rays(grid)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    body = np.nan_to_num(rays @ camera.cam_from_body, nan=1e-3).astype(np.float32)
    back = np.array([[1 / _CELL_PX, 0.0, 1.0], [0.0, 1 / _CELL_PX, 1.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(body, back, (width, height), flags=flags), dtype=np.float32)


def _layout() -> tuple[list[int], list[int], list[int]]:
    sides = [_TILE_PX >> k for k in range(_LEVELS)]
    lefts = [0] + [_TILE_PX + 2] * (_LEVELS - 1)
    tops = [0, 0]
    for side in sides[1:-1]:
        tops.append(tops[-1] + side + 2)
    return sides, lefts, tops


_SIDES, _LEFTS, _TOPS = (np.array(values, dtype=np.float32) for values in _layout())


def atlas(tile: Image) -> Image:
    """The mip levels of a tile (512, 512) in one image, each with a border that repeats it."""
    image = np.empty((_TILE_PX + 2, _TILE_PX + 2 + _TILE_PX // 2 + 2), dtype=np.uint8)
    level = tile
    for left, top in zip(_LEFTS.astype(int), _TOPS.astype(int), strict=True):
        side = level.shape[0]
        image[top : top + side, left : left + side] = level
        image[top + side, left : left + side] = level[0]
        image[top : top + side, left + side] = level[:, 0]
        image[top + side, left + side] = level[0, 0]
        level = np.asarray(cv2.resize(level, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return image


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sample:
    """An image (h, w) uint8 grey, and its mask (h, w) uint8: the share of lane marking in each pixel, 0..255.

    `UNKNOWN` in the mask stands for a marking that is not visible.
    """

    image: Image
    mask: Image


def make_sample(seed: int, width_px: int = 512, height_px: int = 256) -> Sample:
    """The training sample of a seed, the same for the same seed."""
    rng = np.random.default_rng(seed)
    kind = random_kind(rng)
    return drawn_scene(rng, kind, random_camera(rng, kind, width_px, height_px), uneven=0.25)


def random_kind(rng: Rng) -> Kind:
    """The kind of a scene to draw."""
    return (Kind.SCALE, Kind.ROAD, Kind.CIRCUIT)[int(rng.choice(3, p=(0.5, 0.38, 0.12)))]


def drawn_scene(rng: Rng, kind: Kind, camera: GroundCamera, uneven: float) -> Sample:
    """What a camera sees of a random scene; the share `uneven` of them is not flat."""
    road = random_road(rng, kind)
    dark = kind is Kind.SCALE and rng.random() < _DARK
    ground = lit_ground(rng, camera, road, (*random_distractors(rng, road), *road.bars, *road.stripes), dark)
    draw_objects(ground.image, ground.mask, camera, rng, min(road.reach, 60.0))
    layers = ground.image, ground.mask, ground.seen, ground.whole
    if rng.random() < uneven:
        layers = _warped(rng, layers)
    return augmented(layers, int(rng.integers(2**62)), dark)


def augmented(layers: Layers, seed: int, dark: bool = False) -> Sample:
    """The image with lens and sensor effects, and the mask with `UNKNOWN` where a marking is not visible.

    The same effects are applied to the image with whole paint and without paint: a marking is invisible where both look
    alike. Of `dark` paint the image is the negative, which is what the network gets in the car.
    """
    scene, mask, seen, whole = layers
    image = _shown(augment(scene, np.random.default_rng(seed)), dark)
    if not mask.any():
        return Sample(image=image, mask=mask)
    bare = np.where(mask > 0, np.clip(scene - seen, 0.0, 255.0), scene)
    full = np.where(mask > 0, np.clip(bare + whole, 0.0, 255.0), scene)
    parts = [part.astype(np.uint8) for part in (bare, full)]
    without, painted = (_shown(augment(part, np.random.default_rng(seed), scene), dark) for part in parts)
    rough = cv2.blur(cv2.absdiff(without, cv2.blur(without, (7, 7))), (21, 21)).astype(np.float32)
    needed = _FAINT + np.float32(_ROUGH_SHARE) * rough
    known = _stands_out(painted, without, needed, 9) * _stands_out(image, without, needed, 31)
    shown = np.round(mask * known).astype(np.uint8)
    shown[(mask > _SURE) & (shown < _SURE)] = UNKNOWN
    return Sample(image=image, mask=shown)


def _shown(image: Image, dark: bool) -> Image:
    return np.asarray(cv2.bitwise_not(image), dtype=np.uint8) if dark else image


def _stands_out(image: Image, without: Image, needed: FloatImage, around_px: int) -> FloatImage:
    """The visibility (h, w) of paint at or near each pixel, 0..1."""
    signal = cv2.dilate(cv2.blur(cv2.subtract(image, without), (3, 3)), np.ones((around_px, around_px), np.uint8))
    return np.asarray(np.clip((signal - needed) / (0.5 * needed), 0.0, 1.0), dtype=np.float32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ground:
    """The lit ground without objects: image and mask (h, w), and the grey levels that paint adds.

    `seen` is the contribution of the worn paint, `whole` that of paint without wear.
    """

    image: Image
    mask: Image
    seen: FloatImage
    whole: FloatImage


def lit_ground(
    rng: Rng, camera: GroundCamera, road: Road, shapes: Sequence[Stripe | Patch], dark: bool = False
) -> Ground:
    """The camera's view of a road with its shapes, in front of a backdrop; `dark`: dark paint on a light floor."""
    canvas = Canvas(camera)
    for shape in (*road.paved, *shapes):
        if isinstance(shape, Stripe):
            canvas.stripe(shape)
        else:
            canvas.patch(shape)
    view = GroundView(camera, farthest=300.0)
    floor = _floor(rng, view, canvas.coverage(Ink.ROADBED))
    if dark:
        floor *= np.float32(rng.uniform(100.0, 215.0) / max(float(floor.mean()), 8.0))
    image, seen, whole = _painted(rng, view, canvas, floor, dark)
    before = image.copy()
    light(image, camera, rng)
    gain = (image + 4.0) / (before + 4.0)
    gain = np.where(((before - seen) * gain > 250.0) & (not dark), 0.0, np.minimum(gain, 1.0))
    if rng.random() < 0.15:
        clear = np.exp(view.distance * np.float32(-1.0 / rng.uniform(10.0, 200.0)))
        image = np.float32(rng.uniform(60.0, 220.0)) * (1.0 - clear) + clear * image
        gain = gain * clear
    mask = np.round(canvas.label() * (view.share > 0.5)).astype(np.uint8)
    if float(view.share.min()) < 1.0:
        behind = _behind(rng, view, camera).astype(np.float32)
        image = behind + view.share * (image - behind)
    return Ground(
        image=np.clip(image, 0.0, 255.0).astype(np.uint8),
        mask=mask,
        seen=np.asarray(seen * gain, dtype=np.float32),
        whole=np.asarray(whole * gain, dtype=np.float32),
    )


@lru_cache(maxsize=2 * _TILES)
def _ground_atlas(number: int, roadside: bool) -> tuple[Image, float, float]:
    """The atlas, mean grey and size of a floor or roadside; a few hundred are cached."""
    rng = np.random.default_rng((number, int(roadside)))
    tile = roadside_tile(rng) if roadside else floor_tile(rng)
    return atlas(tile.image), float(tile.image.mean()), tile.size_lanes


def _surface(rng: Rng, view: GroundView, roadside: bool) -> FloatImage:
    """A view of a random floor with random tone and contrast."""
    tile, mean, size = _ground_atlas(int(rng.integers(_TILES)), roadside)
    turn = rng.normal(0.0, 0.1) if rng.random() < 0.5 else rng.uniform(0.0, 2.0 * math.pi)
    seen = view.laid(tile, size * math.exp(rng.normal(0.0, 0.3)), turn, tuple(rng.uniform(0.0, 1.0, 2)))
    tone = np.clip(mean * math.exp(rng.normal(0.0, 0.35)), 6.0, 235.0)
    contrast = tone / max(mean, 8.0) * math.exp(rng.normal(0.0, 0.3))
    return (seen.astype(np.float32) - np.float32(mean)) * np.float32(contrast) + np.float32(tone)


def _floor(rng: Rng, view: GroundView, bed: FloatImage | None) -> FloatImage:
    """The ground without shapes, with another surface beside a paved road."""
    floor = _surface(rng, view, roadside=False)
    if bed is None:
        return floor
    beside = _surface(rng, view, roadside=True)
    return beside + bed * (floor - beside)


def _painted(
    rng: Rng, view: GroundView, canvas: Canvas, floor: FloatImage, dark: bool
) -> tuple[FloatImage, FloatImage, FloatImage]:
    """The ground with its shapes, and the contributions of worn and whole paint."""
    image = floor.copy()
    base = float(np.median(floor[::4, ::4][view.share[::4, ::4] > 0.5])) if (view.share[::4, ::4] > 0.5).any() else 90.0
    keep = _wear(rng, view)
    band = canvas.coverage(Ink.BAND)
    if band is not None:
        if rng.random() < 0.6:
            band = np.asarray(cv2.blur(band, (9, 5)), dtype=np.float32)
        image *= 1.0 + band * np.float32(rng.uniform(-0.35, 0.12))
    whole = seen = np.zeros_like(floor)
    for ink in (Ink.DARK, Ink.BRIGHT, Ink.SECOND_PAINT, Ink.PAINT):
        cover = canvas.coverage(ink)
        stands_out = np.float32(_contrast(rng, ink, base, dark))
        if cover is None:
            continue
        tone = np.float32(base) + stands_out
        rough = np.float32(rng.uniform(0.0, 0.7)) * tone / np.float32(max(base, 20.0))
        surface = tone + rough * (floor - np.float32(base))
        if ink in (Ink.SECOND_PAINT, Ink.PAINT):
            further = np.minimum if dark else np.maximum
            surface = further(surface, floor + 0.5 * stands_out)
            full = cover * (surface - image)
            added = keep * full
            whole, seen = further(whole, full), further(seen, added)
        else:
            added = cover * (surface - image)
        image += added
    return image, seen, whole


def _contrast(rng: Rng, ink: Ink, base: float, dark: bool) -> float:
    """Grey levels between the floor and an ink on it; `dark`: of paint that is darker than the floor."""
    if dark and ink in (Ink.SECOND_PAINT, Ink.PAINT):
        return -base * rng.uniform(0.2, 0.9)
    if ink is Ink.DARK:
        return -base * rng.uniform(0.15, 0.85)
    if ink is Ink.BRIGHT:
        return float(rng.uniform(10.0, 110.0))
    room = max(255.0 - base, 25.0)
    if rng.random() < 0.12:
        return float(min(room, rng.uniform(9.0, 30.0)))
    return float(room * rng.uniform(0.25, 1.0))


def _wear(rng: Rng, view: GroundView) -> FloatImage:
    """The share of the paint that is left at each pixel (h, w)."""
    if rng.random() < 0.5:
        return np.ones(view.share.shape, dtype=np.float32)
    lost = float(rng.beta(1.0, 2.2)) * 0.95 if rng.random() < 0.75 else rng.uniform(0.6, 0.95)
    grain = noise.fractal(float(rng.choice([0.8, 1.1, 1.4])), noise.variant(rng))[:512, :512]
    tile = atlas(worn(grain, lost, rng.uniform(8.0, 60.0)))
    turn, shift = rng.uniform(0.0, math.pi), tuple(rng.uniform(0.0, 1.0, 2))
    keep = view.laid(tile, rng.uniform(0.6, 5.0), turn, shift).astype(np.float32) * np.float32(1.0 / 255.0)
    least = np.float32(rng.uniform(0.0, 0.4) ** 2)
    return np.asarray(least + (1.0 - least) * keep, dtype=np.float32)


def _behind(rng: Rng, view: GroundView, camera: GroundCamera) -> Image:
    """The backdrop (h, w), warped so that its horizon matches that of the camera."""
    height, width = view.share.shape
    focal = float(camera.camera.matrix[1, 1])
    row = float(np.interp(0.0, view.rise[::-1, width // 2], np.arange(height)[::-1], left=height, right=-20.0))
    flat = backdrop(rng, width, height, row)
    v = np.float32(row) - np.float32(focal) * np.clip(view.rise, -2.0, 2.0)
    u = np.broadcast_to(np.arange(width, dtype=np.float32), v.shape)
    return np.asarray(cv2.remap(flat, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT), dtype=np.uint8)


def _warped(rng: Rng, layers: Layers) -> Layers:
    """The layers with smoothly shifted rows, as from hills, or from pitching with a rolling shutter."""
    height, width = layers[0].shape
    rows = np.arange(height) / height
    middle, spread = rng.uniform(0.1, 0.6), rng.uniform(0.1, 0.3)
    shift = rng.uniform(-0.35, 0.35) * spread * np.exp(-(((rows - middle) / spread) ** 2))
    slope = rng.normal(0.0, 0.02) * np.sin(2.0 * math.pi * (rows * rng.uniform(0.3, 1.5) + rng.random()))
    v = np.repeat(((rows + shift) * height)[:, None], width, axis=1).astype(np.float32)
    u = (np.arange(width)[None, :] + (slope * width)[:, None]).astype(np.float32)
    maps = cv2.convertMaps(u, v, cv2.CV_16SC2)

    def warped(layer: Image | FloatImage) -> Any:
        return cv2.remap(layer, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    image, mask, seen, whole = layers
    return warped(image), warped(mask), warped(seen), warped(whole)
