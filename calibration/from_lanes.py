"""The camera's attitude and height from the lines of a straight road, and nothing else.

The lines' vanishing point, over pictures of a drive, is where the car heads on average: pitch and yaw. Seen from there
each line lies in a plane through the camera; how steep it is says how far the line is to the side, in heights of the
camera, and a lane's known width gives the height. A camera that rolls sees lanes on one side wider than on the other:
where pictures show lanes at different places, roll is what makes all of them one width.

Roll and height of a camera from lines seen in a plane of view each: all lanes are of one width.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from automodel.config import Extrinsics
from automodel.geometry import CameraModel, GroundCamera, cam_from_body_rotation
from automodel.types import FloatArray, Image
from calibration.vanishing_point_fit import BENDING, Pencil, Rays, common_vanishing_point, fit_pencil

WIDTHS = np.geomspace(0.9, 9.0, 231)  # of a lane, in heights of the camera: 1 % apart
AGREED = 0.04  # of a lane's width: how much lanes differ, one sigma
ONE_LANE = 0.4  # and by how much the distance of two lines may, to count as a lane at all
SUPPORT = 0.12  # share of rows on which a line is seen that needs no more
SMALLER = 0.6  # of the votes of the best width that a smaller one needs: two lanes are no lane
ROLLS_RAD = np.radians(np.arange(-8.0, 8.01, 0.25))
NO_LANE = "pictures: none shows two lines of a lane with the camera between them"
ROLL_PRIOR_RAD, ROLL_KNOWN_RAD = math.radians(3.0), math.radians(0.5)


@dataclass(frozen=True, slots=True, kw_only=True)
class Attitude:
    """A camera's `pitch_rad`, `yaw_rad` and `roll_rad`, and a lane's width in its heights, `width_heights`."""

    pitch_rad: float
    yaw_rad: float
    roll_rad: float
    width_heights: float
    roll_known: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Pairs:
    """Two lines of one picture each: steepness (n, 2) [rad], the left one's last, weight (n,) and the picture (n,)."""

    steepness_rad: FloatArray
    weight: FloatArray
    picture: NDArray[np.intp]

    def widths(self, turn_rad: float) -> FloatArray:
        """Distances (n,) in heights of the camera, of a camera turned by `turn_rad` about the line of travel."""
        right, left = np.tan(np.clip(self.steepness_rad + turn_rad, -1.5, 1.5)).T
        return left - right


def level(direction_cam: FloatArray, roll_rad: float) -> tuple[float, float]:
    """Pitch and yaw [rad] of a camera with that roll that sees body x in `direction_cam` (3,)."""
    right, down, ahead = direction_cam / np.linalg.norm(direction_cam)
    cos, sin = math.cos(roll_rad), math.sin(roll_rad)
    left, up = sin * down - cos * right, -sin * right - cos * down
    return math.atan2(up, ahead), -math.asin(left)


def _rotation(direction_cam: FloatArray, roll_rad: float) -> FloatArray:
    pitch, yaw = level(direction_cam, roll_rad)
    return cam_from_body_rotation(Extrinsics(pitch_rad=pitch, yaw_rad=yaw, roll_rad=roll_rad))


def steepness(pencil: Pencil, focal_px: float) -> FloatArray:
    """The angle (k,) [rad] of the plane through the camera and each line, for a camera without roll.

    0 straight below the camera, positive to the left: the line is tan(angle) heights of the camera to the left.
    """
    ahead = np.array((*pencil.vanishing_px, focal_px))
    along = np.column_stack((pencil.slopes, np.ones(len(pencil.slopes)), np.zeros(len(pencil.slopes))))
    normal = np.cross(ahead, along) @ _rotation(ahead, 0.0)
    return np.arctan(normal[:, 2] / normal[:, 1])


def solve_attitude(
    pencils: Sequence[Pencil], focal_px: float, roll_rad: float, near_heights: float | None = None
) -> Attitude:
    """What the lines of several pictures say; `roll_rad` stands where they do not tell the roll.

    `near_heights` is about a lane's width in heights of the camera, where it is known already. Raises ValueError where
    no two lines lie on both sides of the camera, a lane's width apart.
    """
    middle = np.median([pencil.vanishing_px for pencil in pencils], axis=0)
    ahead = np.array((*middle, focal_px))
    around = _pairs(pencils, focal_px, True)
    turn_given = float(np.interp(roll_rad, ROLLS_RAD, _turns(ahead)))
    width = near_heights or _usual_width(around, turn_given)
    turn, sigma = _level_turn(_within(_pairs(pencils, focal_px, False), width, turn_given))
    known = sigma < ROLL_KNOWN_RAD
    roll = float(np.interp(turn, _turns(ahead), ROLLS_RAD)) if known else roll_rad
    turn = turn if known else turn_given
    own = _within(around, width, turn)
    pitch, yaw = level(ahead, roll)
    widths = _median(own.widths(turn), own.weight)
    return Attitude(pitch_rad=pitch, yaw_rad=yaw, roll_rad=roll, width_heights=widths, roll_known=known)


def _turns(ahead: FloatArray) -> FloatArray:
    """By how much (n,) [rad] each of `ROLLS_RAD` turns the ground about the line of travel."""
    upright = _rotation(ahead, 0.0)
    turned = [_rotation(ahead, float(roll)).T @ upright for roll in ROLLS_RAD]
    return np.array([math.atan2(r[2, 1], r[1, 1]) for r in turned])


def _pairs(pencils: Sequence[Pencil], focal_px: float, around: bool) -> _Pairs:
    """All pairs of lines of each picture; those with the camera between them if `around`."""
    found, weights, pictures = [], [], []
    for number, pencil in enumerate(pencils):
        angle, weight = steepness(pencil, focal_px), np.minimum(pencil.support / SUPPORT, 1.0)
        for i, j in itertools.combinations(np.argsort(angle), 2):
            if not around or angle[i] < 0.0 < angle[j]:
                found.append((angle[i], angle[j]))
                weights.append(min(weight[i], weight[j]))
                pictures.append(number)
    return _Pairs(
        steepness_rad=np.array(found).reshape(-1, 2), weight=np.array(weights), picture=np.array(pictures, np.intp)
    )


def _usual_width(pairs: _Pairs, turn_rad: float) -> float:
    """The smallest width on which the pictures agree about as well as on any."""
    widths = pairs.widths(turn_rad)
    near = np.exp(-0.5 * (np.log(WIDTHS[:, None] / np.maximum(widths, 1e-3)) / AGREED) ** 2)
    each = np.zeros((int(pairs.picture.max(initial=0)) + 1, len(WIDTHS)))
    np.maximum.at(each, pairs.picture, (near * pairs.weight).T)  # a picture has one vote, however many lines it shows
    votes = each.sum(axis=0)
    if not votes.max(initial=0.0) > 0.5:
        raise ValueError(NO_LANE)
    summit = (votes >= np.roll(votes, 1)) & (votes >= np.roll(votes, -1)) & (votes >= SMALLER * votes.max())
    return float(WIDTHS[int(np.argmax(summit))])


def _within(pairs: _Pairs, width: float, turn_rad: float) -> _Pairs:
    """Those pairs that may be one lane; raises ValueError where there are none."""
    lane = np.abs(pairs.widths(turn_rad) / width - 1.0) < ONE_LANE
    if not lane.any():
        raise ValueError(NO_LANE)
    return _Pairs(steepness_rad=pairs.steepness_rad[lane], weight=pairs.weight[lane], picture=pairs.picture[lane])


def _median(values: FloatArray, weight: FloatArray) -> float:
    order = np.argsort(values)
    sums = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(sums, 0.5 * sums[-1])])


def _level_turn(pairs: _Pairs) -> tuple[float, float]:
    """The turn [rad] that makes all lanes one width, and its sigma."""
    turns = ROLLS_RAD
    costs, spreads = [], []
    for turn in turns:
        widths = pairs.widths(float(turn))
        ratio = widths / _median(widths, pairs.weight) - 1.0
        cost = float((pairs.weight * np.minimum((ratio / AGREED) ** 2, 9.0)).sum())
        costs.append(cost + (float(turn) / ROLL_PRIOR_RAD) ** 2)
        spreads.append(ratio)
    at = int(np.argmin(costs))
    best = float(turns[at])
    if 0 < at < len(turns) - 1:
        before, here, after = costs[at - 1 : at + 2]
        curve = before - 2.0 * here + after
        best += 0.5 * (before - after) / max(curve, 1e-9) * float(turns[1] - turns[0])
    near = np.abs(spreads[at]) < 3.0 * AGREED
    step = 1e-3
    slope = (np.log(pairs.widths(best + step)) - np.log(pairs.widths(best - step))) / (2.0 * step)
    weight = pairs.weight * near
    slope = slope - float(weight @ slope) / max(float(weight.sum()), 1e-9)
    information = float(weight @ slope**2) / AGREED**2
    return best, 1.0 / math.sqrt(max(information, 1e-9))


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
