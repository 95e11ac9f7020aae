from __future__ import annotations

import math

import pytest

from automodel.config import ControlConfig
from automodel.control.longitudinal import ObstacleGuard, SpeedPlanner
from automodel.control.path import LanePath
from automodel.curves import JoinedCurve, arc, line
from automodel.signals import LaneStatus, VehicleState

MS = 1_000_000
STRAIGHT = LanePath(line(-0.3, 0.0, 0.0, 5.0))
TRACKING = LaneStatus.TRACKING


def heard(t_ns: int, *ranges_m: float | None) -> VehicleState:
    return VehicleState(t_ns=t_ns, ranges_m=ranges_m)


def settle(planner: SpeedPlanner, lane: LanePath, speed: float, status: LaneStatus = TRACKING, t_ns: int = 0) -> float:
    requested = speed
    for k in range(200):
        requested = planner.step(lane, 0.3, status, speed, t_ns + k * 20 * MS)
    return requested


def ahead(way_m: float, kappa: float) -> LanePath:
    """Straight for `way_m` from arc length 0.3 on, then a bend."""
    return LanePath(JoinedCurve((line(-0.3, 0.0, 0.0, 0.3 + way_m), arc(way_m, 0.0, 0.0, kappa, 1.0))))


def test_speed_rises_along_the_ramp_to_the_configured_one() -> None:
    planner = SpeedPlanner(ControlConfig(speed_mps=1.0, accel_mps2=1.5), 2.0)
    got = [planner.step(STRAIGHT, 0.3, TRACKING, 0.0, k * 20 * MS) for k in range(60)]
    for k, speed in enumerate(got):
        assert speed == pytest.approx(min(0.03 * k, 1.0))


def test_ramp_begins_at_the_speed_that_the_car_has() -> None:
    planner = SpeedPlanner(ControlConfig(), 2.0)
    assert planner.step(STRAIGHT, 0.3, TRACKING, 0.8, 0) == pytest.approx(0.8)
    planner.stop()
    assert planner.step(STRAIGHT, 0.3, TRACKING, 0.6, 20 * MS) == pytest.approx(0.6)
    planner.reset()
    assert planner.step(STRAIGHT, 0.3, TRACKING, -0.2, 40 * MS) == 0.0


def test_never_above_the_safety_limit() -> None:
    assert settle(SpeedPlanner(ControlConfig(speed_mps=5.0), 2.0), STRAIGHT, 2.0) == 2.0


@pytest.mark.parametrize("kappa", [1 / 1.2, -1 / 0.6])
def test_in_a_bend_the_lateral_acceleration_is_the_configured_one(kappa: float) -> None:
    lane = LanePath(arc(-0.3, 0.0, 0.0, kappa, 3.0))
    speed = settle(SpeedPlanner(ControlConfig(speed_mps=3.0, lateral_accel_mps2=1.5), 3.0), lane, 1.0)
    assert speed**2 * abs(kappa) == pytest.approx(1.5)


def test_slows_down_early_enough_for_a_bend() -> None:
    config = ControlConfig(speed_mps=2.0, lateral_accel_mps2=1.5)
    bend_mps = math.sqrt(1.5 * 0.6)
    # a car whose speed follows with the reaction time and brakes at the limit arrives no faster than the bend allows
    distance, speed, t_ns, requested = 1.4, 2.0, 0, [2.0] * 15
    planner = SpeedPlanner(config, 2.0)
    while distance > 0:
        t_ns += 10 * MS
        requested.append(planner.step(ahead(distance, 1 / 0.6), 0.3, TRACKING, speed, t_ns))
        speed = requested[-15]
        distance -= speed * 0.01
    assert speed <= 1.05 * bend_mps
    far = SpeedPlanner(config, 2.0)
    assert settle(far, ahead(2.5, 1 / 0.6), 2.0) == 2.0  # and not earlier than it must


def test_falls_no_faster_than_the_ramp() -> None:
    planner = SpeedPlanner(ControlConfig(speed_mps=2.0, decel_mps2=3.0), 2.0)
    planner.step(STRAIGHT, 0.3, TRACKING, 2.0, 0)
    lane = LanePath(arc(-0.3, 0.0, 0.0, 2.0, 3.0))
    assert planner.step(lane, 0.3, TRACKING, 2.0, 20 * MS) == pytest.approx(2.0 - 3.0 * 0.02)


@pytest.mark.parametrize(
    ("status", "share"), [(LaneStatus.TRACKING, 1.0), (LaneStatus.ONE_LINE, 0.9), (LaneStatus.COASTING, 0.5)]
)
def test_share_of_the_speed_by_status(status: LaneStatus, share: float) -> None:
    planner = SpeedPlanner(ControlConfig(speed_mps=1.0, one_line_speed=0.9, coasting_speed=0.5), 2.0)
    assert settle(planner, STRAIGHT, 1.0, status) == pytest.approx(share)


def test_guard_stops_and_goes_with_hysteresis() -> None:
    guard = ObstacleGuard(0.35, 0.45)
    blocked = []
    for k, reading in enumerate([1.0, 0.5, 0.4, 0.34, 0.33, 0.4, 0.44, 0.44, 0.46, 0.47, 0.4]):
        guard.step(heard(k, None, reading, None), k)
        blocked.append(guard.blocked)
    assert blocked == [False] * 4 + [True] * 5 + [False] * 2


@pytest.mark.parametrize("spurious", [0.02, 0.3])
def test_a_single_short_reading_does_not_stop_the_car(spurious: float) -> None:
    guard = ObstacleGuard(0.35, 0.45)
    for k, reading in enumerate([None, None, spurious, None, 3.0, spurious, None, None]):
        guard.step(heard(k, None, reading, None), k)
        assert not guard.blocked


def test_a_single_missing_echo_does_not_free_the_car_and_a_free_way_does() -> None:
    guard = ObstacleGuard(0.35, 0.45)
    for k, reading in enumerate([0.3, 0.3, None, 0.3]):
        guard.step(heard(k, None, reading, None), k)
    assert guard.blocked
    for k in (4, 5):
        guard.step(heard(k, None, None, None), k)
    assert not guard.blocked


def test_the_same_state_counts_once_and_an_old_or_silent_one_not_at_all() -> None:
    guard = ObstacleGuard(0.35, 0.45)
    for _ in range(5):
        guard.step(heard(10, None, 0.1, None), 20)
    assert not guard.blocked
    for k in range(5):
        guard.step(heard(20 + k, None, 0.1, None), 10**9)
        guard.step(None, 10**9)
        guard.step(heard(10**9 - k), 10**9)
    assert not guard.blocked
    guard.step(heard(11, None, math.nan, None), 20)
    assert math.isinf(guard.range_m)


def test_only_the_sensor_ahead_counts() -> None:
    guard = ObstacleGuard(0.35, 0.45)
    for k in range(5):
        guard.step(heard(k, 0.1, None, 0.1), k)
    assert not guard.blocked


def test_an_obstacle_stops_at_once_and_the_car_goes_on_after_it() -> None:
    planner = SpeedPlanner(ControlConfig(), 2.0)
    assert settle(planner, STRAIGHT, 1.0) == 1.0
    t_ns = 4000 * MS
    for k in range(2):
        planner.observe(heard(t_ns + k, None, 0.3, None), t_ns + k)
    assert planner.step(STRAIGHT, 0.3, TRACKING, 1.0, t_ns) == 0.0
    for k in range(2, 4):
        planner.observe(heard(t_ns + k, None, None, None), t_ns + k)
    assert 0.0 < planner.step(STRAIGHT, 0.3, TRACKING, 0.0, t_ns + 20 * MS) <= 1.5 * 0.02 + 1e-9


@pytest.mark.parametrize("speed", [0.6, 1.0, 2.0])
def test_comes_to_rest_before_an_obstacle(speed: float) -> None:
    config = ControlConfig(speed_mps=speed)
    planner = SpeedPlanner(config, 2.0)
    gap, now, t_ns = 2.5, speed, 0
    for step in range(2000):
        t_ns += 10 * MS
        if step % 2 == 0:
            planner.observe(heard(t_ns, None, gap, None), t_ns)
        requested = planner.step(STRAIGHT, 0.3, TRACKING, now, t_ns)
        now += (requested - now) * (1.0 - math.exp(-0.01 / 0.12))
        gap -= now * 0.01
    assert now < 1e-3
    assert 0.25 < gap <= 0.35


def test_impossible_distances_are_refused() -> None:
    with pytest.raises(ValueError, match="go_m"):
        ObstacleGuard(0.4, 0.3)
