"""Random cameras, from a wide-angle lens 10 cm above a floor to a windscreen camera; lengths in lane widths."""

from __future__ import annotations

import math
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from automodel.config import Extrinsics, Intrinsics
from automodel.geometry import CameraModel, GroundCamera
from automodel.types import FloatArray

_WIDEST_RAD = 1.45  # the largest angle from the optical axis in the image corners


class Kind(Enum):
    """The kind of scene: the floor of a scale car, a public road, a race circuit."""

    SCALE = "scale"
    ROAD = "road"
    CIRCUIT = "circuit"


class WideLens(CameraModel):
    """A lens that images a ray at the angle `theta` from its axis at the normalised radius tan(a theta) / a.

    `bend` a = 1 is the pinhole, 0.5 the stereographic and a -> 0 the equidistant fisheye lens: barrel distortion with a
    closed-form inverse for any field of view.
    """

    def __init__(self, intrinsics: Intrinsics, width_px: int, height_px: int, bend: float = 1.0) -> None:
        super().__init__(intrinsics, width_px, height_px)
        if not 0.0 < bend <= 1.0:
            raise ValueError(f"bend: expected more than 0 and at most 1 (the pinhole), got {bend}")
        self.bend = bend
        self._limit_rad = min(1.55, 0.49 * math.pi / bend)

    def project(self, points_cam: ArrayLike) -> FloatArray:
        """Points (..., 3) to pixels (..., 2); NaN outside the lens's field of view."""
        p = np.asarray(points_cam, dtype=np.float64)
        across = np.hypot(p[..., 0], p[..., 1])
        theta = np.arctan2(across, p[..., 2])
        theta = np.where(theta < self._limit_rad, theta, np.nan)
        scale = np.tan(self.bend * theta) / (self.bend * np.maximum(across, 1e-12))
        m = self.matrix
        return np.stack((m[0, 0] * scale * p[..., 0] + m[0, 2], m[1, 1] * scale * p[..., 1] + m[1, 2]), axis=-1)

    def rays(self, pixels: ArrayLike) -> FloatArray:
        """Pixels (..., 2) to rays (..., 3) of the cam frame with z = 1; NaN outside the lens's field of view."""
        p = np.asarray(pixels, dtype=np.float64)
        m = self.matrix
        x, y = (p[..., 0] - m[0, 2]) / m[0, 0], (p[..., 1] - m[1, 2]) / m[1, 1]
        radius = np.hypot(x, y)
        theta = self.off_axis_rad(radius)
        theta = np.where(theta < self._limit_rad, theta, np.nan)
        scale = np.tan(theta) / np.maximum(radius, 1e-12)
        scale = np.where(radius < 1e-9, 1.0, scale)
        return np.stack((x * scale, y * scale, np.where(np.isnan(theta), np.nan, 1.0)), axis=-1)

    def off_axis_rad(self, radius: ArrayLike) -> FloatArray:
        """The angle from the axis [rad] at a normalised image radius."""
        return np.asarray(np.arctan(self.bend * np.asarray(radius, dtype=np.float64)) / self.bend)


def random_camera(rng: np.random.Generator, kind: Kind, width_px: int, height_px: int) -> GroundCamera:
    """A random camera above the body's origin, for an image that was cropped and rescaled."""
    bend, half_rad = _lens(rng, kind)
    focal = 0.5 * bend / math.tan(bend * half_rad)  # in widths of the original image
    left, top, kept_w, kept_h = _crop(rng)
    reach = math.hypot(max(0.5 - left, kept_w - 0.5 + left), kept_h)
    focal = max(focal, reach * bend / math.tan(min(bend * _WIDEST_RAD, 1.45)))
    aspect_error = math.exp(rng.normal(0.0, 0.03))
    fx, fy = focal * width_px / kept_w, focal * height_px / kept_h * aspect_error
    cx = (0.5 - left + rng.normal(0.0, 0.015)) / kept_w * width_px - 0.5
    cy = (-top + rng.normal(0.0, 0.015)) / kept_h * height_px - 0.5
    intrinsics = Intrinsics(fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy)
    lens = WideLens(intrinsics, width_px, height_px, bend)
    drop = (cy - _horizon(rng, kind) * height_px) / fy
    pitch = math.copysign(float(lens.off_axis_rad(abs(drop))), drop)
    extrinsics = Extrinsics(
        x_m=0.0,
        y_m=0.0,
        z_m=_height(rng, kind),
        pitch_rad=float(np.clip(pitch, -0.35, 1.1)),
        yaw_rad=math.radians(float(np.clip(rng.normal(0.0, 2.5), -8.0, 8.0))),
        roll_rad=math.radians(float(np.clip(rng.normal(0.0, 1.3), -4.0, 4.0))),
    )
    return GroundCamera(lens, extrinsics)


def _lens(rng: np.random.Generator, kind: Kind) -> tuple[float, float]:
    """The lens's bend, and half the horizontal field of view of the original image [rad]."""
    if kind is Kind.ROAD:
        width_deg = rng.uniform(40.0, 75.0) if rng.random() < 0.8 else rng.uniform(75.0, 110.0)
    elif kind is Kind.CIRCUIT:
        width_deg = rng.uniform(55.0, 110.0)
    else:
        width_deg = rng.uniform(55.0, 100.0) if rng.random() < 0.5 else rng.uniform(90.0, 150.0)
    if width_deg > 105.0:
        bend = rng.uniform(0.05, 0.75)
    else:
        bend = 1.0 if rng.random() < 0.6 else rng.uniform(0.3, 1.0)
    return bend, math.radians(0.5 * width_deg)


def _crop(rng: np.random.Generator) -> tuple[float, float, float, float]:
    """The crop in widths of the original: left edge, top edge below the optical axis, width, height."""
    height = 1.0 / rng.choice([4 / 3, 1.6, 16 / 9, 2.0], p=[0.4, 0.12, 0.4, 0.08])
    top, bottom, left, right = 0.0, 0.0, 0.0, 0.0
    if rng.random() < 0.4:
        top, bottom = rng.uniform(0.0, 0.45), rng.uniform(0.0, 0.25)
    if rng.random() < 0.12:
        left, right = rng.uniform(0.0, 0.2, 2)
    return left, (top - 0.5) * height, 1.0 - left - right, (1.0 - top - bottom) * height


def _horizon(rng: np.random.Generator, kind: Kind) -> float:
    """The row of the horizon in image heights from the top."""
    if rng.random() < 0.15:
        return float(rng.uniform(-0.9, 0.65))
    if kind is Kind.SCALE:
        return float(np.clip(rng.normal(0.2, 0.22), -0.7, 0.62))
    return float(np.clip(rng.normal(0.38, 0.12), -0.1, 0.65))


def _height(rng: np.random.Generator, kind: Kind) -> float:
    """The camera's height in lane widths."""
    low, high = {Kind.SCALE: (0.18, 0.9), Kind.ROAD: (0.28, 0.65), Kind.CIRCUIT: (0.06, 0.3)}[kind]
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))
