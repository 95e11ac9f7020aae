"""The camera's attitude and height from images of a straight road alone.

The vanishing point of the lines, over the images of a drive, is where the car heads on average: it gives pitch and yaw.
Each line lies in a plane through the camera. The steepness of that plane gives the lateral distance of the line in
camera heights, and the known width of a lane gives the height. A camera with roll sees lanes on one side wider than on
the other: where the images show lanes at different places, roll is the angle that makes all of them one width.
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
from calibration.vanishing_point_fit import (
    BENDING,
    CommonPoint,
    ConvergingLines,
    Rays,
    common_vanishing_point,
    fit_converging_lines,
)

WIDTHS = np.geomspace(0.9, 9.0, 231)  # of a lane, in camera heights, in steps of 1 %
AGREED = 0.04  # of a lane's width: one sigma of the difference between lanes
ONE_LANE = 0.4  # of a lane's width: largest difference of two lines' distance from it for a pair to be a lane
SUPPORT = 0.12  # share of rows from which a line has full weight
SMALLER = 0.6  # share of the most votes that a smaller width needs to be preferred: it may be one lane of two
ROLLS_RAD = np.radians(np.arange(-8.0, 8.01, 0.25))
NO_LANE = "images: none shows two lines of a lane with the camera between them"
ROLL_PRIOR_RAD, ROLL_KNOWN_RAD = math.radians(3.0), math.radians(0.5)


@dataclass(frozen=True, slots=True, kw_only=True)
class Attitude:
    """A camera's `pitch_rad`, `yaw_rad` and `roll_rad`, and the width of a lane in camera heights."""

    pitch_rad: float
    yaw_rad: float
    roll_rad: float
    width_heights: float
    roll_known: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Pairs:
    """Pairs of lines of one image: steepness (n, 2) [rad], right line first, weight (n,) and image number (n,)."""

    steepness_rad: FloatArray
    weight: FloatArray
    image: NDArray[np.intp]

    def widths(self, turn_rad: float) -> FloatArray:
        """Distances (n,) in camera heights, for a camera rotated by `turn_rad` about the direction of travel."""
        right, left = np.tan(np.clip(self.steepness_rad + turn_rad, -1.5, 1.5)).T
        return left - right


def level(direction_cam: FloatArray, roll_rad: float) -> tuple[float, float]:
    """Pitch and yaw [rad] of a camera with this roll that sees body x in `direction_cam` (3,)."""
    right, down, ahead = direction_cam / np.linalg.norm(direction_cam)
    cos, sin = math.cos(roll_rad), math.sin(roll_rad)
    left, up = sin * down - cos * right, -sin * right - cos * down
    return math.atan2(up, ahead), -math.asin(left)


def _rotation(direction_cam: FloatArray, roll_rad: float) -> FloatArray:
    pitch, yaw = level(direction_cam, roll_rad)
    return cam_from_body_rotation(Extrinsics(pitch_rad=pitch, yaw_rad=yaw, roll_rad=roll_rad))


def steepness(lines: ConvergingLines, focal_px: float) -> FloatArray:
    """The angle (k,) [rad] of the plane through the camera and each line, for a camera without roll.

    0 is straight below the camera, positive to the left: the line is tan(angle) camera heights to the left.
    """
    ahead = np.array((*lines.vanishing_px, focal_px))
    along = np.column_stack((lines.slopes, np.ones(len(lines.slopes)), np.zeros(len(lines.slopes))))
    normal = np.cross(ahead, along) @ _rotation(ahead, 0.0)
    return np.arctan(normal[:, 2] / normal[:, 1])


def solve_attitude(
    bundles: Sequence[ConvergingLines], focal_px: float, roll_rad: float, near_heights: float | None = None
) -> Attitude:
    """The attitude from the lines of several images; roll is `roll_rad` where they do not determine it.

    `near_heights` is the approximate width of a lane in camera heights, where it is known. Raises ValueError where no
    two lines lie on both sides of the camera, a lane's width apart.
    """
    middle = np.median([lines.vanishing_px for lines in bundles], axis=0)
    ahead = np.array((*middle, focal_px))
    around = _pairs(bundles, focal_px, True)
    turn_given = float(np.interp(roll_rad, ROLLS_RAD, _turns(ahead)))
    width = near_heights or _usual_width(around, turn_given)
    turn, sigma = _level_turn(_within(_pairs(bundles, focal_px, False), width, turn_given))
    known = sigma < ROLL_KNOWN_RAD
    roll = float(np.interp(turn, _turns(ahead), ROLLS_RAD)) if known else roll_rad
    turn = turn if known else turn_given
    own = _within(around, width, turn)
    pitch, yaw = level(ahead, roll)
    widths = _median(own.widths(turn), own.weight)
    return Attitude(pitch_rad=pitch, yaw_rad=yaw, roll_rad=roll, width_heights=widths, roll_known=known)


def _turns(ahead: FloatArray) -> FloatArray:
    """The rotation (n,) [rad] of the ground about the direction of travel for each of `ROLLS_RAD`."""
    upright = _rotation(ahead, 0.0)
    turned = [_rotation(ahead, float(roll)).T @ upright for roll in ROLLS_RAD]
    return np.array([math.atan2(r[2, 1], r[1, 1]) for r in turned])


def _pairs(bundles: Sequence[ConvergingLines], focal_px: float, around: bool) -> _Pairs:
    """All pairs of lines of each image; with `around` only those with the camera between them."""
    found, weights, images = [], [], []
    for number, lines in enumerate(bundles):
        angle, weight = steepness(lines, focal_px), np.minimum(lines.support / SUPPORT, 1.0)
        for i, j in itertools.combinations(np.argsort(angle), 2):
            if not around or angle[i] < 0.0 < angle[j]:
                found.append((angle[i], angle[j]))
                weights.append(min(weight[i], weight[j]))
                images.append(number)
    return _Pairs(
        steepness_rad=np.array(found).reshape(-1, 2), weight=np.array(weights), image=np.array(images, np.intp)
    )


def _usual_width(pairs: _Pairs, turn_rad: float) -> float:
    """The smallest width with about as many votes as the best one."""
    widths = pairs.widths(turn_rad)
    near = np.exp(-0.5 * (np.log(WIDTHS[:, None] / np.maximum(widths, 1e-3)) / AGREED) ** 2)
    each = np.zeros((int(pairs.image.max(initial=0)) + 1, len(WIDTHS)))
    np.maximum.at(each, pairs.image, (near * pairs.weight).T)  # an image has one vote, however many lines it shows
    votes = each.sum(axis=0)
    if not votes.max(initial=0.0) > 0.5:
        raise ValueError(NO_LANE)
    summit = (votes >= np.roll(votes, 1)) & (votes >= np.roll(votes, -1)) & (votes >= SMALLER * votes.max())
    return float(WIDTHS[int(np.argmax(summit))])


def _within(pairs: _Pairs, width: float, turn_rad: float) -> _Pairs:
    """The pairs that may be one lane; raises ValueError where there are none."""
    lane = np.abs(pairs.widths(turn_rad) / width - 1.0) < ONE_LANE
    if not lane.any():
        raise ValueError(NO_LANE)
    return _Pairs(steepness_rad=pairs.steepness_rad[lane], weight=pairs.weight[lane], image=pairs.image[lane])


def _median(values: FloatArray, weight: FloatArray) -> float:
    order = np.argsort(values)
    sums = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(sums, 0.5 * sums[-1])])


def _level_turn(pairs: _Pairs) -> tuple[float, float]:
    """The rotation [rad] that makes all lanes one width, and its sigma."""
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


SLACK = 0.02  # of the image's width: one sigma of the vanishing point's motion as the car turns and pitches
ASTRAY = 0.03  # of the image's width: a vanishing point within it of the median is never an outlier
STRAY_SIGMAS = 4.0  # of the images' own spread; beyond both limits it is one
LEAST_SHARE = 0.3  # of the images that must show a straight road
LEAST_SUPPORT = 0.4  # sum over an image's lines of the share of rows on which each is seen
CURVED = 5.0  # sigmas of `BENDING`
# What two halves of one drive may differ by. A pitch beyond it, or two lanes taken for one, is no error of measurement;
# the halves of right calibrations differ by a third of it.
SAME_PITCH_RAD, SAME_HEIGHT = math.radians(1.5), 1.15
SURE_HEIGHT = 0.05  # of the height: one sigma from which on it counts as unknown
# One sigma of the pitch from which on it counts as unknown: of cameras in random worlds the right ones had up to
# 0.26 deg, those that took a bend or a reflection for a straight line 0.5 deg and more.
SURE_PITCH_RAD = math.radians(0.4)
WHAT_HELPS = "use a part of the drive with a straight road and few reflections"
ROUNDS = 100  # of the bootstrap
STATED = ("z_m", "pitch_rad", "yaw_rad", "roll_rad")  # of which a sigma is given
SCALE_CAR_M, FULL_SIZE_M = (0.5, 1.0, 2.0), (5.0, 10.0, 20.0)
FULL_SIZE_FROM_M = 1.5  # of a lane's width


@dataclass(frozen=True, slots=True, kw_only=True)
class LanesCalibration:
    """The camera found from the lines.

    `extrinsics` keeps the given `x_m` and `y_m`, and the given roll where `roll_known` is False. `ground_error_m`: by
    distance ahead of the camera [m], the RMS error of a ground point [m], by a bootstrap over the images, as is `std`:
    one sigma of z_m [m] and of pitch_rad, yaw_rad and roll_rad. An error of the lane's width scales all lengths and is
    not included. `markings` is "light" or "dark", `marking_heights` about their width in camera heights. `residual_px`
    is the RMS distance of the points from their lines, `vanishing_px` the vanishing point, `vanishing_sigma_px` its
    spread over the images (u, v). `frames_used` of `frames_seen` images were used.
    """

    extrinsics: Extrinsics
    lane_width_m: float
    roll_known: bool
    residual_px: float
    vanishing_px: tuple[float, float]
    vanishing_sigma_px: tuple[float, float]
    ground_error_m: dict[float, float]
    std: dict[str, float]
    markings: str
    marking_heights: float
    frames_used: int
    frames_seen: int


def camera_from_lanes(
    images: Iterable[Image],
    camera: CameraModel,
    lane_width_m: float,
    mounting: Extrinsics | None = None,
    least_frames: int = 3,
    seed: int = 0,
    markings: str = "both",
) -> LanesCalibration:
    """The camera's extrinsics from `images` (h, w) or (h, w, 3) of a drive along lanes of a known width.

    `camera` has its intrinsics; `mounting` gives what images cannot: x_m and y_m, and roll where the lines do not
    determine it. `markings` against the floor are "light", "dark", or what the images show better ("both").
    Yaw is right if the car's median heading is along the lane. Raises ValueError for too few images, no
    lines that meet, a curve, or no lane around the camera.
    """
    images = list(images)
    if not lane_width_m > 0:
        raise ValueError(f"lane_width_m: expected a positive number, got {lane_width_m}")
    _check_sizes(images, camera, least_frames)
    shown, polarity = sharpest_markings(images, camera, markings)
    bundles = _straight(_fits(shown, camera), camera, least_frames)
    mounting = mounting or Extrinsics(roll_rad=0.0)
    found = solve_attitude(bundles, camera.matrix[0, 0], mounting.roll_rad)
    extrinsics = _extrinsics(found, lane_width_m, mounting)
    places = np.array([lines.vanishing_px for lines in bundles])
    spread = 1.4826 * np.median(np.abs(places - np.median(places, axis=0)), axis=0)
    u, v = camera.project(GroundCamera(camera, extrinsics).cam_from_body[:, 0])
    best = LanesCalibration(
        extrinsics=extrinsics,
        lane_width_m=lane_width_m,
        roll_known=found.roll_known,
        residual_px=math.sqrt(float(np.mean([lines.residual_px**2 for lines in bundles]))),
        vanishing_px=(float(u), float(v)),
        vanishing_sigma_px=(float(spread[0]), float(spread[1])),
        ground_error_m={},
        std={},
        markings=polarity,
        marking_heights=shown.marking,
        frames_used=len(bundles),
        frames_seen=len(images),
    )
    error_m, std = _errors(camera, best, bundles, mounting.roll_rad, seed)
    return replace(best, ground_error_m=error_m, std=std)


def sharpest_markings(images: Sequence[Image], camera: CameraModel, markings: str) -> tuple[CommonPoint, str]:
    """Where the lines meet, and whether they are "light" or "dark"; "both" looks for either and takes the clearer."""
    wanted = ("light", "dark") if markings == "both" else (markings,)
    seen = [
        (common_vanishing_point([255 - image for image in images] if name == "dark" else images, camera), name)
        for name in wanted
    ]
    return max(seen, key=lambda each: each[0].sharpness)


def check_consistent(images: Sequence[Image], camera: CameraModel, found: LanesCalibration) -> None:
    """Raise ValueError where the images leave height or pitch open, or the drive's halves show different cameras.

    A bend or a reflection that is taken for straight lines is the same in images in a row, not over the whole drive.
    """
    share = found.std["z_m"] / found.extrinsics.z_m
    if not share < SURE_HEIGHT:
        raise ValueError(f"images: they leave the height of the camera open by {100.0 * share:.0f} %; {WHAT_HELPS}")
    if not found.std["pitch_rad"] < SURE_PITCH_RAD:
        open_deg = math.degrees(found.std["pitch_rad"])
        raise ValueError(f"images: they leave the pitch of the camera open by {open_deg:.1f} deg; {WHAT_HELPS}")
    middle = len(images) // 2
    for part, half in (("first", images[:middle]), ("second", images[middle:])):
        try:
            own = camera_from_lanes(
                half, camera, found.lane_width_m, found.extrinsics, markings=found.markings
            ).extrinsics
        except ValueError:  # mostly bends: the other half has the straight road
            continue
        pitch_rad, ratio = own.pitch_rad - found.extrinsics.pitch_rad, own.z_m / found.extrinsics.z_m
        if abs(pitch_rad) > SAME_PITCH_RAD or not 1.0 / SAME_HEIGHT < ratio < SAME_HEIGHT:
            raise ValueError(
                f"images: the {part} half of the drive shows a camera {math.degrees(pitch_rad):+.1f} deg lower and "
                f"{ratio:.2f} times as high as all of it; {WHAT_HELPS}"
            )


def line_residuals(images: Sequence[Image], camera: CameraModel, markings: str) -> FloatArray:
    """The RMS distance (n,) [ideal px] of marking points from their lines in each image; NaN without two lines."""
    shown, _ = sharpest_markings(images, camera, markings)
    return np.array([math.nan if fit is None else fit.residual_px for fit in _fits(shown, camera)])


def _fits(shown: CommonPoint, camera: CameraModel) -> list[ConvergingLines | None]:
    size, rays = (camera.width_px, camera.height_px), Rays(camera)
    return [fit_converging_lines(points, shown.vanishing_px, rays, size, SLACK) for points in shown.points]


def _check_sizes(images: Sequence[Image], camera: CameraModel, least_frames: int) -> None:
    if len(images) < max(least_frames, 1):
        raise ValueError(f"images: expected {max(least_frames, 1)} or more of a straight road, got {len(images)}")
    for number, image in enumerate(images):
        if image.shape[:2] != (camera.height_px, camera.width_px):
            height, width = image.shape[:2]
            raise ValueError(
                f"images: expected {camera.width_px}x{camera.height_px} pixels as the camera has, number {number} has "
                f"{width}x{height}"
            )


def _straight(fits: Sequence[ConvergingLines | None], camera: CameraModel, least_frames: int) -> list[ConvergingLines]:
    """The lines of those images that show a straight road and agree on the vanishing point."""
    least = max(least_frames, math.ceil(LEAST_SHARE * len(fits)))
    wanted = f"expected {least} of a straight road with two lines"
    seen = [lines for lines in fits if lines is not None and lines.support.sum() >= LEAST_SUPPORT]
    if len(seen) < least:
        raise ValueError(f"images: {wanted}; {len(seen)} of {len(fits)} show lines that meet in one point")
    bend = CURVED * BENDING * camera.height_px**2
    straight = [lines for lines in seen if abs(lines.bend_px2) < bend]
    if len(straight) < least:
        raise ValueError(f"images: {wanted}; {len(seen) - len(straight)} of {len(fits)} show a curve")
    places = np.array([lines.vanishing_px for lines in straight])
    away = np.abs(places - np.median(places, axis=0))
    limit = np.maximum(STRAY_SIGMAS * 1.4826 * np.median(away, axis=0), ASTRAY * camera.width_px)
    kept = [lines for lines, far in zip(straight, away, strict=True) if (far <= limit).all()]
    if len(kept) < least:
        raise ValueError(f"images: {wanted}; the lines of {len(kept)} of {len(fits)} meet in the same place")
    return kept


def _extrinsics(found: Attitude, lane_width_m: float, mounting: Extrinsics) -> Extrinsics:
    return replace(
        mounting,
        z_m=lane_width_m / found.width_heights,
        pitch_rad=found.pitch_rad,
        yaw_rad=found.yaw_rad,
        roll_rad=found.roll_rad,
    )


def _errors(
    camera: CameraModel, best: LanesCalibration, bundles: Sequence[ConvergingLines], roll_rad: float, seed: int
) -> tuple[dict[float, float], dict[str, float]]:
    """Over resampled images: by distance ahead of the camera [m] the RMS error [m] of a ground point, and `std`."""
    rng = np.random.default_rng(seed)
    distances = np.array(SCALE_CAR_M if best.lane_width_m < FULL_SIZE_FROM_M else FULL_SIZE_M)
    place = np.column_stack((best.extrinsics.x_m + distances, np.full(3, best.extrinsics.y_m)))
    pixels = GroundCamera(camera, best.extrinsics).ground_to_px(place)
    squares: list[FloatArray] = []
    poses: list[tuple[float, ...]] = []
    for _ in range(ROUNDS):
        drawn = [_perturbed(bundles[i], rng) for i in rng.integers(len(bundles), size=len(bundles))]
        try:
            found = solve_attitude(drawn, camera.matrix[0, 0], roll_rad, best.lane_width_m / best.extrinsics.z_m)
        except ValueError:  # by chance no image drawn shows a lane
            continue
        extrinsics = _extrinsics(found, best.lane_width_m, best.extrinsics)
        poses.append(tuple(getattr(extrinsics, name) for name in STATED))
        other = GroundCamera(camera, extrinsics)
        squares.append(np.sum((other.px_to_ground(pixels) - place) ** 2, axis=1))
    known = np.array(squares or np.full((1, 3), np.inf))
    known[np.isnan(known)] = np.inf  # a pixel above the horizon
    rms = np.sqrt(known.mean(axis=0))
    spread = np.std(poses, axis=0) if poses else np.full(len(STATED), np.inf)
    return (
        dict(zip(distances.tolist(), rms.tolist(), strict=True)),
        dict(zip(STATED, spread.tolist(), strict=True)),
    )


def _perturbed(lines: ConvergingLines, rng: np.random.Generator) -> ConvergingLines:
    """The lines with a random error of their covariance."""
    error = rng.multivariate_normal(np.zeros(len(lines.covariance)), lines.covariance, method="eigh")
    return replace(lines, vanishing_px=lines.vanishing_px + error[:2], slopes=lines.slopes + error[3:])
