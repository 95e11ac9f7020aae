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
from automodel.sim.world import Scene, TrueLane

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
