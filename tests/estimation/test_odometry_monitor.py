"""Trust in an odometer, by where lines lie."""

from __future__ import annotations

import numpy as np
import pytest

from automodel.estimation.odometry_monitor import OdometryMonitor

NODES = np.arange(8)
PERIOD_NS = 33_333_333
SIGMA_M = np.full(16, 0.002)
SURE_M = np.zeros(16)  # nothing is uncertain of the lane's predicted place
FOUND = np.ones(8)


def frames_until_broken(residual: np.ndarray, found: np.ndarray = FOUND, frames: int = 60) -> int | None:
    monitor = OdometryMonitor(SIGMA_M, 3)
    return next((k for k in range(frames) if monitor.rejects(k * PERIOD_NS, SURE_M, NODES, residual, found)), None)


@pytest.mark.parametrize("sigmas", [0.0, 1.0, 1.5])
def test_lines_about_where_they_are_expected_keep_it(sigmas: float) -> None:
    residual = sigmas * 0.002 * np.random.default_rng(0).choice([-1.0, 1.0], 8)
    assert frames_until_broken(residual) is None


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_lines_far_off_break_it_but_not_in_one_frame(sign: float) -> None:
    broken = frames_until_broken(np.full(8, sign * 0.02))
    assert broken is not None
    assert 1 <= broken <= 3


@pytest.mark.parametrize("off", [3, 4])
def test_half_of_the_nodes_on_another_line_do_not(off: int) -> None:
    residual = np.full(8, 0.001)
    residual[8 - off :] = 0.05
    assert frames_until_broken(residual) is None


def test_lines_far_off_a_place_that_was_uncertain_do_not() -> None:
    monitor, far = OdometryMonitor(SIGMA_M, 3), np.full(8, 0.02)
    assert not any(monitor.rejects(k * PERIOD_NS, np.full(16, 0.02), NODES, far, FOUND) for k in range(60))


def test_two_nodes_tell_nothing() -> None:
    assert frames_until_broken(np.full(8, 0.05), np.array([1.0, 1.0, 0, 0, 0, 0, 0, 0])) is None


def test_it_gets_another_chance() -> None:
    monitor, far = OdometryMonitor(SIGMA_M, 3), np.full(8, 0.02)
    first = next(k for k in range(9) if monitor.rejects(k * PERIOD_NS, SURE_M, NODES, far, FOUND))
    t_ns = first * PERIOD_NS
    assert not monitor.trusted(t_ns + PERIOD_NS)
    assert not monitor.trusted(t_ns + OdometryMonitor.RETRY_NS - 1)
    assert monitor.trusted(t_ns + OdometryMonitor.RETRY_NS)
    again = next(k for k in range(9) if monitor.rejects(10**11 + k * PERIOD_NS, SURE_M, NODES, far, FOUND))
    assert again == first


@pytest.mark.parametrize("jump_ns", [-1, -(10**12), 10**12])
def test_time_that_jumps_gives_another_chance(jump_ns: int) -> None:
    monitor, far = OdometryMonitor(SIGMA_M, 3), np.full(8, 0.02)
    while not monitor.rejects(10**13, SURE_M, NODES, far, FOUND):
        pass
    assert not monitor.trusted(10**13)
    assert monitor.trusted(10**13 + jump_ns)
