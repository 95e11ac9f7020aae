"""The highway of the stereo paper's sequence: its lanes, its paint, and a drive that changes lanes."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from automodel.sim.highway import Highway, HighwayDrive, LaneChange
from automodel.sim.truth import TruthFollower

SPEED_MPS = 95.0 / 3.6


def test_lanes_lie_beside_each_other_with_paint_between_them() -> None:
    road = Highway(lanes=3, width_m=3.5)
    track, lanes = road.build()
    assert len(lanes) == 3
    assert track.forward is lanes[0]
    for right, left in itertools.pairwise(lanes):
        places = left.centerline.position(np.linspace(0.0, left.centerline.length_m, 12))
        np.testing.assert_allclose([right.centerline.project(place)[1] for place in places], 3.5, atol=1e-3)
    edges = [paint for paint in track.paint() if paint.kind == "line"]
    dashes = [paint for paint in track.paint() if paint.kind == "dash"]
    away = np.concatenate([[abs(track.road.project(p)[1]) for p in paint.polygon_m[:2]] for paint in edges])
    np.testing.assert_allclose(away, 1.5 * 3.5, atol=0.1)
    beside = np.concatenate([[abs(track.road.project(p)[1]) for p in paint.polygon_m[:2]] for paint in dashes])
    np.testing.assert_allclose(beside, 0.5 * 3.5, atol=0.1)


def test_the_drive_turns_no_faster_than_the_papers_and_ends_in_the_next_lane() -> None:
    _, lanes = Highway().build()
    drive = HighwayDrive(lanes[0], SPEED_MPS, (LaneChange(from_s=12.5),), wander_m=0.15)
    assert drive.lasts_s > 25.0
    poses = [drive.pose(t) for t in np.linspace(0.0, 25.0, 501)]
    rates = np.abs([math.degrees(pose.yaw_rate_radps) for pose in poses])
    assert 1.5 < rates.max() < 2.2
    assert {pose.speed_mps for pose in poses} == {SPEED_MPS}
    follower = TruthFollower(lanes[1], 0.0)
    offsets = np.array([follower.step(pose.x_m, pose.y_m, pose.yaw_rad).offset_m for pose in poses])
    assert offsets[:250] == pytest.approx(-3.5, abs=0.16)
    assert offsets[355:] == pytest.approx(0.0, abs=0.16)
    assert (np.diff(offsets[250:355]) > -0.01).all()
