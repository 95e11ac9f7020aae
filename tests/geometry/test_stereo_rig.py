"""The compiled cameras against `CameraModel` and `GroundCamera`, and the rig over a plane that is not level."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.config import Extrinsics, Intrinsics
from automodel.geometry import CameraModel, GroundCamera
from automodel.geometry.stereo_rig import Eye, Plane, StereoRig, bearings, image_of, on_ground

LENS = Intrinsics(fx_px=480.0, fy_px=470.0, cx_px=310.0, cy_px=180.0, distortion=(-0.3, 0.1, 1e-3, -2e-3, 0.02))
CAMERA = GroundCamera(
    CameraModel(LENS, 640, 360), Extrinsics(x_m=1.0, y_m=0.9, z_m=1.5, pitch_rad=0.2, yaw_rad=-0.1, roll_rad=0.05)
)
RIGHT = GroundCamera(
    CameraModel(LENS, 640, 360), Extrinsics(x_m=1.1, y_m=-0.9, z_m=1.3, pitch_rad=0.1, yaw_rad=0.1, roll_rad=-0.02)
)


def test_bearings_are_the_cameras_rays() -> None:
    pixels = np.random.default_rng(1).uniform((0, 0), (639, 359), (50, 2))
    expected = CAMERA.camera.rays(pixels) @ CAMERA.cam_from_body
    np.testing.assert_allclose(bearings(Eye.of(CAMERA), pixels), expected, atol=1e-8)


def test_a_pixel_beyond_the_fold_of_the_lens_has_no_bearing() -> None:
    folding = Intrinsics(fx_px=100.0, fy_px=100.0, cx_px=319.5, cy_px=179.5, distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))
    camera = GroundCamera(CameraModel(folding, 640, 360), Extrinsics())
    assert np.isnan(bearings(Eye.of(camera), np.array([[0.0, 0.0]]))).all()


def test_the_image_of_a_point_is_the_cameras() -> None:
    for point in np.random.default_rng(2).uniform((3.0, -3.0, -0.5), (20.0, 3.0, 1.0), (20, 3)):
        np.testing.assert_allclose(image_of(Eye.of(CAMERA), *point), CAMERA.body_to_px(point), atol=1e-8)
    assert np.isnan(image_of(Eye.of(CAMERA), -5.0, 0.0, 0.0)).all()


def test_directions_meet_the_ground_where_the_camera_says() -> None:
    pixels = np.array([[100.0, 300.0], [500.0, 340.0], [320.0, 5.0]])
    eye = Eye.of(CAMERA)
    np.testing.assert_allclose(on_ground(eye, bearings(eye, pixels)), CAMERA.px_to_ground(pixels), atol=1e-7)


@pytest.mark.parametrize("name", ["height_m", "pitch_rad", "roll_rad"])
def test_a_rig_over_a_plane_sees_its_ground_as_level(name: str) -> None:
    """Ground points of a tilted plane, placed by rotation about the middle of the cameras, project alike."""
    rig, plane = StereoRig(CAMERA, RIGHT), Plane(**{name: 0.05})
    level = np.array([[8.0, 2.0, 0.0], [15.0, -1.0, 0.0], [6.0, 0.0, 0.0]])
    middle = rig.middle_m + np.array((0.0, 0.0, plane.height_m))
    as_calibrated = (level - middle) @ plane.level_from_body + rig.middle_m
    for calibrated, over in zip((CAMERA, RIGHT), rig.over(plane), strict=True):
        np.testing.assert_allclose(over.body_to_px(level), calibrated.body_to_px(as_calibrated), atol=1e-9)


def test_positive_pitch_looks_down_and_positive_roll_leans_right() -> None:
    def turned(**angles: float) -> np.ndarray:
        return Plane(**angles).level_from_body @ np.array((1.0, 1.0, 0.0))

    assert turned(pitch_rad=0.1)[2] == pytest.approx(-math.sin(0.1))  # the nose goes down
    assert turned(roll_rad=0.1)[2] == pytest.approx(math.sin(0.1))  # the left side goes up


def test_the_baseline_is_the_distance_of_the_cameras() -> None:
    assert StereoRig(CAMERA, RIGHT).baseline_m == pytest.approx(math.sqrt(0.1**2 + 1.8**2 + 0.2**2))
