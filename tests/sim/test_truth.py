"""Ground truth against the lane's own geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.config import VehicleConfig
from automodel.curves import JoinedCurve, OffsetCurve, arc, line
from automodel.geometry import SE2
from automodel.sim.track import Lane, Track, constant
from automodel.sim.track_files import load_track
from automodel.sim.truth import Truth, TruthFollower

REFERENCE_M = 0.13
CAR = VehicleConfig()  # 0.20 m wide, from 0.07 m behind the rear axle to 0.33 m ahead of it


@pytest.fixture(scope="module")
def tmr() -> Track:
    return load_track("tmr")


def open_lane(width_m: float = 0.4) -> Lane:
    road = line(0.0, 0.0, 0.0, 4.0)
    half = 0.5 * width_m
    return Lane(
        centerline=road, left=OffsetCurve(road, half), right=OffsetCurve(road, -half), width_m=constant(width_m)
    )


def at(lane: Lane, s_m: float, offset_m: float = 0.0, heading_rad: float = 0.0) -> SE2:
    """The rear axle's pose of a car whose reference point has this pose in the lane."""
    return lane.pose(s_m, offset_m, heading_rad) @ SE2(-REFERENCE_M, 0.0, 0.0)


def step(follower: TruthFollower, pose: SE2) -> Truth:
    return follower.step(pose.x_m, pose.y_m, pose.yaw_rad)


@pytest.mark.parametrize("name", ["tmr", "oval", "chicane"])
@pytest.mark.parametrize("direction", ["forward", "reverse"])
def test_a_drive_is_told_as_it_was(name: str, direction: str) -> None:
    lane = load_track(name).lane(direction)
    length = lane.centerline.length_m
    follower = TruthFollower(lane, REFERENCE_M)
    for i, s in enumerate(np.arange(0.7, 2.2 * length, 0.13)):
        offset, heading = 0.09 * math.sin(1.3 * s), 0.6 * math.sin(0.9 * i)
        truth = step(follower, at(lane, s, offset, heading))
        assert truth.offset_m == pytest.approx(offset, abs=1e-6)
        assert truth.heading_rad == pytest.approx(heading, abs=1e-3)
        assert math.remainder(truth.s_m - s, length) == pytest.approx(0.0, abs=1e-6)
        assert 0.0 <= truth.s_m <= length
        assert truth.lap == int((s - 0.7 + 1e-9) // length)
        assert truth.width_m == 0.4
    expected = float(lane.centerline.curvature(s))
    assert truth.curvature_per_m == pytest.approx(expected, abs=1e-2)


def test_driving_backwards_counts_laps_down() -> None:
    lane = load_track("oval").lane()
    length = lane.centerline.length_m
    follower = TruthFollower(lane, REFERENCE_M)
    for s in np.arange(0.5, 0.4 - 2.0 * length, -0.11):
        assert step(follower, at(lane, s)).lap == -int((0.5 - s + 1e-9) // length)


@pytest.mark.parametrize("direction", ["forward", "reverse"])
def test_any_start_is_found_also_on_the_intersections(tmr: Track, direction: str) -> None:
    lane = tmr.lane(direction)
    rng = np.random.default_rng(3)
    centres = [(5.18, 3.08), (6.78, 3.08)]
    near = [
        s
        for s in np.arange(0.0, lane.centerline.length_m, 0.1)
        if min(math.dist(lane.centerline.position(s), c) for c in centres) < 0.5
    ]
    assert len(near) > 20
    follower = TruthFollower(lane, REFERENCE_M)
    for s in [*near, *rng.uniform(0.0, lane.centerline.length_m, 40)]:
        offset, heading = rng.uniform(-0.1, 0.1), rng.uniform(-0.5, 0.5)
        follower.reset()
        truth = step(follower, at(lane, float(s), offset, heading))
        assert truth.offset_m == pytest.approx(offset, abs=1e-6)
        assert truth.s_m == pytest.approx(s, abs=1e-6)


def test_at_a_crossing_the_branch_it_was_on_counts(tmr: Track) -> None:
    lane = tmr.lane()
    crossing = tmr.crossings[0]
    start = float(lane.centerline.project(tmr.road.offset_position(crossing.s_first_m - 1.0, -0.2))[0])
    follower = TruthFollower(lane, REFERENCE_M)
    for i in range(
        200
    ):  # through the crossing, turned right by up to 80 deg: the other branch's direction is then nearer
        s = start + 0.01 * i
        truth = step(follower, at(lane, s, 0.0, -min(0.014 * i, 1.4)))
        assert truth.s_m == pytest.approx(s, abs=1e-6)
        assert truth.offset_m == pytest.approx(0.0, abs=1e-6)


def test_a_car_that_starts_aslant_on_an_intersection_is_on_the_branch_that_it_starts_on(tmr: Track) -> None:
    lane = tmr.lane()
    crossing = tmr.crossings[0]
    s = float(lane.centerline.project(tmr.road.offset_position(crossing.s_first_m, -0.2))[0])
    aslant = at(lane, s, 0.0, -1.4)  # the other branch's direction is nearer
    assert step(TruthFollower(lane, REFERENCE_M), aslant).s_m != pytest.approx(s, abs=1.0)
    follower = TruthFollower(lane, REFERENCE_M, s - 0.1)
    for _ in range(2):
        truth = step(follower, aslant)
        assert truth.s_m == pytest.approx(s, abs=1e-6)
        assert truth.heading_rad == pytest.approx(-1.4, abs=1e-6)
        assert truth.lap == 0
        follower.reset()


def test_reference_point_and_signs_on_a_left_arc() -> None:
    road = arc(2.0, 0.0, math.pi / 2, 0.5, 3.0)  # about the origin, radius 2, anticlockwise
    lane = Lane(centerline=road, left=OffsetCurve(road, 0.2), right=OffsetCurve(road, -0.2), width_m=constant(0.4))
    follower = TruthFollower(lane, 0.5)
    truth = follower.step(1.9, 0.0, math.pi / 2 + 0.1)  # 0.1 m left of the lane's middle, turned left
    x, y = 1.9 - 0.5 * math.sin(0.1), 0.5 * math.cos(0.1)
    assert truth.offset_m == pytest.approx(2.0 - math.hypot(x, y), abs=1e-6)
    assert truth.heading_rad == pytest.approx(0.1 - math.atan2(y, x), abs=1e-6)
    assert truth.s_m == pytest.approx(2.0 * math.atan2(y, x), abs=1e-6)
    assert truth.curvature_per_m == pytest.approx(0.5)
    assert truth.lap == 0


def test_heading_is_wrapped_over_laps_and_yaws() -> None:
    lane = load_track("oval").lane()
    follower = TruthFollower(lane, REFERENCE_M)
    for s in np.arange(0.0, 3.0 * lane.centerline.length_m, 0.3):
        pose = at(lane, s, 0.0, 0.2)
        truth = follower.step(pose.x_m, pose.y_m, pose.yaw_rad + 2 * math.tau)
        assert truth.heading_rad == pytest.approx(0.2, abs=1e-3)


def test_a_long_jump_along_the_lane_is_followed() -> None:
    lane = load_track("oval").lane()
    follower = TruthFollower(lane, REFERENCE_M)
    step(follower, at(lane, 0.5))
    assert step(follower, at(lane, 2.4)).s_m == pytest.approx(2.4, abs=1e-6)


def test_beyond_the_ends_of_an_open_lane() -> None:
    follower = TruthFollower(open_lane(), 0.0)
    assert follower.step(3.9, 0.1, 0.0).s_m == pytest.approx(3.9)
    truth = follower.step(4.6, 0.1, 0.0)
    assert (truth.s_m, truth.offset_m, truth.lap) == pytest.approx((4.0, 0.1, 0))
    follower.reset()
    truth = follower.step(-0.5, -0.1, 0.3)
    assert (truth.s_m, truth.offset_m, truth.heading_rad) == pytest.approx((0.0, -0.1, 0.3))


def test_body_reach_on_a_straight_lane() -> None:
    follower = TruthFollower(open_lane(), REFERENCE_M)
    assert follower.lateral_reach_m(SE2(1.0, 0.03, 0.0), CAR) == pytest.approx(0.13)
    # turned left by 0.2: the front left corner is the outermost
    expected = 0.03 + 0.33 * math.sin(0.2) + 0.10 * math.cos(0.2)
    assert follower.lateral_reach_m(SE2(1.0, 0.03, 0.2), CAR) == pytest.approx(expected)


def test_body_reach_in_a_bend_is_that_of_its_corners(tmr: Track) -> None:
    lane = tmr.lane()
    follower = TruthFollower(lane, REFERENCE_M)
    # on the west inner loop, about (3.78, 4.48): the lane's middle has radius 1.2
    pose = at(lane, 2.0, 0.02, -0.1)
    step(follower, pose)
    corners = pose.apply([(0.33, 0.1), (0.33, -0.1), (-0.07, 0.1), (-0.07, -0.1)])
    expected = np.abs(np.hypot(*(corners - (3.78, 4.48)).T) - 1.2).max()
    assert follower.lateral_reach_m(pose, CAR) == pytest.approx(expected, abs=1e-6)


def test_width_of_a_lane_that_changes() -> None:
    road = line(0.0, 0.0, 0.0, 4.0)
    lane = Lane(
        centerline=road,
        left=OffsetCurve(road, lambda s: 0.2 + 0.02 * s),
        right=OffsetCurve(road, lambda s: -0.2 - 0.02 * s),
        width_m=lambda s: 0.4 + 0.04 * np.asarray(s, dtype=np.float64),
    )
    follower = TruthFollower(lane, 0.0)
    assert follower.step(3.0, 0.0, 0.0).width_m == pytest.approx(0.52)


def test_long_lanes_stay_within_the_stated_error() -> None:
    # so long that the samples are 0.1 m apart
    road = JoinedCurve([line(-5900.0, 0.0, 0.0, 5900.0), arc(0.0, 0.0, 0.0, 1 / 20.0, 100.0)])
    lane = Lane(centerline=road, left=OffsetCurve(road, 5.0), right=OffsetCurve(road, -5.0), width_m=constant(10.0))
    follower = TruthFollower(lane, 1.5)
    for s in np.arange(5905.0, 5999.0, 1.37):
        truth = step(follower, lane.pose(s, 1.2, 0.2) @ SE2(-1.5, 0.0, 0.0))
        assert (truth.s_m, truth.offset_m, truth.heading_rad) == pytest.approx((s, 1.2, 0.2), rel=0.0, abs=2e-6)
