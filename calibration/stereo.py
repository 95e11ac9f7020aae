"""Lens and place of the right camera of a pair, from views of a board that both cameras see at the same time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from automodel.config import CarConfig, ConfigError, Extrinsics, Intrinsics
from automodel.geometry import CameraModel, GroundCamera
from automodel.perception.stereo.points import epipolar
from automodel.types import FloatArray
from calibration.boards import Board, FoundBoard
from calibration.camera import FEWEST_VIEWS, OUTLIER, OUTLIER_PX, Check, graded, intrinsics_of, rms_of
from calibration.ground import NAMES, pose_of_matrix
from calibration.stereo_fit import LENS, Fit, Rig, Sight, board_pose, fit_pair, matrices, start_boards
from calibration.views import CalibrationError, Refused, View

_FOLDS = 5
_SAME_PLACE_M = 1e-3  # as `stereo` refuses a pair
_WRONG_WAY = -0.5  # cosine: a baseline nearer to the opposite direction than to a right angle
_LOOSE_RAD, _USELESS_RAD = math.radians(0.4) / 3.0, math.radians(1.2) / 3.0  # one sigma; three are the doctor's limits
# of a pair: what the ground plane of `stereo` takes in, and what it does not
_BASELINE_OFF = 0.01, 0.05  # shares, as those of a focal length in `check_camera`: both scale all distances


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairView:
    """One pair of images: the right camera's view of the board, and the left one's where it shows the same corners."""

    name: str
    right: View
    left: View | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairError:
    """The error of one pair, both cameras' corners together, as in `camera.ViewError`.

    `epipolar_px` (n,): how far the right camera's corners lie off the epipolar lines of the left one's, in the fit
    without the pair.
    """

    pair: PairView
    rms_px: float
    held_out_px: float
    epipolar_px: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StereoCalibration:
    """The right camera found, and its accuracy.

    `std` has one sigma of each of the extrinsics, relative to the left camera: errors of its calibration are not in it.
    `rms_px`: over all corners of both cameras; `cross_validated_px`: the same, each pair in a fit without it, in which
    only the board's pose is fitted; `epipolar_px`: root mean square, of pairs in fits without them.
    """

    intrinsics: Intrinsics
    extrinsics: Extrinsics
    std: dict[str, float]
    baseline_m: float
    rms_px: float
    cross_validated_px: float
    epipolar_px: float
    pairs: tuple[PairError, ...]
    dropped: tuple[Refused, ...]


def pair_views(left: Sequence[View], right: Sequence[View], board: Board) -> list[PairView]:
    """Views of both cameras, by the name of their pair.

    A ChArUco board counts for both where they share a corner, a chessboard where each sees the whole of it: of a part
    nothing tells which part it is. Its corners are then in the left camera's order; the cameras may be rolled against
    each other by less than 45 deg.
    """
    seen = {view.name: view for view in left}
    pairs = []
    for view in right:
        partner = seen.get(view.name)
        if partner is not None and board.marker_m is None:
            whole = all(len(one.found.grid) == board.columns * board.rows for one in (partner, view))
            partner = partner if whole else None
            view = replace(view, found=_in_order_of(partner.found, view.found)) if partner is not None else view
        pair = PairView(name=view.name, right=view, left=partner)
        pairs.append(pair if partner is None or len(corners_of_both(pair)[0]) else replace(pair, left=None))
    return pairs


def _in_order_of(one: FoundBoard, other: FoundBoard) -> FoundBoard:
    """The other camera's corners, numbered as the first camera's: by the direction of rows and columns."""
    lattice = other.corners_px.reshape(other.rows, other.columns, 2)
    turned = (np.rot90(lattice, k) for k in range(4))
    fitting = [corners for corners in turned if corners.shape[:2] == (one.rows, one.columns)]
    away = one.corners_px - one.corners_px.mean(axis=0)
    best = max(fitting, key=lambda corners: float(np.sum(away * corners.reshape(-1, 2))))
    return FoundBoard(corners_px=best.reshape(-1, 2), grid=one.grid, columns=one.columns, rows=one.rows)


def calibrate_stereo(
    pairs: Sequence[PairView], board: Board, left: GroundCamera, lens: Intrinsics, fit_lens: bool
) -> StereoCalibration:
    """The right camera that sees the boards where the left one, which is taken as exact, says they are.

    Least squares over all corners of both cameras: the right camera's pose, the boards' poses and, with `fit_lens`, the
    right lens, which starts from `lens`. Pairs that fit far worse than the others are dropped. Raises CalibrationError
    for too few pairs.
    """
    used = [pair for pair in pairs if pair.left is not None or fit_lens]
    check_count(used)
    sights = [_sight(pair, board) for pair in used]
    numbers = np.array([lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, *lens.distortion])
    free = np.array([True] * 6 + [fit_lens] * (LENS - 1) + [fit_lens and lens.distortion[4] != 0.0])
    rig = Rig(left=left.camera, pose=_start(sights, left.camera, numbers), lens=numbers, free=free)
    fit, used, sights, dropped = _consistent(rig, used, sights)
    extrinsics, std = _placed(fit, left)
    baseline_m = _baseline_m(fit, std)
    both = [i for i, pair in enumerate(used) if pair.left is not None]
    held_out, off = _cross_validated(fit, used, sights, both, left)
    errors = tuple(
        PairError(pair=used[i], rms_px=rms_of([fit.residuals_px[i]]), held_out_px=rms_of([outside]), epipolar_px=off_px)
        for i, outside, off_px in zip(both, held_out, off, strict=True)
    )
    return StereoCalibration(
        intrinsics=_intrinsics(fit.rig) if fit_lens else lens,
        extrinsics=extrinsics,
        std=std,
        baseline_m=baseline_m,
        rms_px=rms_of([fit.residuals_px[i] for i in both]),
        cross_validated_px=rms_of(held_out),
        epipolar_px=math.sqrt(float(np.mean(np.concatenate(off) ** 2))),
        pairs=errors,
        dropped=tuple(dropped),
    )


def check_count(pairs: Sequence[PairView]) -> None:
    """Raise CalibrationError where both cameras saw the board too seldom."""
    count = sum(pair.left is not None for pair in pairs)
    if count == 0:
        raise CalibrationError(
            "no pair of images shows the whole board to both cameras; hold it where both see it, farther away"
        )
    if count < FEWEST_VIEWS:
        raise CalibrationError(
            f"expected at least {FEWEST_VIEWS} pairs of images with the whole board in both, better 15, got {count}: "
            "near and far, at all sides of what both cameras see, tilted to all sides"
        )


def _sight(pair: PairView, board: Board) -> Sight:
    points, pixels = zip(
        *(
            (np.empty((0, 3)), np.empty((0, 2)))
            if view is None
            else (board.points_m(view.found.grid), view.found.corners_px)
            for view in (pair.left, pair.right)
        ),
        strict=True,
    )
    return Sight(points_m=points, pixels=pixels)


def _start(sights: Sequence[Sight], left: CameraModel, lens: FloatArray) -> FloatArray:
    """Of the poses right_from_left that single pairs give, the one that is nearest to all others, (6,)."""
    poses = []
    for sight in sights:
        if len(sight.points_m[0]):
            one = board_pose(sight, 0, left.matrix, left.distortion)
            other = board_pose(sight, 1, *matrices(lens))
            back = cv2.Rodrigues(one[:3])[0].T
            turn = cv2.Rodrigues(other[:3])[0] @ back
            poses.append(np.concatenate((cv2.Rodrigues(turn)[0].ravel(), other[3:] - turn @ one[3:])))
    table = np.array(poses)
    scale = np.where(np.arange(6) < 3, 1.0, 1.0 / max(float(np.median(np.linalg.norm(table[:, 3:], axis=1))), 1e-9))
    apart = np.linalg.norm((table[:, None] - table[None]) * scale, axis=2).sum(axis=1)
    return np.asarray(table[int(np.argmin(apart))])


def _consistent(
    rig: Rig, pairs: list[PairView], sights: list[Sight]
) -> tuple[Fit, list[PairView], list[Sight], list[Refused]]:
    """The fit without pairs that fit badly, the worst dropped first: something moved between their two images."""
    dropped: list[Refused] = []
    while True:
        fit = fit_pair(rig, sights, start_boards(rig, sights))
        errors = np.array([rms_of([residuals]) for residuals in fit.residuals_px])
        worst, usual = int(np.argmax(errors)), float(np.median(errors))
        if errors[worst] < max(OUTLIER * usual, OUTLIER_PX) or len(pairs) < max(FEWEST_VIEWS, 4 * len(dropped)):
            return fit, pairs, sights, dropped
        reason = f"does not fit the others: error {errors[worst]:.1f} px, median {usual:.1f} px"
        dropped.append(Refused(name=pairs[worst].name, reason=reason))
        pairs = [pair for i, pair in enumerate(pairs) if i != worst]
        sights = [sight for i, sight in enumerate(sights) if i != worst]
        check_count(pairs)


def _cross_validated(
    fit: Fit, pairs: Sequence[PairView], sights: Sequence[Sight], both: Sequence[int], left: GroundCamera
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Of every pair that both cameras see, in a fit without it: residuals (m, 2), and distances (n,) [px] of the right
    corners from the epipolar lines of the left ones."""
    folds = min(_FOLDS, len(both))
    residuals: list[FloatArray] = [np.empty((0, 2))] * len(both)
    off: list[FloatArray] = [np.empty(0)] * len(both)
    for fold in range(folds):
        out = set(both[fold::folds])
        inside = [i for i in range(len(sights)) if i not in out]
        found = fit_pair(fit.rig, [sights[i] for i in inside], fit.boards[inside]).rig
        held = replace(found, free=np.zeros_like(found.free))
        other = GroundCamera(_model(found), _extrinsics(found.pose, left))
        for k in range(fold, len(both), folds):
            sight = sights[both[k]]
            residuals[k] = fit_pair(held, [sight], fit.boards[[both[k]]]).residuals_px[0]
            off[k] = epipolar(left, other, *corners_of_both(pairs[both[k]]))[0]
    return residuals, off


def corners_of_both(pair: PairView) -> tuple[FloatArray, FloatArray]:
    """The pixels (n, 2) of the corners that both cameras see, in the left and in the right image."""
    assert pair.left is not None
    one, other = pair.left.found, pair.right.found
    numbers = {tuple(place): i for i, place in enumerate(other.grid.tolist())}
    shared = [(i, numbers[tuple(place)]) for i, place in enumerate(one.grid.tolist()) if tuple(place) in numbers]
    left, right = np.array(shared, dtype=np.int64).reshape(-1, 2).T
    return one.corners_px[left], other.corners_px[right]


def _placed(fit: Fit, left: GroundCamera) -> tuple[Extrinsics, dict[str, float]]:
    """The right camera in the body frame, and one sigma of each of its numbers beside the left one's."""
    pose, step = fit.rig.pose, 1e-6
    jacobian = np.stack(
        [(_body_pose(pose + d, left) - _body_pose(pose - d, left)) / (2.0 * step) for d in step * np.eye(6)], axis=1
    )
    std = np.sqrt(np.diag(jacobian @ fit.covariance[:6, :6] @ jacobian.T))
    return _extrinsics(pose, left), dict(zip(NAMES, std.tolist(), strict=True))


def _baseline_m(fit: Fit, std: dict[str, float]) -> float:
    """The distance between both cameras; raises CalibrationError where it is none."""
    baseline_m = float(np.linalg.norm(fit.rig.pose[3:]))
    if baseline_m < max(_SAME_PLACE_M, 3.0 * max(std[name] for name in NAMES if name.endswith("_m"))):
        raise CalibrationError(
            f"both cameras would be at the same place ({1e3 * baseline_m:.1f} mm apart); are LEFT and RIGHT images of "
            "one camera?"
        )
    return baseline_m


def _body_pose(pose: FloatArray, left: GroundCamera) -> FloatArray:
    """right_from_left (6,) and the left camera -> x, y, z, pitch, yaw, roll of the right one."""
    turn = np.asarray(cv2.Rodrigues(pose[:3])[0], np.float64)
    centre_m = left.centre_m - left.cam_from_body.T @ (turn.T @ pose[3:])
    return pose_of_matrix(turn @ left.cam_from_body, centre_m)


def _extrinsics(pose: FloatArray, left: GroundCamera) -> Extrinsics:
    try:
        return Extrinsics(**dict(zip(NAMES, _body_pose(pose, left).round(5).tolist(), strict=True)))
    except ValueError as error:
        raise CalibrationError(
            f"the pairs give an impossible right camera ({error}); is [camera.extrinsics] right, and were both images "
            "of a pair taken at the same time?"
        ) from None


def _model(rig: Rig) -> CameraModel:
    return CameraModel(_intrinsics(rig), rig.left.width_px, rig.left.height_px)


def _intrinsics(rig: Rig) -> Intrinsics:
    return intrinsics_of(*matrices(rig.lens))


def check_direction(found: StereoCalibration, left: Extrinsics, before: Extrinsics | None) -> None:
    """As `check_sides`, of a calibration with a board."""
    check_sides(found.extrinsics, left, before)


def check_sides(right: Extrinsics, left: Extrinsics, before: Extrinsics | None) -> None:
    """Raise CalibrationError where the cameras were swapped: the right one lies opposite to where it was `before`.

    Without that it should lie to the right of the left one.
    """
    baseline = _centre(right) - _centre(left)
    expected = np.array([0.0, -1.0, 0.0]) if before is None else _centre(before) - _centre(left)
    if float(baseline @ expected) > _WRONG_WAY * float(np.linalg.norm(baseline) * np.linalg.norm(expected)):
        return
    x, y, z = (round(1e3 * float(value)) for value in baseline)
    where = "to the right" if before is None else "where [camera.right.extrinsics] has it"
    raise CalibrationError(
        f"LEFT and RIGHT seem to be swapped: RIGHT would be ({x}, {y}, {z}) mm ahead, left and above of LEFT, and not "
        f"{where}"
    )


def check_left(car: CarConfig, car_file: Path) -> None:
    """Raise ConfigError where the left camera, from which the right one is measured, was never calibrated."""
    records = (("camera", "intrinsics", car.calibration.camera), ("ground", "extrinsics", car.calibration.ground))
    for command, section, record in records:
        if record is None:
            raise ConfigError(
                f"{car_file}: the left camera's [camera.{section}] were never calibrated, and the right camera is "
                f"measured from it; run automodel calibrate {command} with the left camera first"
            )


def _centre(camera: Extrinsics) -> FloatArray:
    return np.array([camera.x_m, camera.y_m, camera.z_m])


def check_stereo(found: StereoCalibration, width_px: int) -> tuple[Check, ...]:
    """All checks of a calibration, the most important first."""
    thousandths, ratio = 1e3 * found.rms_px / width_px, found.cross_validated_px / max(found.rms_px, 1e-9)
    off = max(found.std[name] for name in NAMES if name.endswith("_rad"))
    place = max(found.std[name] for name in NAMES if name.endswith("_m"))
    return (
        graded(
            "residual",
            thousandths,
            (1.0, 4.0),
            f"{found.rms_px:.2f} px over {len(found.pairs)} pairs",
            "hold the board still, take both images at the same time; calibrate the left lens again",
        ),
        graded(
            "pairs left out",
            ratio,
            (1.3, 3.0),
            f"{found.cross_validated_px:.2f} px, and {found.epipolar_px:.2f} px off the epipolar lines",
            "too few or too similar pairs: take more, of all sides",
        ),
        graded(
            "direction",
            off,
            (_LOOSE_RAD, _USELESS_RAD),
            f"+- {math.degrees(off):.3f} deg",
            "more pairs, at all sides of the images, near and far",
        ),
        graded(
            "baseline",
            place / max(found.baseline_m, 1e-9),
            _BASELINE_OFF,
            f"{found.baseline_m:.4f} m, each of x, y, z +- {1e3 * place:.1f} mm",
            "hold the board nearer",
        ),
    )
