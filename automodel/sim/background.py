"""The surroundings of the floor: a panorama at infinity that moves with the car's heading; haze in front of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from automodel.geometry import GroundCamera
from automodel.sim.appearance import Appearance
from automodel.sim.ground_projection import GroundProjection
from automodel.types import Bools, FloatArray, Image

TURN = 2.0 * math.pi
HAZE_TOP = 20.0  # height of the layer of haze [scene units]


def directions(camera: GroundCamera, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Azimuth (left positive, 0 ahead) and elevation [rad] in the body frame of pixels (..., 2); NaN without a ray."""
    ray = camera.camera.rays(pixels) @ camera.cam_from_body
    return np.arctan2(ray[..., 1], ray[..., 0]), np.arctan2(ray[..., 2], np.hypot(ray[..., 0], ray[..., 1]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Canvas:
    """A panorama to draw on: `per_rad` pixels per radian, row 0 at elevation `top_rad`, column 0 at azimuth 0."""

    image: Image
    per_rad: float
    top_rad: float

    def fill(self, azimuth_rad: float, low_rad: float, size_rad: tuple[float, float], bgr: FloatArray) -> None:
        """A rectangle (width, height) whose lower edge is centred at an azimuth and elevation."""
        width, height = size_rad
        left = (azimuth_rad - 0.5 * width) * self.per_rad
        top, foot = (self.top_rad - low_rad - height) * self.per_rad, (self.top_rad - low_rad) * self.per_rad
        for lap in (0.0, -TURN * self.per_rad):
            corners = np.array([(left + lap, top), (left + lap + width * self.per_rad, foot)])
            (x0, y0), (x1, y1) = np.round(corners - 0.5).astype(int).tolist()
            cv2.rectangle(self.image, (x0, y0), (x1, y1), bgr.tolist(), -1)

    def disc(self, azimuth_rad: float, elevation_rad: float, size_rad: tuple[float, float], bgr: FloatArray) -> None:
        """An ellipse (width, height) centred at an azimuth and elevation."""
        axes = tuple(max(round(0.5 * size * self.per_rad), 1) for size in size_rad)
        y = round((self.top_rad - elevation_rad) * self.per_rad)
        for lap in (0.0, -TURN):
            middle = (round((azimuth_rad + lap) * self.per_rad), y)
            cv2.ellipse(self.image, middle, axes, 0.0, 0.0, 360.0, bgr.tolist(), -1, cv2.LINE_AA)


def panorama(look: Appearance, width_px: int, top_rad: float) -> Image:
    """The surroundings (h, width_px, 3), from `top_rad` down to the horizon."""
    per_rad = width_px / TURN
    rows = max(math.ceil(top_rad * per_rad), 2)
    canvas = Canvas(image=np.empty((rows, width_px, 3), np.uint8), per_rad=per_rad, top_rad=rows / per_rad)
    canvas.image[:] = round(min(look.background_grey, 255.0))
    rng = np.random.default_rng(look.background_seed)
    if look.background == "hall":
        _hall(canvas, rng, look)
    elif look.background == "outdoor":
        _outdoor(canvas, rng, look)
    return canvas.image


def _colour(rng: np.random.Generator, grey: float, spread: float) -> FloatArray:
    return np.clip(grey * (1.0 + rng.uniform(-spread, spread, 3)), 0.0, 255.0)


def _hall(canvas: Canvas, rng: np.random.Generator, look: Appearance) -> None:
    """Walls with skirting, windows, doors and posters, boards around the floor, tables, people; lamps above."""
    wall, count = look.background_grey, look.clutter
    rows = np.linspace(canvas.top_rad, 0.0, canvas.image.shape[0])
    shade = 0.75 + 0.5 * np.clip(rows, 0.0, 0.5)
    canvas.image[:] = np.clip(wall * shade, 0, 255)[:, None, None].astype(np.uint8)
    for _ in range(rng.poisson(9 * count + 1)):
        width, low = rng.uniform(0.08, 0.35), rng.uniform(0.05, 0.12)
        azimuth, height = rng.uniform(0.0, TURN), rng.uniform(0.1, 0.3)
        canvas.fill(azimuth, low - 0.008, (width + 0.016, height + 0.016), _colour(rng, 0.5 * wall, 0.1))
        canvas.fill(azimuth, low, (width, height), np.array([250.0, 245.0, 235.0]))
        canvas.fill(azimuth, low, (0.008, height), _colour(rng, 0.5 * wall, 0.1))
    for _ in range(rng.poisson(14 * count)):  # doors, cupboards, posters
        foot = rng.choice((0.0, 0.0, 0.05))
        size = (rng.uniform(0.03, 0.12), rng.uniform(0.06, 0.2))
        canvas.fill(rng.uniform(0.0, TURN), foot, size, _colour(rng, rng.uniform(20.0, 200.0), 0.4))
    for _ in range(rng.poisson(25 * count)):  # tables and chairs: a board on legs
        azimuth, width, height = rng.uniform(0.0, TURN), rng.uniform(0.04, 0.2), rng.uniform(0.02, 0.05)
        colour = _colour(rng, rng.uniform(20.0, 160.0), 0.3)
        canvas.fill(azimuth, height, (width, 0.008), colour)
        for side in (-0.45, 0.45):
            canvas.fill(azimuth + side * width, 0.0, (0.006, height), 0.5 * colour)
    for _ in range(rng.poisson(22 * count)):
        _person(canvas, rng)
    for _ in range(rng.poisson(12 * count)):
        azimuth, low = rng.uniform(0.0, TURN), rng.uniform(0.35, 0.9)
        canvas.fill(azimuth, low, (rng.uniform(0.05, 0.2), rng.uniform(0.01, 0.03)), np.array([255.0, 255.0, 255.0]))
    canvas.fill(0.5 * TURN, 0.0, (TURN, 0.012), _colour(rng, 0.4 * wall, 0.1))


def _person(canvas: Canvas, rng: np.random.Generator) -> None:
    azimuth, height = rng.uniform(0.0, TURN), rng.uniform(0.08, 0.24)
    trousers, shirt = _colour(rng, rng.uniform(15.0, 90.0), 0.3), _colour(rng, rng.uniform(20.0, 200.0), 0.35)
    for side in (-0.05, 0.05):
        canvas.fill(azimuth + side * height, 0.0, (0.085 * height, 0.48 * height), trousers)
    canvas.fill(azimuth, 0.45 * height, (0.25 * height, 0.4 * height), shirt)
    canvas.disc(azimuth, 0.93 * height, (0.11 * height, 0.15 * height), np.array([110.0, 140.0, 190.0]))


def _outdoor(canvas: Canvas, rng: np.random.Generator, look: Appearance) -> None:
    """Sky, hills, trees, houses, poles."""
    sky = look.background_grey
    rows = np.linspace(canvas.top_rad, 0.0, canvas.image.shape[0])
    fade = np.clip(1.1 - 0.35 * rows, 0.5, 1.1)[:, None] * np.array([1.08, 1.0, 0.94])
    canvas.image[:] = np.clip(sky * fade, 0, 255)[:, None, :].astype(np.uint8)
    azimuth = np.arange(canvas.image.shape[1]) / canvas.per_rad
    for height, grey in ((0.05, 0.6), (0.025, 0.4)):
        ridge = np.full(len(azimuth), height)
        for k in range(2, 14):
            ridge += rng.uniform(0.0, 0.5) * height / k * np.sin(k * azimuth + rng.uniform(0.0, TURN))
        below = rows[:, None] < ridge[None, :]
        canvas.image[below] = np.clip(sky * grey * np.array([0.95, 1.0, 0.9]), 0, 255).astype(np.uint8)
    for _ in range(rng.poisson(12 * look.clutter)):
        size = (rng.uniform(0.03, 0.12), rng.uniform(0.02, 0.06))
        canvas.fill(rng.uniform(0.0, TURN), 0.0, size, _colour(rng, rng.uniform(60.0, 190.0), 0.15))
    for _ in range(rng.poisson(60 * look.clutter)):
        at, height, dark = rng.uniform(0.0, TURN), rng.uniform(0.02, 0.1), rng.uniform(25.0, 70.0)
        canvas.fill(at, 0.0, (0.08 * height, 0.6 * height), np.full(3, 0.6 * dark))
        size = (height * rng.uniform(0.5, 0.9), 0.75 * height)
        canvas.disc(at, 0.65 * height, size, dark * np.array([0.7, 1.1, 0.8]))
    for _ in range(rng.poisson(10 * look.clutter)):
        canvas.fill(rng.uniform(0.0, TURN), 0.0, (0.004, rng.uniform(0.05, 0.2)), _colour(rng, 70.0, 0.1))


class Background:
    """Looks up the panorama for every pixel that shows no ground.

    `end_row` is the row below the last such pixel; `mask` (end_row, w) is 255 at these pixels.
    """

    def __init__(self, camera: GroundCamera, ground_seen: Bools, look: Appearance) -> None:
        rows = np.flatnonzero(~ground_seen.all(axis=1))
        self.end_row = int(rows[-1]) + 1 if len(rows) else 0
        self.mask: Image = np.where(ground_seen[: self.end_row], 0, 255).astype(np.uint8)
        self.view: Image | None = None
        if not self.end_row:
            return
        rows_px, columns_px = np.mgrid[0 : self.end_row, 0 : ground_seen.shape[1]]
        azimuth, elevation = directions(camera, np.stack((columns_px, rows_px), axis=-1).astype(np.float64))
        outwards = float(np.nanmax(elevation)) if np.isfinite(elevation).any() else 0.1
        width = 2 ** min(math.ceil(math.log2(4.0 * float(camera.camera.matrix[0, 0]))), 12)
        self._per_rad = width / TURN
        view = panorama(look, width, min(max(outwards, 0.0) + 0.05, 0.5 * math.pi))
        self.top_rad = view.shape[0] / self._per_rad
        self.view = view
        self._laid_out = np.concatenate((view, view, view[:, : width // 2]), axis=1)
        u = np.nan_to_num(azimuth) * self._per_rad - 0.5
        v = np.clip(self.top_rad - np.nan_to_num(elevation), 0.0, self.top_rad) * self._per_rad - 0.5
        self._columns = u.astype(np.float32)
        self._rows = np.clip(v, 0.0, view.shape[0] - 1.0).astype(np.float32)
        self._grey = cv2.cvtColor(self._laid_out, cv2.COLOR_BGR2GRAY)

    def look_up(self, yaw_rad: float, colour: bool) -> Image | None:
        """The rows above `end_row` (end_row, w[, 3]) for a car with heading `yaw_rad`, valid where `mask` is set.

        None where every pixel shows ground.
        """
        if not self.end_row:
            return None
        turn = (yaw_rad % TURN) * self._per_rad
        if turn < 0.5 * TURN * self._per_rad:
            turn += TURN * self._per_rad
        source = self._laid_out if colour else self._grey
        seen = cv2.remap(
            source, self._columns + np.float32(turn), self._rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
        )
        return np.asarray(seen, dtype=np.uint8)


class Haze:
    """Fades what is far away into the colour of the horizon, by Koschmieder's law: contrasts fall as exp(-haze d)."""

    def __init__(self, projection: GroundProjection, look: Appearance, unit_m: float) -> None:
        camera = projection.camera
        height, width = projection.seen.shape
        rows, columns = np.mgrid[0:height, 0:width]
        elevation = directions(camera, np.stack((columns, rows), axis=-1).astype(np.float64))[1]
        flat = np.linalg.norm(np.nan_to_num(projection.ground_m) - camera.centre_m[:2], axis=-1)
        above = HAZE_TOP * unit_m / np.maximum(np.sin(np.nan_to_num(elevation, nan=1.0)), 1e-3)
        distance_m = np.where(projection.seen, np.hypot(flat, camera.centre_m[2]), above)
        self._left = np.exp(-look.haze * distance_m / unit_m).astype(np.float32)
        self._air = np.float32(look.background_grey) * (1.0 - self._left)

    def apply(self, image: Image, light: FloatArray) -> Image:
        """The hazy image; `light` is a factor for each channel."""
        channels = cv2.split(image) if image.ndim == 3 else [image]
        hazy = [
            cv2.convertScaleAbs(
                cv2.addWeighted(cv2.multiply(c, self._left, dtype=cv2.CV_32F), 1.0, self._air, float(gain), 0.0)
            )
            for c, gain in zip(channels, light, strict=True)
        ]
        return np.asarray(cv2.merge(hazy) if image.ndim == 3 else hazy[0], dtype=np.uint8)
