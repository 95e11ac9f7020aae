"""The camera's attitude and height from the lines of a straight road, and nothing else.

The lines' vanishing point, over pictures of a drive, is where the car heads on average: pitch and yaw. Seen from there
each line lies in a plane through the camera; how steep it is says how far the line is to the side, in heights of the
camera, and a lane's known width gives the height. A camera that rolls sees lanes on one side wider than on the other:
where pictures show lanes at different places, roll is what makes all of them one width.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from automodel.config import Extrinsics
from automodel.geometry import CameraModel, GroundCamera
from automodel.types import FloatArray, Image
from calibration.lane_widths import Attitude, solve_attitude
from calibration.pencils import BENDING, Pencil, fit_pencil
from calibration.picture_lines import Rays, common_vanishing_point

SLACK = 0.02  # of the picture's width: how far the vanishing point moves as the car turns and nods, one sigma
ASTRAY, STRAY_SIGMAS = (
    0.03,
    4.0,
)  # of that width, and of the pictures' own spread: further off a vanishing point is wrong
LEAST_SHARE = 0.3  # of the pictures must show a straight road
LEAST_SUPPORT = 0.4  # shares of the rows on which the lines of a picture are seen, all together
CURVED = 5.0  # sigmas of `BENDING`
ROUNDS = 100  # of the bootstrap
SCALE_CAR_M, FULL_SIZE_M = (0.5, 1.0, 2.0), (5.0, 10.0, 20.0)
FULL_SIZE_FROM_M = 1.5  # of a lane's width


@dataclass(frozen=True, slots=True, kw_only=True)
class LanesCalibration:
    """What the lines say of the camera.

    `extrinsics` keeps the `x_m` and `y_m` that were given, and their roll where `roll_known` is False.
    `ground_error_m`: by distance ahead of the camera [m], how far a ground point is misplaced [m], RMS of a bootstrap
    over the pictures; an error of the lane's width comes on top, all lengths grow with it. `residual_px` is the RMS
    distance of the lines' points from the lines, `vanishing_px` where those meet in the picture, `vanishing_sigma_px`
    how much that varies from picture to picture (u, v). `frames_used` of `frames_seen` pictures counted.
    """

    extrinsics: Extrinsics
    lane_width_m: float
    roll_known: bool
    residual_px: float
    vanishing_px: tuple[float, float]
    vanishing_sigma_px: tuple[float, float]
    ground_error_m: dict[float, float]
    frames_used: int
    frames_seen: int


def camera_from_lanes(
    pictures: Iterable[Image],
    camera: CameraModel,
    lane_width_m: float,
    mounting: Extrinsics | None = None,
    least_frames: int = 3,
    seed: int = 0,
) -> LanesCalibration:
    """The camera's extrinsics from `pictures` (h, w) or (h, w, 3) of a drive along lanes of a known width.

    `camera` are its intrinsics; `mounting` says what pictures cannot: x_m and y_m, and roll where lines do not tell it.
    Yaw is right where the car heads along the lane on the median. Raises ValueError, in one line, when nothing can be
    concluded: too few pictures, no lines that meet, a curve, no lane about the camera.
    """
    images = list(pictures)
    if not lane_width_m > 0:
        raise ValueError(f"lane_width_m: {lane_width_m} where a positive number is wanted")
    _check_sizes(images, camera, least_frames)
    place, points = common_vanishing_point(images, camera)
    size, rays = (camera.width_px, camera.height_px), Rays(camera)
    fits = [fit_pencil(p, place, rays, size, SLACK) for p in points]
    pencils = _straight(fits, camera, least_frames)
    mounting = mounting or Extrinsics(roll_rad=0.0)
    found = solve_attitude(pencils, camera.matrix[0, 0], mounting.roll_rad)
    extrinsics = _extrinsics(found, lane_width_m, mounting)
    places = np.array([pencil.vanishing_px for pencil in pencils])
    spread = 1.4826 * np.median(np.abs(places - np.median(places, axis=0)), axis=0)
    u, v = camera.project(GroundCamera(camera, extrinsics).cam_from_body[:, 0])
    best = LanesCalibration(
        extrinsics=extrinsics,
        lane_width_m=lane_width_m,
        roll_known=found.roll_known,
        residual_px=math.sqrt(float(np.mean([pencil.residual_px**2 for pencil in pencils]))),
        vanishing_px=(float(u), float(v)),
        vanishing_sigma_px=(float(spread[0]), float(spread[1])),
        ground_error_m={},
        frames_used=len(pencils),
        frames_seen=len(images),
    )
    return replace(best, ground_error_m=_ground_errors(camera, best, pencils, mounting.roll_rad, seed))


def _check_sizes(pictures: Sequence[Image], camera: CameraModel, least_frames: int) -> None:
    if len(pictures) < max(least_frames, 1):
        raise ValueError(
            f"pictures: {len(pictures)} where {max(least_frames, 1)} or more of a straight road are wanted"
        )
    for number, image in enumerate(pictures):
        if image.shape[:2] != (camera.height_px, camera.width_px):
            height, width = image.shape[:2]
            raise ValueError(
                f"pictures: number {number} has {width}x{height} pixels where the camera has"
                f" {camera.width_px}x{camera.height_px}"
            )


def _straight(fits: Sequence[Pencil | None], camera: CameraModel, least_frames: int) -> list[Pencil]:
    """The pictures' pencils that show a straight road and agree on where its lines meet."""
    least = max(least_frames, math.ceil(LEAST_SHARE * len(fits)))
    wanted = f"{least} of a straight road with two lines are wanted"
    seen = [pencil for pencil in fits if pencil is not None and pencil.support.sum() >= LEAST_SUPPORT]
    if len(seen) < least:
        raise ValueError(f"pictures: {len(seen)} of {len(fits)} show lines that meet in one point; {wanted}")
    bend = CURVED * BENDING * camera.height_px**2
    straight = [pencil for pencil in seen if abs(pencil.bend_px2) < bend]
    if len(straight) < least:
        raise ValueError(f"pictures: {len(seen) - len(straight)} of {len(fits)} show a curve; {wanted}")
    places = np.array([pencil.vanishing_px for pencil in straight])
    away = np.abs(places - np.median(places, axis=0))
    limit = np.maximum(STRAY_SIGMAS * 1.4826 * np.median(away, axis=0), ASTRAY * camera.width_px)
    kept = [pencil for pencil, far in zip(straight, away, strict=True) if (far <= limit).all()]
    if len(kept) < least:
        raise ValueError(f"pictures: the lines of {len(kept)} of {len(fits)} meet in the same place; {wanted}")
    return kept


def _extrinsics(found: Attitude, lane_width_m: float, mounting: Extrinsics) -> Extrinsics:
    return replace(
        mounting,
        z_m=lane_width_m / found.width_heights,
        pitch_rad=found.pitch_rad,
        yaw_rad=found.yaw_rad,
        roll_rad=found.roll_rad,
    )


def _ground_errors(
    camera: CameraModel, best: LanesCalibration, pencils: Sequence[Pencil], roll_rad: float, seed: int
) -> dict[float, float]:
    """By distance ahead of the camera [m]: the RMS displacement [m] over resampled pictures."""
    rng = np.random.default_rng(seed)
    distances = np.array(SCALE_CAR_M if best.lane_width_m < FULL_SIZE_FROM_M else FULL_SIZE_M)
    place = np.column_stack((best.extrinsics.x_m + distances, np.full(3, best.extrinsics.y_m)))
    pixels = GroundCamera(camera, best.extrinsics).ground_to_px(place)
    squares: list[FloatArray] = []
    for _ in range(ROUNDS):
        drawn = [_shaken(pencils[i], rng) for i in rng.integers(len(pencils), size=len(pencils))]
        try:
            found = solve_attitude(drawn, camera.matrix[0, 0], roll_rad, best.lane_width_m / best.extrinsics.z_m)
        except ValueError:  # by chance none of the drawn shows a lane
            continue
        other = GroundCamera(camera, _extrinsics(found, best.lane_width_m, best.extrinsics))
        squares.append(np.sum((other.px_to_ground(pixels) - place) ** 2, axis=1))
    known = np.array(squares or np.full((1, 3), np.inf))
    known[np.isnan(known)] = np.inf  # a pixel above the horizon: that far nothing is known
    rms = np.sqrt(known.mean(axis=0))
    return {float(at): float(error) for at, error in zip(distances, rms, strict=True)}


def _shaken(pencil: Pencil, rng: np.random.Generator) -> Pencil:
    """The pencil as it might have been measured as well."""
    error = rng.multivariate_normal(np.zeros(len(pencil.covariance)), pencil.covariance, method="eigh")
    return replace(pencil, vanishing_px=pencil.vanishing_px + error[:2], slopes=pencil.slopes + error[3:])
