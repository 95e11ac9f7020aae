"""The motion between two frames: what ends it, what makes it unknown, and its poses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.estimation.road import LOST_PACE, LOST_TURN_RAD, MAX_GAP_S, MOST_SIGMAS
from automodel.signals import Motion, MotionSource
from automodel.tracking.frame_motion import FrameMotion, FrameMotions

LANE_M = 0.4
STEP_NS = 50_000_000


def moving(speed_mps: float, yaw_rate_radps: float, source: MotionSource = MotionSource.MEASURED) -> Motion:
    return Motion(t_ns=0, speed_mps=speed_mps, yaw_rate_radps=yaw_rate_radps, source=source)


def second(motion: Motion, dt_ns: int = STEP_NS, trusted: bool = True) -> FrameMotion | None:
    """The motion to the second frame."""
    motions = FrameMotions(LANE_M)
    assert motions.step(7, motion) is None  # there is no frame before the first
    return motions.step(7 + dt_ns, motion, trusted)


def test_distance_and_turn_are_speed_and_yaw_rate_over_the_time_between_the_frames() -> None:
    moved = second(moving(1.2, -0.4))
    assert moved is not None
    assert moved.known
    assert (moved.distance_m, moved.turn_rad, moved.dt_s) == pytest.approx((0.06, -0.02, 0.05))


@pytest.mark.parametrize("dt_ns", [0, -STEP_NS, round(MAX_GAP_S * 1e9) + 1])
def test_a_gap_and_time_that_does_not_go_on_end_what_was_followed(dt_ns: int) -> None:
    assert second(moving(1.0, 0.0), dt_ns) is None


def test_the_longest_gap_is_still_followed_and_after_one_that_is_not_the_next_frame_is() -> None:
    gap_ns = round(MAX_GAP_S * 1e9)
    assert second(moving(1.0, 0.0), gap_ns) is not None
    motions = FrameMotions(LANE_M)
    motions.step(0, moving(1.0, 0.0))
    assert motions.step(gap_ns + 1, moving(1.0, 0.0)) is None
    assert motions.step(gap_ns + 1 + STEP_NS, moving(1.0, 0.0)) is not None


def test_after_a_reset_the_next_frame_is_the_first() -> None:
    motions = FrameMotions(LANE_M)
    motions.step(0, moving(1.0, 0.0))
    motions.reset()
    assert motions.step(STEP_NS, moving(1.0, 0.0)) is None


@pytest.mark.parametrize(
    "motion",
    [
        moving(1.0, 0.2, MotionSource.NONE),
        moving(1.01 * MOST_SIGMAS * LOST_PACE * LANE_M, 0.0),
        moving(-1.01 * MOST_SIGMAS * LOST_PACE * LANE_M, 0.0),
        moving(1.0, 1.01 * MOST_SIGMAS * LOST_TURN_RAD),
        moving(math.nan, 0.0),
        moving(1.0, math.nan),
        moving(math.inf, 0.0),
    ],
)
def test_a_motion_that_no_car_makes_is_unknown_and_counts_as_none(motion: Motion) -> None:
    moved = second(motion)
    assert moved == FrameMotion(distance_m=0.0, turn_rad=0.0, dt_s=0.05, known=False)


def test_a_motion_that_is_not_trusted_is_unknown() -> None:
    moved = second(moving(1.0, 0.2), trusted=False)
    assert moved == FrameMotion(distance_m=0.0, turn_rad=0.0, dt_s=0.05, known=False)


def test_a_point_that_stands_still_moves_backwards_in_the_body_frame() -> None:
    quarter = FrameMotion(distance_m=0.5 * math.pi, turn_rad=0.5 * math.pi, dt_s=0.1, known=True)  # radius 1 m, left
    point = np.array((1.0, 1.0))  # where the car is afterwards
    assert quarter.after_from_before.apply(point) == pytest.approx(np.zeros(2), abs=1e-12)
    assert quarter.before_from_after.apply(np.zeros(2)) == pytest.approx(point, abs=1e-12)
