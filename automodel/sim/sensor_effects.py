"""What lens and sensor do to a picture: blur, vignetting, exposure, noise."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.sim.appearance import Appearance
from automodel.types import Image

Float32Array = NDArray[np.float32]

POOL_MARGIN = (251, 509)  # rows and columns by which noise is shifted from picture to picture


def mixed(*numbers: int) -> int:
    """A well mixed 64-bit number from others (the finaliser of splitmix64)."""
    state = 0
    for number in numbers:
        state = (state + number + 0x9E3779B97F4A7C15) & 0xFFFFFFFFFFFFFFFF
        state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & 0xFFFFFFFFFFFFFFFF
        state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) & 0xFFFFFFFFFFFFFFFF
        state ^= state >> 31
    return state


def exposure(look: Appearance, index: int) -> float:
    """Factor on everything in picture `index`: it jumps every `exposure_hold_frames` pictures."""
    if not look.exposure_step:
        return 1.0
    draw = mixed(look.exposure_seed, index // look.exposure_hold_frames) / 2.0**64
    return 1.0 + look.exposure_step * (2.0 * draw - 1.0)


def blur_kernel(sigma_px: float, smear_px: float) -> Float32Array:
    """Gaussian of `sigma_px` convolved with a box `smear_px` long, both sampled over pixels; odd length, sum 1."""
    sigma = math.hypot(sigma_px, 0.05)
    reach = math.ceil(3.0 * sigma_px + 0.5 * smear_px)
    borders = np.arange(-reach, reach + 2) - 0.5
    if smear_px < 1e-3:
        rising = np.array([0.5 * (1.0 + math.erf(b / (sigma * math.sqrt(2.0)))) for b in borders])
    else:
        rising = np.array([_ramp(b + 0.5 * smear_px, sigma) - _ramp(b - 0.5 * smear_px, sigma) for b in borders])
    kernel = np.diff(rising)
    return (kernel / kernel.sum()).astype(np.float32)


def _ramp(x: float, sigma: float) -> float:
    """The integral of the normal distribution's distribution function."""
    z = x / sigma
    density = math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    return x * 0.5 * (1.0 + math.erf(z / math.sqrt(2.0))) + sigma * density


class SensorEffects:
    """Applies lens and sensor of an appearance to pictures (h, w[, 3]) of one size."""

    def __init__(self, look: Appearance, shape: tuple[int, int], focal_px: float, channels: int) -> None:
        self._look, self._shape, self._focal_px, self._channels = look, shape, focal_px, channels
        self._vignette = self._vignette_factors(shape) if look.vignetting else None
        self._pool: Float32Array | None = None
        if look.read_noise or look.shot_noise:
            rng = np.random.default_rng(look.noise_seed)
            size = (shape[0] + POOL_MARGIN[0], shape[1] + POOL_MARGIN[1], channels)
            self._pool = rng.standard_normal(size, dtype=np.float32)
        levels = np.arange(256.0)
        self._sigma = np.sqrt(look.read_noise**2 + look.shot_noise * levels).astype(np.float32)

    def apply(self, picture: Image, yaw_rate_radps: float, index: int) -> Image:
        """The picture as it leaves the sensor."""
        seen: NDArray[Any] = picture
        if self._vignette is not None:
            seen = cv2.multiply(seen, self._vignette, scale=1.0 / 255.0)
        smear_px = abs(yaw_rate_radps) * self._look.exposure_s * self._focal_px
        if self._look.defocus_px > 0.0 or smear_px > 0.05:
            across, down = blur_kernel(self._look.defocus_px, smear_px), blur_kernel(self._look.defocus_px, 0.0)
            seen = cv2.sepFilter2D(seen, cv2.CV_8U, across, down, borderType=cv2.BORDER_REPLICATE)
        if self._pool is not None:
            noise: NDArray[Any] = self._noise(self._pool, index)
            seen = cv2.add(seen, cv2.multiply(noise, cv2.LUT(seen, self._sigma)), dtype=cv2.CV_8U)
        return np.asarray(seen, dtype=np.uint8)

    def _noise(self, pool: Float32Array, index: int) -> Float32Array:
        """Normal noise (h, w[, 3]) of unit variance for picture `index`: a part of the pool."""
        draw = mixed(self._look.noise_seed, index)
        row, column = draw % POOL_MARGIN[0], (draw >> 16) % POOL_MARGIN[1]
        part = pool[row : row + self._shape[0], column : column + self._shape[1]]
        return part[..., 0] if self._channels == 1 else part

    def _vignette_factors(self, shape: tuple[int, int]) -> Image:
        height, width = shape
        v, u = np.mgrid[0:height, 0:width]
        middle_u, middle_v = 0.5 * (width - 1), 0.5 * (height - 1)
        radius2 = ((u - middle_u) ** 2 + (v - middle_v) ** 2) / (middle_u**2 + middle_v**2)
        factor = np.round(255.0 * (1.0 - self._look.vignetting * radius2)).astype(np.uint8)
        return factor if self._channels == 1 else np.repeat(factor[..., None], self._channels, axis=2)
