"""The right camera from lines, dash ends and odometry: constructed sights, and images of a simulated drive."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from automodel.bench.stereo_calibration import RigDrive, driven, random_rig
from automodel.config import Extrinsics, Intrinsics
from automodel.geometry import CameraModel, GroundCamera
from automodel.signals import Motion, MotionSource
from calibration.ground import NAMES
from calibration.lane_bundle import BODY, COMMON, Bundle, BundleFit, Prior, Rows, Unknowns, lens_rays
from calibration.lane_sights import PAIRS, WINDOWS, Drive, dash_end
from calibration.stereo_lanes import RULER_RAD, calibrate_stereo_from_lanes, check_from_lanes
from calibration.views import CalibrationError

LENS = Intrinsics(fx_px=560.0, fy_px=560.0, cx_px=319.5, cy_px=239.5, distortion=(-0.05, 0.0, 0.0, 0.0, 0.0))
LEFT = GroundCamera(CameraModel(LENS, 640, 480), Extrinsics(x_m=1.7, y_m=0.95, z_m=1.15, pitch_rad=0.12, yaw_rad=-0.06))
RIGHT = Extrinsics(x_m=1.75, y_m=-0.95, z_m=1.05, pitch_rad=0.10, yaw_rad=0.05, roll_rad=-0.04)
NEAR = np.array([0.05] * 3 + [math.radians(0.3)] * 3)  # as the search for pitch and yaw leaves it
SIGMA = np.array([0.05] * 3 + [RULER_RAD] * 3)


def constructed(
    lines_m: tuple[float, ...], ends: bool, weave: bool, noise_px: float = 0.05, seed: int = 0
) -> tuple[Bundle, Unknowns]:
    """What both cameras see of straight lines (y, in the road's frame) and of dashes 6 m apart, in four windows.

    Points of the road are projected by `GroundCamera`; the fit projects pixels onto the road. With `weave` the car
    stands elsewhere in the road in each window, and heads elsewhere in each pair.
    """
    rng, eyes = np.random.default_rng(seed), (LEFT, GroundCamera(LEFT.camera, RIGHT))
    parts: list[list[np.ndarray]] = [[] for _ in range(7)]
    place, spine, line_m, end_m = [], [], list[float](), list[float]()
    for window in range(4):
        offset, heading = (0.3 * (window - 1.5), 0.01 * (window - 1.5)) if weave else (0.0, 0.0)
        spine.append((math.tan(-heading), 0.0, 0.0))
        first, first_end = len(line_m), len(end_m)
        line_m += [y - offset for y in lines_m]
        marks = np.arange(6.0, 24.0, 6.0) if ends else np.empty(0)
        end_m += [x * math.cos(heading) for _ in lines_m for x in marks]
        for step in range(3):
            yaw = 0.02 * (step - 1) if weave else 0.0
            at = np.array((3.0 * (step - 1), 0.0))
            place.append((*at, yaw))
            for eye, camera in enumerate(eyes):
                for k, y in enumerate(lines_m):
                    road = np.concatenate((np.geomspace(4.0, 30.0, 20), marks))
                    body = np.column_stack((road, np.full(len(road), y - offset)))
                    body = body @ _turn(heading) - at  # road -> window -> pair
                    pixels = camera.ground_to_px(body @ _turn(yaw))
                    ridge = np.arange(len(road)) < 20
                    way = np.where(ridge[:, None], (1.0, 0.0), (0.0, -1.0))
                    pixels += rng.normal(0.0, noise_px, (len(road), 1)) * way
                    seen = camera.camera.inside(pixels)
                    rays, shifted = lens_rays(camera.camera, pixels, way)
                    number = first_end + k * len(marks) + np.arange(len(road)) - 20
                    values = (
                        rays, shifted, np.full(len(road), eye), np.full(len(road), len(place) - 1),
                        np.full(len(road), window), np.full(len(road), first + k), np.where(ridge, -1, number),
                    )  # fmt: skip
                    for part, value in zip(parts, values, strict=True):
                        part.append(value[seen])
    rows = Rows(**dict(zip(Rows.__slots__, map(np.concatenate, parts), strict=True)))
    common = np.zeros(COMMON)
    common[:7] = (*(getattr(RIGHT, name) for name in NAMES), 1.0)
    common[:6] += np.random.default_rng(seed).choice((-1.0, 1.0), 6) * NEAR
    sigma = np.concatenate((SIGMA, (0.02, 0.5, 0.1, 1e-6, 1e-3, 1e-3)))
    body = np.tile((0.01, 0.05, 0.003, 0.01, 0.01, 0.001), (len(place), 1))
    unknowns = Unknowns(
        common=common,
        body=np.zeros((len(place), BODY)),
        spine=np.array(spine),
        line=np.array(line_m),
        end=np.array(end_m),
    )
    prior = Prior(start=common.copy(), common=sigma, body=body)
    return Bundle((LEFT, LEFT.camera), rows, np.array(place), prior), unknowns


def _turn(angle_rad: float) -> np.ndarray:
    """Rows times this are turned by the angle to the right."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return np.array(((cos, -sin), (sin, cos)))


def errors(fit: BundleFit) -> np.ndarray:
    return np.array([value - getattr(RIGHT, name) for value, name in zip(fit.unknowns.common, NAMES, strict=False)])


def test_constructed_lines_and_dashes_give_the_right_camera() -> None:
    for seed in range(3):
        bundle, start = constructed((-1.75, 1.75, 5.25), ends=True, weave=True, seed=seed)
        fit = bundle.fit(start)
        away, sigma = errors(fit), np.sqrt(np.diag(fit.covariance))[:6]
        assert np.abs(away[:3]).max() < 0.01
        assert np.abs(away[3:]).max() < math.radians(0.02)
        assert np.abs(away / sigma).max() < 5.0  # of four windows each sigma is known to 40 %
        assert fit.sigma_px[0] == pytest.approx(0.05, rel=0.3)


def test_without_noise_the_fit_is_exact() -> None:
    fit = (lambda both: both[0].fit(both[1]))(constructed((-1.75, 1.75, 5.25), ends=True, weave=True, noise_px=0.0))
    assert np.abs(errors(fit)).max() < 1e-3  # what the weak prior of 50 mm and 2 deg pulls


def test_what_the_road_does_not_show_keeps_the_sigma_of_the_ruler() -> None:
    along = [
        math.sqrt(bundle.fit(start).covariance[0, 0])
        for bundle, start in (constructed((-1.75, 1.75), ends=ends, weave=False) for ends in (True, False))
    ]
    assert along[0] < 0.5 * SIGMA[0]
    assert along[1] > 0.9 * SIGMA[0]  # two solid lines straight ahead: nothing tells how far ahead the camera is


def test_two_lines_straight_ahead_leave_roll_height_and_side_together() -> None:
    straight, weaving = (
        np.sqrt(np.diag(bundle.fit(start).covariance))[:6]
        for bundle, start in (
            constructed((-1.75, 1.75), ends=False, weave=False),
            constructed((-1.75, 1.75, 5.25), ends=False, weave=True),
        )
    )
    for number in (1, 2, 5):  # y, z, roll
        assert straight[number] > 3.0 * weaving[number]


def test_the_end_of_a_dash_is_found_within_a_tenth_of_a_pixel() -> None:
    v, u = np.mgrid[0:80, 0:80].astype(np.float64)
    for end in (30.0, 30.3, 30.75):
        share = np.clip(v - end + 0.5, 0.0, 1.0) * np.clip(5.5 - np.abs(u - 40.0), 0.0, 1.0)
        image = (60.0 + 140.0 * share).astype(np.float32)
        ridges = np.column_stack((np.full(12, 40.0), np.arange(34.0, 70.0, 3.0)))
        found = dash_end(image, ridges, 11.0)
        assert found is not None
        assert found[0] == pytest.approx((40.0, end), abs=0.1)
        assert found[1] == pytest.approx((0.0, -1.0))
    solid = (60.0 + 140.0 * (np.abs(u - 40.0) < 5.5)).astype(np.float32)
    assert dash_end(solid, ridges, 11.0) is None
    assert dash_end(image, ridges - (0.0, 30.0), 11.0) is None  # at the image's edge


def test_a_long_drive_is_thinned_and_one_without_odometry_is_refused() -> None:
    drive, image = Drive(3.5), np.zeros((4, 4), np.uint8)
    for k in range(8 * 4 * WINDOWS):
        motion = Motion(t_ns=k * 100_000_000, speed_mps=20.0, yaw_rate_radps=0.1, source=MotionSource.MEASURED)
        drive.add(str(k), image, image, motion)
    assert WINDOWS // 2 <= len(drive.windows) <= WINDOWS
    assert {len(window) for window in drive.windows} == {PAIRS}
    starts = [int(window[0].name) for window in drive.windows]
    assert len(set(np.diff(starts))) == 1
    assert all(int(window[-1].name) - int(window[0].name) == PAIRS - 1 for window in drive.windows)
    one, other = drive.windows[0][0].place, drive.windows[0][1].place
    assert np.hypot(*(other - one)[:2]) == pytest.approx(2.0, rel=1e-3)
    unknown = Motion(t_ns=0, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
    with pytest.raises(CalibrationError, match="motion is not known"):
        Drive(3.5).add("run:0", image, image, unknown)


def test_images_of_a_drive_give_the_right_camera_within_what_is_stated() -> None:
    car, start, lens = random_rig(3)
    right = car.camera.right
    assert right is not None
    drive = driven(RigDrive(seed=3, seconds=3.0), car, lambda share: None)
    found = calibrate_stereo_from_lanes(drive.windows, car, CameraModel(lens, 640, 480), start)
    away = np.array([getattr(found.extrinsics, name) - getattr(right.extrinsics, name) for name in NAMES])
    assert np.abs(away[:3]).max() < 0.03
    assert np.abs(away[3:]).max() < math.radians(0.15)  # the lens's centre is wrong by some tenths of a pixel
    assert np.abs(away / [found.std[name] for name in NAMES]).max() < 6.0
    assert found.unknown == ()
    assert "FAIL" not in {check.status for check in check_from_lanes(found)}
    blind = [
        [replace(pair, images=(pair.images[0], np.full_like(pair.images[1], 90))) for pair in window]
        for window in drive.windows
    ]
    with pytest.raises(CalibrationError, match="right camera does not see the lines"):
        calibrate_stereo_from_lanes(blind, car, CameraModel(lens, 640, 480), start)
    with pytest.raises(CalibrationError, match="the left camera sees 2 lines"):
        calibrate_stereo_from_lanes(drive.windows[:3], car, CameraModel(lens, 640, 480), start)
