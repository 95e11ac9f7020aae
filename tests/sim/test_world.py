"""The scene of the simulated world: its true lane, and the ranges to what stands there."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.curves.base import Curve
from automodel.geometry import SE2
from automodel.signals import Frame, LaneEstimate, LaneStatus, Motion
from automodel.sim.plant import CarState
from automodel.sim.track_files import load_track
from automodel.sim.truth import TruthFollower
from automodel.sim.world import Scene, TrueLane, UltrasonicRanges, distance_in_cone

LANE = load_track("oval").lane()
REFERENCE_X_M = 0.13
PICTURE = np.zeros((4, 6), dtype=np.uint8)
MOTION = Motion(t_ns=0, speed_mps=1.0, yaw_rate_radps=0.0)


def look(s_m: float, offset_m: float = 0.0, heading_rad: float = 0.0) -> tuple[LaneEstimate, SE2]:
    """The estimate for a car whose reference point has this pose in the lane, and the car's pose."""
    at = LANE.pose(s_m, offset_m, heading_rad)
    car = at @ SE2(-REFERENCE_X_M, 0.0, 0.0)
    truth = TruthFollower(LANE, REFERENCE_X_M).step(car.x_m, car.y_m, car.yaw_rad)
    where = {"x_m": car.x_m, "y_m": car.y_m, "yaw_rad": car.yaw_rad}
    state = CarState(**where, speed_mps=1.0, steering_rad=0.0, yaw_rate_radps=0.0, distance_m=0.0)
    pipeline = TrueLane(LANE)
    pipeline.on_scene(Scene(t_ns=5, index=3, car=state, truth=truth, reach_m=0.1))
    return pipeline.step(Frame(t_ns=5, index=3, image=PICTURE), MOTION), car


def centerline(s_m: float) -> Curve:
    """The centerline that is seen from here."""
    curve = look(s_m)[0].centerline
    assert curve is not None
    return curve


@pytest.mark.parametrize("s_m", [0.02, 1.0, 2.9, 5.0, 7.5, 11.0, LANE.centerline.length_m - 0.03])
@pytest.mark.parametrize(("offset_m", "heading_rad"), [(0.0, 0.0), (0.1, -0.3), (-0.15, 0.4)])
def test_it_says_where_the_car_was_put(s_m: float, offset_m: float, heading_rad: float) -> None:
    estimate, car = look(s_m, offset_m, heading_rad)
    pose, line = estimate.pose, estimate.centerline
    assert pose is not None
    assert line is not None
    assert estimate.status is LaneStatus.TRACKING
    assert pose.offset_m == pytest.approx(offset_m, abs=1e-5)
    assert pose.heading_rad == pytest.approx(heading_rad, abs=1e-3)
    assert pose.width_m == pytest.approx(0.4)
    foot_m, aside_m = line.project((REFERENCE_X_M, 0.0))
    assert aside_m == pytest.approx(offset_m, abs=1e-4)
    assert float(line.heading(foot_m)) == pytest.approx(-heading_rad, abs=1e-3)
    assert 0.119 <= foot_m <= 0.161  # so much of it lies behind the reference point
    assert line.length_m - foot_m >= 1.3
    for point in car.apply(line.position(np.linspace(0.0, line.length_m, 30))):
        assert LANE.centerline.project(point)[1] == pytest.approx(0.0, abs=1e-4)


def test_bends_bend_to_their_side() -> None:
    straight = centerline(1.0)
    assert np.abs(straight.curvature([0.3, 1.0])).max() < 1e-9
    bend = centerline(4.0)  # the outer lane's left bend, of 1.4 m
    assert float(bend.curvature(0.5)) == pytest.approx(1 / 1.4)
    assert float(bend.heading(1.0)) == pytest.approx(float(bend.heading(0.0)) + 1.0 / 1.4)


def test_a_lane_that_is_far_aside_is_out_of_sight() -> None:
    assert look(1.0, 0.55)[0].valid
    assert not look(1.0, 0.65)[0].valid


def test_a_frame_that_nobody_announced_shows_no_lane() -> None:
    assert not TrueLane(LANE).step(Frame(t_ns=5, index=3, image=PICTURE), MOTION).valid


def test_headings_are_near_zero_all_around_the_lane() -> None:
    for s_m in np.linspace(0.0, LANE.centerline.length_m - 0.01, 40):
        assert abs(float(centerline(float(s_m)).heading(0.1))) < math.pi / 4


BUMPER_X_M = 0.33


def car(x_m: float = 0.0, y_m: float = 0.0, yaw_rad: float = 0.0) -> CarState:
    return CarState(
        x_m=x_m, y_m=y_m, yaw_rad=yaw_rad, speed_mps=0.0, steering_rad=0.0, yaw_rate_radps=0.0, distance_m=0.0
    )


def box(x_m: float, y_m: float, side_m: float = 0.2) -> np.ndarray:
    half = 0.5 * side_m
    return np.array(
        [(x_m - half, y_m - half), (x_m + half, y_m - half), (x_m + half, y_m + half), (x_m - half, y_m + half)]
    )


def test_a_wall_ahead_is_heard_at_its_distance() -> None:
    wall = np.array([(1.33, -3.0), (1.43, -3.0), (1.43, 3.0), (1.33, 3.0)])
    left, centre, right = UltrasonicRanges([wall], BUMPER_X_M)(car())
    assert centre == pytest.approx(1.0)
    # the outer cones reach in to 15 deg off the axis: that ray meets the wall first
    assert left == pytest.approx(1.0 / math.cos(math.radians(15.0)))
    assert right == pytest.approx(left)


def test_left_and_right_are_told_apart() -> None:
    direction = math.radians(30.0)
    at = (BUMPER_X_M + math.cos(direction), 0.06 + math.sin(direction))
    left, centre, right = UltrasonicRanges([box(*at)], BUMPER_X_M)(car())
    assert left is not None
    assert 0.85 < left < 0.92
    assert centre is None
    assert right is None


@pytest.mark.parametrize("yaw_rad", [0.0, 1.0, -2.5])
def test_the_reading_turns_and_moves_with_the_car(yaw_rad: float) -> None:
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    turn = np.array([(cos, -sin), (sin, cos)])
    placed = box(1.2, 0.1) @ turn.T + (3.0, -4.0)
    there = UltrasonicRanges([placed], BUMPER_X_M)(car(3.0, -4.0, yaw_rad))
    here = UltrasonicRanges([box(1.2, 0.1)], BUMPER_X_M)(car())
    assert there[1] == pytest.approx(1.1 - BUMPER_X_M)
    assert there[1] == pytest.approx(here[1])


@pytest.mark.parametrize("flip", [1, -1])
def test_corners_may_go_round_either_way(flip: int) -> None:
    inside = UltrasonicRanges([box(BUMPER_X_M, 0.0)[::flip]], BUMPER_X_M)(car())
    assert inside[1] == 0.02
    ahead = UltrasonicRanges([box(BUMPER_X_M + 0.6, 0.0)[::flip]], BUMPER_X_M)(car())
    assert ahead[1] == pytest.approx(0.5)


def test_far_and_behind_is_silent() -> None:
    assert UltrasonicRanges([box(BUMPER_X_M + 4.2, 0.0)], BUMPER_X_M)(car())[1] is None
    assert UltrasonicRanges([box(BUMPER_X_M + 4.0, 0.0)], BUMPER_X_M)(car())[1] == pytest.approx(3.9)
    assert UltrasonicRanges([box(-1.0, 0.0)], BUMPER_X_M)(car()) == (None, None, None)
    assert UltrasonicRanges([], BUMPER_X_M)(car()) == (None, None, None)


def test_the_nearest_of_several_counts() -> None:
    assert UltrasonicRanges([box(2.0, 0.0), box(1.0, 0.0)], BUMPER_X_M)(car())[1] == pytest.approx(0.9 - BUMPER_X_M)


def test_distance_in_cone_against_many_points() -> None:
    dice = np.random.default_rng(1)
    half = math.radians(15.0)
    for _ in range(300):
        ends = dice.uniform((-0.5, -1.0), (2.0, 1.0), (2, 2))
        points = ends[0] + np.linspace(0.0, 1.0, 20001)[:, None] * (ends[1] - ends[0])
        heard = np.abs(np.arctan2(points[:, 1], points[:, 0])) <= half
        expected = np.hypot(*points[heard].T).min() if heard.any() else math.inf
        got = distance_in_cone((*ends[0], *ends[1]), half)
        if math.isinf(expected) and not math.isinf(got):
            continue  # a sliver between two points
        assert got == pytest.approx(expected, abs=3e-4)


@pytest.mark.parametrize("obstacle", [np.zeros((2, 2)), np.zeros((3, 3)), np.full((4, 2), np.nan)])
def test_obstacles_that_are_none_are_refused(obstacle: np.ndarray) -> None:
    with pytest.raises(ValueError, match="obstacles_m"):
        UltrasonicRanges([obstacle], BUMPER_X_M)
