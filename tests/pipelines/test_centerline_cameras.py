"""`centerline` behind a perfect mask: other cameras, other scales, and odometry that is wrong or missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from automodel.signals import LaneStatus, MotionSource
from automodel.sim.track_files import load_track
from tests.support.masked_drives import MaskedDrive, arc, clothoid, errors, line, road, scaled
from tests.support.rendered_drives import CAR, camera, with_camera
from tests.support.slow_lane import rest_slow

BEND = line(1.8) + clothoid(0.0, 1.0, 0.4) + arc(1.0, 2.0)
CAMERAS = {
    "high": camera(z_m=0.28, pitch_rad=0.42),
    "low": camera(z_m=0.10, pitch_rad=0.15),
    "wide and distorted": camera(focal_px=300.0, distortion=-0.3),
    "leaning": camera(y_m=0.03, yaw_rad=0.08, roll_rad=0.05),
    "looking aside": camera(y_m=-0.05, yaw_rad=-0.2, pitch_rad=0.35),
    "320x240": camera(320, 240, 240.0, pitch_rad=0.3),
    "256x512": camera(256, 512, 256.0, pitch_rad=0.5),
    "colour": camera(colour=True),
}


@pytest.mark.parametrize("name", rest_slow(CAMERAS, "high", "wide and distorted", "colour"))
def test_other_cameras(name: str) -> None:
    found = errors(MaskedDrive(track=road(BEND), car=with_camera(CAMERAS[name])).run(0.6, 3.2), skip=10)
    assert found.available == 1.0
    assert found.offset_mean_m < 0.002
    assert found.offset_max_m < 0.01
    assert found.heading_mean_deg < 0.6
    assert found.heading_max_deg < 3.0


SCALES = {  # lane, marking, radius [m], speed [m/s]
    "a road": (3.5, 0.15, 12.0, 5.0),
    "a tight road": (3.5, 0.12, 7.0, 4.0),
    "a circuit": (10.0, 0.15, 40.0, 15.0),
    "a chicane": (10.0, 0.15, 20.0, 8.0),
    "broad lines": (10.0, 0.3, 30.0, 10.0),
}


@pytest.mark.parametrize("name", rest_slow(SCALES, "a road", "a chicane"))
def test_full_scale(name: str) -> None:
    lane_m, marking_m, radius_m, speed_mps = SCALES[name]
    ahead = line(5.0 * lane_m) + arc(radius_m, 1.2) + arc(radius_m, -1.0)
    track = road(ahead, width_m=lane_m, marking_m=marking_m)
    drive = MaskedDrive(track=track, car=scaled(CAR, lane_m, 1.35, marking_m), speed_mps=speed_mps, rate_hz=25.0)
    seen = drive.run(lane_m, 5.0 * lane_m + 2.2 * radius_m)
    found = errors(seen, skip=10)
    assert found.available == 1.0
    assert found.offset_mean_m < (0.015 if name == "a tight road" else 0.008) * lane_m  # there it is once in doubt
    assert found.offset_max_m < 0.05 * lane_m
    assert found.heading_mean_deg < 0.9
    assert found.heading_max_deg < 9.0  # where the bend turns from left to right at once
    widths = [s.estimate.pose.width_m for s in seen if s.estimate.pose]
    assert np.abs(np.array(widths) / lane_m - 1.0).max() < (0.1 if name == "a tight road" else 0.05)


@pytest.mark.parametrize("speed_factor", rest_slow((0.9, 1.1), 1.1))
@pytest.mark.parametrize("dashed", [False, True])
def test_a_speed_that_is_wrong_by_ten_percent(speed_factor: float, dashed: bool) -> None:
    track = load_track("oval") if dashed else road(BEND)
    found = errors(MaskedDrive(track=track, speed_factor=speed_factor).run(0.8, 4.2), skip=10)
    assert found.available == 1.0
    assert found.offset_mean_m < 0.015
    assert found.offset_max_m < 0.045  # where the lines do not reach to the car, which is where the odometry says
    assert found.heading_mean_deg < 1.5


@pytest.mark.parametrize("bias_radps", rest_slow((0.05, -0.05), 0.05))
def test_a_gyro_with_a_bias(bias_radps: float) -> None:
    found = errors(MaskedDrive(track=road(BEND), yaw_bias_radps=bias_radps).run(0.8, 4.2), skip=10)
    assert found.available == 1.0
    assert found.offset_mean_m < 0.015
    assert found.heading_mean_deg < 1.5


@pytest.mark.parametrize("rate_hz", rest_slow((15.0, 60.0), 15.0))
@pytest.mark.parametrize("name", ["straight", "bend", "oval"])
def test_without_odometry(rate_hz: float, name: str) -> None:
    """Only what the image shows; the line is looked for where it was in the frame before."""
    track = {"straight": road(line(9.0)), "bend": road(BEND), "oval": load_track("oval")}[name]
    seen = MaskedDrive(track=track, source=MotionSource.NONE, rate_hz=rate_hz).run(0.8, 4.0)
    found = errors(seen, skip=10)
    coasting = found.statuses.get(LaneStatus.COASTING, 0)
    assert found.available >= 0.95
    assert coasting <= 0.2 * len(seen)
    assert found.offset_mean_m < 0.04
    assert found.heading_mean_deg < 8.0
    assert found.offset_max_m < 0.12


@pytest.mark.parametrize(
    ("rate_hz", "speed_mps"), [(100.0, 3.0), (10.0, 1.0), pytest.param(30.0, 0.4, marks=pytest.mark.slow)]
)
def test_other_rates_and_speeds(rate_hz: float, speed_mps: float) -> None:
    drive = MaskedDrive(track=road(BEND), rate_hz=rate_hz, speed_mps=speed_mps)
    seen = drive.run(0.8, 3.4)
    found = errors(seen, skip=max(round(0.3 * rate_hz / speed_mps), 4))
    assert found.available == 1.0
    assert found.offset_max_m < 0.02
    assert found.heading_mean_deg < 0.8


def test_the_reported_point_may_lie_anywhere_in_the_car() -> None:
    for reference_x_m in (0.0, 0.26):
        car = replace(CAR, vehicle=replace(CAR.vehicle, reference_x_m=reference_x_m))
        found = errors(MaskedDrive(track=road(BEND), car=car).run(0.8, 3.2), skip=12)
        assert found.available == 1.0
        assert found.offset_max_m < 0.01
        assert found.heading_mean_deg < 0.6
