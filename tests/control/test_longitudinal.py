from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from automodel.config import ControlConfig, VehicleConfig
from automodel.control.longitudinal import ObstacleGuard, SpeedPlanner, speed_in_free_space
from automodel.control.path import LanePath
from automodel.curves import JoinedCurve, arc, line
from automodel.geometry import SE2
from automodel.signals import LaneEstimate, LaneLine, LanePose, LaneStatus, VehicleState

MS = 1_000_000
CAR = VehicleConfig(width_m=0.2)  # 0.1 m free on either side in a lane of 0.4 m
STRAIGHT = LanePath(line(-0.3, 0.0, 0.0, 5.0))


def seen(
    status: LaneStatus = LaneStatus.TRACKING,
    offset_m: float = 0.0,
    offset_bound_m: float = math.inf,
    heading_bound_rad: float = math.inf,
    t_ns: int = 0,
) -> LaneEstimate:
    pose = LanePose(
        offset_m=offset_m,
        heading_rad=0.0,
        width_m=0.4,
        curvature_per_m=0.0,
        covariance=np.eye(3),
        offset_bound_m=offset_bound_m,
        heading_bound_rad=heading_bound_rad,
    )
    return LaneEstimate(t_ns=t_ns, status=status, pose=pose, centerline=line(-0.3, 0.0, 0.0, 5.0))


TRACKING = seen(t_ns=3600 * 1000 * MS)  # never late


def heard(t_ns: int, *ranges_m: float | None) -> VehicleState:
    return VehicleState(t_ns=t_ns, ranges_m=ranges_m)


def settle(
    planner: SpeedPlanner, lane: LanePath, speed: float, estimate: LaneEstimate = TRACKING, age_ns: int = 0
) -> float:
    requested = speed
    for k in range(200):
        t_ns = k * 20 * MS
        requested = planner.step(lane, 0.3, replace(estimate, t_ns=t_ns), speed, t_ns + age_ns)
    return requested


def ahead(way_m: float, kappa: float) -> LanePath:
    """Straight for `way_m` from arc length 0.3 on, then a bend."""
    return LanePath(JoinedCurve((line(-0.3, 0.0, 0.0, 0.3 + way_m), arc(way_m, 0.0, 0.0, kappa, 1.0))))


def test_speed_rises_along_the_ramp_to_the_configured_one() -> None:
    planner = SpeedPlanner(ControlConfig(speed_mps=1.0, accel_mps2=1.5), 2.0, CAR)
    got = [planner.step(STRAIGHT, 0.3, TRACKING, 0.0, k * 20 * MS) for k in range(60)]
    for k, speed in enumerate(got):
        assert speed == pytest.approx(min(0.03 * k, 1.0))


def test_ramp_begins_at_the_speed_that_the_car_has() -> None:
    planner = SpeedPlanner(ControlConfig(), 2.0, CAR)
    assert planner.step(STRAIGHT, 0.3, TRACKING, 0.8, 0) == pytest.approx(0.8)
    planner.stop()
    assert planner.step(STRAIGHT, 0.3, TRACKING, 0.6, 20 * MS) == pytest.approx(0.6)
    planner.reset()
    assert planner.step(STRAIGHT, 0.3, TRACKING, -0.2, 40 * MS) == 0.0


def test_never_above_the_safety_limit() -> None:
    assert settle(SpeedPlanner(ControlConfig(speed_mps=5.0), 2.0, CAR), STRAIGHT, 2.0) == 2.0


@pytest.mark.parametrize("kappa", [1 / 1.2, -1 / 0.6])
def test_in_a_bend_the_lateral_acceleration_is_the_configured_one(kappa: float) -> None:
    lane = LanePath(arc(-0.3, 0.0, 0.0, kappa, 3.0))
    speed = settle(SpeedPlanner(ControlConfig(speed_mps=3.0, lateral_accel_mps2=1.5), 3.0, CAR), lane, 1.0)
    assert speed**2 * abs(kappa) == pytest.approx(1.5)


def test_slows_down_early_enough_for_a_bend() -> None:
    config = ControlConfig(speed_mps=2.0, lateral_accel_mps2=1.5)
    bend_mps = math.sqrt(1.5 * 0.6)
    # a car whose speed follows with the reaction time and brakes at the limit arrives no faster than the bend allows
    distance, speed, t_ns, requested = 1.4, 2.0, 0, [2.0] * 15
    planner = SpeedPlanner(config, 2.0, CAR)
    while distance > 0:
        t_ns += 10 * MS
        requested.append(planner.step(ahead(distance, 1 / 0.6), 0.3, TRACKING, speed, t_ns))
        speed = requested[-15]
        distance -= speed * 0.01
    assert speed <= 1.05 * bend_mps
    far = SpeedPlanner(config, 2.0, CAR)
    assert settle(far, ahead(2.5, 1 / 0.6), 2.0) == 2.0  # and not earlier than it must


def sighted(left_m: float | None, right_m: float | None, t_ns: int = 0) -> LaneEstimate:
    """A straight lane whose lines are seen to so far ahead of the rear axle; None: not at all."""
    lines = []
    for end_m, y_m in ((left_m, 0.2), (right_m, -0.2)):
        points = np.empty((0, 2)) if end_m is None else np.array([[end_m, y_m], [0.5 * end_m, y_m]])
        lines.append(LaneLine(curve=line(0.0, y_m, 0.0, 5.0), points_m=points, seen=end_m is not None))
    return replace(seen(t_ns=t_ns), left=lines[0], right=lines[1])


def sight_planner(radius_m: float = 0.5) -> SpeedPlanner:
    config = ControlConfig(speed_mps=4.0, lateral_accel_mps2=1.5, decel_mps2=3.0, accel_mps2=5.0)
    return SpeedPlanner(config, 4.0, CAR, tightest_m=radius_m)


def test_a_bend_where_the_lines_end_is_reached_no_faster_than_it_allows() -> None:
    planner, distance, speed, t_ns, requested = sight_planner(), 6.0, 3.0, 0, [3.0] * 15
    fastest = 0.0
    while distance > 0:
        t_ns += 10 * MS
        end_m = min(distance, 1.8)  # the view's end, later the bend's start
        requested.append(planner.step(STRAIGHT, 0.3, sighted(end_m, end_m, t_ns), speed, t_ns))
        speed = requested[-15]  # the reaction time
        distance -= speed * 0.01
        fastest = max(fastest, speed)
    assert speed <= 1.06 * math.sqrt(1.5 * 0.5)
    assert fastest > 2.5  # of a view of 1.8 m the straight makes what it can


def test_what_was_seen_is_known_until_the_car_is_there() -> None:
    planner = sight_planner()
    free = settle(planner, STRAIGHT, 2.0, sighted(4.0, 4.0))
    start_ns = 200 * 20 * MS
    speeds = [
        planner.step(STRAIGHT, 0.3, sighted(None, None, start_ns + k * 20 * MS), 2.0, start_ns + k * 20 * MS)
        for k in range(120)
    ]
    assert speeds[0] == pytest.approx(free)
    assert speeds[49] < free - 0.5
    assert speeds[-1] == pytest.approx(math.sqrt(1.5 * 0.5))  # nothing is left of it: as if the bend were here


def test_the_line_that_ends_first_tells_where_a_bend_may_begin() -> None:
    inner, both, one = (
        settle(sight_planner(), STRAIGHT, 2.0, sighted(*ends)) for ends in ((4.0, 1.0), (1.0, 1.0), (None, 1.0))
    )
    assert inner == both == one
    assert settle(sight_planner(), STRAIGHT, 2.0, sighted(4.0, None)) > inner + 1.0


def test_falls_no_faster_than_the_ramp() -> None:
    planner = SpeedPlanner(ControlConfig(speed_mps=2.0, decel_mps2=3.0), 2.0, CAR)
    planner.step(STRAIGHT, 0.3, TRACKING, 2.0, 0)
    lane = LanePath(arc(-0.3, 0.0, 0.0, 2.0, 3.0))
    assert planner.step(lane, 0.3, TRACKING, 2.0, 20 * MS) == pytest.approx(2.0 - 3.0 * 0.02)


@pytest.mark.parametrize(
    ("status", "share"), [(LaneStatus.TRACKING, 1.0), (LaneStatus.ONE_LINE, 0.9), (LaneStatus.COASTING, 0.5)]
)
def test_share_of_the_speed_by_status(status: LaneStatus, share: float) -> None:
    planner = SpeedPlanner(ControlConfig(speed_mps=1.0, one_line_speed=0.9, coasting_speed=0.5), 2.0, CAR)
    assert settle(planner, STRAIGHT, 1.0, seen(status)) == pytest.approx(share)


@pytest.mark.parametrize(("age_ms", "mps"), [(5, 2.0), (20, 2.0), (40, 1.0), (80, 0.5)])
def test_a_machine_that_is_late_makes_the_car_slower(age_ms: int, mps: float) -> None:
    planner = SpeedPlanner(ControlConfig(speed_mps=2.0, late_lanes=0.1), 2.0, CAR)
    assert settle(planner, STRAIGHT, 2.0, age_ns=age_ms * MS) == pytest.approx(mps)  # 0.04 m in that time


@pytest.mark.parametrize("offset_m", [-0.03, 0.0, 0.05])
@pytest.mark.parametrize("offset_bound_m", [0.0, 0.02, 0.049])
@pytest.mark.parametrize("heading_bound_rad", [0.01, 0.1, 1.0])
@pytest.mark.parametrize("delay_s", [0.05, 0.15])
def test_a_car_as_wrong_as_it_may_be_is_just_at_the_edge_of_its_lane_when_it_can_steer_again(
    offset_m: float, offset_bound_m: float, heading_bound_rad: float, delay_s: float
) -> None:
    pose = seen(offset_m=offset_m, offset_bound_m=offset_bound_m, heading_bound_rad=heading_bound_rad).pose
    assert pose is not None
    speed = speed_in_free_space(pose, 0.1, delay_s)
    turned = SE2(0.0, abs(offset_m) + offset_bound_m, heading_bound_rad)
    assert (turned @ SE2(speed * delay_s)).y_m == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("offset_bound_m", "heading_bound_rad", "speed"),
    [
        (math.inf, 0.1, math.inf),  # not stated: no reason to slow down
        (math.inf, math.inf, math.inf),
        (0.05, math.inf, math.inf),
        (0.05, 0.0, math.inf),
        (0.1, 0.0, 0.0),
        (0.2, math.inf, 0.0),
        (0.2, 3.0, 0.0),
    ],
)
def test_the_free_space_at_the_ends_of_the_bounds(
    offset_bound_m: float, heading_bound_rad: float, speed: float
) -> None:
    pose = seen(offset_bound_m=offset_bound_m, heading_bound_rad=heading_bound_rad).pose
    assert pose is not None
    assert speed_in_free_space(pose, 0.1, 0.1) == speed


def test_a_car_may_be_turned_by_more_than_a_right_angle_but_drives_no_further_sideways_than_its_way() -> None:
    square, backwards = seen(offset_bound_m=0.05, heading_bound_rad=0.5 * math.pi).pose, seen(offset_bound_m=0.05).pose
    assert square is not None
    assert backwards is not None
    backwards = replace(backwards, heading_bound_rad=3.0)
    assert speed_in_free_space(backwards, 0.1, 0.1) == speed_in_free_space(square, 0.1, 0.1) > 0.0


@pytest.mark.parametrize(
    ("offset_bound_m", "heading_bound_rad"), [(0.01, 0.02), (0.03, 0.07), (math.inf, 0.5), (0.05, math.inf)]
)
@pytest.mark.parametrize("status", [LaneStatus.TRACKING, LaneStatus.COASTING])
def test_a_bound_that_is_small_beside_the_car_changes_nothing(
    offset_bound_m: float, heading_bound_rad: float, status: LaneStatus
) -> None:
    bounded = seen(status, 0.02, offset_bound_m, heading_bound_rad)
    plain, other = (SpeedPlanner(ControlConfig(), 2.0, CAR) for _ in range(2))
    assert settle(other, STRAIGHT, 1.0, bounded) == settle(plain, STRAIGHT, 1.0, seen(status))


def test_the_car_slows_as_the_bound_grows_down_to_the_share_that_is_left() -> None:
    def speed(offset_bound_m: float) -> float:
        planner = SpeedPlanner(ControlConfig(speed_mps=2.0, uncertain_speed=0.2), 2.0, CAR)
        return settle(planner, STRAIGHT, 2.0, seen(offset_bound_m=offset_bound_m, heading_bound_rad=0.3))

    speeds = [speed(bound_m) for bound_m in (0.0, 0.04, 0.06, 0.08, 0.0999, 0.3)]
    assert speeds[0] == 2.0
    assert speeds[1:4] == sorted(set(speeds[1:4]), reverse=True)
    assert 0.4 < speeds[3] < speeds[2] < speeds[1] < 2.0
    assert speeds[4] == speeds[5] == pytest.approx(0.4)
    pose = seen(offset_bound_m=0.06, heading_bound_rad=0.3).pose
    assert pose is not None
    assert speeds[2] == pytest.approx(speed_in_free_space(pose, 0.1, ControlConfig().speed_delay_s))


def test_a_frame_that_comes_later_slows_the_car_further() -> None:
    def speed(age_ns: int) -> float:
        estimate = seen(offset_bound_m=0.06, heading_bound_rad=0.5)
        return settle(SpeedPlanner(ControlConfig(), 2.0, CAR), STRAIGHT, 0.7, estimate, age_ns)

    assert 1.0 > speed(0) > speed(50 * MS) > 0.3


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
    planner = SpeedPlanner(ControlConfig(), 2.0, CAR)
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
    planner = SpeedPlanner(config, 2.0, CAR)
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
