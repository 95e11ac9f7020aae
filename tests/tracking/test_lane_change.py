"""When the neighbour lane becomes the lane: once for each change, and never for a car that stays."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import pytest

from automodel.signals import LanePose
from automodel.tracking.lane_change import LaneChanges

LANE_M, RATE_HZ, SPEED_MPS = 3.5, 20.0, 26.0


def pose(offset_m: float, heading_rad: float) -> LanePose:
    return LanePose(
        offset_m=offset_m, heading_rad=heading_rad, width_m=LANE_M, curvature_per_m=0.0, covariance=np.zeros((3, 3))
    )


def changes(places_m: Iterable[float], seed: int = 0, noise_m: float = 0.01) -> list[tuple[int, float]]:
    """Each change's side, and how far from the middle of the lane left [half lanes], of a car that drives so.

    `places_m`: lateral places on the road, at `RATE_HZ`, as from the middle of the lane in which it starts.
    """
    follower, rng, lane, found = LaneChanges(), np.random.default_rng(seed), 0, []
    places = np.array(list(places_m))
    for y, slope in zip(places, np.gradient(places) * RATE_HZ / SPEED_MPS, strict=True):
        offset = y - lane * LANE_M + rng.normal(0.0, noise_m)
        side = follower.due(pose(offset, math.atan(slope) + rng.normal(0.0, 0.0005)))
        if side:
            follower.changed(side)
            found.append((side, abs(offset) / (0.5 * LANE_M)))
            lane += side
    return found


def step(seconds: float) -> np.ndarray:
    u = np.linspace(0.0, 1.0, round(seconds * RATE_HZ))
    return u * u * u * (10.0 + u * (6.0 * u - 15.0))


def test_a_hundred_lane_changes_are_a_hundred() -> None:
    rng = np.random.default_rng(5)
    lane, way, sides = 0, [np.zeros(40)], []
    for _ in range(100):
        side = int(rng.choice((-1, 1)))
        way += [LANE_M * (lane + side * step(rng.uniform(2.0, 10.0)))]
        lane += side
        sides.append(side)
        seconds = rng.uniform(1.0, 6.0)
        waves = np.sin(np.linspace(0.0, math.tau, round(seconds * RATE_HZ)))
        way += [LANE_M * lane + rng.uniform(0.0, 0.5) * waves]
    found = changes(np.concatenate(way))
    assert [side for side, _ in found] == sides
    assert all(0.73 < at < 0.9 for _, at in found)  # a frame's way beyond three quarters at most


def test_a_car_that_swings_through_its_lane_for_ten_minutes_changes_none() -> None:
    t = np.arange(600 * int(RATE_HZ)) / RATE_HZ
    swing = 0.7 * 0.5 * LANE_M * np.sin(0.3 * math.tau * t) * (0.6 + 0.4 * np.sin(0.01 * math.tau * t))
    assert changes(swing) == []


def test_a_change_that_is_given_up_goes_there_and_back() -> None:
    out = LANE_M * 0.45 * step(4.0)
    assert [side for side, _ in changes(np.concatenate((out, out[::-1], np.zeros(20))))] == [1, -1]


@pytest.mark.parametrize("side", [1, -1])
def test_a_car_on_the_limit_changes_once(side: int) -> None:
    """Three quarters and back, again and again: the new lane is kept."""
    t = np.arange(400) / RATE_HZ
    limit = 0.5 * LANE_M * (0.75 + 0.06 * np.sin(0.5 * math.tau * t))
    assert [found for found, _ in changes(side * limit)] == [side]


def test_a_car_that_stands_askew_and_comes_back_changes_none() -> None:
    """Beyond three quarters, but on its way to the middle."""
    assert changes(0.5 * LANE_M * 0.95 * step(3.0)[::-1], noise_m=0.0) == []
