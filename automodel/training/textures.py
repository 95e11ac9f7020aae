"""Ground textures: tileable grey images of floors, roads and roadsides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from automodel.training import noise
from automodel.training.noise import SIDE_PX
from automodel.types import Image

Rng = np.random.Generator


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tile:
    """A square ground texture that repeats without a visible edge.

    `image` is (512, 512) uint8 grey; `size_lanes` is the length of its side in lane widths.
    """

    image: Image
    size_lanes: float


def floor_tile(rng: Rng) -> Tile:
    """A random floor or road surface."""
    kinds, weights = zip(*_FLOORS, strict=True)
    return _finished(kinds[int(rng.choice(len(kinds), p=np.array(weights) / sum(weights)))](rng), rng)


def roadside_tile(rng: Rng) -> Tile:
    """A random roadside: grass, gravel, carpet, bricks, soil or a floor."""
    if rng.random() < 0.35:
        return floor_tile(rng)
    kinds = (_grass, _grass, _gravel, _carpet, _brick, _soil)
    return _finished(kinds[int(rng.integers(len(kinds)))](rng), rng)


def _finished(tile: Tile, rng: Rng) -> Tile:
    """The tile, randomly transposed, so that grain, planks and seams run in both directions."""
    image = tile.image
    if rng.random() < 0.5:
        image = cv2.transpose(image).astype(np.uint8, copy=False)
    image.setflags(write=False)
    return Tile(image=image, size_lanes=tile.size_lanes)


def _plain(grey: float) -> Image:
    return np.full((SIDE_PX, SIDE_PX), int(np.clip(grey, 0, 255)), dtype=np.uint8)


def _log_uniform(rng: Rng, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _grid(rows: int, columns: int, spread: float, rng: Rng) -> Image:
    """A signed layer (512, 512) of `rows` x `columns` blocks, each of its own grey."""
    blocks = np.clip(rng.normal(noise.MIDDLE, spread, (rows, columns)), 0, 255).astype(np.uint8)
    return np.asarray(cv2.resize(blocks, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_NEAREST), dtype=np.uint8)


def _add_signed(image: Image, layer: Image, gain: float = 1.0) -> None:
    cv2.addWeighted(image, 1.0, layer, gain, -noise.MIDDLE * gain, dst=image)


def _edges(count: int) -> list[int]:
    return [round(i * SIDE_PX / count) for i in range(count)]


def _shift(image: Image, rows: slice, columns: slice, change: float) -> None:
    """Add `change` grey levels to a rectangle of the tile."""
    part = image[rows, columns]
    image[rows, columns] = np.clip(part.astype(np.int16) + int(change), 0, 255)


def _joints(image: Image, rows: int, columns: int, width_px: int, change: float) -> None:
    """Straight joints along every row and column edge of a grid (0: none that way)."""
    for y in _edges(rows):
        _shift(image, slice(y, y + width_px), slice(None), change)
    for x in _edges(columns):
        _shift(image, slice(None), slice(x, x + width_px), change)


def _wear(image: Image, rng: Rng, strength: float) -> None:
    """Traces of use: stains, scuffs, dust."""
    if rng.random() < 0.5:
        noise.add_mask(image, noise.stains(noise.variant(rng)), strength * rng.normal(0.0, 30.0), rng)
    if rng.random() < 0.4:
        scuffs = noise.cracks(14, 2, 0.03, noise.variant(rng))
        noise.add_mask(image, scuffs, strength * rng.normal(0.0, 18.0), rng)
    if rng.random() < 0.3:
        noise.add_mask(image, noise.specks(1.0, noise.variant(rng)), strength * rng.normal(10.0, 40.0), rng)


def _patches(image: Image, rng: Rng, spread: float) -> None:
    """Repaired rectangles, with or without a sealed border."""
    for _ in range(int(rng.integers(1, 4))):
        w, h = (int(v) for v in rng.integers(40, 330, 2))
        x, y = int(rng.integers(SIDE_PX - w)), int(rng.integers(SIDE_PX - h))
        _shift(image, slice(y, y + h), slice(x, x + w), rng.normal(0.0, spread))
        if rng.random() < 0.6:
            grey = int(np.clip(image[y, x] + rng.choice((-1, -1, -1, 1)) * rng.uniform(10, 45), 0, 255))
            cv2.rectangle(image, (x, y), (x + w, y + h), grey, int(rng.integers(1, 4)))


def _smooth_floor(rng: Rng) -> Tile:
    """Plastic, painted floor, linoleum, cardboard: almost uniform."""
    dark = rng.random() < 0.45
    image = _plain(_log_uniform(rng, 8, 60) if dark else rng.uniform(60, 190))
    noise.add(image, noise.fractal(1.4, noise.variant(rng)), _log_uniform(rng, 0.8, 9), rng)
    if rng.random() < 0.5:
        noise.add(image, noise.band(128.0, 1.0, noise.variant(rng)), _log_uniform(rng, 0.8, 7), rng)
    if rng.random() < 0.3:
        noise.add(image, noise.band(64.0, 20.0, noise.variant(rng)), _log_uniform(rng, 0.8, 5), rng)
    if rng.random() < 0.3:
        _joints(image, int(rng.integers(0, 3)), int(rng.integers(1, 3)), int(rng.integers(1, 3)), rng.normal(-8, 25))
    _wear(image, rng, 0.4 if dark else 1.0)
    return Tile(image=image, size_lanes=rng.uniform(1.5, 8.0))


def _planks(rng: Rng) -> Tile:
    """Boards with grain, each of its own tone, and joints along and between them."""
    count = int(rng.integers(3, 15))
    image = _plain(rng.uniform(45, 200))
    _add_signed(image, _grid(count, 1, rng.uniform(2, 16), rng))
    noise.add(image, noise.band(64.0, 20.0, noise.variant(rng)), _log_uniform(rng, 2, 14), rng)
    noise.add(image, noise.band(16.0, 6.0, noise.variant(rng)), _log_uniform(rng, 1, 10), rng)
    change, width = rng.uniform(-60, -5), int(rng.integers(1, 3))
    _joints(image, count, 0, width, change)
    for i, y in enumerate(_edges(count)):
        bottom = round((i + 1) * SIDE_PX / count)
        start = int(rng.integers(SIDE_PX // 2))
        stop = int(start + rng.integers(100, SIDE_PX // 2))
        _shift(image, slice(y, bottom), slice(start, stop), rng.normal(0, 8))
        _shift(image, slice(y, bottom), slice(start, start + width), change)
        _shift(image, slice(y, bottom), slice(stop, stop + width), change)
    _wear(image, rng, 0.6)
    return Tile(image=image, size_lanes=count * _log_uniform(rng, 0.12, 0.6))


def _tiles(rng: Rng) -> Tile:
    """Ceramic or carpet squares, plain or chequered, with light or dark joints."""
    count = int(rng.choice((2, 4, 6, 8)))
    image = _plain(rng.uniform(30, 205))
    noise.add(image, noise.fractal(1.4, noise.variant(rng)), _log_uniform(rng, 1, 12), rng)
    noise.add(image, noise.band(128.0, 1.0, noise.variant(rng)), _log_uniform(rng, 0.8, 8), rng)
    layer = _grid(count, count, rng.uniform(0, 12), rng)
    if rng.random() < 0.2:
        rows, columns = np.indices((count, count))
        chequer = np.where((rows + columns) % 2, 128.0 + rng.uniform(8, 60), 128.0 - rng.uniform(0, 60))
        layer = np.asarray(
            cv2.resize(chequer.astype(np.uint8), (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_NEAREST), dtype=np.uint8
        )
    _add_signed(image, layer)
    _joints(image, count, count, int(rng.integers(1, 4)), rng.choice((-1, -1, 1)) * rng.uniform(8, 55))
    _wear(image, rng, 0.6)
    return Tile(image=image, size_lanes=count * _log_uniform(rng, 0.25, 1.2))


def _carpet(rng: Rng) -> Tile:
    """Carpet: strong fine noise, sometimes with ribs or a pattern."""
    image = _plain(rng.uniform(25, 170))
    noise.add(image, noise.band(220.0, 1.0, noise.variant(rng)), _log_uniform(rng, 4, 22), rng)
    noise.add(image, noise.band(64.0, 1.0, noise.variant(rng)), _log_uniform(rng, 1, 12), rng)
    if rng.random() < 0.4:
        noise.add(image, noise.band(128.0, 20.0, noise.variant(rng)), _log_uniform(rng, 3, 14), rng)
    if rng.random() < 0.15:
        noise.add_mask(image, noise.leaves(noise.variant(rng)), rng.normal(0, 14), rng)
    _wear(image, rng, 0.5)
    return Tile(image=image, size_lanes=_log_uniform(rng, 0.8, 4.0))


def _concrete(rng: Rng) -> Tile:
    """Concrete slabs with seams, stains and patches, from the floor of a hall to a motorway."""
    image = _plain(rng.uniform(70, 195))
    noise.add(image, noise.fractal(1.4, noise.variant(rng)), rng.uniform(3, 13), rng)
    noise.add(image, noise.band(128.0, 1.0, noise.variant(rng)), rng.uniform(1, 9), rng)
    if rng.random() < 0.4:  # brushed across or worn along
        noise.add(image, noise.band(64.0, 20.0, noise.variant(rng)), rng.uniform(1, 9), rng)
    rows, columns = int(rng.integers(0, 5)), int(rng.integers(0, 3))
    if rows + columns:
        _add_signed(image, _grid(max(rows, 1), max(columns, 1), rng.uniform(0, 9), rng))
        change = rng.choice((-1, -1, -1, 1)) * rng.uniform(8, 60)
        _joints(image, rows, columns, int(rng.integers(1, 4)), change)
    if rng.random() < 0.3:
        _patches(image, rng, 14.0)
    if rng.random() < 0.3:
        noise.add_mask(image, noise.cracks(8, 1, 0.35, noise.variant(rng)), -rng.uniform(10, 70), rng)
    _wear(image, rng, 1.0)
    return Tile(image=image, size_lanes=_log_uniform(rng, 1.5, 9.0))


def _asphalt(rng: Rng) -> Tile:
    """Asphalt, from new and fine to old and coarse with cracks, tar seams and patches."""
    image = _plain(rng.uniform(35, 140))
    noise.add(image, noise.band(220.0, 1.0, noise.variant(rng)), _log_uniform(rng, 2, 20), rng)
    noise.add(image, noise.band(64.0, 1.0, noise.variant(rng)), _log_uniform(rng, 1, 9), rng)
    noise.add(image, noise.fractal(1.4, noise.variant(rng)), rng.uniform(1, 10), rng)
    age = rng.random()
    if age > 0.35:
        noise.add_mask(image, noise.specks(8.0, noise.variant(rng)), rng.normal(10, 35), rng)
    if age > 0.45 and rng.random() < 0.5:
        _patches(image, rng, 16.0)
    if age > 0.6:
        noise.add_mask(image, noise.cracks(24, 1, 0.4, noise.variant(rng)), -rng.uniform(8, 60), rng)
    if age > 0.6 and rng.random() < 0.5:
        seams = noise.cracks(6, int(rng.integers(2, 5)), 0.15, noise.variant(rng))
        noise.add_mask(image, seams, rng.choice((-1, -1, 1)) * rng.uniform(12, 50), rng)
    if age > 0.4 and rng.random() < 0.4:  # the paver's seam
        change = rng.choice((-1, -1, 1)) * rng.uniform(10, 40)
        _joints(image, 1, int(rng.integers(0, 2)), int(rng.integers(1, 4)), change)
    _wear(image, rng, 0.8)
    return Tile(image=image, size_lanes=_log_uniform(rng, 1.0, 7.0))


def _brick(rng: Rng) -> Tile:
    """Paving stones, in line or in running bond."""
    rows = 2 * int(rng.integers(3, 11))
    columns = max(2, rows // int(rng.integers(1, 4)))
    image = _plain(rng.uniform(50, 185))
    noise.add(image, noise.band(128.0, 1.0, noise.variant(rng)), _log_uniform(rng, 1, 12), rng)
    noise.add(image, noise.fractal(1.4, noise.variant(rng)), rng.uniform(1, 9), rng)
    layer = _grid(rows, columns, rng.uniform(3, 20), rng).copy()
    change = rng.choice((-1, -1, 1)) * rng.uniform(8, 60)
    joints = np.full_like(layer, int(noise.MIDDLE))
    _joints(joints, rows, columns, int(rng.integers(1, 4)), change)
    _add_signed(layer, joints)
    if rng.random() < 0.7:
        half = SIDE_PX // columns // 2
        for y in _edges(rows)[::2]:
            band = slice(y, y + SIDE_PX // rows)
            layer[band] = np.roll(layer[band], half, axis=1)
    _add_signed(image, layer)
    _wear(image, rng, 0.8)
    return Tile(image=image, size_lanes=rows * _log_uniform(rng, 0.03, 0.3))


def _grass(rng: Rng) -> Tile:
    """Blades, clumps, bare spots; dry and bright or lush and dark."""
    image = _plain(rng.uniform(45, 185))
    noise.add(image, noise.band(128.0, 1.0, noise.variant(rng)), rng.uniform(6, 26), rng)
    noise.add(image, noise.band(32.0, 1.0, noise.variant(rng)), rng.uniform(3, 16), rng)
    noise.add(image, noise.fractal(1.4, noise.variant(rng)), rng.uniform(3, 20), rng)
    if rng.random() < 0.3:
        noise.add_mask(image, noise.specks(3.0, noise.variant(rng)), rng.uniform(20, 110), rng)
    return Tile(image=image, size_lanes=_log_uniform(rng, 0.8, 4.0))


def _gravel(rng: Rng) -> Tile:
    """Loose stones."""
    image = _plain(rng.uniform(60, 180))
    noise.add(image, noise.band(rng.choice((64.0, 128.0)), 1.0, noise.variant(rng)), rng.uniform(10, 32), rng)
    noise.add_mask(image, noise.specks(8.0, noise.variant(rng)), rng.uniform(-40, 90), rng)
    noise.add(image, noise.fractal(1.4, noise.variant(rng)), rng.uniform(2, 12), rng)
    return Tile(image=image, size_lanes=_log_uniform(rng, 0.6, 3.0))


def _soil(rng: Rng) -> Tile:
    """Bare earth or sand with tracks in it."""
    image = _plain(rng.uniform(50, 190))
    noise.add(image, noise.fractal(1.4, noise.variant(rng)), rng.uniform(5, 18), rng)
    noise.add(image, noise.band(64.0, 1.0, noise.variant(rng)), rng.uniform(3, 14), rng)
    noise.add(image, noise.band(16.0, 20.0, noise.variant(rng)), rng.uniform(0.5, 12), rng)
    return Tile(image=image, size_lanes=_log_uniform(rng, 1.0, 6.0))


_FLOORS: tuple[tuple[Callable[[Rng], Tile], float], ...] = (
    (_smooth_floor, 3.5),
    (_planks, 1.0),
    (_tiles, 1.2),
    (_carpet, 0.9),
    (_concrete, 3.0),
    (_asphalt, 3.2),
    (_brick, 0.7),
)
