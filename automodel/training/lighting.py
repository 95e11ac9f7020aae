"""Light on the ground: shadows, patches of sun, reflections, headlamps."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.geometry import GroundCamera
from automodel.training import noise
from automodel.types import FloatArray, FloatImage, Image

Rng = np.random.Generator


def light(image: FloatImage, camera: GroundCamera, rng: Rng) -> None:
    """Apply random light to the ground in an image (h, w) float32 of grey 0..255, in place; lengths in lane widths."""
    if rng.random() < 0.4:
        _gradient(image, rng)
    if rng.random() < 0.28:
        _patterns(image, camera, rng)
    if rng.random() < 0.11:
        _dapples(image, camera, rng)
    if rng.random() < 0.14:
        _soft_shadows(image, rng)
    if rng.random() < 0.07:
        _headlamps(image, camera, rng)
    if rng.random() < 0.26:
        reflections(image, rng)
    if rng.random() < 0.08:
        ceiling_lamps(image, camera, rng)
    np.clip(image, 0.0, 255.0, out=image)


def _gradient(image: FloatImage, rng: Rng) -> None:
    """A brightness gradient along and across the image."""
    height, width = image.shape
    along = np.exp(rng.normal(0.0, 0.25) * np.linspace(-1, 1, height))
    across = np.exp(rng.normal(0.0, 0.2) * np.linspace(-1, 1, width))
    image *= along.astype(np.float32)[:, None]
    image *= across.astype(np.float32)[None, :]


def _scale(image: FloatImage, mask: Image, gain: float) -> None:
    """Multiply by `gain` where the mask is 255, by 1 where it is 0."""
    table = (1.0 + (gain - 1.0) * np.arange(256) / 255.0).astype(np.float32)
    cv2.multiply(image, cv2.LUT(mask, table), dst=image)


def _outlines(camera: GroundCamera, quads: FloatArray) -> list[NDArray[np.int32]]:
    """Ground quads (n, 4, 2) as polygons [1/16 px] with edges sampled for lens distortion."""
    steps = np.linspace(0.0, 1.0, 10, endpoint=False)[:, None]
    after = np.roll(quads, -1, axis=1)
    edges = quads[:, :, None, :] * (1.0 - steps) + after[:, :, None, :] * steps
    pixels = camera.ground_to_px(edges.reshape(len(quads), -1, 2))
    found = [p[np.isfinite(p).all(axis=1)] for p in pixels]
    return [np.rint(np.clip(p, -4000, 4000) * 16).astype(np.int32) for p in found if len(p) >= 3]


def _patterns(image: FloatImage, camera: GroundCamera, rng: Rng) -> None:
    """Hard or soft shapes on the ground, darker or brighter than their surroundings."""
    kind = rng.random()
    if kind < 0.4:
        quads = _stripes(rng)
    elif kind < 0.7:
        quads = _window_panes(rng)
    elif kind < 0.85:
        quads = _big_shade(rng)
    else:
        quads = _own_shadow(camera, rng)
    mask = np.zeros(image.shape, dtype=np.uint8)
    for outline in _outlines(camera, quads):
        cv2.fillPoly(mask, [outline], 255, cv2.LINE_AA, 4)
    if rng.random() < 0.6:
        mask = np.asarray(cv2.GaussianBlur(mask, (0, 0), rng.uniform(0.6, 4.0)), dtype=np.uint8)
    if kind < 0.7 and rng.random() < 0.55:
        room = max(1.25, 225.0 / max(float(image[image.shape[0] // 2 :: 8, ::8].mean()), 20.0))
        _scale(image, mask, min(rng.uniform(1.2, 3.5), room))
    elif kind < 0.7 and rng.random() < 0.3:  # light between shadows
        _scale(image, np.bitwise_not(mask), rng.uniform(0.25, 0.8))
    else:
        _scale(image, mask, rng.uniform(0.2, 0.8))


def _stripes(rng: Rng) -> FloatArray:
    """Shadows of poles, trunks or rails at any angle, or the light between them. Ground quads (n, 4, 2)."""
    count = int(rng.integers(1, 12))
    angle = rng.choice((math.pi / 2, rng.uniform(0, math.pi)))
    spacing = rng.uniform(0.2, 1.6)
    at = np.cumsum(rng.uniform(0.4, 1.6, count)) * spacing
    width = rng.uniform(0.03, 0.3) * rng.uniform(0.6, 1.6, count)
    turn = angle + rng.normal(0.0, 0.06, count)
    along = np.stack((np.cos(turn), np.sin(turn)), axis=1)
    normal = np.stack((np.sin(turn), -np.cos(turn)), axis=1)
    centre = np.stack((rng.uniform(0.4, 2.0) + at * abs(math.sin(angle)), at * math.cos(angle)), axis=1)
    centre[:, 1] += rng.uniform(-1.5, 1.5)
    reach = rng.uniform(0.5, 6.0, (count, 1))
    half = normal * width[:, None] / 2.0
    start, end = centre - along * reach, centre + along * reach
    taper = rng.uniform(0.3, 1.0)
    return np.stack((start - half, start + half, end + half * taper, end - half * taper), axis=1)


def _window_panes(rng: Rng) -> FloatArray:
    """The light of a barred window on the floor: a sheared grid of panes. Ground quads (n, 4, 2)."""
    rows, columns = int(rng.integers(1, 5)), int(rng.integers(1, 5))
    pane = rng.uniform(0.08, 0.8, 2)
    gap = rng.uniform(0.05, 0.4)
    angle, shear = rng.uniform(0, math.pi), rng.normal(0, 0.5)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    turn = turn @ np.array([[1.0, shear], [0.0, 1.0]])
    corner = np.stack(np.meshgrid(np.arange(rows), np.arange(columns)), axis=-1).reshape(-1, 1, 2) * pane
    shape = np.array([[0, 0], [0, 1], [1, 1], [1, 0]]) * pane * (1.0 - gap)
    where = np.array([rng.uniform(0.4, 4.0), rng.uniform(-1.5, 1.5)])
    quads: FloatArray = (corner + shape) @ turn.T + where
    return quads


def _big_shade(rng: Rng) -> FloatArray:
    """The shadow of a bridge, a house or a wall beside the road. Ground quads (1, 4, 2)."""
    if rng.random() < 0.5:
        near, lean = rng.uniform(0.3, 6.0), rng.normal(0.0, 1.5)
        far = near + rng.uniform(0.5, 12.0)
        return np.array([[[near - lean, -9], [near + lean, 9], [far + lean, 9], [far - lean, -9]]])
    edge, side, lean = rng.uniform(-1.2, 1.2), rng.choice((-1, 1)), rng.normal(0.0, 2.0)
    return np.array([[[0.1, edge], [40, edge + lean], [40, side * 40], [0.1, side * 40]]])


def _own_shadow(camera: GroundCamera, rng: Rng) -> FloatArray:
    """The shadow of the car itself ahead of it. Ground quads (1, 4, 2)."""
    x, y = camera.centre_m[0], camera.centre_m[1] + rng.normal(0, 0.3)
    reach, half, lean = rng.uniform(0.3, 2.0), rng.uniform(0.15, 0.5), rng.normal(0, 0.3)
    return np.array([[[x, y - half], [x, y + half], [x + reach, y + half + lean], [x + reach, y - half + lean]]])


def _dapples(image: FloatImage, camera: GroundCamera, rng: Rng) -> None:
    """Light through leaves or soft shadows of clouds, in perspective."""
    height, width = image.shape
    size_lanes = rng.uniform(1.5, 9.0)
    scale = noise.SIDE_PX / size_lanes
    pattern = noise.crop(noise.leaves(noise.variant(rng)), rng)
    blur = int(rng.choice((3, 9, 25)))
    pattern = np.asarray(cv2.blur(pattern, (blur, blur)), dtype=np.uint8)
    ahead, left = rng.uniform(0, size_lanes, 2)
    texture_from_ground = np.array([[0.0, -scale, left * scale], [scale, 0.0, ahead * scale], [0.0, 0.0, 1.0]])
    px_from_texture = np.linalg.solve(texture_from_ground.T, camera.homography.T).T
    half = np.diag([0.5, 0.5, 1.0]) @ px_from_texture
    seen = cv2.warpPerspective(
        pattern, half, (width // 2, height // 2), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
    )
    mask = np.asarray(cv2.resize(seen, (width, height)), dtype=np.uint8)
    _scale(image, mask, rng.uniform(0.3, 0.85) if rng.random() < 0.75 else rng.uniform(1.15, 1.8))


def _soft_shadows(image: FloatImage, rng: Rng) -> None:
    """Soft shadows, and uneven gloss of a floor."""
    height, width = image.shape
    part = noise.crop(noise.fractal(1.8, noise.variant(rng)), rng, 128, 256)
    mask = np.asarray(cv2.resize(part, (width, height)), dtype=np.uint8)
    _scale(image, mask, rng.uniform(0.3, 1.6))


def _headlamps(image: FloatImage, camera: GroundCamera, rng: Rng) -> None:
    """Night: light from headlamps and little ambient light."""
    height, width = image.shape
    u, v = np.meshgrid(np.linspace(0, width - 1, 24), np.linspace(0, height - 1, 20))
    ground = camera.px_to_ground(np.stack((u, v), axis=-1)) - camera.centre_m[:2]
    x, y = ground[..., 0], ground[..., 1]
    reach, spread = rng.uniform(3.0, 15.0), rng.uniform(0.25, 0.8)
    off = y / (0.5 + spread * np.maximum(x, 0.0))
    lit = np.exp(-x / reach - off * off)
    gain = rng.uniform(0.06, 0.35) + rng.uniform(0.6, 1.5) * np.where(np.isfinite(lit), np.clip(lit, 0, 1), 0.0)
    image *= cv2.resize(gain.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)


def reflections(image: FloatImage, rng: Rng) -> None:
    """Reflections of lamps and windows in a shiny floor: soft, wavy vertical streaks."""
    height, width = image.shape
    glow = np.zeros((height // 2, width // 2), dtype=np.float32)
    panes = rng.random() < 0.3
    bright = rng.uniform(25, 230)
    thin = float(np.exp(rng.uniform(math.log(0.7), math.log(9.0))))
    drawn_out = rng.uniform(1.0, 8.0)
    for _ in range(int(np.exp(rng.uniform(0.0, 3.4)))):
        u, v = int(rng.integers(width // 2)), int(rng.integers(height // 8, height // 2))
        w = max(1, int(thin * rng.uniform(0.6, 1.6)))
        h = max(1, int(min(w * drawn_out * rng.uniform(0.6, 1.6), height / 5)))
        level = bright * float(rng.uniform(0.3, 1.0))
        if panes:
            cv2.rectangle(glow, (u - w, v - h), (u + w, v + h), level, -1)
        else:
            cv2.ellipse(glow, (u, v), (w, h), rng.normal(0, 4), 0, 360, level, -1)
    sigma = max(0.6, thin * rng.uniform(0.1, 0.6))
    glow = np.asarray(cv2.GaussianBlur(glow, (0, 0), sigma, sigmaY=sigma * rng.uniform(1.0, 4.0)), dtype=np.float32)
    glow = np.asarray(cv2.resize(glow, (width, height)), dtype=np.float32)
    if rng.random() < 0.6:  # an uneven floor breaks the mirror
        mottle = noise.crop(noise.fractal(1.0, noise.variant(rng)), rng, height, width)
        _scale(glow, mottle, rng.uniform(0.1, 1.0))
    np.minimum(glow, 250.0, out=glow)
    image += glow * (1.0 - np.minimum(image, 255.0) * np.float32(1.0 / 320.0))  # the sensor's shoulder


def ceiling_lamps(image: FloatImage, camera: GroundCamera, rng: Rng) -> None:
    """Rows of lamps or tubes under a ceiling, mirrored in the floor: what is above it appears as far below it."""
    height, width = image.shape
    ceiling = math.exp(rng.uniform(math.log(4.0), math.log(25.0)))
    long, wide = (rng.uniform(1.0, 5.0), rng.uniform(0.1, 0.9)) if rng.random() < 0.7 else rng.uniform(0.3, 1.5, 2)
    pitch = long * rng.uniform(1.05, 2.5), wide + rng.uniform(1.5, 8.0)
    turn = 0.0 if rng.random() < 0.6 else rng.uniform(0.0, math.pi)
    cos, sin = math.cos(turn), math.sin(turn)
    places = np.stack(np.meshgrid(np.arange(-12, 13), np.arange(-4, 5)), axis=-1).reshape(-1, 1, 2) * pitch
    corners = np.array([[0.0, 0.0], [long, 0.0], [long, wide], [0.0, wide]])
    start = camera.centre_m[:2] + np.array([rng.uniform(0.0, 10.0), rng.uniform(-4.0, 4.0)])
    ground = (places + corners) @ np.array([[cos, sin], [-sin, cos]]) + start
    below = np.concatenate((ground, np.full((*ground.shape[:2], 1), -ceiling)), axis=-1)
    pixels = camera.body_to_px(below)
    glow = np.zeros((height, width), dtype=np.uint8)
    for quad in pixels[np.isfinite(pixels).all(axis=(1, 2))]:
        outline = np.rint(np.clip(quad, -4000.0, 4000.0) * 16.0).astype(np.int32)
        cv2.fillPoly(glow, [outline], 255, cv2.LINE_AA, 4)
    sigma = math.exp(rng.uniform(math.log(2.0), math.log(6.0)))  # no floor of a hall is a perfect mirror
    soft = np.asarray(cv2.GaussianBlur(glow, (0, 0), sigma, sigmaY=sigma * rng.uniform(1.0, 4.0)), dtype=np.float32)
    soft *= np.float32(rng.uniform(20.0, 200.0) / 255.0)
    if rng.random() < 0.5:
        _scale(soft, noise.crop(noise.fractal(1.0, noise.variant(rng)), rng, height, width), rng.uniform(0.1, 1.0))
    image += soft * (1.0 - np.minimum(image, 255.0) * np.float32(1.0 / 320.0))
