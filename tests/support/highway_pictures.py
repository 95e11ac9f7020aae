"""Pictures of a highway, drawn by asking of each pixel's rays which ground they meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from automodel.config import Extrinsics, Intrinsics
from automodel.geometry import CameraModel, GroundCamera

LANE_M = 3.7
SOLID = (1.0, 0.0)  # metres of paint and of gap
DASHES = (3.0, 9.0)
DOTS = (0.1, 1.1)
_FINE = 2


@dataclass(frozen=True)
class Line:
    """A line `offset_m` to the left of the road's middle, painted in a pattern, `grey` levels above the road."""

    offset_m: float
    pattern: tuple[float, float] = SOLID
    phase_m: float = 0.0
    width_m: float = 0.12
    grey: float = 90.0


def camera_model(width: int = 512, height: int = 288, f_px: float = 450.0, distortion=(0.0,) * 5) -> CameraModel:
    centre = {"cx_px": 0.5 * (width - 1), "cy_px": 0.5 * (height - 1)}
    return CameraModel(Intrinsics(fx_px=f_px, fy_px=f_px, distortion=distortion, **centre), width, height)


def mounted(model: CameraModel | None = None, **extrinsics: float) -> GroundCamera:
    """A camera 1.6 m above the road, the horizon a third from the top, unless `extrinsics` say otherwise."""
    return GroundCamera(model or camera_model(), Extrinsics(**{"x_m": 0.0, "z_m": 1.6, "pitch_rad": 0.1, **extrinsics}))


@lru_cache(maxsize=4)
def _rays(model: CameraModel) -> np.ndarray:
    """The rays (h, w, 3) through `_FINE` by `_FINE` places in each pixel: a lens takes its time to be undone."""
    u, v = ((np.arange(n * _FINE) + 0.5) / _FINE - 0.5 for n in (model.width_px, model.height_px))
    return model.rays(np.stack(np.meshgrid(u, v), axis=-1))


def _ground(camera: GroundCamera) -> tuple[np.ndarray, np.ndarray]:
    """x and y of the ground at those places, NaN above the horizon."""
    x, y, z = np.moveaxis(_rays(camera.camera) @ camera.cam_from_body, -1, 0)
    scale = camera.centre_m[2] / np.where(z < -1e-9, -z, np.nan)
    return camera.centre_m[0] + scale * x, camera.centre_m[1] + scale * y


def draw(
    camera: GroundCamera,
    lines: Sequence[Line],
    heading_rad: float = 0.0,
    curvature_per_m: float = 0.0,
    seed: int = 0,
    noise: float = 3.0,
) -> np.ndarray:
    """The road (h, w) uint8: its middle starts below the camera, in direction `heading_rad` to the left of body x."""
    width, height = camera.camera.width_px, camera.camera.height_px
    x, y = _ground(camera)
    with np.errstate(invalid="ignore"):
        road = np.isfinite(x) & (x < 150.0)
        beside = y - (heading_rad * x + 0.5 * curvature_per_m * x * x)  # the flat curve: small angles
        grey = np.where(road, 110.0, 180.0)
        for line in lines:
            paint, gap = line.pattern
            on = np.abs(beside - line.offset_m) < 0.5 * line.width_m
            on &= (x + line.phase_m) % (paint + gap) < paint
            grey[road & on] += line.grey
    grey = grey.reshape(height, _FINE, width, _FINE).mean(axis=(1, 3))
    grey += np.random.default_rng(seed).normal(0.0, noise, grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def lane(offset_m: float = 0.0, left=DASHES, right=SOLID, phase_m: float = 0.0, **more: float) -> list[Line]:
    """The two lines of a lane in which the car is `offset_m` to the left of the middle."""
    return [
        Line(-offset_m + 0.5 * LANE_M, left, phase_m, **more),
        Line(-offset_m - 0.5 * LANE_M, right, 0.6 * phase_m, **more),
    ]
