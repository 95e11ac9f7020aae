"""The camera over the ground plane z = 0 of the body frame."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from automodel.config import CameraConfig, Extrinsics
from automodel.geometry.camera import CameraModel
from automodel.types import FloatArray


def cam_from_body_rotation(extrinsics: Extrinsics) -> FloatArray:
    """Rotation (3, 3) from the body frame to the cam frame.

    A camera that looks along body x is turned by yaw (left positive) about z, pitch (down positive) about its y axis
    and roll (right side down positive) about its optical axis.
    """
    cy, sy = math.cos(extrinsics.yaw_rad), math.sin(extrinsics.yaw_rad)
    cp, sp = math.cos(extrinsics.pitch_rad), math.sin(extrinsics.pitch_rad)
    cr, sr = math.cos(extrinsics.roll_rad), math.sin(extrinsics.roll_rad)
    yaw = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    pitch = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    roll = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    axes = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # x right, y down, z ahead
    return np.asarray(axes @ (yaw @ pitch @ roll).T)


class GroundCamera:
    """A calibrated camera on the car: ground points of the body frame to pixels and back."""

    def __init__(self, camera: CameraModel, extrinsics: Extrinsics) -> None:
        self.camera, self.extrinsics = camera, extrinsics
        self.cam_from_body = cam_from_body_rotation(extrinsics)
        self.centre_m: FloatArray = np.array([extrinsics.x_m, extrinsics.y_m, extrinsics.z_m])

    @classmethod
    def from_config(cls, camera: CameraConfig) -> GroundCamera:
        """The camera of car.toml."""
        return cls(CameraModel.from_config(camera), camera.extrinsics)

    def pitched(self, angle_rad: float) -> GroundCamera:
        """The camera if it looked down by so much more."""
        return GroundCamera(self.camera, self.extrinsics.pitched(angle_rad))

    def body_to_px(self, points_m: ArrayLike) -> FloatArray:
        """Points (..., 3) [m] of the body frame -> pixels (..., 2), also outside the image; NaN where there is none."""
        points = np.asarray(points_m, dtype=np.float64)
        return self.camera.project((points - self.centre_m) @ self.cam_from_body.T)

    def ground_to_px(self, points_m: ArrayLike) -> FloatArray:
        """Ground points (..., 2) [m] of the body frame -> pixels (..., 2); NaN where there is none."""
        points = np.asarray(points_m, dtype=np.float64)
        return self.body_to_px(np.concatenate((points, np.zeros((*points.shape[:-1], 1))), axis=-1))

    def px_to_ground(self, pixels: ArrayLike) -> FloatArray:
        """Pixels (..., 2) -> ground points (..., 2) [m] of the body frame; NaN at and above the horizon."""
        rays = self.camera.rays(pixels) @ self.cam_from_body
        down = rays[..., 2] < -1e-9
        scale = np.where(down, -self.centre_m[2] / np.where(down, rays[..., 2], -1.0), np.nan)
        return np.asarray(self.centre_m[:2] + rays[..., :2] * scale[..., None])

    @property
    def homography(self) -> FloatArray:
        """`px_from_ground` (3, 3) without distortion: ground point (x, y, 1) -> pixel (u, v, 1) times its depth."""
        basis = np.column_stack(
            (self.cam_from_body[:, 0], self.cam_from_body[:, 1], -self.cam_from_body @ self.centre_m)
        )
        return np.asarray(self.camera.matrix @ basis)

    def first_visible_x_m(self) -> float:
        """Body x [m] of the nearest ground in the image's bottom row; raises ValueError if there is no ground in it."""
        bottom = [(u, self.camera.height_px - 1.0) for u in np.linspace(0, self.camera.width_px - 1.0, 9)]
        x = self.px_to_ground(bottom)[:, 0]
        if not np.isfinite(x).any():
            raise ValueError("pitch_rad: the image's bottom row shows no ground; the camera looks too high")
        return float(np.nanmin(x))
