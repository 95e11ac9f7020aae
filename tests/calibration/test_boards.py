"""Boards are found whole or in part, with each corner where it is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from automodel.geometry import CameraModel
from calibration.boards import Board, FoundBoard, find_board, other_dictionary
from tests.support.drawn_boards import LENS, PAPER_PX, SIZE, charuco, chessboard, held, seen, turned

BOARD = Board(columns=9, rows=6, square_m=0.025)
CHARUCO = Board(columns=9, rows=6, square_m=0.025, marker_m=0.01875)
ALL = np.argwhere(np.ones((9, 6)))
POSE, CENTRE = turned(0.5, -0.3, 0.15), np.array([0.03, 0.01, 0.30])


def picture(paper: np.ndarray, centre: np.ndarray = CENTRE) -> np.ndarray:
    return seen(paper, BOARD.square_m / PAPER_PX, POSE, centre)


def truth_px(grid: np.ndarray, centre: np.ndarray = CENTRE, board: Board = BOARD) -> np.ndarray:
    middle = 0.5 * np.array((board.columns - 1, board.rows - 1))
    points = np.column_stack(((grid - middle) * board.square_m, np.zeros(len(grid))))
    return CameraModel(LENS, *SIZE).project(points @ POSE.T + centre)


def misses_px(found: FoundBoard, centre: np.ndarray = CENTRE) -> np.ndarray:
    """Distance of each corner found from where the nearest true one is projected."""
    return np.linalg.norm(found.corners_px[:, None] - truth_px(ALL, centre)[None], axis=2).min(axis=1)


def test_a_chessboard_is_found_to_a_tenth_of_a_pixel() -> None:
    found = find_board(picture(chessboard(9, 6)), BOARD)
    assert found is not None
    assert (found.columns, found.rows, len(found.grid)) == (9, 6, 54)
    assert np.linalg.norm(found.corners_px - truth_px(found.grid), axis=1).max() < 0.3
    assert misses_px(found).mean() < 0.1


def test_a_chessboard_may_be_asked_for_either_way_round() -> None:
    found = find_board(picture(chessboard(9, 6)), Board(columns=6, rows=9, square_m=0.025))
    assert found is not None
    assert found.size == "6x9"
    along = found.corners_px[1] - found.corners_px[0]
    down = found.corners_px[6] - found.corners_px[0]
    assert along[0] * down[1] - along[1] * down[0] > 0  # seen from its front


@pytest.mark.parametrize("shift", [(0.18, 0.0, 0.0), (0.0, -0.09, 0.0)])
def test_of_a_cut_chessboard_the_rest_is_used(shift: tuple[float, ...]) -> None:
    centre = CENTRE + np.array(shift)
    found = find_board(picture(chessboard(9, 6), centre), BOARD)
    assert found is not None
    assert 20 <= found.columns * found.rows < 54
    assert misses_px(found, centre).max() < 0.4
    nearest = np.linalg.norm(found.corners_px[:, None] - truth_px(ALL, centre)[None], axis=2).argmin(axis=1)
    lattice = ALL[nearest].reshape(found.rows, found.columns, 2)
    for axis in (0, 1):  # no row or column is left out
        assert (np.abs(np.diff(lattice, axis=axis)).sum(axis=2) == 1).all()


def test_another_board_comes_with_its_own_size() -> None:
    found = find_board(picture(chessboard(10, 7)), BOARD)
    assert found is not None
    assert found.size == "10x7"
    smaller = find_board(picture(chessboard(7, 5)), BOARD)
    assert smaller is not None
    assert smaller.size == "7x5"


def test_no_board_is_none() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (360, 640), dtype=np.uint8)
    for image in (np.full((360, 640), 90, np.uint8), noise, np.zeros((360, 640, 3), np.uint8)):
        assert find_board(image, BOARD) is None
        assert find_board(image, CHARUCO) is None


@pytest.mark.parametrize("legacy", [False, True])
def test_a_charuco_board_knows_its_corners(legacy: bool) -> None:
    grey = picture(charuco(9, 6, legacy=legacy))
    found = find_board(np.stack((grey, grey, grey), axis=-1), CHARUCO)
    assert found is not None
    assert len(found.grid) > 50
    assert np.linalg.norm(found.corners_px - truth_px(found.grid), axis=1).mean() < 0.2


def test_a_part_of_a_charuco_board_keeps_its_place() -> None:
    centre = CENTRE + np.array((0.17, 0.0, 0.0))
    found = find_board(picture(charuco(9, 6), centre), CHARUCO)
    assert found is not None
    assert found.columns < 9
    assert np.linalg.norm(found.corners_px - truth_px(found.grid, centre), axis=1).max() < 0.6


@pytest.mark.slow
def test_markers_of_another_dictionary_are_named() -> None:
    image = picture(charuco(9, 6, cv2.aruco.DICT_5X5_100))
    assert find_board(image, CHARUCO) is None
    assert other_dictionary(image, CHARUCO) == "5x5_50"  # the smallest that has them
    assert other_dictionary(picture(charuco(9, 6)), CHARUCO) is None


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"columns": 2}, "3 .. 50 inner corners"),
        ({"square_m": 0.0}, "expected squares of 0 .. 10 m"),
        ({"square_m": float("nan")}, "expected squares of 0 .. 10 m"),
        ({"marker_m": 0.03}, "expected markers smaller than squares"),
        ({"dictionary": "8x8_50"}, "expected a dictionary of 4x4_50"),
    ],
)
def test_impossible_boards_are_refused(wrong: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        Board(**{"columns": 9, "rows": 6, "square_m": 0.025, **wrong})


@pytest.mark.realdata
@pytest.mark.parametrize(("number", "size"), [(1, "9x5"), (4, "9x6"), (5, "9x5")])
def test_real_boards_that_the_edge_cuts(data_root: Path, number: int, size: str) -> None:
    image = cv2.imread(str(data_root / "udacity" / "camera_cal" / f"calibration{number}.jpg"), cv2.IMREAD_GRAYSCALE)
    found = find_board(np.asarray(image, np.uint8), BOARD)
    assert found is not None
    assert found.size == size
    lattice = found.corners_px.reshape(found.rows, found.columns, 2)
    steps = np.linalg.norm(np.diff(lattice, axis=1), axis=2)
    assert (np.abs(np.diff(steps, axis=1)) < 0.25 * steps[:, 1:]).all()  # the detector alone leaves out columns of 5


def test_the_drawn_boards_are_held_all_over_the_picture() -> None:
    found = [find_board(image, BOARD) for image in held(9, 6, 0.025, 4)]
    middles = [board.corners_px.mean(axis=0) for board in found if board is not None]
    assert len(middles) == 4
    assert (np.ptp(middles, axis=0) > 80).all()
