"""Where the camera sits and looks, from ground points whose places are measured, with the error on the ground.

Camera poses over the ground by least squares on pixels, many at a time.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.config import Extrinsics
from automodel.geometry import CameraModel, GroundCamera
from automodel.types import FloatArray
from calibration.views import CalibrationError

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


_ROUNDS = 400  # of the bootstrap
_PRIOR_WEIGHT = 2.0  # the stated accuracy of tape and pixels counts like so many measurements
_CONTRADICTION = 6.0  # times the stated accuracy: something was measured or clicked wrongly
_THIN = 0.08  # breadth over length of the points' extent: less is nearly a line
_USELESS = 0.25  # of the nearest distance; a larger error on the ground is no calibration
_FULL_SIZE_M = 0.6  # height of the camera from which distances are those of a full-size car


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GroundPoints:
    """Ground points (n, 2) [m] of the body frame and where the picture shows them (n, 2) [px], with their accuracy.

    `point_m`: each point by itself (the tape); `shift_m`, `turn_rad`: all of them together, as a sheet that was put
    down a little beside its place; `pixel_px`: where a point is seen. All one sigma.
    """

    points_m: FloatArray
    pixels: FloatArray
    point_m: float = 0.003
    pixel_px: float = 1.0
    shift_m: float = 0.0
    turn_rad: float = 0.0

    def __post_init__(self) -> None:
        for name in ("points_m", "pixels"):
            array = np.array(getattr(self, name), dtype=np.float64).reshape(-1, 2)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if len(self.points_m) != len(self.pixels):
            raise ValueError(f"pixels: {len(self.pixels)} for {len(self.points_m)} ground points")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GroundCalibration:
    """What was found. `std` has one sigma of each of the extrinsics, 0 for what was held.

    `misses_px` (n, 2): seen minus projected. By distance ahead of the camera [m], how far [m] a ground point is
    misplaced: `error_m` its root mean square, `bound_m` what it stays below in 95 of 100 such calibrations; NaN where
    the lens model or a horizon is in the way.
    """

    extrinsics: Extrinsics
    std: Mapping[str, float]
    residual_px: float
    misses_px: FloatArray
    error_m: Mapping[float, float]
    bound_m: Mapping[float, float]


def distances_m(height_m: float) -> tuple[float, float, float]:
    """At which distances ahead of the camera errors are said, for a camera at this height."""
    return (0.5, 1.0, 2.0) if height_m < _FULL_SIZE_M else (5.0, 10.0, 20.0)


def camera_from_points(
    measured: GroundPoints, camera: CameraModel, mounting: Extrinsics, keep_position: bool = False, seed: int = 0
) -> GroundCalibration:
    """The camera that sees the ground points where the picture shows them.

    `keep_position` holds x_m and y_m as `mounting` has them. Raises CalibrationError for fewer than four points, points
    nearly on one line, outside the picture or contradictory.
    """
    _check(measured, camera)
    free = np.array([2, 3, 4, 5] if keep_position else range(6))
    start = start_pose(measured.points_m, measured.pixels, camera, mounting, keep_position)
    whiten = _whitening(measured, camera, start)
    points, pixels = measured.points_m[None], measured.pixels[None]
    pose = fit_poses(camera, start[None], points, pixels, whiten, free)[0]
    misses = measured.pixels - projected(camera, pose[None], points)[0]
    _check_misses(measured, np.einsum("nij,nj->ni", whiten, misses), misses, len(free))
    poses = _bootstrap(measured, camera, pose, whiten, free, misses, seed)
    extrinsics = pose_of(pose)
    error_m, bound_m = _ground_errors(camera, extrinsics, poses)
    nearest = next(iter(error_m))
    if not error_m[nearest] < _USELESS * nearest:
        raise CalibrationError(
            f"the points say too little: {nearest:g} m ahead the ground would be wrong by "
            f"{1e3 * error_m[nearest]:.0f} mm; spread them over the ground from near to far and from side to side"
        )
    return GroundCalibration(
        extrinsics=extrinsics,
        std={name: float(poses[:, i].std()) if i in free else 0.0 for i, name in enumerate(NAMES)},
        residual_px=math.sqrt(float(np.mean(np.sum(misses**2, axis=1)))),
        misses_px=misses,
        error_m=error_m,
        bound_m=bound_m,
    )


def _check(measured: GroundPoints, camera: CameraModel) -> None:
    count = len(measured.points_m)
    if count < 4:
        raise CalibrationError(f"{count} ground points; four at least are wanted, six are better")
    if not (np.isfinite(measured.points_m).all() and np.isfinite(measured.pixels).all()):
        raise CalibrationError("the ground points are not all finite numbers")
    outside = np.flatnonzero(~camera.inside(measured.pixels))
    if len(outside):
        u, v = measured.pixels[outside[0]]
        raise CalibrationError(
            f"point {outside[0] + 1}: pixel ({u:g}, {v:g}) lies outside the picture of "
            f"{camera.width_px}x{camera.height_px}"
        )
    for name, places in (("on the ground", measured.points_m), ("in the picture", measured.pixels)):
        lengths = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
        if lengths[1] < _THIN * lengths[0]:
            raise CalibrationError(
                f"the points lie nearly on one line {name}; spread them from near to far and from side to side"
            )


def _check_misses(measured: GroundPoints, whitened: FloatArray, misses: FloatArray, unknowns: int) -> None:
    scale = math.sqrt(float(np.sum(whitened**2)) / (2 * len(whitened) - unknowns))
    if scale < _CONTRADICTION:
        return
    worst = int(np.argmax(np.linalg.norm(whitened, axis=1)))
    (x, y), miss = measured.points_m[worst], float(np.linalg.norm(misses[worst]))
    raise CalibrationError(
        f"the points contradict each other, most of all point {worst + 1} ({x:g} m ahead, {y:g} m to the left), seen "
        f"{miss:.0f} px from where it should be; measure and read it again (and is y_m positive to the left?)"
    )


def _whitening(measured: GroundPoints, camera: CameraModel, pose: FloatArray) -> FloatArray:
    """(n, 2, 2): makes a miss of the expected size one unit long; near the car the tape counts for many pixels."""
    at = measured.points_m
    ways = [projected(camera, pose[None], (at + step)[None])[0] for step in ((1e-4, 0.0), (0.0, 1e-4))]
    here = projected(camera, pose[None], at[None])[0]
    jacobian = np.stack([(way - here) / 1e-4 for way in ways], axis=-1)
    variance = measured.pixel_px**2 * np.eye(2) + measured.point_m**2 * jacobian @ jacobian.transpose(0, 2, 1)
    return np.linalg.solve(np.linalg.cholesky(variance), np.broadcast_to(np.eye(2), variance.shape))


def _bootstrap(
    measured: GroundPoints,
    camera: CameraModel,
    pose: FloatArray,
    whiten: FloatArray,
    free: NDArray[np.int64],
    misses: FloatArray,
    seed: int,
) -> FloatArray:
    """Poses (rounds, 6) that would have been found from other measurements of the same accuracy.

    The accuracy is that which was stated, scaled by what the residuals say: its square is drawn from the inverse
    chi-square distribution of residuals and statement together, so that few points give wide bounds.
    """
    rng = np.random.default_rng(seed)
    squares = float(np.sum(np.einsum("nij,nj->ni", whiten, misses) ** 2))
    freedom = 2 * len(misses) - len(free) + _PRIOR_WEIGHT
    scale = np.sqrt((squares + _PRIOR_WEIGHT) / rng.chisquare(freedom, (_ROUNDS, 1, 1)))
    shape = (_ROUNDS, *measured.points_m.shape)
    points = measured.points_m + scale * measured.point_m * rng.normal(size=shape)
    turn = measured.turn_rad * rng.normal(size=(_ROUNDS, 1))
    arm = measured.points_m - measured.points_m.mean(axis=0)
    points += turn[..., None] * np.stack((-arm[:, 1], arm[:, 0]), axis=-1)
    points += measured.shift_m * rng.normal(size=(_ROUNDS, 1, 2))
    seen = projected(camera, pose[None], measured.points_m[None]) + scale * measured.pixel_px * rng.normal(size=shape)
    return fit_poses(camera, np.repeat(pose[None], _ROUNDS, axis=0), points, seen, whiten, free)


def _ground_errors(
    camera: CameraModel, best: Extrinsics, poses: FloatArray
) -> tuple[dict[float, float], dict[float, float]]:
    distances = distances_m(best.z_m)
    place = np.column_stack((best.x_m + np.array(distances), np.full(3, best.y_m)))
    pixels = GroundCamera(camera, best).ground_to_px(place)
    away = np.linalg.norm(on_ground(camera, poses, pixels) - place, axis=-1)
    rms, bound = np.sqrt(np.mean(away**2, axis=0)), np.sort(away, axis=0)[int(0.95 * len(away))]
    return (dict(zip(distances, rms.tolist(), strict=True)), dict(zip(distances, bound.tolist(), strict=True)))
