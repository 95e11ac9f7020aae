"""Camera poses over the ground by least squares on pixels, many at a time."""

from __future__ import annotations

import contextlib
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.config import Extrinsics
from automodel.geometry import CameraModel
from automodel.types import FloatArray
from calibration.views import CalibrationError

__all__ = ["NAMES", "fit_poses", "on_ground", "pose_of", "projected", "start_pose"]


NAMES = ("x_m", "y_m", "z_m", "pitch_rad", "yaw_rad", "roll_rad")  # a pose's six numbers, in the body frame
_STEP = 1e-6  # of the numeric derivatives, metres and radians
_TURNS = 150  # some ten are usual; points that say little make the valley long
_STALLED = 3  # turns without progress of any pose: with other damping none is to be had either
_RIDGE = 1e-12
_AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # cam x right, y down, z ahead


def pose_of(pose: FloatArray) -> Extrinsics:
    """The six numbers by name; raises CalibrationError for a camera that is not over the ground."""
    try:
        return Extrinsics(**dict(zip(NAMES, pose.tolist(), strict=True)))
    except ValueError as error:
        raise CalibrationError(
            f"the points put the camera where none can be ({error}); is x_m ahead, and is y_m positive to the left?"
        ) from None


def _cam_from_body(poses: FloatArray) -> FloatArray:
    """Rotations (b, 3, 3) of poses (b, 6), as `automodel.geometry.ground.cam_from_body_rotation` has them."""
    (sp, sy, sr), (cp, cy, cr) = np.sin(poses[:, 3:]).T, np.cos(poses[:, 3:]).T
    body_from_axes = np.array(  # yaw, then pitch, then roll
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    return _AXES @ body_from_axes.transpose(2, 1, 0)


def projected(camera: CameraModel, poses: FloatArray, points_m: FloatArray) -> FloatArray:
    """Ground points (b or 1, n, 2) of the body frame -> pixels (b, n, 2) for poses (b, 6); NaN where not seen."""
    ground = np.concatenate((points_m, np.zeros((*points_m.shape[:-1], 1))), axis=-1)
    return camera.project(np.einsum("bij,bnj->bni", _cam_from_body(poses), ground - poses[:, None, :3]))


def on_ground(camera: CameraModel, poses: FloatArray, pixels: FloatArray) -> FloatArray:
    """Pixels (n, 2) -> ground points (b, n, 2) [m] of the body frame for poses (b, 6); NaN at and above the horizon."""
    rays = np.einsum("bji,nj->bni", _cam_from_body(poses), camera.rays(pixels))
    reach = poses[:, None, 2] / np.where(rays[..., 2] < -1e-9, -rays[..., 2], np.nan)
    return poses[:, None, :2] + rays[..., :2] * reach[..., None]


def start_pose(
    points_m: FloatArray, pixels: FloatArray, camera: CameraModel, mounting: Extrinsics, held: bool
) -> FloatArray:
    """A pose (6,) near the solution: of those in closed form and `mounting` the one that fits best.

    With `held` all have the x_m and y_m of `mounting`. Raises CalibrationError where none of them sees the points.
    """
    rays = camera.rays(pixels)
    if np.isnan(rays).any():
        raise CalibrationError("the lens model does not reach all points; calibrate the camera first")
    ground = np.column_stack((points_m, np.zeros(len(points_m))))
    best = np.array([getattr(mounting, name) for name in NAMES])
    candidates = [best]
    with contextlib.suppress(cv2.error):
        solutions = cv2.solvePnPGeneric(
            ground, np.ascontiguousarray(rays[:, :2]), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
        for rotation, shift in zip(solutions[1], solutions[2], strict=True):
            matrix = np.asarray(cv2.Rodrigues(rotation)[0], np.float64)
            candidates.append(_numbers(matrix, -matrix.T @ np.asarray(shift, np.float64).ravel()))
    least = math.inf
    for pose in candidates:
        if held:
            pose[:2] = mounting.x_m, mounting.y_m
        miss = float(np.sum((projected(camera, pose[None], points_m[None])[0] - pixels) ** 2))
        if pose[2] > 0.0 and miss < least:
            best, least = pose, miss
    if not math.isfinite(least):
        raise CalibrationError(
            "no camera over the ground sees the points so; is x_m ahead, and is y_m positive to the left?"
        )
    return best


def _numbers(cam_from_body: FloatArray, centre_m: FloatArray) -> FloatArray:
    turn = (_AXES.T @ cam_from_body).T
    pitch = math.asin(max(-1.0, min(1.0, -turn[2, 0])))
    return np.array([*centre_m, pitch, math.atan2(turn[1, 0], turn[0, 0]), math.atan2(turn[2, 1], turn[2, 2])])


def fit_poses(
    camera: CameraModel,
    start: FloatArray,
    points_m: FloatArray,
    pixels: FloatArray,
    whiten: FloatArray,
    free: NDArray[np.int64],
) -> FloatArray:
    """Poses (b, 6) with the least squares of whitened misses, each from its own start (b, 6), by Levenberg-Marquardt.

    `points_m` and `pixels` (b, n, 2); `whiten` (n, 2, 2); only the numbers `free` of a pose change.
    """

    def misses(poses: FloatArray) -> FloatArray:
        with np.errstate(over="ignore", invalid="ignore"):  # a step that went astray is taken back below
            away = pixels - projected(camera, poses, points_m)
            return np.einsum("nij,bnj->bni", whiten, away).reshape(len(poses), -1)

    poses, damping, stalled = start.copy(), np.full(len(start), 1e-4), 0
    here = misses(poses)
    cost = np.sum(here**2, axis=1)
    for _ in range(_TURNS):
        if stalled == _STALLED:
            break
        slopes = []
        for number in free:
            step = np.zeros(6)
            step[number] = _STEP
            slopes.append((misses(poses + step) - misses(poses - step)) / (2.0 * _STEP))
        slope = np.nan_to_num(np.stack(slopes, axis=-1))
        square = slope.transpose(0, 2, 1) @ slope
        damped = square + damping[:, None, None] * np.einsum("bii->bi", square)[:, :, None] * np.eye(len(free))
        change = -np.linalg.solve(damped + _RIDGE * np.eye(len(free)), slope.transpose(0, 2, 1) @ here[..., None])
        tried = poses.copy()
        tried[:, free] += change[..., 0]
        there = misses(tried)
        with np.errstate(over="ignore"):
            new_cost = np.sum(there**2, axis=1)
        better = new_cost < cost  # False for NaN: points behind the camera
        stalled = 0 if (better & (cost - new_cost > 1e-9 * cost + 1e-15)).any() else stalled + 1
        poses, here = np.where(better[:, None], tried, poses), np.where(better[:, None], there, here)
        cost, damping = (
            np.where(better, new_cost, cost),
            np.where(better, 0.1 * damping, 10.0 * damping).clip(1e-9, 1e9),
        )
    return poses
