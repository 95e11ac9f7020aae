"""Corners that both cameras see: epipolar errors and parallaxes from constructions, and rigs that are wrong."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
import pytest

from automodel.config import Extrinsics, Intrinsics
from automodel.geometry import CameraModel, GroundCamera
from automodel.geometry.stereo_rig import Eye, StereoRig, image_of
from automodel.perception.stereo.points import RigCheck, check_rig, epipolar
from tests.support.stereo_pictures import mirror_cameras

F_PX, BASELINE_M, WALL_M = 480.0, 0.25, 3.0


def parallel(right_pitch_rad: float = 0.0) -> StereoRig:
    """Two level cameras beside each other."""
    lens = Intrinsics(fx_px=F_PX, fy_px=F_PX, cx_px=319.5, cy_px=179.5)

    def camera(y_m: float, pitch_rad: float) -> GroundCamera:
        return GroundCamera(CameraModel(lens, 640, 360), Extrinsics(x_m=0.0, y_m=y_m, z_m=1.0, pitch_rad=pitch_rad))

    return StereoRig(camera(0.5 * BASELINE_M, 0.0), camera(-0.5 * BASELINE_M, right_pitch_rad))


def wall(noise: float = 2.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A patterned wall `WALL_M` ahead of both, as they see it."""
    rng = np.random.default_rng(seed)
    shift = round(F_PX * BASELINE_M / WALL_M)
    pattern = cv2.resize(rng.integers(40, 220, (60, 120)).astype(np.uint8), None, fx=6.5, fy=6.5)
    whole = pattern[:360, : 640 + shift].astype(float)
    left, right = whole[:, :640], whole[:, shift:]  # what is at column u on the left is at u - shift on the right

    def noisy(image: np.ndarray) -> np.ndarray:
        return np.clip(image + noise * rng.standard_normal(image.shape), 0, 255).astype(np.uint8)

    return noisy(left), noisy(right)


def test_rays_that_meet_have_no_error_and_the_angle_between_them() -> None:
    rig = mirror_cameras()
    eyes = Eye.of(rig.left), Eye.of(rig.right)
    rng = np.random.default_rng(1)
    points = np.column_stack((rng.uniform(5, 40, 50), rng.uniform(-3, 3, 50), rng.uniform(-0.5, 2, 50)))
    left, right = (np.array([image_of(eye, *point) for point in points]) for eye in eyes)
    error, parallax = epipolar(rig.left, rig.right, left, right)
    np.testing.assert_allclose(error, 0.0, atol=1e-4)
    one, other = points - rig.left.centre_m, points - rig.right.centre_m
    cosine = (one * other).sum(axis=1) / np.linalg.norm(one, axis=1) / np.linalg.norm(other, axis=1)
    np.testing.assert_allclose(parallax, 600.0 * np.sin(np.arccos(cosine)), rtol=1e-4)
    _, swapped = epipolar(rig.right, rig.left, right, left)  # both exchanged: the same points
    assert (swapped > 0.0).all()


def test_a_pixel_beside_its_epipolar_line_is_off_by_so_much() -> None:
    rig = parallel()
    left = np.array([[320.0, 180.0], [200.0, 100.0]])
    right = left - np.array((40.0, 0.0))
    assert epipolar(rig.left, rig.right, left, right)[0] == pytest.approx([0.0, 0.0], abs=1e-6)
    off, _ = epipolar(rig.left, rig.right, left, right + np.array((0.0, 3.0)))
    assert np.abs(off) == pytest.approx([3.0, 2.6], abs=0.3)  # farther out a pixel is a smaller angle


def test_the_calibrated_rig_explains_what_it_sees() -> None:
    check = check_rig([wall()], parallel())
    assert check.rigid > 0.6 * check.matched > 100
    assert check.error_px < 1.0
    assert check.as_given > 20 * check.exchanged
    assert check.order_sigmas > 10.0


def test_exchanged_images_lie_behind_the_cameras() -> None:
    left, right = wall()
    check = check_rig([(right, left)], parallel())
    assert check.order_sigmas < -10.0
    assert check.error_px < 1.0  # epipolar lines alone would not tell


@pytest.mark.parametrize("pitch_rad", [0.02, 0.05])
def test_a_camera_that_looks_elsewhere_than_calibrated_is_off_by_that(pitch_rad: float) -> None:
    check = check_rig([wall(seed=2), wall(seed=3)], parallel(pitch_rad))
    assert check.error_px == pytest.approx(F_PX * math.sin(pitch_rad), rel=0.1)


def test_nothing_to_see_is_no_point() -> None:
    grey = np.full((360, 640), 90, np.uint8)
    for pairs in ([], [(grey, grey)], [(grey, wall()[1])]):
        check = check_rig(pairs, parallel())
        assert (check.matched, check.rigid, check.as_given, check.exchanged, check.order_sigmas) == (0, 0, 0, 0, 0.0)
        assert math.isnan(check.error_px)


def test_the_sign_test() -> None:
    check = RigCheck(matched=0, rigid=0, error_px=0.0, as_given=20, exchanged=5)
    assert check.order_sigmas == 3.0
    assert dataclasses.replace(check, as_given=5, exchanged=20).order_sigmas == -3.0


def test_matches_of_which_opencv_makes_no_geometry_have_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*args: object) -> None:
        raise cv2.error("Assertion failed: !model.empty()")

    monkeypatch.setattr(cv2, "findFundamentalMat", refused)
    check = check_rig([wall()], parallel())
    assert (check.rigid, check.as_given > 20 * check.exchanged) == (0, True)
    assert math.isnan(check.error_px)
