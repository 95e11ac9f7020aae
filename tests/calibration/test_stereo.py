"""The right camera from corners of a board that both cameras see, projected with noise."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from automodel.config import Extrinsics
from automodel.geometry import GroundCamera
from calibration.boards import Board, FoundBoard
from calibration.camera import calibrate_camera
from calibration.ground import NAMES
from calibration.stereo import (
    PairView,
    StereoCalibration,
    calibrate_stereo,
    check_count,
    check_direction,
    check_stereo,
    corners_of_both,
    pair_views,
)
from calibration.stereo_fit import LENS, Rig, Sight, linearised
from calibration.views import CalibrationError, View
from tests.support.board_pairs import RIGHT_LENS, cameras, mounts, projected_pairs
from tests.support.drawn_boards import LENS as LEFT_LENS

NOISE_PX = 0.2
BOARDS = {0.25: Board(columns=9, rows=6, square_m=0.05), 1.0: Board(columns=9, rows=6, square_m=0.12)}
BASELINES_M = tuple(BOARDS)


def found_from(pairs: list[PairView], baseline_m: float) -> StereoCalibration:
    """The calibration with the right lens measured as well."""
    board = BOARDS[baseline_m]
    lens = calibrate_camera([pair.right for pair in pairs], board).intrinsics
    return calibrate_stereo(pairs, board, cameras(baseline_m)[0], lens, True)


@pytest.fixture(scope="module")
def pairs() -> list[PairView]:
    return projected_pairs(0.25, BOARDS[0.25], 16, NOISE_PX)


@pytest.fixture(scope="module")
def found(pairs: list[PairView]) -> StereoCalibration:
    return found_from(pairs, 0.25)


def errors(found: StereoCalibration, truth: Extrinsics) -> np.ndarray:
    """Of x, y, z [m], pitch, yaw, roll [rad]."""
    return np.array([getattr(found.extrinsics, name) - getattr(truth, name) for name in NAMES])


@pytest.mark.parametrize(
    ("baseline_m", "place_m", "direction_rad"), [(0.25, 0.002, 0.006), (1.0, 0.006, 0.005)]
)  # of 20 seeds the largest: 1.1 mm and 4.6 mrad, 3.9 mm and 3.2 mrad
def test_the_right_camera_is_found_and_its_stated_error_is_about_right(
    baseline_m: float, place_m: float, direction_rad: float
) -> None:
    _, truth = mounts(baseline_m)
    shares = []
    for seed in range(5):
        found = found_from(projected_pairs(baseline_m, BOARDS[baseline_m], 16, NOISE_PX, seed), baseline_m)
        away = errors(found, truth)
        assert np.abs(away[:3]).max() < place_m
        assert np.abs(away[3:]).max() < direction_rad
        shares.append(away / [found.std[name] for name in NAMES])
        assert "FAIL" not in {check.status for check in check_stereo(found, 640)}
        assert found.baseline_m == pytest.approx(math.dist(*(eye.centre_m for eye in cameras(baseline_m))), rel=0.005)
    assert np.abs(shares).max() < 4.0
    assert 0.6 < math.sqrt(float(np.mean(np.square(shares)))) < 1.4


def test_the_errors_in_pixels_are_those_of_the_noise(found: StereoCalibration) -> None:
    assert found.rms_px == pytest.approx(NOISE_PX * math.sqrt(2.0), rel=0.1)  # per corner, both coordinates
    assert found.rms_px < found.cross_validated_px < 1.1 * found.rms_px
    assert found.epipolar_px == pytest.approx(NOISE_PX * math.sqrt(2.0), rel=0.15)  # both cameras', across the line


def test_a_known_lens_stays_and_makes_the_direction_more_certain(pairs: list[PairView], found) -> None:
    known = calibrate_stereo(pairs, BOARDS[0.25], cameras(0.25)[0], RIGHT_LENS, False)
    assert known.intrinsics == RIGHT_LENS
    assert found.intrinsics.fx_px == pytest.approx(RIGHT_LENS.fx_px, rel=0.004)
    assert known.std["yaw_rad"] < 0.5 * found.std["yaw_rad"]
    assert np.abs(errors(known, mounts(0.25)[1]) / [known.std[name] for name in NAMES]).max() < 4.0
    assert len(known.pairs) == 12  # four boards are seen by the right camera alone: they only tell of its lens


def test_how_pixels_change_is_as_numeric_differences_have_it() -> None:
    left, right = cameras(1.0)
    rng = np.random.default_rng(0)
    points = np.column_stack((rng.uniform(-0.4, 0.4, (7, 2)), np.zeros(7)))
    lens = np.array([*right.camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *right.camera.distortion])
    pose, board = np.array([0.03, -0.2, 0.07, -1.0, 0.02, 0.05]), np.array([0.3, -0.4, 0.1, 0.2, -0.1, 2.5])
    rig = Rig(left=left.camera, pose=pose, lens=lens, free=np.ones(6 + LENS, np.bool_))
    sight = Sight(points_m=(points, points), pixels=(np.zeros((7, 2)), np.zeros((7, 2))))
    exact = linearised(rig, sight, board)
    for number in range(6 + LENS):
        step = np.eye(6 + LENS)[number] * 1e-6
        ends = [linearised(rig.moved(sign * step), sight, board).residuals for sign in (1.0, -1.0)]
        assert (ends[1] - ends[0]) / 2e-6 == pytest.approx(exact.by_free[:, number], rel=1e-4, abs=1e-3)
    for number in range(6):
        step = np.eye(6)[number] * 1e-6
        ends = [linearised(rig, sight, board + sign * step).residuals for sign in (1.0, -1.0)]
        assert (ends[1] - ends[0]) / 2e-6 == pytest.approx(exact.by_board[:, number], rel=1e-4, abs=1e-3)


def renumbered(view: View, quarters: int) -> View:
    """The same board with its corners numbered from another one."""
    lattice = np.rot90(view.found.corners_px.reshape(view.found.rows, view.found.columns, 2), quarters)
    corners = lattice.reshape(-1, 2)
    return dataclasses.replace(view, found=dataclasses.replace(view.found, corners_px=corners))


@pytest.mark.parametrize(("columns", "quarters"), [(9, 2), (6, 1), (6, 2), (6, 3)])
def test_corners_that_the_right_camera_numbers_otherwise(columns: int, quarters: int) -> None:
    board = Board(columns=columns, rows=6, square_m=0.05)
    for pair in projected_pairs(0.25, board, 6, 0.0):
        left = [] if pair.left is None else [pair.left]
        (again,) = pair_views(left, [renumbered(pair.right, quarters)], board)
        if pair.left is not None:
            assert np.array_equal(again.right.found.corners_px, pair.right.found.corners_px)


def test_what_both_do_not_see_counts_for_the_lens_alone(pairs: list[PairView]) -> None:
    seen = pairs[0].right
    part = FoundBoard(corners_px=seen.found.corners_px[:45], grid=seen.found.grid[:45], columns=9, rows=5)
    assert pairs[0].left is not None
    (pair,) = pair_views([pairs[0].left], [dataclasses.replace(seen, found=part)], BOARDS[0.25])
    assert pair.left is None
    charuco = dataclasses.replace(BOARDS[0.25], marker_m=0.03)
    (pair,) = pair_views([pairs[0].left], [dataclasses.replace(seen, found=part)], charuco)
    assert [len(pixels) for pixels in corners_of_both(pair)] == [45, 45]
    other = pairs[0].left.found
    rest = FoundBoard(corners_px=other.corners_px[45:], grid=other.grid[45:], columns=9, rows=1)
    (pair,) = pair_views(
        [dataclasses.replace(pairs[0].left, found=rest)], [dataclasses.replace(seen, found=part)], charuco
    )
    assert pair.left is None  # no corner that both see


def test_a_board_that_moved_between_both_images_is_dropped_and_named(pairs: list[PairView], found) -> None:
    seen = pairs[1].right
    moved = dataclasses.replace(seen.found, corners_px=seen.found.corners_px + 7.0)
    spoilt = dataclasses.replace(pairs[1], right=dataclasses.replace(seen, found=moved))
    again = found_from([pairs[0], spoilt, *pairs[2:]], 0.25)
    assert [seen.name for seen in again.dropped] == ["pair 1"]
    assert again.dropped[0].reason.startswith("does not fit the others: error ")
    assert np.abs(errors(again, mounts(0.25)[1]) / [again.std[name] for name in NAMES]).max() < 4.0


def test_too_few_pairs_are_refused(pairs: list[PairView]) -> None:
    with pytest.raises(CalibrationError, match="expected at least 4 pairs of images with the whole board in both"):
        calibrate_stereo(pairs[:3], BOARDS[0.25], cameras(0.25)[0], RIGHT_LENS, False)
    alone = [pair for pair in pairs if pair.left is None]
    with pytest.raises(CalibrationError, match="no pair of images shows the whole board to both cameras"):
        check_count(alone)


def test_cameras_that_were_swapped(found: StereoCalibration) -> None:
    left, right = mounts(0.25)
    check_direction(found, left, None)
    check_direction(found, left, right)
    with pytest.raises(CalibrationError, match=r"swapped: .* and not where \[camera.right.extrinsics\] has it"):
        check_direction(found, left, dataclasses.replace(left, y_m=left.y_m + 0.25))
    swapped = dataclasses.replace(found, extrinsics=dataclasses.replace(left, y_m=left.y_m + 0.25))
    with pytest.raises(CalibrationError, match=r"RIGHT would be \(0, 250, 0\) mm ahead, left and above of LEFT"):
        check_direction(swapped, left, None)


def test_images_of_one_camera_are_refused(pairs: list[PairView]) -> None:
    twins = [dataclasses.replace(pair, right=pair.left) for pair in pairs if pair.left is not None]
    left = cameras(0.25)[0]
    with pytest.raises(CalibrationError, match="are LEFT and RIGHT images of one camera"):
        calibrate_stereo(twins, BOARDS[0.25], left, LEFT_LENS, False)


def test_a_camera_below_the_ground_is_refused(pairs: list[PairView]) -> None:
    left = GroundCamera(cameras(0.25)[0].camera, Extrinsics(z_m=0.01))
    with pytest.raises(CalibrationError, match=r"an impossible right camera \(z_m"):
        calibrate_stereo(pairs, BOARDS[0.25], left, RIGHT_LENS, False)


@pytest.mark.parametrize(
    ("changes", "name", "status"),
    [
        ({"rms_px": 1.0, "cross_validated_px": 1.0}, "residual", "WARN"),
        ({"rms_px": 3.0, "cross_validated_px": 3.0}, "residual", "FAIL"),
        ({"cross_validated_px": 0.5}, "pairs left out", "WARN"),
        ({"std": dict.fromkeys(NAMES, 0.001) | {"yaw_rad": math.radians(0.2)}}, "direction", "WARN"),
        ({"std": dict.fromkeys(NAMES, 0.001) | {"roll_rad": math.radians(0.5)}}, "direction", "FAIL"),
        ({"std": dict.fromkeys(NAMES, 0.001) | {"x_m": 0.005}}, "baseline", "WARN"),
        ({"std": dict.fromkeys(NAMES, 0.001) | {"x_m": 0.02}}, "baseline", "FAIL"),
    ],
)
def test_what_is_not_good_enough_is_told(found: StereoCalibration, changes: dict, name: str, status: str) -> None:
    checks = {check.name: check.status for check in check_stereo(dataclasses.replace(found, **changes), 640)}
    assert checks[name] == status
    assert {other for key, other in checks.items() if key != name} == {"OK"}
