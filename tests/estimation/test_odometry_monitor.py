"""What lines say against an odometer, by where they lie."""

from __future__ import annotations

import numpy as np
import pytest

from automodel.estimation.odometry_monitor import OdometryMonitor

NODES = np.arange(8)
SIGMA_M = np.full(16, 0.002)
SURE_M = np.zeros(16)  # nothing is uncertain of the lane's predicted place
FOUND = np.ones(8)


def frames_until_broken(residual: np.ndarray, found: np.ndarray = FOUND, frames: int = 60) -> int | None:
    monitor = OdometryMonitor(SIGMA_M, 3)
    return next((k for k in range(frames) if monitor.contradicted(SURE_M, NODES, residual, found)), None)


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
    assert not any(monitor.contradicted(np.full(16, 0.02), NODES, far, FOUND) for _ in range(60))


def test_two_nodes_tell_nothing() -> None:
    assert frames_until_broken(np.full(8, 0.05), np.array([1.0, 1.0, 0, 0, 0, 0, 0, 0])) is None


def test_after_a_contradiction_the_next_frames_are_a_new_case() -> None:
    monitor, far = OdometryMonitor(SIGMA_M, 3), np.full(8, 0.02)
    broken = [monitor.contradicted(SURE_M, NODES, far, FOUND) for _ in range(12)]
    first = broken.index(True)
    assert broken == 12 // (first + 1) * ([False] * first + [True])
