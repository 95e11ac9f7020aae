"""`windows` on rendered drives: poses against the truth, for several cameras and scales."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from automodel.config import CarConfig, LaneConfig, VehicleConfig
from automodel.signals import LaneStatus, MotionSource
from automodel.sim.appearance import Appearance
from automodel.sim.track import Track
from automodel.sim.track_files import load_track, parse_track
from tests.support.rendered_drives import CAR, RenderedDrive, Seen, camera, check_sound, with_camera
from tests.support.slow_lane import rest_slow

OVAL = load_track("oval")
CAMERAS = {
    "default": CAR,
    "high": with_camera(camera(z_m=0.28, pitch_rad=0.42)),
    "wide": with_camera(camera(focal_px=340.0)),
    "askew": with_camera(camera(y_m=0.03, yaw_rad=0.08, roll_rad=0.05)),
    "barrel": with_camera(camera(focal_px=420.0, distortion=-0.3)),
    "320x240": with_camera(camera(320, 240, 240.0, pitch_rad=0.3)),
    "1280x720": with_camera(camera(1280, 720, 960.0)),
}
ROAD = """
name = "road"
closed = false

[floor]
x0_m = -50.0
y0_m = -200.0
x1_m = 500.0
y1_m = 200.0

[origin]
x_m = 0.0
y_m = 0.0
heading_rad = 0.0

[lanes]
count = 2
width_m = 3.7

[markings.left]
style = "solid"
width_m = 0.15

[markings.centre]
style = "dashed"
width_m = 0.15
dash_m = 3.0
gap_m = 4.0

[markings.right]
style = "solid"
width_m = 0.15

[start]
direction = "forward"
s_m = 5.0

[[pieces]]
kind = "line"
length_m = 70.0

[[pieces]]
kind = "arc"
radius_m = 150.0
turn_rad = TURN
"""


def worst(seen: list[Seen]) -> tuple[float, float]:
    """Largest errors of offset [m] and heading [rad]; every frame must have an estimate."""
    assert all(s.estimate.valid for s in seen), [s.estimate.status for s in seen]
    return max(abs(s.offset_error_m) for s in seen), max(abs(s.heading_error_rad) for s in seen)


@pytest.mark.parametrize("name", rest_slow(CAMERAS, "default", "barrel", "askew"))
@pytest.mark.parametrize("direction", rest_slow(("forward", "reverse"), "forward"))
def test_pose_on_the_straight_and_in_the_bend(name: str, direction: str) -> None:
    car = CAMERAS[name]
    drive = RenderedDrive(track=OVAL, car=car, direction=direction, rate_hz=15.0 if name == "1280x720" else 20.0)
    start = start_of_straight(OVAL, direction) + 0.8
    seen = drive.run(start, start + 3.8)
    for one in seen:
        check_sound(one.estimate, one.frame.t_ns)
    bends = {round(one.truth.curvature_per_m, 2) for one in seen}
    assert len(bends) == 2  # straight and bend
    after = seen[10:]  # the start has seen only what lies ahead
    offset, heading = worst(after)
    assert offset < 0.015
    assert heading < math.radians(3.0)  # in the frames where the curvature jumps under the car
    assert np.quantile([abs(s.offset_error_m) for s in after], 0.9) < 0.01
    assert np.quantile([abs(s.heading_error_rad) for s in after], 0.9) < math.radians(1.5)
    assert np.mean([abs(s.offset_error_m) for s in after]) < 0.005
    assert np.mean([abs(s.heading_error_rad) for s in after]) < math.radians(0.8)
    widths = [s.estimate.pose.width_m for s in after if s.estimate.pose]
    assert np.abs(np.array(widths) - 0.4).max() < 0.01
    reported = np.array([s.estimate.pose.curvature_per_m for s in after if s.estimate.pose])
    true = np.array([s.truth.curvature_per_m for s in after])
    assert np.abs(reported - true)[np.abs(np.gradient(true)) == 0].mean() < 0.12


def start_of_straight(track: Track, direction: str) -> float:
    """Arc length at which the first straight of at least 2.5 m begins."""
    line = track.lane(direction).centerline
    s = np.arange(0.0, line.length_m, 0.05)
    flat = np.abs(line.curvature(s)) < 1e-3
    for i in np.flatnonzero(flat & ~np.roll(flat, 1)):
        if flat[i : i + 50].all() and len(flat[i : i + 50]) == 50:
            return float(s[i])
    raise AssertionError("no straight")


def test_the_first_frame_tells_the_lane_already() -> None:
    drive = RenderedDrive(track=OVAL)
    first = drive.run(1.0, 1.04)[0]
    assert first.estimate.status is LaneStatus.TRACKING
    assert abs(first.offset_error_m) < 0.02
    assert abs(first.heading_error_rad) < math.radians(3.0)


@pytest.mark.parametrize("seed", rest_slow((1, 4), 4))
def test_competition_light(seed: int) -> None:
    drive = RenderedDrive(track=OVAL, look=Appearance.random(seed, "competition"), rate_hz=30.0)
    seen = drive.run(0.8, 4.4)
    for one in seen:
        check_sound(one.estimate, one.frame.t_ns)
    settled = seen[15:]
    reported = [s for s in settled if s.estimate.valid]
    assert len(reported) >= 0.97 * len(settled)
    assert np.mean([abs(s.offset_error_m) for s in reported]) < 0.01
    assert np.mean([abs(s.heading_error_rad) for s in reported]) < math.radians(1.0)
    assert max(abs(s.offset_error_m) for s in reported) < 0.1


def test_colour_is_as_good_as_grey() -> None:
    grey = RenderedDrive(track=OVAL, rate_hz=20.0).run(1.8, 3.8)
    colour = RenderedDrive(track=OVAL, car=with_camera(camera(colour=True)), rate_hz=20.0).run(1.8, 3.8)
    assert colour[0].frame.image.ndim == 3
    for one, other in zip(grey, colour, strict=True):
        assert one.estimate.pose is not None
        assert other.estimate.pose is not None
        assert other.estimate.pose.offset_m == pytest.approx(one.estimate.pose.offset_m, abs=0.002)
        assert other.estimate.pose.heading_rad == pytest.approx(one.estimate.pose.heading_rad, abs=0.006)


def test_one_line_carries_through_a_tight_bend() -> None:
    """In the bends of the contest's floor the inner line leaves the image."""
    track = load_track("tmr")
    drive = RenderedDrive(track=track, rate_hz=30.0)
    line = track.lane("forward").centerline
    s = np.arange(0.0, line.length_m, 0.05)
    bent = np.abs(line.curvature(s)) > 0.5
    begin = next(float(s[i]) for i in range(60, len(s)) if bent[i : i + 35].all() and not bent[i - 50 : i].any())
    seen = drive.run(begin - 1.2, begin + 1.7)
    offset, heading = worst(seen[15:])
    assert offset < 0.02
    assert heading < math.radians(3.0)
    one_line = [s for s in seen if s.estimate.status is LaneStatus.ONE_LINE]
    assert len(one_line) > 10
    for s_one in one_line:
        assert s_one.estimate.left is not None
        assert s_one.estimate.right is not None
        assert s_one.estimate.left.seen  # all bends turn right: the outer line is the left one
        assert len(s_one.estimate.right.points_m) == 0


def test_lines_and_centerline_lie_where_they_are() -> None:
    drive = RenderedDrive(track=OVAL, rate_hz=15.0)
    seen = drive.run(1.0, 4.0)
    for one in seen[::6]:
        estimate, pose = one.estimate, drive.pose(1.0 + one.frame.index / drive.rate_hz)
        assert estimate.left is not None
        assert estimate.right is not None
        assert estimate.centerline is not None
        assert estimate.right.seen
        for line, true in ((estimate.left, drive.lane.left), (estimate.right, drive.lane.right)):
            away = [abs(true.project(p)[1]) for p in pose.apply(line.points_m)]
            assert line.seen == (len(away) >= 2)
            assert np.quantile([*away, 0.0], 0.8) < 0.01
        near = [(x, y) for x, y in estimate.centerline.position(np.linspace(0.0, 2.2, 45)) if 0.13 < x < 0.8]
        assert len(near) > 5
        assert max(abs(drive.lane.centerline.project(p)[1]) for p in pose.apply(near)) < 0.015


def full_size() -> CarConfig:
    return replace(
        with_camera(camera(focal_px=500.0, x_m=1.5, z_m=1.2, pitch_rad=0.12)),
        lane=LaneConfig(width_m=3.7, marking_width_m=0.15),
        vehicle=VehicleConfig(wheelbase_m=2.7, reference_x_m=1.3, width_m=1.8),
    )


@pytest.mark.parametrize("turn", ["0.5", "-0.5"])
def test_a_highway_lane_at_full_scale(turn: str) -> None:
    track = parse_track(ROAD.replace("TURN", turn), "road.toml")
    drive = RenderedDrive(track=track, car=full_size(), speed_mps=20.0, rate_hz=20.0)
    seen = drive.run(5.0, 105.0)
    settled = seen[15:]
    assert sum(s.estimate.valid for s in settled) >= 0.97 * len(settled)
    reported = [s for s in settled if s.estimate.valid]
    assert np.mean([abs(s.offset_error_m) for s in reported]) < 0.10
    assert np.mean([abs(s.heading_error_rad) for s in reported]) < math.radians(0.8)
    assert max(abs(s.offset_error_m) for s in reported) < 0.4


def test_without_odometry_the_lane_is_still_found() -> None:
    drive = RenderedDrive(track=OVAL, source=MotionSource.NONE)
    seen = drive.run(0.8, 4.0)
    for one in seen:
        check_sound(one.estimate, one.frame.t_ns)
    reported = [s for s in seen[10:] if s.estimate.valid]
    assert len(reported) >= 0.95 * len(seen[10:])
    assert np.mean([abs(s.offset_error_m) for s in reported]) < 0.02
    assert np.mean([abs(s.heading_error_rad) for s in reported]) < math.radians(2.5)
