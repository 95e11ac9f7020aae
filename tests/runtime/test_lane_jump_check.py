from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.curves import line
from automodel.runtime.input_checks import KEPT_S, LaneJumpCheck
from automodel.signals import LaneEstimate, LanePose, LaneStatus

MS = 1_000_000


def at(
    t_ms: float, offset_m: float = 0.0, heading_rad: float = 0.0, status: LaneStatus = LaneStatus.TRACKING
) -> LaneEstimate:
    if status is LaneStatus.LOST:
        return LaneEstimate(t_ns=round(t_ms * MS), status=status)
    pose = LanePose(
        offset_m=offset_m, heading_rad=heading_rad, width_m=0.4, curvature_per_m=0.0, covariance=np.eye(3) * 1e-4
    )
    return LaneEstimate(t_ns=round(t_ms * MS), status=status, pose=pose, centerline=line(0.0, 0.0, 0.0, 1.4))


@pytest.mark.parametrize(
    ("offset_m", "heading_rad", "text"),
    [
        (0.19, 0.0, None),
        (-0.19, 0.55, None),
        (0.21, 0.0, "the lane has jumped sideways by 0.21 m"),
        (-0.40, 0.0, "the lane has jumped sideways by 0.40 m"),
        (0.0, 0.65, "the lane has turned by 0.65 rad at once"),
        (0.0, -1.5, "the lane has turned by 1.50 rad at once"),
    ],
)
def test_half_a_lane_aside_or_a_quarter_turn_is_another_line(
    offset_m: float, heading_rad: float, text: str | None
) -> None:
    check = LaneJumpCheck()
    assert check.step(at(0)) is None
    assert check.step(at(16, offset_m, heading_rad)) == text


def test_headings_are_compared_around_the_circle() -> None:
    check = LaneJumpCheck()
    check.step(at(0, heading_rad=math.pi - 0.1))
    assert check.step(at(16, heading_rad=-math.pi + 0.1)) is None


def test_a_lane_that_jumped_stays_wrong_until_it_is_back_or_the_right_one_is_long_ago() -> None:
    check = LaneJumpCheck()
    check.step(at(0))
    assert all(check.step(at(t_ms, 0.3)) for t_ms in range(16, round(KEPT_S * 1000), 16))
    assert check.step(at(KEPT_S * 1000, 0.3)) is None
    assert check.step(at(KEPT_S * 1000 + 16, 0.0)) is not None  # and the old one has jumped now
    check = LaneJumpCheck()
    check.step(at(0))
    check.step(at(16, 0.3))
    assert check.step(at(32, 0.01)) is None


def test_a_lane_that_wanders_may_go_anywhere() -> None:
    check = LaneJumpCheck()
    assert [check.step(at(16 * i, 0.05 * i, 0.1 * i)) for i in range(20)] == [None] * 20


def test_a_lost_lane_is_no_jump_but_may_be_one_when_it_is_found() -> None:
    check = LaneJumpCheck()
    check.step(at(0))
    assert check.step(at(16, status=LaneStatus.LOST)) is None
    assert check.step(at(32, 0.3)) is not None


def test_after_dead_reckoning_a_line_that_is_seen_again_is_right() -> None:
    check = LaneJumpCheck()
    check.step(at(0))
    check.step(at(16, 0.1, status=LaneStatus.COASTING))
    assert check.step(at(32, 0.35)) is None
    assert check.step(at(48, 0.0)) is not None
