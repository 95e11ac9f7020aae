"""A car guessed from drawn roads against the camera that they were drawn with."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from automodel.geometry import GroundCamera
from calibration.from_lanes import camera_from_lanes
from calibration.guess import GuessedCar, guess_car
from tests.support.highway_pictures import LANE_M, SOLID, Line, camera_model, draw, lane, mounted

SIZE, FOCAL_PX = (480, 270), 384.0  # a field of view of 64 deg, the usual one
VIEW_RAD = 2.0 * math.atan(0.5 * SIZE[0] / FOCAL_PX)
DRIVE = [(0.3, 0.01), (-0.4, -0.012), (0.1, 0.0), (-0.2, 0.006), (0.4, -0.004), (0.0, 0.0)]  # offset [m], heading [rad]


def drive(camera: GroundCamera, **marking: float) -> list[np.ndarray]:
    return [
        draw(
            camera,
            [*lane(offset, phase_m=2.3 * k, **marking), Line(-offset + 1.5 * LANE_M, SOLID, **marking)],
            -heading,
            seed=k,
        )
        for k, (offset, heading) in enumerate(DRIVE)
    ]


@cache
def guessed(focal_px: float = FOCAL_PX, told: bool = True, k1: float = 0.0, **marking: float) -> GuessedCar:
    model = camera_model(*SIZE, focal_px, (k1, 0.0, 0.0, 0.0, 0.0))
    images = drive(mounted(model, z_m=1.4, pitch_rad=0.12, roll_rad=0.02), **marking)
    view_rad = 2.0 * math.atan(0.5 * SIZE[0] / focal_px)
    return guess_car(images, 25.0, LANE_M if told else None, view_rad if told else None)


def test_a_camera_whose_lens_and_lane_are_given_is_found() -> None:
    guess = guessed()
    e = guess.car.camera.extrinsics
    assert (guess.car.camera.width_px, guess.car.camera.height_px) == SIZE
    assert e.pitch_rad == pytest.approx(0.12, abs=math.radians(0.2))
    assert e.z_m == pytest.approx(1.4, rel=0.02)
    assert e.roll_rad == pytest.approx(0.02, abs=0.005)
    assert abs(e.yaw_rad) < 0.02
    assert guess.car.lane.marking_width_m == pytest.approx(0.12, rel=0.3)
    assert guess.car.lane.markings == "light"
    assert guess.car.camera.intrinsics.distortion[0] == 0.0
    assert guess.told == ("focal length", "lane width")
    assert guess.sigma["width_m"] == 0.0
    assert guess.sigma["fx_px"] == 0.0


def test_dark_tape_is_found_to_be_dark() -> None:
    guess = guessed(grey=-70.0)
    assert guess.car.lane.markings == "dark"
    assert guess.car.camera.extrinsics.z_m == pytest.approx(1.4, rel=0.03)


def test_the_stated_errors_hold_what_an_unknown_lens_and_lane_cost() -> None:
    guess = guessed(focal_px=330.0, told=False)
    e, sigma = guess.car.camera.extrinsics, guess.sigma
    assert guess.told == ()
    assert abs(guess.car.camera.intrinsics.fx_px - 330.0) < 2.0 * sigma["fx_px"]
    assert abs(e.pitch_rad - 0.12) < 2.0 * sigma["pitch_rad"] < math.radians(4.0)
    assert guess.car.lane.width_m == 3.5  # narrow markings: a street
    assert abs(e.z_m - 1.4) < 2.0 * sigma["z_m"] < 0.4
    assert e.z_m / guess.car.lane.width_m == pytest.approx(1.4 / LANE_M, rel=0.03)  # whatever the lens


def test_wide_markings_are_those_of_a_scale_track() -> None:
    assert guessed(told=False, width_m=0.28).car.lane.width_m == 0.4


def test_a_barrel_distortion_is_seen_in_the_lines() -> None:
    guess = guessed(k1=-0.3)
    assert guess.car.camera.intrinsics.distortion[0] == pytest.approx(-0.3, abs=0.1)
    assert guess.car.camera.extrinsics.z_m == pytest.approx(1.4, rel=0.02)


def test_large_images_give_the_same_camera() -> None:
    model = camera_model(960, 540, 768.0)
    images = drive(mounted(model, z_m=1.4, pitch_rad=0.12))
    guess = guess_car(images, 25.0, LANE_M, VIEW_RAD)
    assert guess.car.camera.intrinsics.fx_px == pytest.approx(768.0)
    assert guess.car.camera.extrinsics.pitch_rad == pytest.approx(0.12, abs=math.radians(0.3))
    assert guess.car.camera.extrinsics.z_m == pytest.approx(1.4, rel=0.02)


def test_halves_that_show_two_cameras_are_refused() -> None:
    model = camera_model(*SIZE, FOCAL_PX)
    high = drive(mounted(model, z_m=2.4, pitch_rad=0.12))
    with pytest.raises(ValueError, match="half of the drive shows a camera"):
        guess_car([*drive(mounted(model, z_m=1.4, pitch_rad=0.12)), *high], 25.0, LANE_M, VIEW_RAD)


@pytest.mark.parametrize("width_m", [0.0, -1.0, math.nan, math.inf])
def test_an_impossible_width_is_refused(width_m: float) -> None:
    with pytest.raises(ValueError, match="lane_width_m"):
        guess_car([np.zeros((90, 160), np.uint8)] * 4, 25.0, width_m)


def test_images_without_a_lane_are_refused_in_a_line() -> None:
    with pytest.raises(ValueError, match="0 of 6 show lines that meet") as caught:
        guess_car([np.full((90, 160), 80, np.uint8)] * 6, 25.0, 0.4)
    assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="there are none"):
        guess_car([], 25.0)


def test_the_calibration_finds_dark_tape_by_itself() -> None:
    camera = mounted(camera_model(*SIZE, FOCAL_PX), z_m=1.4)
    found = camera_from_lanes(drive(camera, grey=-70.0), camera.camera, LANE_M)
    assert found.markings == "dark"
    assert found.extrinsics.z_m == pytest.approx(1.4, rel=0.02)
    assert 0.0 < found.std["z_m"] < 0.05
