"""The camera over the ground is found again, in DESIGN's signs, and the stated error is the true one."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from automodel.config import Extrinsics
from automodel.geometry import CameraModel, GroundCamera
from automodel.geometry.ground import cam_from_body_rotation
from calibration.boards import Board
from calibration.ground import NAMES, GroundPoints, camera_from_points, distances_m, on_ground, pose_of, projected
from calibration.pictures import ground_picture
from calibration.printed_targets import ArucoSheet, SeenSheet, SheetPlace, camera_from_sheet, find_sheet
from calibration.views import CalibrationError
from tests.support.drawn_boards import LENS, PAPER_PX, SIZE, charuco, chessboard, marker, on_floor
from tests.support.slow_lane import rest_slow

CAMERA = CameraModel(LENS, *SIZE)
MOUNT = Extrinsics(x_m=0.21, y_m=0.012, z_m=0.19, pitch_rad=0.33, yaw_rad=0.04, roll_rad=-0.05)
POINTS = np.array([(0.55, 0.15), (0.55, -0.15), (0.9, 0.3), (0.9, -0.3), (1.4, 0.1), (0.7, -0.02)])


def pixels_of(mount: Extrinsics, points_m: np.ndarray = POINTS) -> np.ndarray:
    return GroundCamera(CAMERA, mount).ground_to_px(points_m)


def numbers(mount: Extrinsics) -> list[float]:
    return [getattr(mount, name) for name in NAMES]


def random_mounts(count: int) -> list[Extrinsics]:
    rng = np.random.default_rng(4)
    low, high = (0.1, -0.05, 0.15, 0.15, -0.15, -0.15), (0.25, 0.05, 0.3, 0.5, 0.15, 0.15)
    return [Extrinsics(**dict(zip(NAMES, rng.uniform(low, high), strict=True))) for _ in range(count)]


@pytest.mark.parametrize("mount", random_mounts(12), ids=lambda m: f"{m.pitch_rad:.2f}")
def test_exact_points_give_the_camera_back(mount: Extrinsics) -> None:
    ahead = np.array([(mount.x_m + x, y) for x in (0.6, 0.9, 1.4) for y in (-0.15, 0.15)])
    pixels = pixels_of(mount, ahead)
    assert CAMERA.inside(pixels).all()
    found = camera_from_points(GroundPoints(points_m=ahead, pixels=pixels), CAMERA, Extrinsics())
    assert numbers(found.extrinsics) == pytest.approx(numbers(mount), abs=1e-7)
    assert found.residual_px < 1e-6


def test_signs_without_any_rotation_matrix() -> None:
    """Pitch down raises the ground in the picture, yaw left moves it right, roll right side down lowers the left."""
    ahead = np.array([(0.9, 0.0)])
    level = pixels_of(Extrinsics(), ahead)[0]
    assert pixels_of(Extrinsics(pitch_rad=0.36), ahead)[0, 1] < level[1] - 10
    assert pixels_of(Extrinsics(yaw_rad=0.1), ahead)[0, 0] > level[0] + 10
    left, right = pixels_of(Extrinsics(roll_rad=0.1), np.array([(0.9, 0.2), (0.9, -0.2)]))
    assert left[1] > right[1] + 5
    for name, turn in (("pitch_rad", 0.36), ("yaw_rad", 0.1), ("roll_rad", 0.1)):
        mount = dataclasses.replace(Extrinsics(), **{name: turn})
        measured = GroundPoints(points_m=POINTS, pixels=pixels_of(mount))
        assert getattr(camera_from_points(measured, CAMERA, Extrinsics()).extrinsics, name) == pytest.approx(turn)


def test_the_fit_projects_as_the_geometry_does() -> None:
    poses = np.array([numbers(mount) for mount in random_mounts(5)])
    for pose, pixels in zip(poses, projected(CAMERA, poses, POINTS[None]), strict=True):
        camera = GroundCamera(CAMERA, pose_of(pose))
        assert pixels == pytest.approx(camera.ground_to_px(POINTS), abs=1e-9, nan_ok=True)
        back = on_ground(CAMERA, pose[None], camera.ground_to_px(POINTS))[0]
        assert back == pytest.approx(camera.px_to_ground(camera.ground_to_px(POINTS)), abs=1e-9, nan_ok=True)
        assert camera.cam_from_body == pytest.approx(cam_from_body_rotation(pose_of(pose)))


def test_the_position_can_be_held() -> None:
    measured = GroundPoints(points_m=POINTS, pixels=pixels_of(MOUNT))
    found = camera_from_points(measured, CAMERA, dataclasses.replace(MOUNT, pitch_rad=0.1), keep_position=True)
    assert numbers(found.extrinsics) == pytest.approx(numbers(MOUNT), abs=1e-7)
    assert (found.std["x_m"], found.std["y_m"]) == (0.0, 0.0)
    assert found.std["z_m"] > 0.0


def measured_again(rng: np.random.Generator, tape_m: float, pixel_px: float, points: np.ndarray) -> GroundPoints:
    return GroundPoints(
        points_m=points + rng.normal(0.0, tape_m, points.shape),
        pixels=pixels_of(MOUNT, points) + rng.normal(0.0, pixel_px, points.shape),
    )


@pytest.mark.parametrize(
    ("count", "worse"), [(4, 1.0), *(pytest.param(6, worse, marks=pytest.mark.slow) for worse in (1.0, 2.5))]
)
def test_the_stated_error_covers_the_true_one_as_often_as_it_says(count: int, worse: float) -> None:
    """Of many calibrations 95 % have their error within the bound, nearly so when the tape was worse than said."""
    rng = np.random.default_rng(count)
    least = 0.85 if worse == 1.0 else 0.75  # which 40 trials of 0.95, or of 0.90, miss once in a hundred times
    covered, true_m, said_m = [], [], []
    for _ in range(40):
        measured = measured_again(rng, 0.003 * worse, 1.0 * worse, POINTS[:count])
        found = camera_from_points(measured, CAMERA, MOUNT)
        place = np.column_stack((MOUNT.x_m + np.array([0.5, 1.0]), [MOUNT.y_m] * 2))
        away = np.linalg.norm(
            GroundCamera(CAMERA, found.extrinsics).px_to_ground(pixels_of(MOUNT, place)) - place, axis=1
        )
        bound = np.array([found.bound_m[0.5], found.bound_m[1.0]])
        covered.append(away <= bound)
        true_m.append(away)
        said_m.append([found.error_m[0.5], found.error_m[1.0]])
    share = np.mean(covered, axis=0)
    assert (share >= least).all()
    rms = np.sqrt(np.mean(np.square(true_m), axis=0))
    assert (np.median(said_m, axis=0) < 2.0 * rms).all()  # and it is not simply large
    assert (np.median(said_m, axis=0) > 0.6 * rms).all()


def test_errors_are_said_where_a_car_of_this_size_looks() -> None:
    assert distances_m(0.19) == (0.5, 1.0, 2.0)
    assert distances_m(1.3) == (5.0, 10.0, 20.0)


def refused(points: np.ndarray, pixels: np.ndarray | None = None) -> str:
    pixels = pixels_of(MOUNT, points) if pixels is None else pixels
    with pytest.raises(CalibrationError) as caught:
        camera_from_points(GroundPoints(points_m=points, pixels=pixels), CAMERA, MOUNT)
    return str(caught.value)


def test_what_says_nothing_is_refused() -> None:
    assert refused(POINTS[:3]) == "expected at least four ground points, better six, got 3"
    line = np.column_stack((np.linspace(0.5, 1.4, 6), 0.02 * np.array([0, 1, 0, 1, 0, 1])))
    assert refused(line).startswith("the points lie nearly on one line on the ground; spread them")
    across = np.column_stack(([0.9, 0.92, 0.9, 0.92], [-0.4, -0.1, 0.1, 0.4]))
    assert "nearly on one line on the ground" in refused(across)
    lined_up = pixels_of(MOUNT, POINTS)
    lined_up[:, 1] = 200.0
    assert "nearly on one line in the image" in refused(POINTS, lined_up)
    outside = pixels_of(MOUNT, POINTS)
    outside[1] = 700.0, 100.0
    assert refused(POINTS, outside) == "point 2: pixel (700, 100) lies outside the image of 640x360"
    assert refused(POINTS, np.full((6, 2), np.nan)) == "the ground points are not all finite numbers"
    together = np.array([(0.9, 0.0), (0.9, 0.01), (0.92, 0.0), (0.92, 0.01)])
    assert refused(together).startswith(
        "the points do not determine the camera: 0.5 m ahead the ground would be wrong by "
    )


def test_a_wrong_point_is_named() -> None:
    wrong = POINTS.copy()
    wrong[3, 1] = 0.1
    assert "the points contradict each other, most of all point " in refused(wrong, pixels_of(MOUNT))
    mirrored = POINTS * (1.0, -1.0) + (0.0, 0.1)
    assert "is y_m positive to the left?" in refused(mirrored, pixels_of(MOUNT))


BOARD = Board(columns=9, rows=6, square_m=0.03)
SHEETS: dict[str, tuple[Board | ArucoSheet, np.ndarray, float, float]] = {
    "chessboard": (BOARD, chessboard(9, 6), 0.03 / PAPER_PX, 0.63),
    "charuco": (dataclasses.replace(BOARD, marker_m=0.0225), charuco(9, 6), 0.03 / PAPER_PX, 0.63),
    "marker": (ArucoSheet(columns=1, rows=1, marker_m=0.2, gap_m=0.0), marker(17), 0.2 / 192, 0.63),
}


@pytest.mark.parametrize("turn_deg", rest_slow((6.0, 181.0), 181.0))
@pytest.mark.parametrize("kind", SHEETS)
def test_a_sheet_on_the_floor_whichever_way_it_lies(kind: str, turn_deg: float) -> None:
    sheet, paper, m_per_px, x_m = SHEETS[kind]
    image = on_floor(paper, m_per_px, (x_m, 0.02), math.radians(turn_deg), MOUNT)
    seen = find_sheet(image, sheet)
    assert seen is not None
    said_deg = (turn_deg + 45.0) % 90.0 - 45.0
    place = SheetPlace(x_m=x_m, y_m=0.02, turn_rad=math.radians(said_deg))
    found, measured = camera_from_sheet(seen, place, CAMERA, Extrinsics())
    assert found.residual_px < 0.5
    position, angles = numbers(found.extrinsics)[:3], numbers(found.extrinsics)[3:]
    assert position == pytest.approx(numbers(MOUNT)[:3], abs=0.004)
    assert angles == pytest.approx(numbers(MOUNT)[3:], abs=0.008)
    if kind == "chessboard":
        assert measured.points_m.mean(axis=0) == pytest.approx((x_m, 0.02))
    assert found.error_m[1.0] > 0.004  # the place itself is only known to 3 mm and 0.6 deg


def test_a_sheet_of_markers_is_numbered_row_by_row() -> None:
    sheet = ArucoSheet(columns=2, rows=1, marker_m=0.1, gap_m=0.025)
    paper = np.hstack((marker(0)[:, :-24], marker(1)[:, 24:]))  # 192 px are 0.1 m, the rims between them 48 px
    image = on_floor(paper, 0.1 / 192, (0.55, 0.0), 0.0, MOUNT)
    seen = find_sheet(image, sheet)
    assert seen is not None
    assert len(seen.points_m) == 8
    found, _ = camera_from_sheet(seen, SheetPlace(x_m=0.55), CAMERA, Extrinsics())
    assert numbers(found.extrinsics) == pytest.approx(numbers(MOUNT), abs=0.01)


def test_a_part_of_a_chessboard_has_no_known_middle() -> None:
    image = on_floor(chessboard(9, 6), 0.03 / PAPER_PX, (0.63, 0.02), 0.0, MOUNT)
    assert find_sheet(image, BOARD) is not None
    assert find_sheet(np.ascontiguousarray(image[:, 260:]), BOARD) is None
    assert find_sheet(np.full((360, 640), 90, np.uint8), SHEETS["marker"][0]) is None


def test_a_sheet_that_lies_askew_is_refused() -> None:
    grid = np.array([(x, y) for x in (-0.1, 0.0, 0.1) for y in (-0.06, 0.06)])
    lying = np.column_stack((0.63 - grid[:, 1], 0.02 - grid[:, 0]))
    turned = dataclasses.replace(MOUNT, yaw_rad=0.75)
    pixels = GroundCamera(CameraModel(LENS, 4000, 4000), turned).ground_to_px(lying) - 1500.0
    shifted = CameraModel(dataclasses.replace(LENS, cx_px=LENS.cx_px - 1500.0, cy_px=LENS.cy_px - 1500.0), 640, 360)
    with pytest.raises(CalibrationError):
        camera_from_sheet(SeenSheet(points_m=grid, pixels=pixels), SheetPlace(x_m=0.63, y_m=0.02), shifted, MOUNT)


def test_the_grid_lies_on_the_ground() -> None:
    camera = GroundCamera(CAMERA, MOUNT)
    picture = ground_picture(np.zeros((360, 640), np.uint8), camera, POINTS, camera.ground_to_px(POINTS) + 1.0)
    assert picture.shape == (360, 640, 3)
    for point, colour in (((0.75, -0.125), (110, 210, 110)), ((1.1, 0.0), (60, 170, 255))):
        u, v = np.rint(camera.ground_to_px(np.array(point))).astype(int)
        around = picture[v - 1 : v + 2, u - 1 : u + 2].reshape(-1, 3)
        assert np.abs(around.astype(int) - colour).sum(axis=1).min() < 90
    u, v = np.rint(camera.ground_to_px(np.array((0.62, -0.125)))).astype(int)
    assert not picture[v - 2 : v + 3, u - 2 : u + 3].any()
