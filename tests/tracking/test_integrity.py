"""The bound of a pose: what a camera that is not as configured adds, and what innovations say."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from automodel.config import CameraConfig, CarConfig
from automodel.geometry import GroundCamera
from automodel.tracking import integrity
from automodel.tracking.integrity import MOST, CameraErrors, Innovations, K, bound

CAMERA, LANE_M = CarConfig().camera, CarConfig().lane.width_m


def mounted(camera: CameraConfig, **change: float) -> CameraConfig:
    return replace(camera, extrinsics=replace(camera.extrinsics, **change))


def seen_pose(assumed: CameraConfig, real: CameraConfig, aside_m: float = 0.0) -> tuple[float, float]:
    """Lateral place [m] at x = 0 and direction [rad] at which a lane's middle is seen that runs straight ahead."""
    near_m = GroundCamera.from_config(assumed).first_visible_x_m()
    x = np.linspace(near_m + 0.1, near_m + 0.5, 5)
    fits = []
    for side in (0.5 * LANE_M, -0.5 * LANE_M):
        px = GroundCamera.from_config(real).ground_to_px(np.column_stack((x, np.full(5, side + aside_m))))
        points = GroundCamera.from_config(assumed).px_to_ground(px)
        fits.append(np.polyfit(points[:, 0], points[:, 1], 1))
    slope, place = np.mean(fits, axis=0)
    return float(place), math.atan(float(slope))


@pytest.mark.parametrize("aside_m", [0.0, 0.15, -0.15])
@pytest.mark.parametrize(
    ("name", "share"), [("pitch_rad", 0.0), ("yaw_rad", 0.0), ("roll_rad", 0.0), ("z_m", integrity.HEIGHT_SHARE)]
)
def test_the_error_of_a_camera_off_by_one_sigma_lies_within_the_bound(name: str, share: float, aside_m: float) -> None:
    step = share * CAMERA.extrinsics.z_m or integrity.ANGLE_RAD
    errors = CameraErrors(CAMERA, LANE_M, 0.0)
    offset_sigma, heading_sigma = errors.sigmas(abs(aside_m))
    for sign in (1.0, -1.0):
        real = mounted(CAMERA, **{name: getattr(CAMERA.extrinsics, name) + sign * step})
        place, direction = seen_pose(CAMERA, real, aside_m)
        assert abs(place - aside_m) < 2.0 * offset_sigma
        assert abs(direction) < 2.0 * heading_sigma


def test_a_yaw_turns_the_lane_by_itself() -> None:
    assert CameraErrors(CAMERA, LANE_M, 0.0).heading_rad >= integrity.ANGLE_RAD - 1e-4


@pytest.mark.parametrize("name", ["ANGLE_RAD", "HEIGHT_SHARE"])
def test_the_worse_a_camera_is_mounted_the_larger_its_errors(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    before = CameraErrors(CAMERA, LANE_M, 0.0).sigmas(0.5 * LANE_M)
    monkeypatch.setattr(integrity, name, 2.0 * getattr(integrity, name))
    after = CameraErrors(CAMERA, LANE_M, 0.0).sigmas(0.5 * LANE_M)
    assert after[0] > before[0]
    assert after[1] >= before[1]


def test_a_lane_to_the_side_is_less_sure_than_one_ahead() -> None:
    errors = CameraErrors(CAMERA, LANE_M, 0.0)
    sigmas = [errors.sigmas(aside_m) for aside_m in (0.0, 0.1, 0.3)]
    assert sigmas == sorted(sigmas)
    assert sigmas[0] == pytest.approx((errors.offset_m, errors.heading_rad))


def test_a_car_ten_times_as_large_has_ten_times_the_offset_error_and_the_same_heading_error() -> None:
    mount = CAMERA.extrinsics
    big = mounted(CAMERA, x_m=10.0 * mount.x_m, y_m=10.0 * mount.y_m, z_m=10.0 * mount.z_m)
    one, other = CameraErrors(CAMERA, LANE_M, 0.1), CameraErrors(big, 10.0 * LANE_M, 1.0)
    assert other.offset_m == pytest.approx(10.0 * one.offset_m, rel=1e-6)
    assert (other.heading_rad, other.scale) == pytest.approx((one.heading_rad, one.scale), rel=1e-6)
    assert other.wedge_per_m == pytest.approx(0.1 * one.wedge_per_m, rel=1e-6)


def test_a_bound_is_so_many_sigmas_of_both_errors_together() -> None:
    assert bound(0.0009, 0.04) == pytest.approx(K * 0.05)
    assert bound(0.0, 0.02) == pytest.approx(K * 0.02)
    assert bound(-1e-18, 0.0) == 0.0  # a covariance may round to that
    assert bound(0.002, 0.04) > bound(0.001, 0.04)
    assert bound(0.001, 0.05) > bound(0.001, 0.04)


def test_a_bound_is_exceeded_by_fewer_than_one_error_in_a_thousand() -> None:
    random = np.random.default_rng(3)
    errors = random.normal(0.0, 0.03, 100_000) + random.normal(0.0, 0.04, 100_000)
    assert np.mean(np.abs(errors) > bound(0.0009, 0.04)) < 0.001


def test_innovations_as_large_as_expected_inflate_little() -> None:
    innovations, random = Innovations(), np.random.default_rng(4)
    factors = []
    for squared in random.chisquare(2.0, 2000):
        innovations.add(0.5 * squared)
        factors.append(innovations.inflation)
    assert min(factors) == 1.0
    assert np.mean(factors) < 1.15
    assert max(factors) < 2.0


def test_innovations_that_are_too_large_inflate_and_are_forgotten() -> None:
    innovations = Innovations()
    for _ in range(200):
        innovations.add(9.0)
    assert innovations.inflation == pytest.approx(9.0, rel=0.01)  # errors three times as large as said
    for _ in range(200):
        innovations.add(1.0)
    assert innovations.inflation == pytest.approx(1.0, abs=0.01)
    innovations.add(9.0)
    innovations.reset()
    assert innovations.inflation == 1.0


def test_no_single_innovation_inflates_much_and_what_is_no_number_counts_for_nothing() -> None:
    innovations = Innovations()
    innovations.add(math.nan)
    innovations.add(math.inf)
    assert innovations.inflation == 1.0
    innovations.add(1e12)
    assert innovations.inflation < 1.0 + 0.1 * MOST
    for _ in range(1000):
        innovations.add(1e12)
    assert innovations.inflation <= MOST
