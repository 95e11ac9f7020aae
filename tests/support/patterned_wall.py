"""Two cameras before a patterned wall."""

from __future__ import annotations

import cv2
import numpy as np

from automodel.config import Extrinsics, Intrinsics
from automodel.geometry import CameraModel, GroundCamera
from automodel.geometry.stereo_rig import StereoRig

F_PX, BASELINE_M, WALL_M = 480.0, 0.25, 3.0


def parallel(right_pitch_rad: float = 0.0) -> StereoRig:
    """Two level cameras beside each other."""
    lens = Intrinsics(fx_px=F_PX, fy_px=F_PX, cx_px=319.5, cy_px=179.5)

    def camera(y_m: float, pitch_rad: float) -> GroundCamera:
        return GroundCamera(CameraModel(lens, 640, 360), Extrinsics(x_m=0.0, y_m=y_m, z_m=1.0, pitch_rad=pitch_rad))

    return StereoRig(camera(0.5 * BASELINE_M, 0.0), camera(-0.5 * BASELINE_M, right_pitch_rad))


def wall(noise: float = 2.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A patterned wall `WALL_M` ahead of both, as they see it."""
    rng = np.random.default_rng(seed)
    shift = round(F_PX * BASELINE_M / WALL_M)
    pattern = cv2.resize(rng.integers(40, 220, (60, 120)).astype(np.uint8), None, fx=6.5, fy=6.5)
    whole = pattern[:360, : 640 + shift].astype(float)
    left, right = whole[:, :640], whole[:, shift:]  # what is at column u on the left is at u - shift on the right

    def noisy(image: np.ndarray) -> np.ndarray:
        return np.clip(image + noise * rng.standard_normal(image.shape), 0, 255).astype(np.uint8)

    return noisy(left), noisy(right)
