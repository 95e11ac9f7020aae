"""Layers of periodic noise and marks, created once per process from fixed seeds and cropped at random.

Every layer is a periodic image (512, 512) repeated 2 x 2, so that any crop up to (512, 512) is a view. Signed layers
have the mean `MIDDLE` and the standard deviation `SPREAD`; masks are 0 (nothing) to 255.
"""

from __future__ import annotations

import math
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.types import Image

SIDE_PX = 512
MIDDLE = 128.0
SPREAD = 40.0
VARIANTS = 3


def _repeated(tile: NDArray[np.generic]) -> Image:
    layer = np.tile(np.clip(np.rint(tile), 0, 255).astype(np.uint8), (2, 2))
    layer.setflags(write=False)
    return layer


def _filtered(amplitude: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Periodic noise with an amplitude spectrum (512, 257); zero mean, unit standard deviation."""
    white = np.random.default_rng(seed).standard_normal((SIDE_PX, SIDE_PX))
    amplitude[0, 0] = 0.0
    shaped: NDArray[np.float64] = np.fft.irfft2(np.fft.rfft2(white) * amplitude, s=(SIDE_PX, SIDE_PX))
    return shaped / shaped.std()


def _frequencies(stretch: float) -> NDArray[np.float64]:
    """Cycles per tile (512, 257) of each term of the spectrum, multiplied by `stretch` along the rows."""
    fx, fy = np.fft.rfftfreq(SIDE_PX, 1.0 / SIDE_PX), np.fft.fftfreq(SIDE_PX, 1.0 / SIDE_PX)
    return np.maximum(np.hypot(fx[None, :] * stretch, fy[:, None]), 1e-6)


@cache
def band(cycles: float, stretch: float = 1.0, variant: int = 0) -> Image:
    """Signed noise with about `cycles` waves per tile, stretched by `stretch` along the rows."""
    octaves = np.log2(_frequencies(stretch) / cycles)
    return _repeated(MIDDLE + SPREAD * _filtered(np.exp(-((octaves / 0.8) ** 2)), 1000 + variant))


@cache
def fractal(slope: float = 1.4, variant: int = 0) -> Image:
    """Signed noise whose amplitude falls with frequency to the power `slope`: clouds, dirt, uneven paint."""
    return _repeated(MIDDLE + SPREAD * _filtered(_frequencies(1.0) ** -slope, 2000 + variant))


@cache
def stains(variant: int = 0) -> Image:
    """A mask of soft blobs that cover about a sixth of the tile."""
    return _repeated(110.0 * (_filtered(_frequencies(1.0) ** -1.8, 3000 + variant) - 0.9))


@cache
def leaves(variant: int = 0) -> Image:
    """A mask of hard-edged blobs of many sizes that cover half of the tile: foliage, dappled light."""
    octaves = np.log2(_frequencies(1.0) / 20.0)
    amplitude = np.exp(-((octaves / 1.6) ** 2)) * _frequencies(1.0) ** -0.5
    return _repeated(128.0 + 190.0 * _filtered(amplitude, 4000 + variant))


@cache
def specks(percent: float, variant: int = 0) -> Image:
    """A mask of small bright dots that cover about `percent` of the tile: stones, dust, litter."""
    rng = np.random.default_rng(5000 + variant)
    dots = (rng.random((SIDE_PX, SIDE_PX)) < percent / 400.0).astype(np.float32)
    dots *= rng.uniform(0.3, 1.0, dots.shape).astype(np.float32)
    wide = cv2.copyMakeBorder(dots, 4, 4, 4, 4, cv2.BORDER_WRAP)
    return _repeated(255.0 * 2.4 * cv2.GaussianBlur(wide, (0, 0), 0.8)[4:-4, 4:-4])


@cache
def white(variant: int = 0) -> NDArray[np.float32]:
    """Independent normal noise (1024, 1024) float32, for the sensor."""
    noise = np.random.default_rng(6000 + variant).standard_normal((2 * SIDE_PX, 2 * SIDE_PX)).astype(np.float32)
    noise.setflags(write=False)
    return noise


def _walk(rng: np.random.Generator, steps: int, step_px: float, wander_rad: float) -> NDArray[np.float64]:
    heading = rng.uniform(0.0, 2.0 * math.pi) + np.cumsum(rng.normal(0.0, wander_rad, steps))
    start = rng.uniform(0.0, SIDE_PX, 2)
    return start + np.cumsum(step_px * np.column_stack((np.cos(heading), np.sin(heading))), axis=0)


def _draw_wrapped(mask: Image, path: NDArray[np.float64], grey: int, width_px: int) -> None:
    """Draw a path of pixels (n, 2) on a periodic tile."""
    low = np.floor(path.min(axis=0) / SIDE_PX).astype(int)
    high = np.floor(path.max(axis=0) / SIDE_PX).astype(int)
    for i in range(low[0] - 1, high[0] + 2):
        for j in range(low[1] - 1, high[1] + 2):
            moved = np.rint((path - (i * SIDE_PX, j * SIDE_PX)) * 16.0).astype(np.int32)
            cv2.polylines(mask, [moved], False, grey, width_px, cv2.LINE_AA, 4)


@cache
def cracks(paths: int, width_px: int, wander_rad: float, variant: int = 0) -> Image:
    """A mask of random lines: cracks (much `wander_rad`), tar seams (some), skid marks and scratches (little)."""
    rng = np.random.default_rng(7000 + variant)
    mask = np.zeros((SIDE_PX, SIDE_PX), dtype=np.uint8)
    for _ in range(paths):
        walk = _walk(rng, int(rng.integers(20, 90)), rng.uniform(4.0, 9.0), wander_rad)
        _draw_wrapped(mask, walk, int(rng.integers(90, 256)), width_px)
    wide = cv2.copyMakeBorder(mask, 4, 4, 4, 4, cv2.BORDER_WRAP)
    return _repeated(cv2.GaussianBlur(wide, (0, 0), 0.6)[4:-4, 4:-4])


def variant(rng: np.random.Generator) -> int:
    """The number of a random variant of a layer."""
    return int(rng.integers(VARIANTS))


def crop(layer: Image, rng: np.random.Generator, height_px: int = SIDE_PX, width_px: int = SIDE_PX) -> Image:
    """A random crop (height, width) of a layer, which is enlarged if it is too small."""
    if max(height_px, width_px) > SIDE_PX:
        small = crop(layer, rng)
        return np.asarray(cv2.resize(small, (width_px, height_px), interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
    y, x = int(rng.integers(SIDE_PX)), int(rng.integers(SIDE_PX))
    return layer[y : y + height_px, x : x + width_px]


def add(image: Image, layer: Image, spread: float, rng: np.random.Generator) -> None:
    """Add a random crop of a signed layer in place, scaled to a standard deviation of `spread` grey levels."""
    part = crop(layer, rng, *image.shape[:2])
    cv2.addWeighted(image, 1.0, part, spread / SPREAD, -MIDDLE * spread / SPREAD, dst=image)


def add_mask(image: Image, layer: Image, change: float, rng: np.random.Generator) -> None:
    """Add `change` grey levels in place, in proportion to a random crop of a mask."""
    cv2.addWeighted(image, 1.0, crop(layer, rng, *image.shape[:2]), change / 255.0, 0.0, dst=image)
