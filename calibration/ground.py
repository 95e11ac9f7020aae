"""Where the camera sits and looks, from ground points whose places are measured, with the error on the ground."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from automodel.config import Extrinsics
from automodel.geometry import CameraModel, GroundCamera
from automodel.types import FloatArray
from calibration.pose_fit import NAMES, fit_poses, on_ground, pose_of, projected, start_pose
from calibration.views import CalibrationError

__all__ = ["GroundCalibration", "GroundPoints", "camera_from_points", "distances_m"]


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
