"""The least-squares fit of a right camera beside a left one, and of the boards that they see."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

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
    rows = [linearised(rig, sight, board) for sight, board in zip(sights, boards, strict=True)]
    cost = sum(float(residual @ residual) for residual, _, _ in rows)
    for _ in range(_STEPS):
        step, steps, _ = _normal(rows)
        for halving in range(_HALVINGS):
            share = 0.5**halving
            moved, moved_boards = rig.moved(share * step), boards + share * steps
            new = [linearised(moved, sight, board) for sight, board in zip(sights, moved_boards, strict=True)]
            new_cost = sum(float(residual @ residual) for residual, _, _ in new)
            if new_cost < cost:
                break
        else:
            break
        gain, cost, rig, boards, rows = cost - new_cost, new_cost, moved, moved_boards, new
        if gain < _CONVERGED * cost:
            break
    _, _, normal = _normal(rows)
    freedom = sum(len(residual) for residual, _, _ in rows) - boards.size - int(rig.free.sum())
    if not math.isfinite(cost):
        raise CalibrationError("the views do not determine the cameras: tilt the board to all sides, near and far")
    return Fit(
        rig=rig,
        boards=boards,
        residuals_px=tuple(residual.reshape(-1, 2) for residual, _, _ in rows),
        covariance=np.asarray(cost / max(freedom, 1) * np.linalg.pinv(normal, hermitian=True), np.float64),
    )


def linearised(rig: Rig, sight: Sight, board: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals (m,) [px] of a sight, and how its projections change with its board (m, 6) and the free numbers (m, k).

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
    return np.concatenate(away), np.concatenate(by_boards), np.concatenate(by_free)[:, rig.free]


def _normal(rows: Sequence[tuple[FloatArray, FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The steps of the free numbers (k,) and of the boards (n, 6), and the normal matrix (k, k) without the boards."""
    size = rows[0][2].shape[1]
    normal, right_side = np.zeros((size, size)), np.zeros(size)
    bases = [np.linalg.qr(by_board) for _, by_board, _ in rows]
    for (residual, _, by_free), (basis, _) in zip(rows, bases, strict=True):
        clean = by_free - basis @ (basis.T @ by_free)
        normal += clean.T @ clean
        right_side += clean.T @ residual
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    step = scale * np.linalg.lstsq(normal * np.outer(scale, scale), scale * right_side, rcond=None)[0]
    steps = [
        np.linalg.lstsq(triangle, basis.T @ (residual - by_free @ step), rcond=None)[0]
        for (residual, _, by_free), (basis, triangle) in zip(rows, bases, strict=True)
    ]
    return step, np.array(steps), normal
