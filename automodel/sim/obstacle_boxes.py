"""Obstacles as shaded prisms that hide what lies behind them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import cv2
import numpy as np

from automodel.geometry import SE2, GroundCamera
from automodel.types import FloatArray, Image

FRACTION_BITS = 6


class Prism(Protocol):
    """Something upright on the floor: its outline (n, 2) [m] in the world frame, anticlockwise and convex."""

    @property
    def polygon_m(self) -> FloatArray:
        """Outline."""
        ...

    @property
    def height_m(self) -> float:
        """Height of its flat top."""
        ...

    @property
    def grey(self) -> int:
        """Brightness of its lit faces, 0 .. 255."""
        ...


def draw_obstacles(
    picture: Image, obstacles: Sequence[Prism], camera: GroundCamera, pose: SE2, light: FloatArray
) -> None:
    """Draw obstacles into a picture (h, w[, 3]), the farthest first; `light` is a factor for each channel."""
    body_from_world = pose.inverse()
    near = [
        (float(np.linalg.norm(body_from_world.apply(o.polygon_m).mean(axis=0))), i) for i, o in enumerate(obstacles)
    ]
    for _, i in sorted(near, reverse=True):
        outline = body_from_world.apply(obstacles[i].polygon_m)
        for face, shade in _faces(outline, obstacles[i].height_m, camera.centre_m, pose.yaw_rad):
            polygon = _picture_of(face, camera)
            if len(polygon) >= 3:
                colour = np.clip(obstacles[i].grey * shade * light, 0.0, 255.0).round().tolist()
                fixed = np.round(polygon * (1 << FRACTION_BITS)).astype(np.int32)
                cv2.fillPoly(picture, [fixed], colour, cv2.LINE_AA, FRACTION_BITS)


def _faces(outline: FloatArray, height_m: float, eye_m: FloatArray, yaw_rad: float) -> list[tuple[FloatArray, float]]:
    """Faces (n, 3) [m] that the eye can see and their brightness; the light comes from a fixed side of the world."""
    faces = []
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        along = b - a
        if along[0] * (eye_m[1] - a[1]) - along[1] * (eye_m[0] - a[0]) >= 0.0:
            continue  # the eye is on the inner side of this wall
        outwards = math.atan2(-along[0], along[1]) + yaw_rad
        wall = np.array([(*a, 0.0), (*b, 0.0), (*b, height_m), (*a, height_m)])
        faces.append((wall, 0.7 + 0.25 * math.cos(outwards - 0.8)))
    if eye_m[2] > height_m:
        faces.append((np.column_stack((outline, np.full(len(outline), height_m))), 1.0))
    return faces


def _picture_of(face: FloatArray, camera: GroundCamera) -> FloatArray:
    """Pixels (m, 2) of a face (n, 3) of the body frame, without what is behind the camera or beyond its lens."""
    cam = (face - camera.centre_m) @ camera.cam_from_body.T
    cam = _cut(cam, np.array([0.0, 0.0, 1.0]), 0.02 * float(camera.centre_m[2]))
    if len(cam) < 3:
        return np.zeros((0, 2))
    if camera.camera.distortion.any():
        parts = np.linspace(0.0, 1.0, 24, endpoint=False)[:, None]
        cam = np.concatenate([a + parts * (b - a) for a, b in zip(cam, np.roll(cam, -1, axis=0), strict=True)])
    pixels = camera.camera.project(cam)
    return np.clip(pixels[np.isfinite(pixels[:, 0])], -2e4, 2e4)


def _cut(polygon: FloatArray, normal: FloatArray, level: float) -> FloatArray:
    """The part of a polygon (n, 3) where `normal @ p >= level` (Sutherland and Hodgman)."""
    side = polygon @ normal - level
    kept = []
    for i in range(len(polygon)):
        j = (i + 1) % len(polygon)
        if side[i] >= 0.0:
            kept.append(polygon[i])
        if side[i] * side[j] < 0.0:
            kept.append(polygon[i] + side[i] / (side[i] - side[j]) * (polygon[j] - polygon[i]))
    return np.array(kept).reshape(-1, 3)
