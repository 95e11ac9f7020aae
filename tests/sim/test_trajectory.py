"""Prescribed drives: where they go, and what they say of their own motion."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.signals import MotionSource
from automodel.sim.track_files import load_track
from automodel.sim.trajectory import STYLES, Drive, DrivenPose, Odometer

OVAL = load_track("oval")
CAR_WIDTH_M = 0.2


def drive(style: str, direction: str = "forward", seed: int = 0, speed_mps: float = 1.3) -> Drive:
    return Drive(lane=OVAL.lane(direction), style=style, speed_mps=speed_mps, car_width_m=CAR_WIDTH_M, seed=seed)


def in_lane(way: Drive, step_s: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Offset [m] and heading [rad] in the lane along the whole drive."""
    line = way.lane.centerline
    offsets, headings, near = [], [], None
    for t in np.arange(0.0, way.path.length_m / way.speed_mps, step_s):
        pose = way.pose(float(t))
        near, offset = line.project((pose.x_m, pose.y_m), near, 0.4)
        offsets.append(offset)
        headings.append(math.remainder(pose.yaw_rad - float(line.heading(near)), math.tau))
    return np.array(offsets), np.array(headings)


@pytest.mark.parametrize("direction", ["forward", "reverse"])
@pytest.mark.parametrize("style", STYLES)
def test_styles_stay_in_their_lane(style: str, direction: str) -> None:
    offsets, headings = in_lane(drive(style, direction))
    free = 0.5 * (0.4 - CAR_WIDTH_M)
    bound = {"centred": 0.05 * 0.4, "oscillating": free + 0.05 * 0.4, "racing": free}[style]
    assert np.abs(offsets).max() <= 1.03 * bound
    assert np.abs(offsets).max() >= 0.8 * bound
    top = math.degrees(float(np.abs(headings).max()))
    if style == "oscillating":
        assert 36.0 < top < 46.0
        assert math.degrees(headings.min()) < -30.0
        assert math.degrees(headings.max()) > 30.0
    else:
        assert top < 20.0


def test_the_racing_line_takes_the_inside_of_the_bends() -> None:
    for direction, side in (("forward", 1.0), ("reverse", -1.0)):  # the oval turns left, driven backwards right
        way = drive("racing", direction)
        points = way.path.position(np.arange(400) / 400.0 * way.path.length_m)
        feet = np.array([way.lane.centerline.project(point) for point in points])
        bent = np.abs(way.lane.centerline.curvature(feet[:, 0])) > 0.5
        assert np.mean(side * feet[bent, 1]) > 0.05
        assert np.abs(feet[:, 1]).min() < 0.01


@pytest.mark.parametrize("style", STYLES)
def test_motion_is_the_path_derivative(style: str) -> None:
    way = drive(style)
    h = 2e-4
    for t in np.linspace(0.1, 7.0, 40):
        before, here, after = (way.pose(float(t) + dt) for dt in (-h, 0.0, h))
        speed = math.hypot(after.x_m - before.x_m, after.y_m - before.y_m) / (2 * h)
        assert speed == pytest.approx(way.speed_mps, rel=2e-3)
        assert here.speed_mps == way.speed_mps
        turning = math.remainder(after.yaw_rad - before.yaw_rad, math.tau) / (2 * h)
        assert here.yaw_rate_radps == pytest.approx(turning, abs=0.02 + 0.01 * abs(turning))
        course = math.atan2(after.y_m - before.y_m, after.x_m - before.x_m)
        assert math.remainder(here.yaw_rad - course, math.tau) == pytest.approx(0.0, abs=1e-3)


def test_a_lap_comes_back_to_its_start() -> None:
    way = drive("oscillating", speed_mps=2.0)
    lap_s = way.path.length_m / 2.0
    first, again = way.pose(0.3), way.pose(0.3 + lap_s)
    assert (again.x_m, again.y_m) == pytest.approx((first.x_m, first.y_m), abs=1e-6)
    assert math.remainder(again.yaw_rad - first.yaw_rad, math.tau) == pytest.approx(0.0, abs=1e-6)
    assert -math.pi <= again.yaw_rad <= math.pi


def test_seeds_shift_the_swing_and_nothing_else() -> None:
    one, same, other = (drive("centred", seed=seed).pose(1.0) for seed in (1, 1, 2))
    assert one == same
    assert one != other


def test_the_odometer_errs_as_instruments_do() -> None:
    pose = DrivenPose(x_m=0.0, y_m=0.0, yaw_rad=0.0, speed_mps=1.5, yaw_rate_radps=0.4)
    scales, biases = [], []
    for seed in range(60):
        odometer = Odometer(seed)
        told = [odometer.motion(pose, k) for k in range(150)]
        assert told[3].t_ns == 3
        assert told[0].source is MotionSource.MEASURED
        speeds = {m.speed_mps for m in told}
        assert len(speeds) == 1  # a wheel's scale does not change on the way
        scales.append(speeds.pop() / 1.5)
        rates = np.array([m.yaw_rate_radps for m in told])
        assert 0.003 < rates.std() < 0.03
        biases.append(rates.mean() - 0.4)
    assert 0.004 < np.std(scales) < 0.02
    assert np.mean(scales) == pytest.approx(1.0, abs=0.005)
    assert 0.002 < np.std(biases) < 0.015
    assert np.mean(biases) == pytest.approx(0.0, abs=0.004)
    again = [Odometer(7).motion(pose, 0) for _ in range(2)]
    assert again[0] == again[1]
