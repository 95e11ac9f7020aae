"""The least-squares fit of a right camera beside a left one, and of the boards that they see."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.geometry import CameraModel
from automodel.types import FloatArray
from calibration.views import CalibrationError

LENS = 9  # numbers of a lens: fx fy cx cy k1 k2 p1 p2 k3
_STEPS, _HALVINGS = 50, 8  # of Gauss-Newton; 4 to 8 steps are usual
_CONVERGED = 1e-9  # share of the squared error that a step still removes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sight:
    """Corners (n, 3) [m] of a board in its own frame and their pixels (n, 2), for the left and the right camera."""

    points_m: tuple[FloatArray, FloatArray]
    pixels: tuple[FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rig:
    """The pair as numbers: `pose` (6,) rotation vector and shift [m], right_from_left; `lens` (9,) of the right camera.

    `free`: which of these 15 numbers are fitted.
    """

    left: CameraModel
    pose: FloatArray
    lens: FloatArray
    free: NDArray[np.bool_]

    def moved(self, step: FloatArray) -> Rig:
        """The pair with `step` added to its free numbers."""
        numbers = np.concatenate((self.pose, self.lens))
        numbers[self.free] += step
        return replace(self, pose=numbers[:6], lens=numbers[6:])


class Row(NamedTuple):
    """Residuals (m,) [px], and the derivatives of the pixels by the board's pose (m, 6) and the free numbers (m, k)."""

    residuals: FloatArray
    by_board: FloatArray
    by_free: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """`boards` (n, 6): rotation vector and shift [m] of each board, left_from_board; `covariance` of the free numbers.

    `residuals_px`: seen minus projected, (m, 2) of each sight, the left camera's first.
    """

    rig: Rig
    boards: FloatArray
    residuals_px: tuple[FloatArray, ...]
    covariance: FloatArray


def board_pose(sight: Sight, side: int, matrix: FloatArray, distortion: FloatArray) -> FloatArray:
    """Rotation vector and shift [m] of the board in the cam frame of one camera (0 left, 1 right), (6,)."""
    _, turn, shift = cv2.solvePnP(sight.points_m[side], sight.pixels[side], matrix, distortion)
    return np.concatenate((np.ravel(turn), np.ravel(shift)))


def matrices(lens: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The numbers of a lens (9,) -> OpenCV's camera matrix (3, 3) and distortion (5,)."""
    fx, fy, cx, cy = lens[:4]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), lens[4:]


def start_boards(rig: Rig, sights: Sequence[Sight]) -> FloatArray:
    """Where each board is by one camera alone, left_from_board (n, 6): the left one where it sees it."""
    turn = cv2.Rodrigues(rig.pose[:3])[0]
    boards = []
    for sight in sights:
        if len(sight.points_m[0]):
            boards.append(board_pose(sight, 0, rig.left.matrix, rig.left.distortion))
            continue
        pose = board_pose(sight, 1, *matrices(rig.lens))
        both = cv2.Rodrigues(turn.T @ cv2.Rodrigues(pose[:3])[0])[0].ravel()
        boards.append(np.concatenate((both, turn.T @ (pose[3:] - rig.pose[3:]))))
    return np.array(boards)


def fit_pair(rig: Rig, sights: Sequence[Sight], boards: FloatArray) -> Fit:
    """Gauss-Newton; each board's pose is eliminated by a QR decomposition of its own columns.

    Raises CalibrationError where the views do not determine the cameras.
    """
    rows, cost = _rows(rig, sights, boards)
    for _ in range(_STEPS):
        step, steps = _step(rows)
        for halving in range(_HALVINGS):
            moved, moved_boards = rig.moved(0.5**halving * step), boards + 0.5**halving * steps
            new, new_cost = _rows(moved, sights, moved_boards)
            if new_cost < cost:
                break
        else:
            break
        gain, cost, rig, boards, rows = cost - new_cost, new_cost, moved, moved_boards, new
        if gain < _CONVERGED * cost:
            break
    if not math.isfinite(cost):
        raise CalibrationError("the views do not determine the cameras: tilt the board to all sides, near and far")
    return Fit(
        rig=rig,
        boards=boards,
        residuals_px=tuple(row.residuals.reshape(-1, 2) for row in rows),
        covariance=_jackknife(rows),
    )


def _rows(rig: Rig, sights: Sequence[Sight], boards: FloatArray) -> tuple[list[Row], float]:
    """Every sight linearised, and the sum of the squared residuals [px^2]."""
    rows = [linearised(rig, sight, board) for sight, board in zip(sights, boards, strict=True)]
    return rows, sum(float(row.residuals @ row.residuals) for row in rows)


def linearised(rig: Rig, sight: Sight, board: FloatArray) -> Row:
    """The residuals of a sight beside a rig and a board's pose (6,).

    Rotations by `cv2.composeRT` and `cv2.projectPoints`, with their derivatives.
    """
    turn, shift, *changes = cv2.composeRT(board[:3], board[3:], rig.pose[:3], rig.pose[3:])
    by_board = np.block([[changes[0], changes[1]], [changes[4], changes[5]]])  # of (turn, shift)
    by_pose = np.block([[changes[2], changes[3]], [changes[6], changes[7]]])
    away, by_boards, by_free = [], [], []
    if len(sight.points_m[0]):
        pixels, change = cv2.projectPoints(
            sight.points_m[0], board[:3], board[3:], rig.left.matrix, rig.left.distortion
        )
        away.append((sight.pixels[0] - pixels.reshape(-1, 2)).ravel())
        by_boards.append(change[:, :6])
        by_free.append(np.zeros((len(change), 6 + LENS)))
    pixels, change = cv2.projectPoints(sight.points_m[1], turn, shift, *matrices(rig.lens))
    away.append((sight.pixels[1] - pixels.reshape(-1, 2)).ravel())
    by_boards.append(change[:, :6] @ by_board)
    by_free.append(np.column_stack((change[:, :6] @ by_pose, change[:, 6 : 6 + LENS])))
    return Row(np.concatenate(away), np.concatenate(by_boards), np.concatenate(by_free)[:, rig.free])


def _equations(row: Row) -> tuple[FloatArray, FloatArray]:
    """Normal matrix (k, k) and right side (k,) of the free numbers, without the board's pose."""
    basis, _ = np.linalg.qr(row.by_board)
    clean = row.by_free - basis @ (basis.T @ row.by_free)
    return clean.T @ clean, clean.T @ row.residuals


def _solved(normal: FloatArray, right_side: FloatArray) -> FloatArray:
    """The solution (k,), with the numbers scaled alike: pixels and radians are far apart."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
    found = np.linalg.lstsq(normal * np.outer(scale, scale), scale * right_side, rcond=None)[0]
    return np.asarray(scale * found)


def _step(rows: Sequence[Row]) -> tuple[FloatArray, FloatArray]:
    """The steps of the free numbers (k,) and of the boards (n, 6)."""
    normals, right_sides = zip(*map(_equations, rows), strict=True)
    step = _solved(sum(normals), sum(right_sides))
    boards = [np.linalg.lstsq(row.by_board, row.residuals - row.by_free @ step, rcond=None)[0] for row in rows]
    return step, np.array(boards)


def _jackknife(rows: Sequence[Row]) -> FloatArray:
    """Covariance (k, k) of the free numbers, from the linearised fits that leave out one sight each.

    The corners of one image err together (blur, light, the board's slant): counted one by one they promise too much.
    """
    normals, right_sides = zip(*map(_equations, rows), strict=True)
    whole = sum(normals)
    away = np.array([_solved(whole - normal, side) for normal, side in zip(normals, right_sides, strict=True)])
    away -= away.mean(axis=0)
    return np.asarray((len(rows) - 1) / len(rows) * away.T @ away)
