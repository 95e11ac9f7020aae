"""Where the camera sits and looks, from ground points whose places are measured, with the error on the ground."""

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

NAMES = ("x_m", "y_m", "z_m", "pitch_rad", "yaw_rad", "roll_rad")  # the six numbers of a pose, in the body frame
_AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # body axes -> cam x right, y down, z ahead
_ROUNDS = 400  # of the bootstrap
_CORRECTIONS = 2  # Gauss-Newton steps of a round; one is linear error propagation, the second removes most of its bias
_PRIOR_WEIGHT = 2.0  # measurements that the stated accuracy of tape and pixels counts for
_CONTRADICTION = 6.0  # times the stated accuracy; beyond it a point was measured or clicked wrongly
_THIN = 0.08  # ratio of the singular values of the points' extent; below it they are nearly on one line
_USELESS = 0.25  # of the nearest distance: a larger error on the ground is refused
_FULL_SIZE_M = 0.6  # height of the camera from which distances are those of a full-size car


def pose_of(pose: FloatArray) -> Extrinsics:
    """The six numbers by name; raises CalibrationError for a camera that is not over the ground."""
    try:
        return Extrinsics(**dict(zip(NAMES, pose.tolist(), strict=True)))
    except ValueError as error:
        raise CalibrationError(
            f"the points give an impossible camera ({error}); is x_m ahead, and is y_m positive to the left?"
        ) from None


def _cam_from_body(poses: FloatArray) -> FloatArray:
    """Rotations (b, 3, 3) of poses (b, 6), as `automodel.geometry.ground.cam_from_body_rotation`."""
    from scipy.spatial.transform import Rotation

    body_from_axes = Rotation.from_euler("ZYX", poses[:, [4, 3, 5]]).as_matrix()
    return np.asarray(_AXES @ body_from_axes.transpose(0, 2, 1), dtype=np.float64)


def projected(camera: CameraModel, poses: FloatArray, points_m: FloatArray) -> FloatArray:
    """Ground points (b or 1, n, 2) of the body frame -> pixels (b, n, 2) for poses (b, 6); NaN where not visible."""
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
    """A pose (6,) near the solution: the best of `mounting` and the closed-form solutions of Collins and Bartoli 2014.

    With `held` x_m and y_m are those of `mounting`. Raises CalibrationError where no pose sees the points.
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
            candidates.append(pose_of_matrix(matrix, -matrix.T @ np.asarray(shift, np.float64).ravel()))
    least = math.inf
    for pose in candidates:
        if held:
            pose[:2] = mounting.x_m, mounting.y_m
        error = float(np.sum((projected(camera, pose[None], points_m[None])[0] - pixels) ** 2))
        if pose[2] > 0.0 and error < least:
            best, least = pose, error
    if not math.isfinite(least):
        raise CalibrationError(
            "no camera over the ground sees the points like this; is x_m ahead, and is y_m positive to the left?"
        )
    return best


def pose_of_matrix(cam_from_body: FloatArray, centre_m: FloatArray) -> FloatArray:
    """Rotation (3, 3) and optical centre (3,) [m] -> the six numbers of a pose (6,)."""
    from scipy.spatial.transform import Rotation

    yaw, pitch, roll = Rotation.from_matrix((_AXES.T @ cam_from_body).T).as_euler("ZYX")
    return np.array([*centre_m, pitch, yaw, roll])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GroundPoints:
    """Ground points (n, 2) [m] of the body frame and their pixels (n, 2), with their accuracy (one sigma).

    `point_m`: of each point (the tape); `shift_m`, `turn_rad`: of all points together, as of a sheet that lies a little
    beside its place; `pixel_px`: of a pixel.
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
            raise ValueError(
                f"pixels: expected {len(self.points_m)}, one for each ground point, got {len(self.pixels)}"
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GroundCalibration:
    """The camera found. `std` has one sigma of each of the extrinsics, 0 for those that were held.

    `residuals_px` (n, 2): seen minus projected. By distance ahead of the camera [m], the error of a ground point [m]:
    `error_m` is its root mean square, `bound_m` is exceeded in 5 of 100 such calibrations; NaN above the horizon and
    where the lens model ends.
    """

    extrinsics: Extrinsics
    std: Mapping[str, float]
    residual_px: float
    residuals_px: FloatArray
    error_m: Mapping[float, float]
    bound_m: Mapping[float, float]


def fit_pose(
    camera: CameraModel, start: FloatArray, measured: GroundPoints, whiten: FloatArray, free: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """The pose (6,) with the least sum of squared whitened residuals, and their Jacobian (2 n, k).

    `whiten` (n, 2, 2); only the k numbers `free` of the pose change.
    """
    from scipy.optimize import least_squares

    def residuals(values: FloatArray) -> FloatArray:
        pose = start.copy()
        pose[free] = values
        with np.errstate(over="ignore", invalid="ignore"):  # NaN behind the camera: the solver shortens its step
            return _residuals(camera, pose[None], measured.points_m[None], measured.pixels, whiten)[0]

    found = least_squares(residuals, start[free], jac="3-point", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    pose = start.copy()
    pose[free] = found.x
    return pose, np.asarray(found.jac, dtype=np.float64)


def _residuals(
    camera: CameraModel, poses: FloatArray, points_m: FloatArray, pixels: FloatArray, whiten: FloatArray
) -> FloatArray:
    """Whitened (b, 2 n): pixels (b or 1, n, 2) seen minus points (b or 1, n, 2) projected."""
    away = pixels - projected(camera, poses, points_m)
    return np.einsum("nij,bnj->bni", whiten, away).reshape(len(poses), -1)


def distances_m(height_m: float) -> tuple[float, float, float]:
    """The distances ahead of a camera at this height for which errors are given."""
    return (0.5, 1.0, 2.0) if height_m < _FULL_SIZE_M else (5.0, 10.0, 20.0)


def camera_from_points(
    measured: GroundPoints, camera: CameraModel, mounting: Extrinsics, keep_position: bool = False, seed: int = 0
) -> GroundCalibration:
    """The camera that sees the ground points at their pixels.

    `keep_position` holds x_m and y_m of `mounting`. Raises CalibrationError for fewer than four points, and for points
    nearly on one line, outside the image or contradictory.
    """
    _check(measured, camera)
    free = np.array([2, 3, 4, 5] if keep_position else range(6))
    start = start_pose(measured.points_m, measured.pixels, camera, mounting, keep_position)
    whiten = _whitening(measured, camera, start)
    pose, jacobian = fit_pose(camera, start, measured, whiten, free)
    residuals = measured.pixels - projected(camera, pose[None], measured.points_m[None])[0]
    whitened = np.einsum("nij,nj->ni", whiten, residuals)
    _check_residuals(measured, whitened, residuals, len(free))
    scale = _accuracy_scales(whitened, len(free), rng := np.random.default_rng(seed))
    points, pixels = _measured_again(measured, camera, pose, scale, rng)
    poses = np.repeat(pose[None], _ROUNDS, axis=0)
    for _ in range(_CORRECTIONS):
        poses[:, free] -= _residuals(camera, poses, points, pixels, whiten) @ np.linalg.pinv(jacobian).T
    extrinsics = pose_of(pose)
    error_m, bound_m = _ground_errors(camera, extrinsics, poses)
    nearest = next(iter(error_m))
    if not error_m[nearest] < _USELESS * nearest:
        raise CalibrationError(
            f"the points do not determine the camera: {nearest:g} m ahead the ground would be wrong by "
            f"{1e3 * error_m[nearest]:.0f} mm; spread them over the ground from near to far and from side to side"
        )
    return GroundCalibration(
        extrinsics=extrinsics,
        std={name: float(poses[:, i].std()) if i in free else 0.0 for i, name in enumerate(NAMES)},
        residual_px=math.sqrt(float(np.mean(np.sum(residuals**2, axis=1)))),
        residuals_px=residuals,
        error_m=error_m,
        bound_m=bound_m,
    )


def _check(measured: GroundPoints, camera: CameraModel) -> None:
    count = len(measured.points_m)
    if count < 4:
        raise CalibrationError(f"expected at least four ground points, better six, got {count}")
    if not (np.isfinite(measured.points_m).all() and np.isfinite(measured.pixels).all()):
        raise CalibrationError("the ground points are not all finite numbers")
    outside = np.flatnonzero(~camera.inside(measured.pixels))
    if len(outside):
        u, v = measured.pixels[outside[0]]
        raise CalibrationError(
            f"point {outside[0] + 1}: pixel ({u:g}, {v:g}) lies outside the image of "
            f"{camera.width_px}x{camera.height_px}"
        )
    for name, places in (("on the ground", measured.points_m), ("in the image", measured.pixels)):
        lengths = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
        if lengths[1] < _THIN * lengths[0]:
            raise CalibrationError(
                f"the points lie nearly on one line {name}; spread them from near to far and from side to side"
            )


def _check_residuals(measured: GroundPoints, whitened: FloatArray, residuals: FloatArray, unknowns: int) -> None:
    scale = math.sqrt(float(np.sum(whitened**2)) / (2 * len(whitened) - unknowns))
    if scale < _CONTRADICTION:
        return
    worst = int(np.argmax(np.linalg.norm(whitened, axis=1)))
    (x, y), off_px = measured.points_m[worst], float(np.linalg.norm(residuals[worst]))
    raise CalibrationError(
        f"the points contradict each other, most of all point {worst + 1} ({x:g} m ahead, {y:g} m to the left), seen "
        f"{off_px:.0f} px from where it should be; measure and read it again (and is y_m positive to the left?)"
    )


def _whitening(measured: GroundPoints, camera: CameraModel, pose: FloatArray) -> FloatArray:
    """(n, 2, 2): scales a residual by its expected size; near the car an error of the tape is many pixels."""
    at = measured.points_m
    steps = [projected(camera, pose[None], (at + step)[None])[0] for step in ((1e-4, 0.0), (0.0, 1e-4))]
    here = projected(camera, pose[None], at[None])[0]
    jacobian = np.stack([(step - here) / 1e-4 for step in steps], axis=-1)
    variance = measured.pixel_px**2 * np.eye(2) + measured.point_m**2 * jacobian @ jacobian.transpose(0, 2, 1)
    return np.linalg.solve(np.linalg.cholesky(variance), np.broadcast_to(np.eye(2), variance.shape))


def _accuracy_scales(whitened: FloatArray, unknowns: int, rng: np.random.Generator) -> FloatArray:
    """Factors (rounds, 1, 1) of the stated accuracy, drawn for the bootstrap.

    Their squares have the inverse chi-square distribution of the residuals together with the statement, so that few
    points give wide bounds.
    """
    freedom = whitened.size - unknowns + _PRIOR_WEIGHT
    return np.sqrt((float(np.sum(whitened**2)) + _PRIOR_WEIGHT) / rng.chisquare(freedom, (_ROUNDS, 1, 1)))


def _measured_again(
    measured: GroundPoints, camera: CameraModel, pose: FloatArray, scale: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Points (rounds, n, 2) [m] and pixels (rounds, n, 2) as repeated measurements would give them."""
    shape = (_ROUNDS, *measured.points_m.shape)
    points = measured.points_m + scale * measured.point_m * rng.normal(size=shape)
    turn = measured.turn_rad * rng.normal(size=(_ROUNDS, 1))
    arm = measured.points_m - measured.points_m.mean(axis=0)
    points += turn[..., None] * np.stack((-arm[:, 1], arm[:, 0]), axis=-1)
    points += measured.shift_m * rng.normal(size=(_ROUNDS, 1, 2))
    seen = projected(camera, pose[None], measured.points_m[None]) + scale * measured.pixel_px * rng.normal(size=shape)
    return points, seen


def _ground_errors(
    camera: CameraModel, best: Extrinsics, poses: FloatArray
) -> tuple[dict[float, float], dict[float, float]]:
    distances = distances_m(best.z_m)
    place = np.column_stack((best.x_m + np.array(distances), np.full(3, best.y_m)))
    pixels = GroundCamera(camera, best).ground_to_px(place)
    away = np.linalg.norm(on_ground(camera, poses, pixels) - place, axis=-1)
    rms, bound = np.sqrt(np.mean(away**2, axis=0)), np.sort(away, axis=0)[int(0.95 * len(away))]
    return (dict(zip(distances, rms.tolist(), strict=True)), dict(zip(distances, bound.tolist(), strict=True)))
