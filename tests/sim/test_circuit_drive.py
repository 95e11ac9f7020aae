"""Laps of circuits: where they go, how fast, which stretches are picked, and what a car believes of its motion."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.signals import MotionSource
from automodel.sim.track import Lane
from automodel.sim.track_files import load_track
from automodel.sim.trajectory import STYLES, CircuitDrive, CommandedMotion, DrivenPose, Pace, pick_stretches
from automodel.sim.truth import TruthFollower

CAR_WIDTH_M = 1.8


@pytest.fixture(scope="module")
def lane() -> Lane:
    return load_track("circuit").lane()


@pytest.fixture(scope="module", params=STYLES)
def way(request: pytest.FixtureRequest, lane: Lane) -> CircuitDrive:
    return CircuitDrive(lane, request.param, CAR_WIDTH_M, seed=3)


def in_lane(way: CircuitDrive) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offset [m], heading [deg] and lane width [m] every 0.2 s of a lap, at the rear axle."""
    follower = TruthFollower(way.lane, 0.0)
    truths = [follower.step(p.x_m, p.y_m, p.yaw_rad) for p in way.poses(np.arange(0.0, way.lap_s, 0.2))]
    offset, heading, width = np.array([(t.offset_m, t.heading_rad, t.width_m) for t in truths]).T
    return offset, np.degrees(heading), width


def test_styles_do_what_they_are_named_for(lane: Lane) -> None:
    for style in STYLES:
        offset, heading, width = in_lane(CircuitDrive(lane, style, CAR_WIDTH_M, seed=3))
        share = np.abs(offset) / (0.5 * (width - CAR_WIDTH_M))
        assert share.max() < 1.02  # the car's sides stay between the lines
        if style == "centred":
            assert np.abs(offset / width).max() == pytest.approx(0.05, abs=0.003)
            assert np.abs(heading).max() < 8.0
        elif style == "oscillating":
            assert (heading.min(), heading.max()) == pytest.approx((-40.0, 40.0), abs=1.5)
            assert share.max() > 0.9
        else:
            assert share.max() > 0.97
            assert (share > 0.8).mean() > 0.1  # for long close to one side
            assert np.abs(heading).max() < 25.0


def test_the_racing_line_is_less_bent_and_faster(lane: Lane) -> None:
    lines = [CircuitDrive(lane, style, CAR_WIDTH_M) for style in ("centred", "racing")]
    sums = [np.sum(line.path.curvature(np.arange(0.0, line.path.length_m, 0.5)) ** 2) for line in lines]
    assert sums[1] < 0.75 * sums[0]
    assert lines[1].lap_s < 0.95 * lines[0].lap_s


def test_speeds_respect_bends_and_pedals(way: CircuitDrive) -> None:
    poses = way.poses(np.arange(0.0, way.lap_s, 0.05))
    speed = np.array([p.speed_mps for p in poses])
    lateral = np.abs([p.yaw_rate_radps * p.speed_mps for p in poses])
    assert speed.min() >= 3.0
    assert speed.max() <= 15.0
    assert np.ptp(speed) > 4.0
    assert lateral.max() < 1.05 * Pace().lateral_mps2
    accel = np.diff(speed) / 0.05
    assert accel.max() <= Pace().speeding_up_mps2 + 1e-6
    assert accel.min() >= -Pace().braking_mps2 - 1e-6


def test_poses_are_the_motion_that_they_tell(way: CircuitDrive) -> None:
    h = 1e-3
    for t in np.linspace(0.3, way.lap_s - 0.3, 40):
        before, here, after = way.poses([t - h, t, t + h])
        course = math.atan2(after.y_m - before.y_m, after.x_m - before.x_m)
        assert math.hypot(after.x_m - before.x_m, after.y_m - before.y_m) / (2 * h) == pytest.approx(
            here.speed_mps, rel=2e-3
        )
        assert math.remainder(here.yaw_rad - course, math.tau) == pytest.approx(0.0, abs=1e-3)
        turning = math.remainder(after.yaw_rad - before.yaw_rad, math.tau) / (2 * h)
        assert here.yaw_rate_radps == pytest.approx(turning, abs=0.01)


def test_laps_join_and_places_are_met_in_time(way: CircuitDrive) -> None:
    end, start = way.poses([way.lap_s - 1e-6, way.lap_s])
    assert (end.x_m, end.y_m) == pytest.approx((start.x_m, start.y_m), abs=1e-4)
    assert end.speed_mps == pytest.approx(start.speed_mps, abs=1e-3)
    for s in (40.0, 700.0, 1499.0, 1540.0):
        (pose,) = way.poses([way.time_at(s)])
        foot = way.lane.centerline.project((pose.x_m, pose.y_m))[0]
        assert math.remainder(foot - s, 1500.0) == pytest.approx(0.0, abs=0.5)


def test_seeds_shift_the_swing() -> None:
    lane = load_track("circuit").lane()
    first, same, other = (CircuitDrive(lane, "centred", CAR_WIDTH_M, seed).poses([5.0]) for seed in (1, 1, 2))
    assert first == same
    assert first != other
    with pytest.raises(ValueError, match="style: expected one of centred, oscillating, racing, got 'drifting'"):
        CircuitDrive(lane, "drifting", CAR_WIDTH_M)


def test_half_of_the_stretches_are_the_sharpest_bends(lane: Lane) -> None:
    for seed in range(5):
        picked = pick_stretches(lane, 6, 150.0, seed)
        assert picked == sorted(picked) == pick_stretches(lane, 6, 150.0, seed)
        apart = np.diff([*picked, picked[0] + 1500.0])
        assert apart.min() >= 149.0
        bends = [float(np.abs(lane.centerline.curvature(s + np.arange(-15.0, 15.0))).max()) for s in picked]
        assert sum(bend > 1.0 / 21.0 for bend in bends) >= 3  # both chicanes and the tightest corner
    assert len({tuple(pick_stretches(lane, 6, 150.0, seed)) for seed in range(5)}) > 2
    assert len(pick_stretches(lane, 20, 150.0, 0)) == 20  # more than there is room for: they overlap


def test_a_command_is_wrong_by_a_scale_and_a_little_steering() -> None:
    wheelbase, scales, biases = 2.65, [], []
    for seed in range(80):
        told = CommandedMotion(wheelbase, seed)
        straight = told.motion(DrivenPose(x_m=0.0, y_m=0.0, yaw_rad=0.0, speed_mps=10.0, yaw_rate_radps=0.0), 7)
        assert straight.t_ns == 7
        assert straight.source is MotionSource.COMMAND
        bent = told.motion(DrivenPose(x_m=0.0, y_m=0.0, yaw_rad=0.0, speed_mps=10.0, yaw_rate_radps=0.5), 8)
        assert bent.speed_mps == straight.speed_mps
        scales.append(10.0 / straight.speed_mps)
        biases.append(-math.atan(wheelbase * straight.yaw_rate_radps / straight.speed_mps))
        # the curvature that is believed: 0.05 per metre, but for the wheels' bias
        steering = math.atan(wheelbase * bent.yaw_rate_radps / bent.speed_mps)
        assert steering + biases[-1] == pytest.approx(math.atan(wheelbase * 0.05), abs=1e-12)
    assert np.std(scales) == pytest.approx(0.04, rel=0.3)
    assert np.mean(scales) == pytest.approx(1.0, abs=0.015)
    assert np.std(biases) == pytest.approx(0.005, rel=0.3)
    standing = CommandedMotion(wheelbase, 0).motion(
        DrivenPose(x_m=0.0, y_m=0.0, yaw_rad=0.0, speed_mps=0.0, yaw_rate_radps=0.0), 0
    )
    assert (standing.speed_mps, standing.yaw_rate_radps) == (0.0, 0.0)
