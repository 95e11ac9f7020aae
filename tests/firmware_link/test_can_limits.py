"""Every bound of the limits before a full-size car's bus, swept: reached, and never exceeded."""

from __future__ import annotations

import itertools
import math

import pytest

from firmware_link.can_limits import (
    ACCEL_JERK_MAX_MPS3,
    BANK_TOLERANCE_MPS2,
    DT_MAX_S,
    LATERAL_ACCEL_MAX_MPS2,
    LATERAL_JERK_MAX_MPS3,
    STEERING_MAX_RAD,
    STEERING_RATE_MAX_RADPS,
    acceleration_mps2,
    lateral_accel_mps2,
    limited_acceleration_mps2,
    limited_steering_rad,
    steering_max_rad,
)

WHEELBASE_M = 2.7
SPEEDS_MPS = (0.0, 0.5, 3.0, 5.0, 8.0, 12.0, 15.0, 20.0, 30.0, 50.0)
DT_S = 0.02
TINY = 1e-9
ALLOWED_MPS2 = LATERAL_ACCEL_MAX_MPS2 - BANK_TOLERANCE_MPS2


def test_the_bounds_are_those_of_the_standard() -> None:
    assert (LATERAL_ACCEL_MAX_MPS2, LATERAL_JERK_MAX_MPS3) == (3.0, 5.0)
    assert pytest.approx(9.81 * math.sin(0.06), abs=0.005) == BANK_TOLERANCE_MPS2


@pytest.mark.parametrize("speed_mps", SPEEDS_MPS)
@pytest.mark.parametrize("side", [-1, 1])
def test_acceleration_is_reached_and_never_exceeded(speed_mps: float, side: int) -> None:
    steering = 0.0
    for _ in range(2000):
        steering = limited_steering_rad(side * 10.0, steering, speed_mps, DT_S, WHEELBASE_M)
        assert abs(lateral_accel_mps2(steering, speed_mps, WHEELBASE_M)) <= ALLOWED_MPS2 + TINY
        assert abs(steering) <= STEERING_MAX_RAD + TINY
    reached = abs(lateral_accel_mps2(steering, speed_mps, WHEELBASE_M)) == pytest.approx(ALLOWED_MPS2)
    assert reached or abs(steering) == pytest.approx(STEERING_MAX_RAD)
    assert math.copysign(1, steering) == side
    assert abs(steering) == pytest.approx(steering_max_rad(speed_mps, WHEELBASE_M))


@pytest.mark.parametrize("speed_mps", SPEEDS_MPS)
@pytest.mark.parametrize("dt_s", [0.0, 0.001, 0.01, 0.02, DT_MAX_S])
def test_jerk_and_rate_are_reached_and_never_exceeded(speed_mps: float, dt_s: float) -> None:
    most = steering_max_rad(speed_mps, WHEELBASE_M)
    for share, request in itertools.product((-1.0, -0.5, 0.0, 0.5, 1.0), (-10.0, -0.01, 0.0, 0.01, 10.0)):
        before = share * most
        after = limited_steering_rad(request, before, speed_mps, dt_s, WHEELBASE_M)
        change = lateral_accel_mps2(after, speed_mps, WHEELBASE_M) - lateral_accel_mps2(before, speed_mps, WHEELBASE_M)
        assert abs(change) <= LATERAL_JERK_MAX_MPS3 * dt_s + TINY
        assert abs(after - before) <= STEERING_RATE_MAX_RADPS * dt_s + TINY
        bounded = (
            after == request
            or abs(change) == pytest.approx(LATERAL_JERK_MAX_MPS3 * dt_s, abs=TINY)
            or abs(after - before) == pytest.approx(STEERING_RATE_MAX_RADPS * dt_s, abs=TINY)
            or abs(after) == pytest.approx(most)
        )
        assert bounded, "as near to the request as allowed"


def test_a_late_loop_does_not_jump() -> None:
    late = limited_steering_rad(1.0, 0.0, 0.0, 3.0, WHEELBASE_M)
    assert late == pytest.approx(STEERING_RATE_MAX_RADPS * DT_MAX_S)
    assert limited_steering_rad(1.0, 0.1, 0.0, -3.0, WHEELBASE_M) == 0.1


@pytest.mark.parametrize("request_rad", [math.nan, math.inf, -math.inf])
def test_what_is_no_angle_keeps_the_angle(request_rad: float) -> None:
    assert limited_steering_rad(request_rad, 0.01, 10.0, DT_S, WHEELBASE_M) == 0.01


def test_a_speed_that_rose_takes_the_angle_back() -> None:
    before = steering_max_rad(10.0, WHEELBASE_M)
    assert limited_steering_rad(before, before, 20.0, DT_S, WHEELBASE_M) == steering_max_rad(20.0, WHEELBASE_M)


def test_acceleration_towards_the_wanted_speed() -> None:
    assert acceleration_mps2(10.0, 9.0, 0.8, 2.0, 3.5) == pytest.approx(0.8)
    assert acceleration_mps2(30.0, 9.0, 0.8, 2.0, 3.5) == 2.0
    assert acceleration_mps2(0.0, 9.0, 0.8, 2.0, 3.5) == -3.5
    assert acceleration_mps2(math.nan, 9.0, 0.8, 2.0, 3.5) == -3.5
    assert acceleration_mps2(10.0, 10.0, 0.8, 2.0, 3.5, -2.5) == -2.5
    assert acceleration_mps2(10.0, 9.0, 0.8, 2.0, 3.5, -2.5) == pytest.approx(-1.7)
    assert acceleration_mps2(10.0, 10.0, 0.8, 2.0, 3.5, math.inf) == -3.5


@pytest.mark.parametrize("dt_s", [-1.0, 0.0, 0.001, 0.01, 0.02, DT_MAX_S, 3.0])
@pytest.mark.parametrize("before_mps2", [-3.5, -1.0, 0.0, 2.0])
def test_the_asked_acceleration_s_jerk_is_reached_and_never_exceeded(dt_s: float, before_mps2: float) -> None:
    most = ACCEL_JERK_MAX_MPS3 * min(max(dt_s, 0.0), DT_MAX_S)
    for request in (-3.5, -0.5, 0.0, 0.01, 2.0):
        after = limited_acceleration_mps2(request, before_mps2, dt_s)
        assert abs(after - before_mps2) <= most + TINY
        assert after == request or abs(after - before_mps2) == pytest.approx(most, abs=TINY)
