"""Masks of the simulated tracks through feature points and line following, against where the lines truly are."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from automodel.geometry import SE2, View
from automodel.perception.markings.binary_views import FeaturePoints
from automodel.perception.windows.line_following import LineFollowing
from automodel.perception.windows.window_tracker import ExpectedLine
from automodel.sim.track import Lane
from automodel.sim.track_files import load_track
from tests.support.drawn_roads import MARKING_M
from tests.support.rendered_drives import CAR, renderer

VIEW = View(x_near_m=0.36, x_far_m=2.28, half_width_m=0.64, m_per_px=0.008)


def expected(lane: Lane, pose: SE2, s_m: float, side_m: float, turn_rad: float) -> ExpectedLine:
    """The lane's line, turned about the car: a model is never quite right."""
    s = np.linspace(s_m - 0.4, s_m + 2.2, 60)
    wrong = SE2(0.0, 0.005, turn_rad) @ pose.inverse()
    points = wrong.apply(lane.centerline.offset_position(s, side_m))
    return ExpectedLine(points_m=points, heading_rad=lane.centerline.heading(s) + wrong.yaw_rad)


@pytest.mark.parametrize(
    ("track", "direction", "stations"),
    [
        ("tmr", "forward", np.arange(0.25, 46.0, 3.5)),
        ("tmr", "forward", np.arange(4.0, 7.5, 0.5)),  # both intersections with their zebras
        ("tmr", "reverse", np.arange(44.0, 47.5, 0.5)),
        ("chicane", "forward", np.arange(0.0, 20.0, 1.5)),
        ("oval", "reverse", np.arange(0.0, 12.0, 2.0)),
    ],
)
def test_points_lie_on_the_lanes_lines(track: str, direction: str, stations: np.ndarray) -> None:
    world = load_track(track)
    lane, eye = world.lane(direction), renderer(world, CAR)
    half = 0.5 * float(lane.width_m(0.0))
    features = FeaturePoints(CAR.camera, VIEW, MARKING_M)
    following = LineFollowing(VIEW, 2.0 * half, MARKING_M, features.visible)
    errors: list[float] = []
    for s in stations.tolist():
        pose = lane.pose(s, 0.04 * math.sin(3.0 * s), 0.1 * math.cos(2.3 * s))
        mask = cv2.resize(eye.render_mask(pose.x_m, pose.y_m, pose.yaw_rad), (512, 256), interpolation=cv2.INTER_AREA)
        view = features.step(np.asarray(mask, dtype=np.uint8))
        for side in (half, -half):
            line = following.follow(view, None, expected(lane, pose, s, side, 0.02 * math.sin(s)), 0.03)
            for point in pose.apply(line.points_m):
                errors.append(lane.centerline.project(point, near_s_m=s + 1.0, reach_m=2.0)[1] - side)
    away = np.abs(errors)
    assert len(away) > 8 * len(stations)
    assert math.sqrt(float((away**2).mean())) < 0.25 * VIEW.m_per_px
    assert away.max() < MARKING_M
