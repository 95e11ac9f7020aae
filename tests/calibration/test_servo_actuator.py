"""Dead time, lag, rate limit: against closed forms, and from drives of a plant."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from automodel.sim.plant import Plant, PlantConfig
from automodel.sim.randomised_plant import randomised_servo
from calibration.actuator import Actuator, fit_actuator, wheel_angles
from calibration.servo import ServoLog, ServoTable, fit_table, without_bias
from tests.support.servo_drives import WHEELBASE_M, changed, driven
from tests.support.slow_lane import rest_slow

MS = 1_000_000


def test_a_step_through_a_lag_is_an_exponential() -> None:
    dt, lag = 0.002, 0.05
    target = np.concatenate(([0.0], np.full(200, 0.3)))
    t = dt * np.arange(1, 201)
    assert wheel_angles(target, dt, lag, 100.0, 0.0)[1:] == pytest.approx(0.3 * (1.0 - np.exp(-t / lag)))


def test_a_step_against_the_rate_limit_is_a_ramp() -> None:
    dt = 0.001
    target = np.concatenate(([0.0], np.full(300, 0.4)))
    t = dt * np.arange(1, 301)
    assert wheel_angles(target, dt, 0.0, 2.0, 0.0)[1:] == pytest.approx(np.minimum(2.0 * t, 0.4))


def test_the_wheels_follow_through_the_gap() -> None:
    target = np.array([0.0, 0.3, 0.29, 0.27, 0.0, -0.3, 0.3])
    wheels = wheel_angles(target, 1.0, 0.0, 100.0, 0.04)
    assert wheels == pytest.approx([0.0, 0.28, 0.28, 0.28, 0.02, -0.28, 0.28])


def test_the_model_is_the_plants() -> None:
    config = PlantConfig(servo_play_rad=0.03, servo_dead_s=0.0, servo_lag_s=0.02, servo_rate_max_radps=5.0)
    plant = Plant(config, start_ns=0)
    pulses = np.repeat(np.random.default_rng(2).uniform(1100, 1900, 20), 100)
    true = []
    for t_ms, pulse in enumerate(pulses.tolist()):
        plant.set_pulses(t_ms * MS, pulse, 0.0)
        true.append(plant.predicted((t_ms + 1) * MS).steering_rad)
    target = np.interp(pulses, config.servo.pulse_us, config.servo.steering_rad)
    model = wheel_angles(np.concatenate(([0.0], target)), 1e-3, 0.02, 5.0, 0.03)[1:]
    assert model == pytest.approx(true, abs=1e-12)


@functools.cache
def fitted(config: PlantConfig) -> tuple[Actuator, ServoLog, ServoTable]:
    log = without_bias(driven(config))
    table = fit_table(log, WHEELBASE_M)
    return fit_actuator(log, table, WHEELBASE_M), log, table


@pytest.mark.parametrize("seed", rest_slow(range(3), 0))
def test_hidden_actuators_are_found(seed: int) -> None:
    config = randomised_servo(seed, PlantConfig(seed=seed))
    found, _, _ = fitted(config)
    assert found.delay_s == pytest.approx(config.servo_dead_s, abs=0.003)
    assert found.lag_s == pytest.approx(config.servo_lag_s, abs=0.003)
    assert found.total_s == pytest.approx(config.servo_dead_s + config.servo_lag_s, abs=0.003)
    assert found.rate_max_radps == pytest.approx(config.servo_rate_max_radps, rel=0.1)
    assert 1e-5 < found.delay_sd_s < 0.002


def test_a_rate_limit_that_was_never_reached_is_not_told() -> None:
    config = PlantConfig(servo_rate_max_radps=90.0, servo_lag_s=0.04, servo_dead_s=0.06)
    found, _, _ = fitted(config)
    assert found.rate_max_radps is None
    assert found.rate_seen_radps > 5.0
    assert found.delay_s == pytest.approx(0.06, abs=0.003)


@pytest.mark.slow
def test_readings_that_are_means_over_a_window_are_taken_for_such() -> None:
    config = randomised_servo(1, PlantConfig(seed=1))
    found, log, table = fitted(config)
    window = 5  # readings, 0.1 s
    smooth = np.convolve(log.yaw_rate_radps, np.full(window, 1 / window), mode="same")
    averaged = fit_actuator(changed(log, yaw_rate_radps=smooth, window_s=window * 0.02), table, WHEELBASE_M)
    assert averaged.delay_s == pytest.approx(found.delay_s, abs=0.004)
    assert averaged.total_s == pytest.approx(found.total_s, abs=0.004)
    blind = fit_actuator(changed(log, yaw_rate_radps=smooth), table, WHEELBASE_M)
    assert abs(blind.delay_s - found.delay_s) > 0.006  # the window is what does it


def test_some_wild_readings_do_no_harm() -> None:
    config = randomised_servo(2, PlantConfig(seed=2))
    _, log, table = fitted(config)
    rates = log.yaw_rate_radps.copy()
    rates[np.random.default_rng(0).choice(len(rates), len(rates) // 50, replace=False)] += 2.0
    found = fit_actuator(changed(log, yaw_rate_radps=rates), table, WHEELBASE_M)
    assert found.delay_s == pytest.approx(config.servo_dead_s, abs=0.005)


def test_a_car_that_hardly_moved_tells_no_delay() -> None:
    _, log, table = fitted(randomised_servo(2, PlantConfig(seed=2)))
    with pytest.raises(ValueError, match="too few to measure"):
        fit_actuator(changed(log, speed_mps=np.zeros(len(log.t_ns))), table, WHEELBASE_M)
