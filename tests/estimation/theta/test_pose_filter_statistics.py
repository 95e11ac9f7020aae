"""The lane-pose filter's claims about itself against many draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from automodel.estimation.theta.pose_filter import LanePoseFilter, predicted_state
from automodel.geometry import SE2
from tests.support.measured_lanes import FILTER, REFERENCE_M, UNIT, point, pose_state


@pytest.mark.parametrize(("lines", "dimensions"), [("LR", 4), ("L", 2), ("R", 2)])
@pytest.mark.parametrize("with_heading", [False, True])
def test_the_innovations_are_as_large_as_the_filter_says(lines: str, dimensions: int, with_heading: bool) -> None:
    """NIS over draws of the filter's own model: within the 95 % bounds of chi-square."""
    rng = np.random.default_rng(10)
    dimensions += with_heading
    runs, steps, total, tests = 40, 20, 0.0, 0
    for _ in range(runs):
        tracker = LanePoseFilter(replace(FILTER, rejected=1e-9))
        start = (0.03, 0.05, 0.02)
        tracker.start(0.02, 0.1, UNIT, sigma=start)
        truth = rng.multivariate_normal(tracker.state, tracker._ekf.P)
        for _ in range(steps):
            motion, kappa = SE2.arc(0.04, rng.normal(0.0, 0.03)), 0.7
            tracker.predict(motion.inverse(), kappa, 0.03)
            reference = np.array((REFERENCE_M, 0.0))
            shift = motion.apply(reference) - reference
            truth, _ = predicted_state(truth, (shift[0], shift[1]), motion.yaw_rad, kappa)
            truth = rng.multivariate_normal(truth, tracker._ekf.Q)
            left = point(truth, 1, rng) if "L" in lines else None
            right = point(truth, -1, rng) if "R" in lines else None
            theta = (truth[0] + rng.normal(0.0, 0.02), 0.02**2) if with_heading else None
            done = tracker.update(left, right, theta)
            assert done.dimensions == dimensions
            total, tests = total + done.nis, tests + done.dimensions
    mean = total / tests
    low, high = chi2.ppf((0.025, 0.975), tests) / tests
    assert low < mean < high


def test_the_errors_are_as_large_as_the_filter_says() -> None:
    """NEES of (offset, heading, width) against the covariance that is published."""
    rng = np.random.default_rng(11)
    total, count = 0.0, 0
    for _ in range(150):
        tracker = LanePoseFilter(replace(FILTER, rejected=1e-9))
        tracker.start(0.0, 0.0, UNIT, sigma=(0.05, 0.05, 0.03))
        truth = rng.multivariate_normal(tracker.state, tracker._ekf.P)
        for step in range(12):
            tracker.predict(SE2.arc(0.04, 0.02).inverse(), 0.5, 0.03)
            shift = SE2.arc(0.04, 0.02).apply((REFERENCE_M, 0.0)) - np.array((REFERENCE_M, 0.0))
            truth = rng.multivariate_normal(predicted_state(truth, (shift[0], shift[1]), 0.02, 0.5)[0], tracker._ekf.Q)
            seen = "LR" if step < 4 else "L"
            tracker.update(point(truth, 1, rng), point(truth, -1, rng) if seen == "LR" else None)
        pose = np.array((0.5 * truth[1] * truth[2], -truth[0], truth[2]))
        error = pose - (tracker.offset_m, tracker.heading_rad, tracker.width_m)
        total += float(error @ np.linalg.solve(tracker.covariance, error))
        count += 3
    low, high = chi2.ppf((0.025, 0.975), count) / count
    assert low < total / count < high


def test_the_gate_passes_the_share_that_it_is_set_to() -> None:
    rng, tracker = np.random.default_rng(12), LanePoseFilter(replace(FILTER, rejected=0.1))
    passed, tries = {0: 0, 1: 0}, 3000
    for _ in range(tries):
        tracker.start(0.0, 0.0, UNIT, sigma=(0.02, 0.02, 0.01))
        truth = rng.multivariate_normal(tracker.state, tracker._ekf.P)
        done = tracker.update(point(truth, 1, rng), None, (truth[0] + rng.normal(0.0, 0.02), 0.02**2))
        passed[0] += done.left
        passed[1] += done.heading
    assert passed[0] / tries == pytest.approx(0.9, abs=0.02)
    assert passed[1] / tries == pytest.approx(0.9, abs=0.02)


def test_the_published_covariance_is_that_of_draws() -> None:
    rng = np.random.default_rng(13)
    tracker = LanePoseFilter(FILTER)
    tracker.start(0.08, -0.3, 0.42, sigma=(0.02, 0.02, 0.02))
    tracker.update(point(tracker.state, 1), None)
    tracker.predict(SE2.arc(0.3, 0.2).inverse(), 0.5, 0.1)  # so that offset and heading err together
    drawn = rng.multivariate_normal(tracker.state, tracker._ekf.P, 40_000)
    poses = np.column_stack((0.5 * drawn[:, 1] * drawn[:, 2], -drawn[:, 0], drawn[:, 2]))
    wanted = np.cov(poses.T)
    scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    np.testing.assert_allclose(tracker.covariance / scale, wanted / scale, atol=0.03)
    assert abs(wanted[0, 1] / scale[0, 1]) > 0.3


def test_the_covariance_stays_positive() -> None:
    rng = np.random.default_rng(14)
    tracker = LanePoseFilter(FILTER)
    for _ in range(3000):
        tracker.predict(SE2.arc(rng.normal(0.0, 0.05), rng.normal(0.0, 0.1)), rng.normal(0.0, 3.0), 0.02)
        sigma = 10.0 ** rng.uniform(-7, 0)
        truth = pose_state(*rng.normal(0.0, (0.2, 0.5)))
        lines = [point(truth, side, rng, sigma) if rng.random() < 0.6 else None for side in (1, -1)]
        theta = (rng.normal(0.0, 2.0), 10.0 ** rng.uniform(-8, 0)) if rng.random() < 0.3 else None
        tracker.update(lines[0], lines[1], theta)
        covariance = tracker.covariance
        np.testing.assert_array_equal(tracker._ekf.P, tracker._ekf.P.T)
        assert np.linalg.eigvalsh(tracker._ekf.P).min() > 0.0
        assert np.isfinite(covariance).all()
        assert np.isfinite(tracker.state).all()
        assert 0.4 * UNIT <= tracker.width_m <= 2.5 * UNIT
