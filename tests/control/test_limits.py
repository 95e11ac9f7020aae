from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from automodel.config import SafetyConfig, VehicleConfig
from automodel.control.limits import MAX_STEP_S, Before, LimitResult, Limits, limit
from automodel.signals import NEUTRAL, Command, Motion, MotionSource

REPEATABLE = settings(derandomize=True, deadline=None)
SAFETY, CAR = SafetyConfig(), VehicleConfig()
L = CAR.wheelbase_m
MS = 1_000_000

angles = st.floats(-3.0, 3.0)
speeds = st.floats(-5.0, 5.0)
any_float = st.floats(allow_nan=True, allow_infinity=True)


def command(steering: float, speed: float, t_ns: int = 0) -> Command:
    return Command(t_ns=t_ns, steering_rad=steering, speed_mps=speed, valid_until_ns=t_ns + 100 * MS)


def kappa(steering: float) -> float:
    return math.tan(steering) / L


def known(speed: float) -> Motion:
    return Motion(t_ns=0, speed_mps=speed, yaw_rate_radps=0.0)


UNKNOWN = Motion(t_ns=0, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)


@REPEATABLE
@given(st.lists(st.tuples(angles, speeds, st.floats(0.0, 0.3), speeds), min_size=1, max_size=30))
def test_no_sequence_of_commands_breaks_a_limit(wishes: list[tuple[float, float, float, float]]) -> None:
    limits, before, t_ns = Limits(SAFETY, CAR), NEUTRAL, 0
    for steering, speed, dt, measured in wishes:
        t_ns += round(dt * 1e9)
        sent = limits.step(command(steering, speed, t_ns), known(measured), t_ns).command
        assert abs(sent.speed_mps) <= SAFETY.speed_max_mps
        assert abs(sent.steering_rad) <= SAFETY.steering_max_rad
        step = min(dt, MAX_STEP_S) + 1e-9
        assert abs(sent.steering_rad - before.steering_rad) <= SAFETY.steering_rate_max_radps * step + 1e-12
        assert abs(kappa(sent.steering_rad)) * sent.speed_mps**2 <= SAFETY.lateral_accel_max_mps2 * (1 + 1e-9)
        fastest = max(abs(sent.speed_mps), abs(before.speed_mps), abs(measured))
        jerk_step = abs(kappa(sent.steering_rad) - kappa(before.steering_rad)) * fastest**2
        assert jerk_step <= SAFETY.lateral_jerk_max_mps3 * step + 1e-9
        assert sent.t_ns == t_ns
        before = sent


@REPEATABLE
@given(st.tuples(any_float, any_float, any_float, any_float, any_float, any_float))
def test_anything_not_finite_gives_neutral_and_says_so(values: tuple[float, ...]) -> None:
    steering, speed, *rest = values
    before = Before(steering_rad=rest[0], speed_mps=rest[1], dt_s=rest[2], measured_mps=rest[3])
    result = limit(command(steering, speed, 5), before, SAFETY, CAR)
    assert math.isfinite(result.command.steering_rad)
    assert math.isfinite(result.command.speed_mps)
    if all(map(math.isfinite, values)):
        assert "non_finite" not in result.reasons
    else:
        assert result.reasons == ("non_finite",)
        assert (result.command.steering_rad, result.command.speed_mps) == (0.0, 0.0)
        assert result.command.valid_until_ns <= result.command.t_ns


@REPEATABLE
@given(angles, angles, speeds, st.floats(0.0, 0.1), speeds)
def test_speed_zero_is_granted_at_once(
    steering: float, before: float, speed_before: float, dt: float, measured: float
) -> None:
    state = Before(steering_rad=before, speed_mps=speed_before, dt_s=dt, measured_mps=measured)
    assert limit(command(steering, 0.0), state, SAFETY, CAR).command.speed_mps == 0.0


@REPEATABLE
@given(st.floats(-0.2, 0.2), st.floats(0.0, 1.0))
def test_what_is_within_the_limits_passes_unchanged(steering: float, speed: float) -> None:
    before = Before(steering_rad=steering + 0.01, speed_mps=speed, dt_s=0.02, measured_mps=speed)
    assert limit(command(steering, speed), before, SAFETY, CAR) == LimitResult(command=command(steering, speed))


@REPEATABLE
@given(angles, speeds, angles, speeds, st.floats(0.0, 0.1))
def test_limiting_twice_changes_nothing_more(
    steering: float, speed: float, before: float, speed_before: float, dt: float
) -> None:
    state = Before(steering_rad=before, speed_mps=speed_before, dt_s=dt, measured_mps=5.0)  # faster than any
    once = limit(command(steering, speed), state, SAFETY, CAR).command
    twice = limit(once, state, SAFETY, CAR).command
    assert twice.steering_rad == pytest.approx(once.steering_rad, abs=1e-12)
    assert twice.speed_mps == pytest.approx(once.speed_mps, abs=1e-12)


def test_each_limit_by_its_value_and_name() -> None:
    slow = Before(steering_rad=0.4, dt_s=0.1)
    assert limit(command(0.8, 0.0), slow, SAFETY, CAR) == LimitResult(command=command(0.45, 0.0), reasons=("steering",))
    assert limit(command(0.0, 9.0), Before(dt_s=0.1), SAFETY, CAR) == LimitResult(
        command=command(0.0, 2.0), reasons=("speed",)
    )
    rate = limit(command(0.4, 0.0), Before(dt_s=0.02), SAFETY, CAR)
    assert rate.command.steering_rad == pytest.approx(6.0 * 0.02)
    assert rate.reasons == ("steering_rate",)
    at_2 = limit(command(0.3, 2.0), Before(steering_rad=0.19, speed_mps=2.0, dt_s=0.1), SAFETY, CAR)
    assert at_2.command.steering_rad == pytest.approx(math.atan(L * 3.0 / 4.0))
    assert at_2.reasons == ("lateral_accel",)
    jerk = limit(command(0.1, 2.0), Before(speed_mps=2.0, dt_s=0.02), SAFETY, CAR)
    assert kappa(jerk.command.steering_rad) * 4.0 == pytest.approx(16.0 * 0.02)
    assert jerk.reasons == ("lateral_jerk",)


def test_the_measured_speed_counts_although_the_command_says_stop() -> None:
    rolling = Before(steering_rad=0.0, speed_mps=0.0, dt_s=0.1, measured_mps=2.0)
    result = limit(command(0.45, 0.0), rolling, SAFETY, CAR)
    assert kappa(result.command.steering_rad) * 4.0 <= 16.0 * 0.1 + 1e-9
    assert result.command.speed_mps == 0.0


def test_steering_that_cannot_come_back_fast_enough_takes_the_speed_down() -> None:
    turned = Before(steering_rad=0.45, speed_mps=0.5, dt_s=0.001)
    result = limit(command(0.45, 2.0), turned, SAFETY, CAR)
    assert kappa(result.command.steering_rad) * result.command.speed_mps**2 == pytest.approx(3.0)
    assert result.command.speed_mps < 1.35
    assert "lateral_accel" in result.reasons


def test_a_bad_command_does_not_spoil_the_ones_after() -> None:
    limits = Limits(SAFETY, CAR)
    limits.step(command(0.0, 1.0, 0), known(1.0), 0)
    assert limits.step(command(math.nan, 1.0, 20 * MS), known(1.0), 20 * MS).reasons == ("non_finite",)
    good = limits.step(command(0.05, 1.0, 40 * MS), known(1.0), 40 * MS)
    assert good.command == command(0.05, 1.0, 40 * MS)


def test_time_that_stands_still_or_goes_back_moves_no_wheel() -> None:
    limits = Limits(SAFETY, CAR)
    limits.step(command(0.0, 0.0, 100 * MS), UNKNOWN, 100 * MS)
    assert limits.step(command(0.3, 0.0, 100 * MS), UNKNOWN, 100 * MS).command.steering_rad == 0.0
    assert limits.step(command(0.3, 0.0, 90 * MS), UNKNOWN, 90 * MS).command.steering_rad == 0.0


def test_a_long_gap_gives_no_larger_step_than_a_short_one() -> None:
    limits = Limits(SAFETY, CAR)
    limits.step(command(0.0, 2.0, 0), known(2.0), 0)
    jump = limits.step(command(0.18, 2.0, 10**10), known(2.0), 10**10)
    assert kappa(jump.command.steering_rad) * 4.0 <= 16.0 * MAX_STEP_S + 1e-9


def test_reset_goes_on_from_what_was_sent() -> None:
    limits = Limits(SAFETY, CAR)
    limits.step(command(0.3, 0.0, 0), UNKNOWN, 0)
    limits.reset(command(0.3, 0.0, 10 * MS))
    result = limits.step(command(0.45, 0.0, 20 * MS), UNKNOWN, 20 * MS)
    assert result.command.steering_rad == pytest.approx(0.3 + 6.0 * 0.01)
    limits.reset()
    assert limits.step(command(0.45, 0.0, 30 * MS), UNKNOWN, 30 * MS).command.steering_rad == 0.0
