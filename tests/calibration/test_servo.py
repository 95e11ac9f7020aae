"""Pulse -> angle from drives of a plant whose servo the estimator does not know."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math

import numpy as np
import pytest

from automodel.config import ServoConfig
from automodel.sim.plant import PlantConfig
from automodel.sim.randomised_plant import randomised_servo
from calibration.drive import DrivePlan, Leg, servo_plan
from calibration.servo import SETTLE_NS, ServoError, ServoLog, ServoTable, fit_table, holds_of, without_bias
from tests.support.servo_drives import WHEELBASE_M, changed, driven

DEG = math.pi / 180.0
QUIET = PlantConfig(gyro_noise_radps=0.0, gyro_bias_radps=0.0)


def error_deg(table: ServoTable, config: PlantConfig) -> float:
    """The largest error over the table's range, by a finer grid than any knot."""
    pulses = np.linspace(table.pulse_us[0], table.pulse_us[-1], 700)
    true = np.interp(pulses, config.servo.pulse_us, config.servo.steering_rad) + config.servo_bias_rad
    return float(np.abs(table.angle_rad(pulses) - true).max()) / DEG


def fitted(config: PlantConfig) -> ServoTable:
    return fit_table(without_bias(driven(config)), WHEELBASE_M)


@functools.cache
def hidden(seed: int) -> tuple[PlantConfig, ServoTable]:
    config = randomised_servo(seed, PlantConfig(seed=seed))
    return config, fitted(config)


def circling(radius_m: float, speed_mps: float = 0.5) -> ServoLog:
    """Two seconds straight, then two on a circle, with readings every 20 ms."""
    t_ns = np.arange(200) * 20_000_000
    yaw_rate = np.where(t_ns < 2_000_000_000, 0.0, speed_mps / radius_m)
    return ServoLog(
        pulse_t_ns=np.array([0, 2_000_000_000]),
        pulse_us=np.array([1500.0, 1300.0]),
        t_ns=t_ns,
        yaw_rate_radps=yaw_rate,
        speed_mps=np.full(200, speed_mps),
    )


@pytest.mark.parametrize("radius_m", [0.6, 5.0, -1.2])
def test_a_hold_has_the_angle_whose_perpendicular_meets_the_circles_centre(radius_m: float) -> None:
    (hold,) = holds_of(circling(radius_m), WHEELBASE_M)
    # the front wheel stands square to the line from it to the centre, which lies `radius` beside the rear axle
    assert hold.steering_rad == pytest.approx(math.atan2(WHEELBASE_M, abs(radius_m)) * math.copysign(1, radius_m))
    assert (hold.pulse_us, hold.rose, hold.t_ns) == (1300.0, False, 2_000_000_000)
    assert hold.sd_rad == pytest.approx(0.0, abs=1e-12)


def test_what_comes_before_the_wheels_have_settled_does_not_count() -> None:
    log = circling(1.0)
    moving = (log.t_ns >= 2_000_000_000) & (log.t_ns < 2_000_000_000 + SETTLE_NS)
    (hold,) = holds_of(changed(log, yaw_rate_radps=np.where(moving, 0.0, log.yaw_rate_radps)), WHEELBASE_M)
    assert hold.steering_rad == pytest.approx(math.atan(WHEELBASE_M))


def test_a_bump_in_a_hold_does_not_count() -> None:
    log = circling(1.0)
    rates = log.yaw_rate_radps + 0.001 * np.sin(np.arange(200))
    rates[170] += 4.0
    (hold,) = holds_of(changed(log, yaw_rate_radps=rates), WHEELBASE_M)
    assert hold.steering_rad == pytest.approx(math.atan(WHEELBASE_M), abs=2e-4)


def test_a_hold_that_was_not_driven_forward_is_none() -> None:
    log = circling(1.0)
    slow = np.where(np.arange(200) == 150, 0.05, 0.5)
    assert holds_of(changed(log, speed_mps=slow), WHEELBASE_M) == []


def test_the_gyros_bias_is_a_line_through_two_standstills() -> None:
    t_ns = np.arange(500) * 20_000_000
    moving = (t_ns >= 2_000_000_000) & (t_ns < 8_000_000_000)
    drifting = 0.02 + 0.003 * t_ns * 1e-9
    log = ServoLog(
        pulse_t_ns=np.array([0]),
        pulse_us=np.array([1500.0]),
        t_ns=t_ns,
        yaw_rate_radps=np.where(moving, 0.7, 0.0) + drifting,
        speed_mps=np.where(moving, 0.5, 0.0),
    )
    assert without_bias(log).yaw_rate_radps[moving] == pytest.approx(0.7, abs=1e-9)


def test_a_car_that_never_stood_still_tells_no_bias() -> None:
    with pytest.raises(ValueError, match="never stood still"):
        without_bias(circling(1.0))


@pytest.mark.parametrize(
    "servo",
    [
        ServoConfig(pulse_us=(1000.0, 1530.0, 2000.0), steering_rad=(0.5, 0.0, -0.38)),
        ServoConfig(pulse_us=(1000.0, 1440.0, 2000.0), steering_rad=(-0.38, 0.0, 0.5)),  # turns the other way
    ],
)
@pytest.mark.parametrize("play_deg", [0.0, 2.0])
def test_a_quiet_servo_is_found_exactly(servo: ServoConfig, play_deg: float) -> None:
    config = dataclasses.replace(QUIET, servo=servo, servo_play_rad=play_deg * DEG)
    table = fitted(config)
    assert error_deg(table, config) < 0.12  # the tolerance of leaving points out of the table
    assert table.centre_us == pytest.approx(servo.pulse_us[1], abs=2.0)
    assert table.play_rad == pytest.approx(play_deg * DEG, abs=0.02 * DEG)
    assert (table.pulse_us[0], table.pulse_us[-1]) == (1050.0, 1950.0)
    ServoConfig(pulse_us=table.pulse_us, steering_rad=table.steering_rad)  # car.toml takes it


def test_the_table_ends_where_the_linkage_stops() -> None:
    servo = ServoConfig(pulse_us=(1138.0, 1500.0, 1861.0), steering_rad=(0.4, 0.0, -0.4))
    config = dataclasses.replace(QUIET, servo=servo, servo_play_rad=2.0 * DEG)
    table = fitted(config)
    assert table.pulse_us[0] == pytest.approx(1138.0, abs=3.0)
    assert table.pulse_us[-1] == pytest.approx(1861.0, abs=3.0)
    assert error_deg(table, config) < 0.15


@pytest.mark.parametrize("seed", range(6))
def test_randomised_servos_are_found_within_half_a_degree(seed: int) -> None:
    config, table = hidden(seed)
    assert error_deg(table, config) <= 0.5
    assert table.play_rad == pytest.approx(config.servo_play_rad, abs=0.3 * DEG)
    # it covers what the servo can do within the pulses that were driven
    low, high = max(1050.0, config.servo.pulse_us[0]), min(1950.0, config.servo.pulse_us[-1])
    assert table.pulse_us[0] == pytest.approx(low, abs=25.0)
    assert table.pulse_us[-1] == pytest.approx(high, abs=25.0)


def test_the_deviations_are_those_of_the_errors() -> None:
    errors = []
    for seed in range(6):
        config, table = hidden(seed)
        true = np.interp(table.pulse_us, config.servo.pulse_us, config.servo.steering_rad)
        errors += ((np.array(table.steering_rad) - true) / table.sd_rad).tolist()
    assert 0.4 < float(np.sqrt(np.mean(np.square(errors)))) < 1.8


def test_one_pulse_where_something_caught_is_left_out() -> None:
    config = dataclasses.replace(PlantConfig(), servo_play_rad=2 * DEG)
    log = without_bias(driven(config))
    holds = [h for h in holds_of(log, WHEELBASE_M) if h.pulse_us == 1350.0]
    rates = log.yaw_rate_radps.copy()
    for hold in holds:
        caught = (log.t_ns >= hold.t_ns) & (log.t_ns < hold.t_ns + 900_000_000)
        rates[caught] = 0.0
    table = fit_table(changed(log, yaw_rate_radps=rates), WHEELBASE_M)
    assert 1350.0 in table.strays
    assert error_deg(table, config) <= 0.5


def test_a_servo_that_does_not_answer_is_refused() -> None:
    dead = ServoConfig(pulse_us=(1000.0, 1500.0, 2000.0), steering_rad=(1e-6, 0.0, -1e-6))
    with pytest.raises(ServoError, match=r"does not respond: 1050 \.\. 1950 us turned the wheels by 0\.\d deg; check"):
        fitted(PlantConfig(servo=dead))


def test_a_car_that_does_not_roll_is_refused() -> None:
    log = without_bias(driven(PlantConfig(), DrivePlan((Leg(duration_s=5.0, steering=1500.0, speed_mps=0.0),))))
    with pytest.raises(ServoError, match="expected 6 pulses that were driven for long enough, got 0"):
        fit_table(log, WHEELBASE_M)


def test_wheels_that_turn_back_are_refused() -> None:
    log = without_bias(driven(PlantConfig(servo_play_rad=0.0)))
    bend = np.interp(log.t_ns, log.pulse_t_ns, log.pulse_us)
    folded = np.where(bend > 1700.0, 1700.0 - (bend - 1700.0), bend)  # beyond 1700 us it comes back
    rates = log.speed_mps / WHEELBASE_M * np.tan((1500.0 - folded) * 1e-3)
    with pytest.raises(ServoError, match="turns back around 19"):
        fit_table(changed(log, yaw_rate_radps=rates), WHEELBASE_M)


def test_wheels_that_are_never_straight_are_refused() -> None:
    with pytest.raises(ServoError, match="never straight"):
        fitted(PlantConfig(servo_bias_rad=0.6))


def test_a_sweep_that_was_cut_short_is_refused() -> None:
    plan = servo_plan(1050.0, 1950.0, 0.5)
    with pytest.raises(ServoError, match="too few pulses were reached from both sides"):
        fit_table(without_bias(driven(PlantConfig(), DrivePlan(plan.legs[:14]))), WHEELBASE_M)


def test_the_plan_reaches_every_pulse_from_both_sides_within_the_ends() -> None:
    plan = servo_plan(1100.0, 1900.0, 0.4)
    steering = [leg.steering for leg in plan.legs]
    assert (min(steering), max(steering)) == (1100.0, 1900.0)
    ways: dict[float, set[bool]] = {}
    for before, after in itertools.pairwise(steering):
        ways.setdefault(round(after, 6), set()).add(after > before)
    swept = np.linspace(1100.0, 1900.0, 25).round(6)[1:-1].tolist()
    assert all(ways[pulse] == {True, False} for pulse in swept)
    assert {leg.speed_mps for leg in plan.legs} == {0.0, 0.4}
    assert plan.at(plan.duration_s) is None
    assert plan.at(0.0) == plan.legs[0]


@pytest.mark.parametrize(
    ("column", "values", "said"),
    [
        ("speed_mps", [0.0], "expected the same length"),
        ("pulse_us", [], "expected one for each of 2 times, got 0"),
        ("t_ns", np.zeros(200), "must be rising"),
        ("yaw_rate_radps", np.full(200, np.nan), "finite"),
    ],
)
def test_logs_that_make_no_sense_are_refused(column: str, values: object, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        changed(circling(1.0), **{column: values})
