"""Augmentation: random effects of lens, exposure, sensor and compression on an image."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.training import noise
from automodel.types import FloatArray, Image

Rng = np.random.Generator
_LEVELS: FloatArray = np.arange(256, dtype=np.float64)


def augment(image: Image, rng: Rng, metered: Image | None = None) -> Image:
    """An image (h, w) uint8 with random camera effects; the input is not changed.

    About one image in seven stays almost clean. The exposure is metered on `metered` (h, w) if given: two versions of a
    scene with the same `metered` and generator state get the same tones.
    """
    if rng.random() < 0.12:
        return _noise(image, rng, 2.0)
    out = _lens(image, rng)
    out = _tone(out, image if metered is None else metered, rng)
    height, width = image.shape
    small = rng.random() < 0.35
    if small:
        out = _sampled(out, rng)
    out = _sensor(out, rng)
    if small:
        method = int(rng.choice((cv2.INTER_LINEAR, cv2.INTER_LINEAR, cv2.INTER_CUBIC, cv2.INTER_NEAREST)))
        out = _as_grey(cv2.resize(out, (width, height), interpolation=method))
    return out


def _as_grey(image: object) -> Image:
    return np.asarray(image, dtype=np.uint8)


def _lens(image: Image, rng: Rng) -> Image:
    """Haze, drops and dirt in front of the lens; then bloom, defocus, motion blur and vignetting."""
    out = image
    if rng.random() < 0.1:
        out = _haze(out, rng)
    if rng.random() < 0.1:
        out = _spots_on_glass(out, rng)
    if rng.random() < 0.2:
        out = _bloom(out, rng)
    if rng.random() < 0.35:
        out = _as_grey(cv2.GaussianBlur(out, (0, 0), float(np.exp(rng.uniform(math.log(0.4), math.log(2.2))))))
    if rng.random() < 0.3:
        out = motion(out, rng)
    if rng.random() < 0.3:
        out = _vignette(out, rng)
    return out


def _haze(image: Image, rng: Rng) -> Image:
    """Fog or stray light, strongest at a random height of the image."""
    height = image.shape[0]
    rows = (np.arange(height) / height - rng.uniform(0.2, 0.6)) / rng.uniform(0.1, 0.6)
    thickness = (rng.uniform(0.1, 0.6) * np.exp(-rows * rows)).astype(np.float32)[:, None]
    veil = rng.uniform(70, 220)
    return _as_grey(image * (1.0 - thickness) + veil * thickness)


def _spots_on_glass(image: Image, rng: Rng) -> Image:
    """Drops of water (another part of the image, blurred) or dirt on the glass."""
    height, width = image.shape
    mask = np.zeros_like(image)
    wet = rng.random() < 0.5
    for _ in range(int(rng.integers(2, 30))):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        axes = tuple(int(v) for v in rng.uniform(2, 16 if wet else 24, 2))
        cv2.ellipse(mask, centre, axes, rng.uniform(0, 180), 0, 360, int(rng.integers(60, 230)), -1)
    mask = _as_grey(cv2.blur(mask, (5, 5)))
    if wet:
        shifted = np.roll(image, (int(rng.integers(-40, 40)), int(rng.integers(-40, 40))), axis=(0, 1))
        behind = cv2.blur(shifted[::-1], (9, 9)).astype(np.float32)
    else:
        behind = np.full(image.shape, rng.uniform(0, 200), dtype=np.float32)
    weight = mask.astype(np.float32) / 255.0
    return _as_grey(image + weight * (behind - image))


def _bloom(image: Image, rng: Rng) -> Image:
    """Bright spots spread into their surroundings."""
    height, width = image.shape
    quarter = cv2.resize(image, (width // 4, height // 4), interpolation=cv2.INTER_AREA)
    over = cv2.subtract(quarter, np.full_like(quarter, int(rng.integers(150, 230))))
    sigma = rng.uniform(1.0, 6.0)
    halo = cv2.GaussianBlur(over.astype(np.float32), (0, 0), sigma, sigmaY=sigma * rng.uniform(0.5, 3.0))
    halo = cv2.resize(halo * rng.uniform(0.5, 4.0), (width, height))
    return _as_grey(cv2.add(image, np.clip(halo, 0, 255).astype(np.uint8)))


def motion(image: Image, rng: Rng) -> Image:
    """Blur along one direction, or radially from the vanishing point as when driving."""
    length = int(rng.integers(3, 16)) if rng.random() < 0.75 else int(rng.integers(12, 29))
    if rng.random() < 0.35:
        return _zoomed(image, rng, length)
    angle = rng.choice((0.0, math.pi / 2, rng.uniform(0, math.pi)))
    kernel = np.zeros((length, length), dtype=np.float32)
    middle = (length - 1) / 2.0
    dx, dy = middle * math.cos(angle), middle * math.sin(angle)
    ends = [(round((middle + s * dx) * 16), round((middle + s * dy) * 16)) for s in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0, 1, cv2.LINE_8, 4)
    return _as_grey(cv2.filter2D(image, -1, kernel / kernel.sum()))


def _zoomed(image: Image, rng: Rng, length: int) -> Image:
    """The mean of the image at several scales about the vanishing point."""
    height, width = image.shape
    u, v = width * rng.uniform(0.3, 0.7), height * rng.uniform(0.1, 0.5)
    step = length / width
    out = _scaled(image, 1.0 - 1.5 * step, (u, v))
    for scale in (1.0 + step, 1.0 + 2.0 * step):  # each doubles the number of exposures
        out = _as_grey(cv2.addWeighted(out, 0.5, _scaled(out, scale, (u, v)), 0.5, 0.0))
    return out


def _scaled(image: Image, scale: float, about: tuple[float, float]) -> Image:
    height, width = image.shape
    matrix = np.array([[scale, 0.0, about[0] * (1.0 - scale)], [0.0, scale, about[1] * (1.0 - scale)]])
    return _as_grey(cv2.warpAffine(image, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE))


def _vignette(image: Image, rng: Rng) -> Image:
    height, width = image.shape
    u = np.linspace(-1.0, 1.0, width) + rng.normal(0, 0.1)
    v = np.linspace(-1.0, 1.0, height) + rng.normal(0, 0.1)
    fall = rng.uniform(0.1, 0.45)
    gain = np.maximum(1.0 - fall * (u * u)[None, :] - fall * (v * v)[:, None], 0.05).astype(np.float32)
    return _as_grey(image * gain)


def _tone(image: Image, metered: Image, rng: Rng) -> Image:
    """Exposure, gamma, contrast and quantisation in one table of 256 levels."""
    middle, high = np.percentile(metered[metered.shape[0] // 2 :: 6, ::6], (50, 97))  # the ground, then its paint
    levels = _LEVELS
    if rng.random() < 0.6:
        target = math.exp(rng.normal(math.log(90.0), 0.35))  # the exposure control aims at a middle grey
        levels = levels * (target / max(middle, 4.0)) ** rng.uniform(0.3, 0.8) * math.exp(rng.normal(0.0, 0.3))
    if rng.random() < 0.35:
        levels = 255.0 * (np.clip(levels, 0, 255) / 255.0) ** math.exp(rng.normal(0.0, 0.3))
    if rng.random() < 0.35:
        contrast = math.exp(rng.normal(0.0, 0.25))
        pivot = rng.uniform(60, 170)
        levels = pivot + contrast * (levels - pivot)
    if rng.random() < 0.25:  # a raised black level
        lift = rng.uniform(0, 50)
        levels = lift + levels * (255.0 - lift) / 255.0
    if rng.random() < 0.15:  # the shoulder and toe of a film-like curve
        x = np.clip(levels, 0, 255) / 255.0
        levels = 255.0 * x * x * (3.0 - 2.0 * x)
    if rng.random() < 0.05:
        step = float(rng.integers(3, 12))
        levels = np.round(levels / step) * step
    out = cv2.LUT(image, _legible(levels, float(middle), float(high)).astype(np.uint8))
    if rng.random() < 0.06:
        out = _levelled(_as_grey(out), rng)
    return _as_grey(out)


def _legible(levels: FloatArray, middle: float, high: float) -> FloatArray:
    """A table (256,) clipped to 0..255, and moderated where it would saturate the contrast of the paint."""
    at = (round(middle), round(high))
    if levels[at[0]] > 205.0:
        levels = levels * (205.0 / levels[at[0]])
    levels = np.clip(levels, 0.0, 255.0)
    if levels[at[1]] - levels[at[0]] < 0.4 * (high - middle):
        levels = 0.5 * (levels + _LEVELS)
    return levels


def _levelled(image: Image, rng: Rng) -> Image:
    """Local contrast equalisation (CLAHE), as in some cameras."""
    return _as_grey(cv2.createCLAHE(rng.uniform(1.0, 4.0), (4, 4)).apply(image))


def _sampled(image: Image, rng: Rng) -> Image:
    """The image of a smaller sensor, with or without aliasing."""
    height, width = image.shape
    scale = rng.uniform(0.31, 0.9)
    size = (max(8, round(width * scale)), max(8, round(height * min(1.0, scale * rng.uniform(1.0, 1.5)))))
    method = int(rng.choice((cv2.INTER_AREA, cv2.INTER_AREA, cv2.INTER_LINEAR, cv2.INTER_NEAREST)))
    return _as_grey(cv2.resize(image, size, interpolation=method))


def _sensor(image: Image, rng: Rng) -> Image:
    """Interlacing, noise and bands of the sensor; then sharpening and JPEG compression."""
    out = image
    if rng.random() < 0.07:
        out = _interlaced(out, rng)
    if rng.random() < 0.55:
        out = _noise(out, rng, float(np.exp(rng.uniform(math.log(0.8), math.log(10.0)))))
    if rng.random() < 0.08:
        out = _bands(out, rng)
    if rng.random() < 0.3:
        out = _sharpened(out, rng)
    if rng.random() < 0.45:
        out = _compressed(out, rng)
    return out


def _noise(image: Image, rng: Rng, strength: float) -> Image:
    """Read and shot noise [grey levels], fine or smoothed by the camera's filter."""
    height, width = image.shape
    bank = noise.white(int(rng.integers(2)))
    if height > bank.shape[0] or width > bank.shape[1]:
        bank = np.tile(bank, (-(-height // bank.shape[0]) + 1, -(-width // bank.shape[1]) + 1))
    y, x = int(rng.integers(bank.shape[0] - height + 1)), int(rng.integers(bank.shape[1] - width + 1))
    grain: NDArray[np.float32] = bank[y : y + height, x : x + width]
    if rng.random() < 0.3:
        grain = np.asarray(cv2.blur(grain, (2, 2)), dtype=np.float32) * 1.6
    shot = rng.uniform(0.0, 1.0)
    sigma = strength * np.sqrt((1.0 - shot) + shot * _LEVELS / 128.0)
    amplitude = cv2.LUT(image, sigma.astype(np.float32))
    noisy = cv2.multiply(grain, amplitude)
    return _as_grey(cv2.add(image, noisy, dtype=cv2.CV_8U))


def _interlaced(image: Image, rng: Rng) -> Image:
    """Every other row from a later field, while the car turns."""
    out, shift = image.copy(), int(rng.integers(-5, 6))
    out[0::2] = np.roll(out[0::2], -(shift // 2), axis=1)
    out[1::2] = np.roll(out[1::2], shift - shift // 2, axis=1)
    return out


def _bands(image: Image, rng: Rng) -> Image:
    """Stripes from mains flicker with a rolling shutter, or from row noise."""
    height = image.shape[0]
    if rng.random() < 0.5:
        gain = 1.0 + rng.uniform(0.03, 0.2) * np.sin(
            np.arange(height) / height * rng.uniform(6, 60) + rng.uniform(0, 6)
        )
    else:
        gain = 1.0 + rng.normal(0.0, 0.03, height)
    return _as_grey(np.clip(image * gain[:, None].astype(np.float32), 0, 255))


def _sharpened(image: Image, rng: Rng) -> Image:
    amount = rng.uniform(0.3, 1.5)
    soft = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.7, 2.0))
    return _as_grey(cv2.addWeighted(image, 1.0 + amount, soft, -amount, 0.0))


def _compressed(image: Image, rng: Rng) -> Image:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(15, 96))])
    return _as_grey(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE))
