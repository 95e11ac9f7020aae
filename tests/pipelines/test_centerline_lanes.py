"""`centerline` behind a perfect mask: straight and bent lanes, steep headings, lanes that widen and narrow."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.signals import LaneStatus
from automodel.sim.track_files import load_track
from tests.support.masked_drives import MaskedDrive, arc, clothoid, errors, line, road, scaled, sine
from tests.support.rendered_drives import CAR, Seen, camera, with_camera
from tests.support.slow_lane import rest_slow

STRAIGHT = line(14.0)
WIDE = with_camera(camera(focal_px=240.0))  # sees both lines also in a bend


def test_straight_lane() -> None:
    found = errors(MaskedDrive(track=road(STRAIGHT)).run(0.5, 4.0), skip=10)
    assert found.statuses == {LaneStatus.TRACKING: 95}
    assert found.offset_max_m < 0.003
    assert found.heading_max_deg < 0.8
    assert found.offset_mean_m < 0.0005
    assert found.heading_mean_deg < 0.15


def test_lines_and_centerline_lie_where_they_are() -> None:
    drive = MaskedDrive(track=road(line(2.0), clothoid(0.0, 0.8, 0.5), arc(1.25, 2.0)))
    every = list(zip(drive.run(0.5, 4.0), drive.frames(0.5, 4.0), strict=True))
    for one, (_, _, pose) in every[::8]:
        estimate = one.estimate
        assert estimate.left is not None
        assert estimate.right is not None
        assert estimate.centerline is not None
        assert estimate.right.seen
        for said, true in ((estimate.left, drive.lane.left), (estimate.right, drive.lane.right)):
            away = [abs(true.project(p)[1]) for p in pose.apply(said.points_m)]
            assert said.seen == (len(away) >= 2)
            assert np.quantile([*away, 0.0], 0.8) < 0.006
        if one.frame.index >= 10:
            middle = estimate.centerline.position(np.linspace(0.0, estimate.centerline.length_m, 40))
            near = middle[(middle[:, 0] > -0.2) & (middle[:, 0] < 0.8)]
            assert len(near) > 5
            assert max(abs(drive.lane.centerline.project(p)[1]) for p in pose.apply(near)) < 0.015


@pytest.mark.parametrize("radius_m", [0.8, -0.8, -1.2])  # in lanes of 0.4 m
@pytest.mark.parametrize("gently", rest_slow((True, False), False))
def test_bends_down_to_a_radius_of_two_lanes(radius_m: float, gently: bool) -> None:
    curvature, radius, side = 1.0 / radius_m, abs(radius_m), math.copysign(1.0, radius_m)
    pieces = (clothoid(0.0, curvature, 0.5), arc(radius, 2.0 * side), clothoid(curvature, 0.0, 0.5))
    bend = "".join(pieces if gently else pieces[1:2])
    drive = MaskedDrive(track=road(line(1.8), bend, line(2.5)))
    seen = drive.run(0.6, 2.2 + 2.0 * radius + gently)
    found = errors(seen, skip=10)
    assert found.available == 1.0
    assert found.offset_max_m < (0.005 if gently else 0.012)
    assert found.heading_max_deg < (2.5 if gently else 5.0)  # where the curvature jumps under the car
    assert found.offset_mean_m < 0.0015
    assert found.heading_mean_deg < (0.4 if gently else 0.6)
    inside = [s for s in seen if abs(s.truth.curvature_per_m) > 0.99 / radius and s.estimate.pose is not None][15:]
    bends = [s.estimate.pose.curvature_per_m for s in inside if s.estimate.pose]
    assert np.median(bends) == pytest.approx(curvature, rel=0.06)


@pytest.mark.parametrize("name", ["oval", "chicane"])
@pytest.mark.parametrize("direction", rest_slow(("forward", "reverse"), "forward"))
def test_shipped_tracks(name: str, direction: str) -> None:
    """Bends of radius 1 m and more, dashed lines; the chicane down to 0.6 m."""
    drive = MaskedDrive(track=load_track(name), direction=direction, speed_mps=1.2)
    lap_m = drive.lane.centerline.length_m
    start, length = (1.0, 6.0) if name == "oval" else (0.42 * lap_m, 0.25 * lap_m)
    found = errors(drive.run(start, start + length), skip=10)
    assert found.available == 1.0
    assert found.offset_mean_m < 0.004
    assert found.heading_mean_deg < 0.9
    assert found.offset_max_m < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("direction", ["forward", "reverse"])
def test_a_lap_of_the_chicane(direction: str) -> None:
    """The inner lane bends down to a radius of one and a half lanes, from left to right at once."""
    drive = MaskedDrive(track=load_track("chicane"), direction=direction)
    lap_m = drive.lane.centerline.length_m
    found = errors(drive.run(0.3 * lap_m, 1.3 * lap_m), skip=10)
    assert found.available >= 0.998
    assert found.offset_mean_m < 0.007
    assert found.heading_mean_deg < 1.4
    assert found.offset_max_m < 0.12  # a false lane begins at half a lane


@pytest.mark.parametrize(("amplitude", "wave_lanes", "steepest_deg"), [(0.25, 4.0, 21.0), (0.2, 2.0, 32.0)])
@pytest.mark.parametrize("bend", [0, 1, -1], ids=["straight", "left", "right"])
def test_steep_headings(amplitude: float, wave_lanes: float, steepest_deg: float, bend: int) -> None:
    """In the bend the camera is one that keeps a line in sight."""
    ahead, car = (line(1.5) + arc(1.2, 3.0 * bend), WIDE) if bend else (STRAIGHT, CAR)
    seen = MaskedDrive(track=road(ahead), car=car, offset=sine(amplitude, wave_lanes)).run(0.7, 3.5)
    found = errors(seen, skip=10)
    assert max(abs(s.truth.heading_rad) for s in seen) > math.radians(steepest_deg)
    assert found.available == 1.0
    assert found.offset_max_m < (0.03 if bend else 0.01)
    assert found.heading_mean_deg < 0.6
    assert found.heading_max_deg < 4.0


def test_headings_of_forty_degrees_in_a_lane_of_ten_metres() -> None:
    car = scaled(CAR, 10.0, 1.35, 0.15)
    track = road(line(200.0), width_m=10.0, marking_m=0.15)
    seen = MaskedDrive(track=track, car=car, speed_mps=8.0, offset=sine(0.32, 2.4)).run(8.0, 56.0)
    found = errors(seen, skip=30)  # the start, at a heading of 23 degrees, is 2 degrees off
    assert max(abs(s.truth.heading_rad) for s in seen) > math.radians(39.5)
    assert found.available == 1.0
    assert found.offset_max_m < 0.12
    assert found.heading_max_deg < 0.4
    assert LaneStatus.ONE_LINE in found.statuses  # the other one is out of sight


def width_errors(seen: list[Seen]) -> np.ndarray:
    """Relative errors (n,) of the width."""
    return np.array([s.estimate.pose.width_m / s.truth.width_m - 1.0 for s in seen if s.estimate.pose])


NARROWING = {"wider": (0.4, 0.52, 1.2), "narrower": (0.4, 0.28, 1.2), "funnel": (0.46, 0.34, 0.8)}


@pytest.mark.parametrize("change", NARROWING)
@pytest.mark.parametrize("bend", rest_slow((False, True), True))
def test_lanes_whose_lines_are_not_parallel(change: str, bend: bool) -> None:
    """The width changes by 30 % over two or three lane widths of distance."""
    before, after, over_m = NARROWING[change]
    road_ahead = line(1.5) + clothoid(0.0, 0.6, 0.5) + arc(1.0 / 0.6, 3.0) if bend else STRAIGHT
    track = road(road_ahead, widths=((2.0, before), (2.0 + over_m, after)))
    seen = MaskedDrive(track=track, car=WIDE if bend else CAR).run(0.5, 4.3)[10:]
    found = errors(seen)
    assert found.statuses == {LaneStatus.TRACKING: len(seen)}
    assert np.abs(width_errors(seen)).max() < 0.03
    assert np.abs(width_errors(seen)).mean() < 0.005
    assert max(abs(s.offset_error_m) / s.truth.width_m for s in seen) < 0.03
    assert found.heading_max_deg < 1.5


def test_a_lane_that_swells_and_shrinks() -> None:
    widths = tuple((1.0 + 1.0 * k, 0.4 + 0.06 * (-1) ** k) for k in range(8))
    seen = MaskedDrive(track=road(STRAIGHT, widths=widths)).run(1.5, 6.5)[20:]
    assert errors(seen).available == 1.0
    assert np.ptp([s.truth.width_m for s in seen]) > 0.3 * 0.4 - 0.001
    assert np.abs(width_errors(seen)).max() < 0.05
    assert max(abs(s.offset_error_m) / s.truth.width_m for s in seen) < 0.05


@pytest.mark.parametrize("lanes", [0.3, -0.3])
def test_a_car_near_one_line(lanes: float) -> None:
    drive = MaskedDrive(track=road(line(1.5), arc(1.5, 2.0)), offset=lambda s: lanes)
    found = errors(drive.run(0.5, 3.5), skip=10)
    assert found.available == 1.0
    assert found.offset_max_m < 0.025
    assert found.offset_mean_m < 0.01
    assert found.heading_max_deg < 3.0
