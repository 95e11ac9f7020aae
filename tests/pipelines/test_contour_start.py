"""`contour` starting from nothing: lanes of another width, and marks that are no lines of the car's lane."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from automodel.config import CarConfig, LaneConfig, VehicleConfig
from automodel.pipelines.contour import Contour
from automodel.signals import FALSE_LANE, Frame, LaneEstimate, LaneStatus, Motion
from automodel.sim.track import Track
from automodel.sim.track_files import load_track, parse_track
from tests.support.masked_drives import arc, gap, line, road
from tests.support.rendered_drives import CAR, RenderedDrive, Seen, camera, check_sound, with_camera
from tests.support.slow_lane import rest_slow

HIGHWAY_CAR = replace(
    with_camera(camera(focal_px=500.0, x_m=1.5, z_m=1.2, pitch_rad=0.12)),
    lane=LaneConfig(width_m=3.7, marking_width_m=0.15),
    vehicle=VehicleConfig(wheelbase_m=2.7, reference_x_m=1.3, width_m=1.8),
)
HIGHWAY = road(line(60.0), arc(250.0, 0.8), width_m=3.7, marking_m=0.15)
TWO_LANES = """
name = "two"
closed = false
[floor]
x0_m = -50.0
y0_m = -50.0
x1_m = 50.0
y1_m = 50.0
[lanes]
count = 2
width_m = 0.4
[markings.left]
style = "solid"
[markings.centre]
style = "dashed"
[markings.right]
style = "solid"
[start]
direction = "forward"
s_m = 0.0
"""
AGAIN_NS = 110_000_000  # long enough for a lane of one line to be told
SURE_FRAMES = 24  # 0.8 s, until a lane that is far from as wide as configured is sure


class Anew:
    """`contour` that starts anew with every image, and may look at it twice."""

    name = "contour"

    def __init__(self, car: CarConfig = CAR) -> None:
        self.started = Contour(car)

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        self.started.reset()
        first = self.started.step(frame, motion)
        if first.valid:
            return first
        still = Motion(t_ns=frame.t_ns + AGAIN_NS, speed_mps=0.0, yaw_rate_radps=0.0)
        return self.started.step(Frame(t_ns=still.t_ns, index=frame.index, image=frame.image), still)

    def reset(self) -> None:
        self.started.reset()


def expecting(car: CarConfig, factor: float, **options: Any) -> CarConfig:
    """A car whose configured lane is `factor` times as wide as the true one."""
    contour = replace(car.pipeline.contour, **options)
    lane = replace(car.lane, width_m=factor * car.lane.width_m)
    return replace(car, lane=lane, pipeline=replace(car.pipeline, contour=contour))


def told_widths(seen: Sequence[Seen]) -> np.ndarray:
    return np.array([s.estimate.pose.width_m for s in seen if s.estimate.pose])


def false_lanes(seen: Sequence[Seen]) -> list[tuple[int, float]]:
    """Index and offset error of the frames whose lane is another one, and whose bound does not say so."""
    reported = [(s, s.estimate.pose) for s in seen if s.estimate.valid]
    return [
        (s.frame.index, s.offset_error_m)
        for s, pose in reported
        if pose is not None and abs(s.offset_error_m) >= max(FALSE_LANE * s.truth.width_m, pose.offset_bound_m)
    ]


def sound(seen: list[Seen]) -> list[Seen]:
    for one in seen[::4]:
        check_sound(one.estimate, one.frame.t_ns)
    return seen


@pytest.mark.parametrize("factor", rest_slow((0.7, 1.0 / 1.3, 0.85, 1.0, 1.15, 1.3, 1.0 / 0.7), 0.7, 1.0, 1.0 / 0.7))
def test_a_scale_lane_that_is_wider_or_narrower_than_configured(factor: float) -> None:
    drive = RenderedDrive(track=road(line(9.0)), pipeline=Contour(expecting(CAR, factor)))
    seen = sound(drive.run(0.3, 3.0))
    assert not false_lanes(seen)
    seen = seen[SURE_FRAMES:]
    assert all(s.estimate.status is LaneStatus.TRACKING for s in seen)
    assert np.mean([abs(s.offset_error_m) for s in seen]) < 0.003
    assert np.mean([abs(s.heading_error_rad) for s in seen]) < math.radians(0.7)
    widths = told_widths(seen)
    assert np.abs(widths - 0.4).max() < 0.03 * 0.4
    assert np.abs(np.diff(widths)).max() < 0.01 * 0.4


@pytest.mark.parametrize("radius_lanes", [1.4, 50.0])
@pytest.mark.parametrize("factor", rest_slow((1.0 / 1.3, 1.3, 1.0 / 0.7), 1.0 / 1.3, 1.0 / 0.7))
def test_a_highway_lane_that_is_wider_or_narrower_than_configured(factor: float, radius_lanes: float) -> None:
    car = expecting(HIGHWAY_CAR, factor, radius_lanes=radius_lanes)
    drive = RenderedDrive(track=HIGHWAY, car=car, pipeline=Contour(car), speed_mps=25.0, swing=0.04)
    seen = sound(drive.run(5.0, 55.0))
    assert not false_lanes(seen)
    seen = seen[SURE_FRAMES:]
    assert all(s.estimate.status is LaneStatus.TRACKING for s in seen)
    assert np.mean([abs(s.offset_error_m) for s in seen]) < 0.02
    assert np.mean([abs(s.heading_error_rad) for s in seen]) < math.radians(0.5)
    assert np.abs(told_widths(seen) - 3.7).max() < 0.03 * 3.7


@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_a_wrong_width_is_put_right_slowly_once_the_second_line_appears(factor: float) -> None:
    """On one line the lane's width is the configured one."""
    drive = RenderedDrive(track=road(line(12.0), gap(0.0, 2.0, "left")), pipeline=Contour(expecting(CAR, factor)))
    seen = sound(drive.run(0.3, 5.0))
    reported = [s for s in seen if s.estimate.valid]
    assert reported[0].estimate.status is LaneStatus.ONE_LINE
    assert reported[0].estimate.pose is not None
    assert reported[0].estimate.pose.width_m == pytest.approx(factor * 0.4, rel=0.02)
    assert not false_lanes(seen)
    assert seen[-1].estimate.status is LaneStatus.TRACKING
    assert told_widths(seen)[-1] == pytest.approx(0.4, rel=0.01)
    assert abs(seen[-1].offset_error_m) < 0.005


@pytest.mark.parametrize("place", [(-0.25, 0.2), (0.0, 0.0), (0.25, -0.2), (0.1, 0.25)])
def test_the_first_picture_tells_the_lane(place: tuple[float, float]) -> None:
    """Offset [lane widths] and heading [rad] of the car."""
    offset, heading = place
    drive = RenderedDrive(track=road(line(9.0)), pipeline=Contour(CAR))
    pose = drive.lane.pose(1.0, offset * 0.4, heading)
    image = drive.renderer.render(pose.x_m, pose.y_m, pose.yaw_rad)
    estimate = drive.estimator.step(
        Frame(t_ns=0, index=0, image=image), Motion(t_ns=0, speed_mps=0.0, yaw_rate_radps=0.0)
    )
    truth = drive.follower.step(pose.x_m, pose.y_m, pose.yaw_rad)
    check_sound(estimate, 0)
    assert estimate.pose is not None
    assert estimate.pose.offset_m == pytest.approx(truth.offset_m, abs=0.02)
    assert estimate.pose.heading_rad == pytest.approx(truth.heading_rad, abs=math.radians(5.0))


@lru_cache(maxsize=4)
def two_lanes(*parts: str) -> Track:
    return parse_track(TWO_LANES + "".join(parts), "two.toml")


@pytest.mark.parametrize("direction", ["forward", "reverse"])
def test_each_of_two_lanes_is_followed(direction: str) -> None:
    drive = RenderedDrive(
        track=two_lanes(line(3.0), arc(2.0, 1.5), line(3.0)), direction=direction, pipeline=Contour(CAR), rate_hz=20.0
    )
    seen = sound(drive.run(0.5, 5.0))
    assert all(s.estimate.valid for s in seen)
    assert not false_lanes(seen)
    assert np.mean([abs(s.offset_error_m) for s in seen]) < 0.005


@pytest.mark.parametrize("swing", [-0.3, 0.0, 0.3])
def test_the_neighbours_line_alone_is_no_lane(swing: float) -> None:
    """Right lane of two, where only the left lane's outer line is painted."""
    track = two_lanes(line(8.0), gap(0.0, 8.0, "centre", "right"))
    assert not any(
        s.estimate.valid for s in RenderedDrive(track=track, pipeline=Anew(), swing=swing, rate_hz=20.0).run(0.5, 3.0)
    )
    both = two_lanes(line(8.0))
    seen = RenderedDrive(track=both, pipeline=Anew(), swing=swing, rate_hz=15.0).run(0.5, 1.5)
    assert sum(s.estimate.valid for s in seen) > 0.9 * len(seen)  # nothing else is missing


def test_no_change_to_the_neighbours_line_while_the_own_are_missing() -> None:
    drive = RenderedDrive(
        track=two_lanes(line(9.0), gap(1.5, 6.0, "centre", "right")), pipeline=Contour(CAR), rate_hz=20.0
    )
    seen = sound(drive.run(0.3, 7.5))
    assert not false_lanes(seen)
    statuses = [s.estimate.status for s in seen]
    assert LaneStatus.LOST in statuses[20:]
    assert statuses[-1] is LaneStatus.TRACKING


def crossing_drive(pipeline: Contour | Anew, rate_hz: float) -> list[Seen]:
    """Straight over the first crossing of the contest's floor, which has zebra bars at each arm."""
    track = load_track("tmr")
    lane = track.lane("forward")
    at_m = track.crossings[0].s_first_m
    drive = RenderedDrive(track=track, pipeline=pipeline, rate_hz=rate_hz)
    assert lane.centerline.length_m > at_m + 3.0
    return drive.run(at_m - 2.5, at_m + 2.0)


def test_zebra_bars_are_driven_over() -> None:
    seen = sound(crossing_drive(Contour(CAR), 30.0))
    assert not false_lanes(seen)
    assert all(s.estimate.valid for s in seen[5:])
    reported = [s for s in seen if s.estimate.valid]
    assert np.mean([abs(s.offset_error_m) for s in reported]) <= 0.007
    assert np.mean([abs(s.heading_error_rad) for s in reported]) <= math.radians(0.7)


def test_no_start_among_zebra_bars_takes_them_for_lines() -> None:
    seen = crossing_drive(Anew(), 20.0)
    reported = [s for s in seen if s.estimate.valid]
    assert len(reported) > 0.4 * len(seen)
    assert not false_lanes(seen)


@pytest.mark.parametrize(
    ("name", "direction", "from_m", "to_m"), [("tmr", "forward", 2.0, 6.0), ("oval", "reverse", 0.3, 4.0)]
)
@pytest.mark.parametrize("swing", [-0.25, 0.25])
def test_in_a_bend_whose_inner_line_is_out_of_sight_the_neighbours_lane_is_not_taken(
    name: str, direction: str, from_m: float, to_m: float, swing: float
) -> None:
    track = load_track(name)
    drive = RenderedDrive(track=track, direction=direction, pipeline=Anew(), swing=swing, rate_hz=15.0)
    seen = drive.run(from_m, to_m)
    assert not false_lanes(seen)
    assert sum(s.estimate.valid for s in seen) > 0.4 * len(seen)
