"""The lens is found again from pictures of a board, the views that spoil it are left out, and impossible ones told."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from automodel.config import Intrinsics
from automodel.geometry import CameraModel
from calibration.boards import Board, FoundBoard
from calibration.camera import CameraCalibration, calibrate_camera, check_camera, field_of_view_deg
from calibration.pictures import coverage_picture, undistorted_picture
from calibration.views import CalibrationError, Refused, View, Views, coverage, edge_width_px, missing_views, settle
from tests.support.drawn_boards import LENS, PAPER_PX, SIZE, chessboard, held, seen, turned

BOARD = Board(columns=9, rows=6, square_m=0.025)


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    return list(held(9, 6, 0.025, 10))


@pytest.fixture(scope="module")
def views(pictures: list[np.ndarray]) -> list[View]:
    taken = Views(BOARD)
    for number, image in enumerate(pictures):
        taken.consider(f"view {number}", image)
    kept, refused = settle(taken)
    assert not refused
    return kept


@pytest.fixture(scope="module")
def found(views: list[View]) -> CameraCalibration:
    return calibrate_camera(views, BOARD)


def test_the_lens_is_found_again(found: CameraCalibration) -> None:
    lens = found.intrinsics
    assert (lens.fx_px, lens.fy_px) == pytest.approx((LENS.fx_px, LENS.fy_px), rel=0.004)
    assert (lens.cx_px, lens.cy_px) == pytest.approx((LENS.cx_px, LENS.cy_px), abs=1.5)
    border = np.array([(u, v) for u in (0.0, 320.0, 639.0) for v in (0.0, 180.0, 359.0)])
    rays = CameraModel(LENS, *SIZE).rays(border)
    assert np.abs(CameraModel(lens, *SIZE).project(rays) - border).max() < 3.0
    assert found.rms_px < 0.15
    assert found.rms_px < found.cross_validated_px < 1.3 * found.rms_px
    assert abs(lens.fx_px - LENS.fx_px) < 4 * found.focal_std_px
    assert {check.status for check in check_camera(found)} == {"OK"}


def test_the_error_of_a_view_is_that_of_its_corners(found: CameraCalibration) -> None:
    squares = [np.sum(error.residuals_px**2, axis=1) for error in found.views]
    assert [error.rms_px for error in found.views] == pytest.approx([np.sqrt(s.mean()) for s in squares])
    assert found.rms_px == pytest.approx(np.sqrt(np.concatenate(squares).mean()))


def projected_views(noise_px: float, lens: Intrinsics, count: int = 12) -> list[View]:
    """Views without pictures: the corners projected, with noise."""
    rng = np.random.default_rng(3)
    grid = np.argwhere(np.ones((9, 6)))
    made = []
    for number in range(count):
        tilt, direction = rng.uniform(0.2, 0.8), 2.4 * number
        pose = turned(tilt * np.cos(direction), tilt * np.sin(direction), rng.uniform(-0.3, 0.3))
        centre = np.array([*rng.uniform(-0.03, 0.03, 2), rng.uniform(0.22, 0.35)])
        points = (grid - (4.0, 2.5)) * 0.025 @ pose[:, :2].T + centre
        corners = CameraModel(lens, *SIZE).project(points) + rng.normal(0.0, noise_px, (54, 2))
        found = FoundBoard(corners_px=corners, grid=grid, columns=9, rows=6)
        made.append(View(name=str(number), width_px=640, height_px=360, found=found, edge_px=1.0, slant_rad=tilt))
    return made


def test_the_stated_error_is_that_of_the_noise() -> None:
    found = calibrate_camera(projected_views(0.5, LENS), BOARD)
    assert found.cross_validated_px == pytest.approx(0.5 * np.sqrt(2.0), rel=0.15)  # per corner, both coordinates
    assert found.rms_px < found.cross_validated_px


def test_k3_is_taken_only_where_it_helps() -> None:
    assert calibrate_camera(projected_views(0.2, LENS), BOARD).intrinsics.distortion[4] == 0.0
    strong = dataclasses.replace(LENS, distortion=(-0.3, 0.15, 0.0, 0.0, -0.06))
    assert calibrate_camera(projected_views(0.01, strong), BOARD).intrinsics.distortion[4] == pytest.approx(
        -0.06, abs=0.02
    )


def test_squeezed_pixels_are_found_and_pass_with_a_warning() -> None:
    """A camera that stores its 16:9 images as 4:3."""
    found = calibrate_camera(projected_views(0.2, dataclasses.replace(LENS, fx_px=0.756 * LENS.fy_px)), BOARD)
    assert found.intrinsics.fx_px / found.intrinsics.fy_px == pytest.approx(0.756, abs=0.005)
    checks = {check.name: check for check in check_camera(found)}
    assert checks["square pixels"].status == "WARN"
    assert "squeezes" in checks["square pixels"].text
    assert "FAIL" not in {check.status for check in checks.values()}


def test_a_view_that_does_not_fit_is_dropped_and_named(views: list[View]) -> None:
    bad = views[3].found.corners_px + np.random.default_rng(0).normal(0.0, 4.0, (54, 2))
    spoilt = dataclasses.replace(views[3], found=dataclasses.replace(views[3].found, corners_px=bad))
    found = calibrate_camera([*views[:3], spoilt, *views[4:]], BOARD)
    assert [seen.name for seen in found.dropped] == ["view 3"]
    assert "does not fit the others: " in found.dropped[0].reason
    assert found.rms_px < 0.15


def test_too_few_views_are_refused(views: list[View]) -> None:
    with pytest.raises(CalibrationError, match="expected at least 4 usable views of the board, better 15, got 3"):
        calibrate_camera(views[:3], BOARD)


def test_views_from_one_side_do_not_pass(views: list[View]) -> None:
    flat = [
        seen(chessboard(9, 6), 0.025 / PAPER_PX, turned(0.0, 0.0), np.array([x, 0.0, 0.3])) for x in (-0.04, 0.0, 0.05)
    ]
    taken = Views(BOARD)
    for number, image in enumerate(
        [*flat, seen(chessboard(9, 6), 0.025 / PAPER_PX, turned(0.02, 0.0), np.array([0.0, 0.02, 0.4]))]
    ):
        taken.consider(str(number), image)
    checks = {check.name: check for check in check_camera(calibrate_camera(taken.kept, BOARD))}
    assert checks["focal length"].status == "FAIL"
    assert "tilt the board" in checks["focal length"].text


@pytest.mark.parametrize(
    ("lens", "name", "status"),
    [
        ({"fy_px": 420.0}, "square pixels", "WARN"),
        ({"fy_px": LENS.fx_px / 0.756}, "square pixels", "WARN"),
        ({"fy_px": LENS.fx_px / 0.6}, "square pixels", "FAIL"),
        ({"fy_px": LENS.fx_px / 1.6}, "square pixels", "FAIL"),
        ({"cx_px": 400.0}, "principal point", "WARN"),
        ({"cx_px": 500.0}, "principal point", "FAIL"),
        ({"distortion": (-0.9, 0.0, 0.0, 0.0, 0.0)}, "distortion", "FAIL"),
        ({"fx_px": 3000.0, "fy_px": 3000.0}, "angle of view", "WARN"),
    ],
)
def test_impossible_cameras_are_told(found: CameraCalibration, lens: dict[str, Any], name: str, status: str) -> None:
    wrong = dataclasses.replace(found, intrinsics=dataclasses.replace(LENS, **lens))
    checks = {check.name: check.status for check in check_camera(wrong)}
    assert checks[name] == status


def test_the_angle_of_view_is_that_of_a_pinhole(found: CameraCalibration) -> None:
    pinhole = Intrinsics(fx_px=319.5, fy_px=319.5, cx_px=319.5, cy_px=179.5)
    assert field_of_view_deg(dataclasses.replace(found, intrinsics=pinhole)) == pytest.approx(90.0)


def reason(views: Views, image: np.ndarray, name: str = "x") -> str:
    seen = views.consider(name, image)
    assert isinstance(seen, Refused)
    return seen.reason


def test_views_that_are_no_good_are_refused_with_the_reason(pictures: list[np.ndarray]) -> None:
    views = Views(BOARD)
    assert isinstance(views.consider("first", pictures[6]), View)
    assert reason(views, np.roll(pictures[6], 3, axis=1)) == "nearly the same view as first"
    blurred = cv2.GaussianBlur(pictures[2], (0, 0), 2.6)
    assert reason(views, np.asarray(blurred, np.uint8)).startswith("blurred: edges are ")
    paper, scale = chessboard(9, 6), 0.025 / PAPER_PX
    tilted = seen(paper, scale, turned(1.2, 0.0), np.array([0.0, 0.0, 0.21]))
    assert reason(views, tilted) in [f"tilted away by {angle} deg" for angle in range(67, 72)]  # 1.2 rad are 69 deg
    far = seen(paper, scale, turned(0.2, 0.1), np.array([0.0, 0.0, 2.0]))
    assert reason(views, far) in ("too far away: squares of 5 px", "no board found")
    assert reason(views, np.full((360, 640), 90, np.uint8)) == "no board found"
    larger = seen(chessboard(10, 7), scale, turned(0.2, 0.1), np.array([0.0, 0.0, 0.4]))
    assert reason(views, larger) == "expected a board of 9x6 inner corners, got 10x7"


def test_edges_are_as_wide_as_the_blur(pictures: list[np.ndarray], views: list[View]) -> None:
    for sigma in (1.5, 2.5):
        blurred = np.asarray(cv2.GaussianBlur(pictures[6], (0, 0), sigma), np.uint8)
        wide = edge_width_px(blurred, views[6].found, 0.35)
        assert wide == pytest.approx(np.sqrt(2.0 * np.pi) * sigma, rel=0.15)  # a Gaussian's rise over its slope


def test_a_smear_to_one_side_is_seen(pictures: list[np.ndarray], views: list[View]) -> None:
    smeared = np.asarray(cv2.blur(pictures[6], (9, 1)), np.uint8)
    assert edge_width_px(smeared, views[6].found, 0.35) > 6.0


def test_mixed_sizes_are_refused_and_a_few_left_out(pictures: list[np.ndarray]) -> None:
    views = Views(BOARD)
    for number, image in enumerate(pictures[:5]):
        views.consider(f"a{number}", image)
    views.consider("large", np.pad(pictures[5], ((0, 1), (0, 1)), mode="edge"))
    kept, refused = settle(views)
    assert len(kept) == 5
    assert [(seen.name, seen.reason) for seen in refused] == [
        ("large", "expected 640x360 pixels, as most images have, got 641x361")
    ]
    for number, image in enumerate(pictures[6:8]):
        views.consider(f"b{number}", np.asarray(cv2.resize(image, (960, 540)), np.uint8))
    with pytest.raises(CalibrationError, match=r"mixed sizes \(5 of 640x360, 2 of 960x540, 1 of 641x361\)"):
        settle(views)


def test_the_wrong_size_is_answered_with_the_right_one(pictures: list[np.ndarray]) -> None:
    for wrong in (Board(columns=8, rows=5, square_m=0.025), Board(columns=10, rows=7, square_m=0.025)):
        views = Views(wrong)
        for image in pictures[:2]:
            views.consider("x", image)
        with pytest.raises(
            CalibrationError, match=f"{wrong.size} inner corners, and 2 of 2 show one of 9x6; give --board 9x6"
        ):
            settle(views)


def test_nothing_found_is_said() -> None:
    views = Views(BOARD)
    with pytest.raises(CalibrationError, match="there are no images"):
        settle(views)
    views.consider("x", np.zeros((360, 640), np.uint8))
    with pytest.raises(CalibrationError, match="a chessboard of 9x6 inner corners is in none of the 1 images"):
        settle(views)


def test_what_is_missing_is_named(views: list[View]) -> None:
    middle = [views[6]]
    assert missing_views(middle).startswith("missing: the board at the ")
    assert coverage(views).sum() == 10 * 54
    picture = coverage_picture(views, SIZE)
    assert picture.shape == (360, 640, 3)


def test_without_distortion_straight_things_are_straight(pictures: list[np.ndarray], views: list[View]) -> None:
    def bend_px(corners: np.ndarray) -> float:
        row = corners[:9]
        return float(np.linalg.svd(row - row.mean(axis=0))[1][1])

    both = undistorted_picture(pictures[10 - 1], CameraModel(LENS, *SIZE))
    assert both.shape == (360, 1280, 3)
    taken = Views(BOARD)
    after = taken.consider("after", np.ascontiguousarray(both[:, 640:]))
    assert isinstance(after, View)
    assert bend_px(after.found.corners_px) < 0.25 * bend_px(views[9].found.corners_px)


@pytest.mark.realdata
@pytest.mark.slow
def test_the_real_camera(data_root: Path) -> None:
    views = Views(BOARD)
    for number in range(1, 21):
        name = f"calibration{number}.jpg"
        image = cv2.imread(str(data_root / "udacity" / "camera_cal" / name), cv2.IMREAD_GRAYSCALE)
        views.consider(name, np.asarray(image, np.uint8))
    kept, refused = settle(views)
    cut = {view.name for view in kept if view.found.size != "9x6"}
    assert cut == {"calibration1.jpg", "calibration5.jpg"}
    assert [seen.reason for seen in refused] == ["expected 1280x720 pixels, as most images have, got 1281x721"] * 2
    found = calibrate_camera(kept, BOARD)
    assert len(found.views) == 18
    assert found.rms_px <= 0.9
    assert found.cross_validated_px < 1.0
    assert found.intrinsics.fx_px == pytest.approx(1157.0, rel=0.01)
    assert found.intrinsics.fy_px == pytest.approx(1157.0, rel=0.01)
    assert {check.status for check in check_camera(found)} == {"OK"}
