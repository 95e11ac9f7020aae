"""A board before two cameras that are not parallel and have different lenses: where its corners are, and pictures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from automodel.config import Extrinsics, Intrinsics
from automodel.geometry import CameraModel, GroundCamera
from calibration.boards import Board, FoundBoard
from calibration.stereo import PairView
from calibration.views import View
from tests.support.drawn_boards import LENS, PAPER_PX, SIZE, chessboard, seen, turned

RIGHT_LENS = Intrinsics(fx_px=452.0, fy_px=454.0, cx_px=314.0, cy_px=186.0, distortion=(-0.2, 0.04, -0.0006, 0.0009, 0))


def mounts(baseline_m: float) -> tuple[Extrinsics, Extrinsics]:
    """Left and right: turned towards each other, pitched and rolled differently, not at one height."""
    half = 0.5 * baseline_m
    return (
        Extrinsics(x_m=0.2, y_m=half, z_m=0.8, pitch_rad=0.2, yaw_rad=-0.09, roll_rad=0.02),
        Extrinsics(x_m=0.23, y_m=-half, z_m=0.77, pitch_rad=0.16, yaw_rad=0.12, roll_rad=-0.05),
    )


def cameras(baseline_m: float) -> tuple[GroundCamera, GroundCamera]:
    """The pair."""
    left, right = (CameraModel(lens, *SIZE) for lens in (LENS, RIGHT_LENS))
    one, other = mounts(baseline_m)
    return GroundCamera(left, one), GroundCamera(right, other)


def poses(baseline_m: float, board: Board, count: int, seed: int = 0) -> Iterator[tuple[np.ndarray, np.ndarray, bool]]:
    """Rotation cam_from_sheet and middle [m] of boards, both in the left cam frame, and whether the left camera sees it
    all; the right one does. One in four is for the right camera alone."""
    rng = np.random.default_rng(seed)
    left, right = cameras(baseline_m)
    extent = np.array([(x * board.columns, y * board.rows, 0.0) for x in (-0.6, 0.6) for y in (-0.6, 0.6)])
    number = 0
    while number < count:
        ray = right.camera.rays(rng.uniform((60.0, 40.0), (580.0, 320.0)))
        far = board.square_m * board.columns * rng.uniform(1.4, 3.0)
        tilt, direction = rng.uniform(0.1, 0.7), rng.uniform(0.0, 2.0 * np.pi)
        sheet = turned(tilt * np.cos(direction), tilt * np.sin(direction), rng.uniform(-0.3, 0.3))
        left_from_right = left.cam_from_body @ right.cam_from_body.T
        sheet = left_from_right @ sheet
        middle = left.cam_from_body @ (right.centre_m + right.cam_from_body.T @ (ray * far) - left.centre_m)
        body = (extent * board.square_m @ sheet.T + middle) @ left.cam_from_body + left.centre_m
        by_left, by_right = (eye.camera.inside(eye.body_to_px(body)).all() for eye in (left, right))
        if by_right and by_left == (number % 4 != 3):
            number += 1
            yield sheet, middle, bool(by_left)


def projected_pairs(
    baseline_m: float, board: Board, count: int, noise_px: float, seed: int = 0, **changed: GroundCamera
) -> list[PairView]:
    """Pairs without pictures: the corners projected, with noise; `changed` replaces the camera left or right."""
    rng = np.random.default_rng(1000 + seed)
    reference, right = cameras(baseline_m)
    eyes = {"left": reference, "right": right} | changed
    grid = np.stack(np.meshgrid(np.arange(board.columns), np.arange(board.rows)), axis=-1).reshape(-1, 2)
    pairs = []
    for number, (sheet, middle, both) in enumerate(poses(baseline_m, board, count, seed)):
        places = (grid - 0.5 * np.array([board.columns - 1, board.rows - 1])) * board.square_m
        body = (places @ sheet[:, :2].T + middle) @ reference.cam_from_body + reference.centre_m

        def view(eye: GroundCamera, name: str = f"pair {number}", body: np.ndarray = body) -> View:
            corners = eye.body_to_px(body) + rng.normal(0.0, noise_px, (len(grid), 2))
            found = FoundBoard(corners_px=corners, grid=grid, columns=board.columns, rows=board.rows)
            return View(name=name, width_px=SIZE[0], height_px=SIZE[1], found=found, edge_px=1.0, slant_rad=0.3)

        seen_left = view(eyes["left"]) if both else None
        pairs.append(PairView(name=f"pair {number}", right=view(eyes["right"]), left=seen_left))
    return pairs


def drawn_pairs(
    baseline_m: float, board: Board, count: int, paper: np.ndarray | None = None, seed: int = 0
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pictures (h, w) of the left and of the right camera."""
    paper = chessboard(board.columns, board.rows) if paper is None else paper
    left, right = cameras(baseline_m)
    for sheet, middle, _ in poses(baseline_m, board, count, seed):
        body = middle @ left.cam_from_body + left.centre_m
        turn = right.cam_from_body @ left.cam_from_body.T
        yield (
            seen(paper, board.square_m / PAPER_PX, sheet, middle, LENS),
            seen(
                paper,
                board.square_m / PAPER_PX,
                turn @ sheet,
                right.cam_from_body @ (body - right.centre_m),
                RIGHT_LENS,
            ),
        )
