"""A camera found from drawn roads against the one that they were drawn with."""

from __future__ import annotations

import dataclasses
import json
import math
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from automodel.config import Extrinsics
from automodel.geometry import GroundCamera, cam_from_body_rotation
from calibration.from_lanes import (
    LanesCalibration,
    camera_from_lanes,
    check_consistent,
    level,
    solve_attitude,
    steepness,
)
from calibration.vanishing_point_fit import ConvergingLines
from tests.support.highway_pictures import DASHES, DOTS, LANE_M, SOLID, Line, camera_model, draw, lane, mounted
from tests.support.slow_lane import rest_slow

BENT = (-0.25, 0.06, 0.0, 0.0, 0.0)
DRIVE = [(0.3, 0.01), (-0.4, -0.012), (0.1, 0.0), (-0.2, 0.006), (0.5, -0.004)]  # offset [m], heading [rad]


def road(offset_m: float, pattern=DASHES, phase_m: float = 0.0) -> list[Line]:
    return [*lane(offset_m, pattern, SOLID, phase_m), Line(-offset_m + 1.5 * LANE_M, SOLID)]


def drive(camera: GroundCamera, pattern=DASHES, **more) -> list[np.ndarray]:
    return [
        draw(camera, road(offset, pattern, 2.3 * k), -heading, seed=k, **more)
        for k, (offset, heading) in enumerate(DRIVE)
    ]


@cache
def found(**extrinsics: float) -> tuple[LanesCalibration, GroundCamera]:
    model = camera_model(f_px=330.0, distortion=BENT) if extrinsics.pop("bent", 0.0) else camera_model()
    camera = mounted(model, **extrinsics)
    return camera_from_lanes(drive(camera), model, LANE_M, Extrinsics(x_m=0.0, roll_rad=0.0)), camera


CAMERAS = [
    {},
    {"z_m": 1.3, "pitch_rad": -0.02, "yaw_rad": 0.03},
    {"roll_rad": 0.03, "z_m": 1.8},
    {"pitch_rad": 0.25, "roll_rad": -0.02, "yaw_rad": -0.03, "bent": 1.0},
]


@pytest.mark.parametrize("extrinsics", rest_slow(CAMERAS, CAMERAS[0], CAMERAS[-1]))
def test_the_camera_is_the_one_that_it_was_drawn_with(extrinsics: dict[str, float]) -> None:
    result, camera = found(**extrinsics)
    wanted = {"z_m": 1.6, "pitch_rad": 0.1, "yaw_rad": 0.0, "roll_rad": 0.0, **extrinsics}
    e = result.extrinsics
    assert e.z_m == pytest.approx(wanted["z_m"], rel=0.015)
    assert e.pitch_rad == pytest.approx(wanted["pitch_rad"], abs=0.002)
    assert e.yaw_rad == pytest.approx(wanted["yaw_rad"], abs=0.004)  # the median heading is 0
    assert e.roll_rad == pytest.approx(wanted["roll_rad"], abs=0.004)
    assert result.roll_known
    assert (result.frames_used, result.frames_seen) == (5, 5)
    assert 0.0 < result.residual_px < 2.0
    vanishing = camera.camera.project(camera.cam_from_body[:, 0])
    np.testing.assert_allclose(result.vanishing_px, vanishing, atol=2.5)


@pytest.mark.parametrize("extrinsics", rest_slow(CAMERAS, CAMERAS[0], CAMERAS[-1]))
def test_the_told_errors_hold_what_is_missed(extrinsics: dict[str, float]) -> None:
    result, camera = found(**extrinsics)
    assert list(result.ground_error_m) == [5.0, 10.0, 20.0]
    place = np.array([[distance, 0.0] for distance in result.ground_error_m])
    off = GroundCamera(camera.camera, result.extrinsics).px_to_ground(camera.ground_to_px(place)) - place
    told = np.array(list(result.ground_error_m.values()))
    assert (np.hypot(*off.T) < 3.0 * told).all()
    assert (told < np.array([0.1, 0.2, 0.4])).all()  # and they say something


def test_dots_are_enough() -> None:
    camera = mounted()
    result = camera_from_lanes(drive(camera, DOTS), camera.camera, LANE_M)
    assert result.extrinsics.pitch_rad == pytest.approx(0.1, abs=0.003)
    assert result.extrinsics.z_m == pytest.approx(1.6, rel=0.02)


def test_a_scale_car_s_camera() -> None:
    model = camera_model(640, 360, 480.0)
    camera = mounted(model, z_m=0.18, pitch_rad=0.26, x_m=0.2)
    small = [Line(0.2, (0.3, 0.3), 0.0, 0.03), Line(-0.2, SOLID, 0.0, 0.03), Line(0.6, SOLID, 0.0, 0.03)]
    images = [
        draw(camera, [Line(one.offset_m - o, one.pattern, p, 0.03) for one in small], h, seed=k)
        for k, (o, h, p) in enumerate([(0.02, 0.0, 0.0), (-0.03, 0.02, 0.2), (0.01, -0.02, 0.5), (0.0, 0.0, 0.35)])
    ]
    result = camera_from_lanes(images, model, 0.4, Extrinsics(x_m=0.2, y_m=0.01))
    assert (result.extrinsics.x_m, result.extrinsics.y_m) == (0.2, 0.01)  # images do not tell
    assert result.extrinsics.z_m == pytest.approx(0.18, rel=0.015)
    assert result.extrinsics.pitch_rad == pytest.approx(0.26, abs=0.003)
    assert list(result.ground_error_m) == [0.5, 1.0, 2.0]


def test_all_lengths_grow_with_the_lane_s_width_and_nothing_else_changes() -> None:
    one, camera = found()
    two = camera_from_lanes(iter(drive(camera)), camera.camera, 2.0 * LANE_M)
    assert two.extrinsics.z_m == 2.0 * one.extrinsics.z_m
    assert two.extrinsics.pitch_rad == one.extrinsics.pitch_rad
    assert (two.residual_px, two.vanishing_px) == (one.residual_px, one.vanishing_px)


def test_two_cameras_in_one_drive_are_refused() -> None:
    camera = mounted()
    images = drive(camera)
    found = camera_from_lanes(images, camera.camera, LANE_M)
    check_consistent(images, camera.camera, found)
    other = drive(mounted(z_m=2.6))
    mixed = camera_from_lanes([*images, *other], camera.camera, LANE_M)
    with pytest.raises(ValueError, match="half of the drive shows a camera"):
        check_consistent([*images, *other], camera.camera, mixed)
    with pytest.raises(ValueError, match="leave the height of the camera open by 9 %"):
        check_consistent(
            images, camera.camera, dataclasses.replace(found, std={**found.std, "z_m": 0.09 * found.extrinsics.z_m})
        )
    with pytest.raises(ValueError, match=r"leave the pitch of the camera open by 0\.6 deg"):
        check_consistent(images, camera.camera, dataclasses.replace(found, std={**found.std, "pitch_rad": 0.01}))


def test_bends_that_pass_for_straight_roads_are_refused() -> None:
    camera = mounted(z_m=1.4, pitch_rad=0.02)
    rng = np.random.default_rng(0)
    bends = [
        draw(camera, road(rng.normal() * 0.3, DASHES, rng.uniform(0, 12)), rng.normal() * 0.005, -1.0 / 170.0, seed=k)
        for k in range(10)
    ]
    with pytest.raises(ValueError, match=r"leave the pitch|show a curve"):
        check_consistent(bends, camera.camera, camera_from_lanes(bends, camera.camera, LANE_M))


def test_one_bend_among_straight_roads_is_left_out() -> None:
    camera = mounted()
    images = [*drive(camera), draw(camera, road(0.0), 0.0, 1.0 / 40.0)]
    result = camera_from_lanes(images, camera.camera, LANE_M)
    assert (result.frames_used, result.frames_seen) == (5, 6)
    assert result.extrinsics.pitch_rad == pytest.approx(0.1, abs=0.002)


def refusal(images: list[np.ndarray], width_m: float = LANE_M, **more: Any) -> str:
    with pytest.raises(ValueError) as caught:
        camera_from_lanes(images, camera_model(), width_m, **more)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_what_nothing_can_be_concluded_from_is_refused_in_a_line() -> None:
    camera = mounted()
    straight = drive(camera)
    assert refusal(straight[:2]).startswith("images: expected 3 or more of a straight road, got 2")
    assert "lane_width_m" in refusal(straight, 0.0)
    assert "expected 512x288 pixels as the camera has, number 1 has 100x50" in refusal(
        [straight[0], np.zeros((50, 100), np.uint8), straight[1]]
    )
    bare = [draw(camera, [], seed=seed) for seed in range(4)]
    assert "0 of 4 show lines that meet" in refusal(bare)
    single = [draw(camera, [Line(-1.7)], 0.0, seed=seed) for seed in range(4)]
    assert "0 of 4 show lines that meet" in refusal(single)
    noise = [np.random.default_rng(seed).integers(0, 255, (288, 512)).astype(np.uint8) for seed in range(4)]
    assert "0 of 4 show lines that meet" in refusal(noise)


def test_a_road_that_bends_is_refused() -> None:
    camera = mounted()
    bends = [draw(camera, road(0.1 * k), 0.0, 1.0 / 40.0, seed=k) for k in range(4)]
    assert "0 of 4 show lines that meet" in refusal(bends)


def test_pitch_yaw_and_roll_come_back_from_the_direction_of_travel() -> None:
    for pitch, yaw, roll in [(0.1, 0.05, 0.0), (-0.2, -0.3, 0.15), (0.9, 0.2, -0.4), (0.0, 0.0, 0.3)]:
        camera = Extrinsics(pitch_rad=pitch, yaw_rad=yaw, roll_rad=roll)
        assert level(cam_from_body_rotation(camera)[:, 0], roll) == pytest.approx((pitch, yaw))


def pencil_of(camera: GroundCamera, laterals_m: list[float], heading_rad: float = 0.0) -> ConvergingLines:
    """The exact lines of straight lines on the ground, from two projected points of each."""
    focal, matrix = camera.camera.matrix[0, 0], camera.camera.matrix
    along = np.array([math.cos(heading_rad), math.sin(heading_rad)])
    slopes = []
    for y in sorted(laterals_m, reverse=True):
        near, far = camera.ground_to_px([np.array([0.0, y]) + s * along for s in (12.0, 40.0)])
        slopes.append((near[0] - far[0]) / (near[1] - far[1]))
    ray = camera.cam_from_body @ np.array([*along, 0.0])
    place = ray[:2] / ray[2] * focal
    assert matrix[0, 0] == matrix[1, 1]
    return ConvergingLines(
        vanishing_px=place, slopes=np.array(slopes), support=np.ones(len(slopes)), bend_px2=0.0,
        covariance=1e-12 * np.eye(3 + len(slopes)), residual_px=0.1,
    )  # fmt: skip


def test_lines_lie_where_their_planes_say() -> None:
    camera = mounted(pitch_rad=0.2, yaw_rad=0.1)
    lines = pencil_of(camera, [5.2, 1.9, -1.6])
    np.testing.assert_allclose(np.tan(steepness(lines, 450.0)), np.array([5.2, 1.9, -1.6]) / 1.6, atol=1e-9)


@pytest.mark.parametrize("roll", [-0.06, 0.0, 0.035])
def test_roll_is_what_makes_all_lanes_one_width(roll: float) -> None:
    camera = mounted(pitch_rad=0.15, yaw_rad=-0.04, roll_rad=roll)
    bundles = [pencil_of(camera, [1.8 + 3.6 - o, 1.8 - o, -1.8 - o]) for o in (0.2, -0.5, 0.1)]
    found = solve_attitude(bundles, 450.0, 0.0)
    assert found.roll_known
    assert found.roll_rad == pytest.approx(roll, abs=0.002)
    assert found.pitch_rad == pytest.approx(0.15, abs=0.001)
    assert found.yaw_rad == pytest.approx(-0.04, abs=0.001)
    assert found.width_heights == pytest.approx(3.6 / 1.6, rel=0.003)


def test_one_lane_seen_from_its_middle_tells_no_roll() -> None:
    camera = mounted(roll_rad=0.05)
    bundles = [pencil_of(camera, [1.8, -1.8])] * 4
    found = solve_attitude(bundles, 450.0, 0.01)
    assert not found.roll_known
    assert found.roll_rad == pytest.approx(0.01)


def test_two_lanes_together_are_no_lane() -> None:
    camera = mounted()
    bundles = [pencil_of(camera, [5.4, 1.8, -1.8]), pencil_of(camera, [5.4, -1.8]), pencil_of(camera, [1.8, -1.8])]
    assert solve_attitude(bundles, 450.0, 0.0).width_heights == pytest.approx(3.6 / 1.6, rel=0.01)
    with pytest.raises(ValueError, match="the camera between them"):
        solve_attitude([pencil_of(camera, [5.4, 1.8])] * 3, 450.0, 0.0)


@pytest.mark.realdata
def test_the_highway_video_s_camera(data_root: Path) -> None:
    """Its camera was estimated by hand from the same video: tests/cars/solid_white_right.toml."""
    file = data_root / "udacity" / "solidWhiteRight.mp4"
    if not file.is_file():
        pytest.skip(f"no {file}")
    video = cv2.VideoCapture(str(file))
    images = [np.asarray(video.read()[1], np.uint8) for _ in range(220)][::30]
    video.release()
    model = camera_model(960, 540, 868.0)
    found = camera_from_lanes(images, model, 3.7)
    assert found.extrinsics.pitch_rad == pytest.approx(-0.0411, abs=0.003)
    assert found.extrinsics.yaw_rad == pytest.approx(0.0025, abs=0.005)
    assert found.extrinsics.z_m == pytest.approx(1.246, rel=0.03)
    np.testing.assert_allclose(found.vanishing_px, (481.7, 305.2), atol=3.0)


@pytest.mark.realdata
def test_ten_highway_frames_agree_with_their_labels(data_root: Path) -> None:
    root = data_root / "tusimple"
    if not (root / "label_data.json").is_file():
        pytest.skip(f"no {root}/label_data.json")
    labels = [json.loads(line) for line in (root / "label_data.json").read_text().splitlines()]
    files = [str(root / label["raw_file"]) for label in labels]
    images = [np.asarray(cv2.imread(file, cv2.IMREAD_GRAYSCALE), np.uint8) for file in files]
    found = camera_from_lanes(images, camera_model(f_px=443.0), 3.7)
    # by the labels alone lines meet in (257 +- 8, 96.5 +- 2), and lanes are 2.2 slopes wide: 3.7 / 2.2 m
    np.testing.assert_allclose(found.vanishing_px, (257.0, 96.5), atol=5.0)
    assert found.extrinsics.z_m == pytest.approx(1.68, rel=0.04)
