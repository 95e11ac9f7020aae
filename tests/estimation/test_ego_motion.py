from __future__ import annotations

import math
import random
from dataclasses import replace

import pytest

from automodel.config import VehicleConfig
from automodel.estimation.ego_motion import MIN_READINGS, MotionEstimator
from automodel.signals import Command, MotionSource, VehicleState

MS = 1_000_000
CAR = VehicleConfig()
COMMAND = Command(t_ns=0, steering_rad=0.2, speed_mps=1.0, valid_until_ns=10**12)
STOP = replace(COMMAND, speed_mps=0.0)
MOVING = VehicleState(t_ns=0, speed_mps=0.8, steering_rad=0.1, yaw_rate_radps=0.7)


def stand(estimator: MotionEstimator, t_ns: int, bias: float, states: int = 60, noise: float = 0.0) -> int:
    """Standing still with a gyro of this bias, 20 ms a state; the time after it."""
    dice = random.Random(2)
    for _ in range(states):
        rate = bias + dice.gauss(0.0, noise)
        estimator.step(VehicleState(t_ns=t_ns, speed_mps=0.0, steering_rad=0.0, yaw_rate_radps=rate), STOP, t_ns)
        t_ns += 20 * MS
    return t_ns


def test_until_the_bias_is_known_the_bicycle_model_gives_the_yaw_rate() -> None:
    motion = MotionEstimator(CAR).step(MOVING, COMMAND, 100 * MS)
    assert motion.source is MotionSource.MODEL
    assert motion.t_ns == 100 * MS
    assert motion.speed_mps == 0.8
    assert motion.yaw_rate_radps == pytest.approx(0.8 * math.tan(0.1) / 0.26)


def test_gyro_without_its_bias_once_that_is_known() -> None:
    estimator = MotionEstimator(CAR)
    t_ns = stand(estimator, 0, 0.05, states=400, noise=0.01)
    assert estimator.bias_radps == pytest.approx(0.05, abs=4 * 0.01 / math.sqrt(380))
    motion = estimator.step(replace(MOVING, t_ns=t_ns), COMMAND, t_ns)
    assert motion.source is MotionSource.MEASURED
    assert motion.yaw_rate_radps == pytest.approx(0.65, abs=0.003)
    assert motion.speed_mps == 0.8


def test_bias_is_learned_only_at_rest_and_after_a_while() -> None:
    estimator = MotionEstimator(CAR)
    stand(estimator, 0, 0.05, states=15 + MIN_READINGS - 1)  # 15 states of settling
    assert estimator.bias_radps is None
    stand(estimator, (15 + MIN_READINGS - 1) * 20 * MS, 0.05, states=1)
    assert estimator.bias_radps == pytest.approx(0.05)
    moving = MotionEstimator(CAR)
    for k in range(100):
        moving.step(replace(MOVING, t_ns=k * 20 * MS), COMMAND, k * 20 * MS)
    assert moving.bias_radps is None
    pushed = MotionEstimator(CAR)  # no tick yet, but commanded to drive
    for k in range(100):
        pushed.step(replace(MOVING, t_ns=k * 20 * MS, speed_mps=0.0), COMMAND, k * 20 * MS)
    assert pushed.bias_radps is None


def test_a_car_that_is_carried_spoils_no_bias() -> None:
    estimator = MotionEstimator(CAR)
    t_ns = stand(estimator, 0, 0.05)
    t_ns = stand(estimator, t_ns, 2.0)
    t_ns = stand(estimator, t_ns, 0.05)
    assert estimator.bias_radps == pytest.approx(0.05)


def test_a_state_counts_once_for_the_bias() -> None:
    estimator = MotionEstimator(CAR)
    t_ns = stand(estimator, 0, 0.05, states=17)
    for _ in range(50):
        estimator.step(VehicleState(t_ns=t_ns, speed_mps=0.0, yaw_rate_radps=0.05), STOP, t_ns)
    assert estimator.bias_radps is None


def test_a_drifting_bias_is_followed() -> None:
    estimator = MotionEstimator(CAR)
    t_ns = stand(estimator, 0, 0.05, states=1000)
    stand(estimator, t_ns, 0.02, states=3000)
    assert estimator.bias_radps == pytest.approx(0.02, abs=1e-3)


def test_a_state_older_than_200_ms_counts_as_absent() -> None:
    estimator = MotionEstimator(CAR)
    assert estimator.step(MOVING, COMMAND, 200 * MS).source is MotionSource.MODEL
    motion = estimator.step(MOVING, COMMAND, 200 * MS + 1)
    assert motion.source is MotionSource.COMMAND
    assert motion.speed_mps == 1.0
    assert motion.yaw_rate_radps == pytest.approx(math.tan(0.2) / 0.26)


def test_command_fills_in_what_the_vehicle_does_not_say() -> None:
    estimator = MotionEstimator(CAR)
    no_speed = estimator.step(VehicleState(t_ns=0, steering_rad=0.1), COMMAND, 0)
    assert no_speed.source is MotionSource.COMMAND
    assert no_speed.yaw_rate_radps == pytest.approx(1.0 * math.tan(0.1) / 0.26)
    no_steering = estimator.step(VehicleState(t_ns=0, speed_mps=0.5), COMMAND, 0)
    assert no_steering.source is MotionSource.COMMAND
    assert no_steering.speed_mps == 0.5
    assert no_steering.yaw_rate_radps == pytest.approx(0.5 * math.tan(0.2) / 0.26)


def test_an_expired_command_drives_nothing() -> None:
    motion = MotionEstimator(CAR).step(None, replace(COMMAND, valid_until_ns=5), 6)
    assert (motion.speed_mps, motion.yaw_rate_radps, motion.source) == (0.0, 0.0, MotionSource.COMMAND)


def test_nothing_known_says_so() -> None:
    motion = MotionEstimator(CAR).step(None, None, 7)
    assert (motion.t_ns, motion.source, motion.known) == (7, MotionSource.NONE, False)
    unsteered = MotionEstimator(CAR).step(VehicleState(t_ns=0, speed_mps=1.0), None, 0)
    assert not unsteered.known


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_values_that_are_not_finite_count_as_absent(bad: float) -> None:
    estimator = MotionEstimator(CAR)
    state = VehicleState(t_ns=0, speed_mps=bad, yaw_rate_radps=bad, steering_rad=bad)
    motion = estimator.step(state, COMMAND, 0)
    assert (motion.speed_mps, motion.source) == (1.0, MotionSource.COMMAND)
    assert math.isfinite(motion.yaw_rate_radps)
    none = estimator.step(state, replace(COMMAND, speed_mps=bad), 0)
    assert not none.known


def test_reset_forgets_the_bias() -> None:
    estimator = MotionEstimator(CAR)
    stand(estimator, 0, 0.05)
    assert estimator.bias_radps is not None
    estimator.reset()
    assert estimator.bias_radps is None
