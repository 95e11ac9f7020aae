"""The batch form against the paper's recursion, the change of origin against a new fit, priors, and bad numbers."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from automodel.estimation.theta.theta_rls import ThetaRls
from automodel.geometry import SE2
from tests.support.measured_lanes import REFERENCE_M, RLS, UNIT

FREE = replace(RLS, prior_rad=math.inf)  # the paper's: no prior
STILL = SE2()


def paper_recursion(w: np.ndarray, r: np.ndarray, mu: float, s: np.ndarray, theta: np.ndarray):
    """Eq. (8)-(13), point by point, in the paper's order of powers."""
    for i, (si, ti) in enumerate(zip(s, theta, strict=True)):
        m = mu if i == 0 else 1.0
        phi = np.array((si**3, si**2, si, 1.0))
        error = ti - w @ phi
        r_tilde = 1.0 / (1.0 + phi @ r @ phi / m)
        r = (r - np.outer(r @ phi, phi @ r) * r_tilde / m) / m
        w = w + error * (r @ phi)
    return w, r


def test_the_batch_is_the_papers_recursion() -> None:
    rng = np.random.default_rng(0)
    rls = ThetaRls(replace(FREE, memory_lanes=0.5))
    scale = rls.scale_m ** np.arange(4)
    s = rng.uniform(-0.5, 1.5, 12)
    rls.start(s, rng.normal(0.0, 0.3, 12), np.ones(12), 0.2, 1e-4)
    assert rls.line is not None
    w = (np.array(rls.line.coefficients_rad) / scale)[::-1]
    r = np.linalg.pinv((rls.information / np.outer(1.0 / scale, 1.0 / scale))[::-1, ::-1])
    for step in range(25):
        dt = (0.03, 0.1, 0.0)[step % 3]
        s = rng.uniform(-0.5, 1.5, int(rng.integers(1, 15)))
        theta = 0.2 + 0.5 * s - 0.1 * s**3 + rng.normal(0.0, 0.1, len(s))
        w, r = paper_recursion(w, r, math.exp(-dt / 0.5), s, theta)
        rls.predict(STILL, 0.0, dt)
        rls.update(s, theta, np.ones(len(s)))
        assert rls.line is not None
        np.testing.assert_allclose(np.array(rls.line.coefficients_rad) / scale, w[::-1], rtol=0, atol=1e-9)
        information = (rls.information * np.outer(scale, scale))[::-1, ::-1]
        np.testing.assert_allclose(information @ r, np.eye(4), atol=1e-6)


def test_weights_count_as_repeated_points() -> None:
    rng = np.random.default_rng(1)
    s, theta, times = rng.uniform(-0.5, 1.0, 15), rng.normal(0.0, 0.2, 15), rng.integers(1, 5, 15)
    weighted, repeated = ThetaRls(RLS), ThetaRls(RLS)
    weighted.start(s, theta, times.astype(float), 0.2, 1e-4)
    repeated.start(np.repeat(s, times), np.repeat(theta, times), np.ones(times.sum()), 0.2, 1e-4)
    assert weighted.line is not None
    assert repeated.line is not None
    np.testing.assert_allclose(weighted.line.coefficients_rad, repeated.line.coefficients_rad, atol=1e-10)


@pytest.mark.parametrize("motion", [SE2.arc(0.12, 0.05), SE2.arc(0.3, -0.2), SE2.arc(-0.1, 0.0), SE2.arc(0.0, 0.4)])
def test_the_moved_model_is_that_of_moved_points(motion: SE2) -> None:
    """Moved and then fitted, or fitted and then moved: the same coefficients, and the same information."""
    rng = np.random.default_rng(2)
    s = np.linspace(-0.6, 1.6, 40)
    theta, weight = 0.1 + 0.6 * s - 0.2 * s**2 + 0.05 * s**3, rng.uniform(1.0, 5.0, 40)
    moved = ThetaRls(replace(FREE, memory_lanes=1e9))
    moved.start(s, theta, weight, 0.2, 1e-4)
    assert moved.line is not None
    before = moved.line
    moved.predict(motion.inverse(), math.hypot(motion.x_m, motion.y_m), 0.0)
    after = moved.line
    # how far the origin went: the old line's foot of the new reference point
    advance = before.foot(tuple(motion.apply((REFERENCE_M, 0.0)).tolist()))[0]
    again = ThetaRls(FREE)
    again.start(s - advance, theta - motion.yaw_rad, weight, 0.2, 1e-4)
    assert again.line is not None
    np.testing.assert_allclose(after.coefficients_rad, again.line.coefficients_rad, atol=1e-6)
    np.testing.assert_allclose(moved.information, again.information, rtol=1e-6, atol=1e-4)
    assert np.linalg.eigvalsh(moved.information).min() > 0.0
    assert (after.s_min_m, after.s_max_m) == pytest.approx((-0.6 - advance, 1.6 - advance))


def test_a_far_sight_is_no_trouble() -> None:
    """Points over fourteen lane widths, as on a highway: the powers of s stay in proportion."""
    s = np.linspace(-2.0, 14.0, 120) * UNIT
    theta = 0.1 + 0.05 * s + 0.01 * s**2 - 0.0008 * s**3
    rls = ThetaRls(FREE)
    rls.start(s, theta, 1.0 / (1.0 + s**2), 0.2, 1e-4)
    for _ in range(200):
        rls.predict(STILL, 0.0, 0.02)
        rls.update(s, theta, 1.0 / (1.0 + s**2))
    assert rls.line is not None
    np.testing.assert_allclose(rls.line.heading(s), theta, atol=1e-6)


def test_directions_may_be_off_by_whole_turns() -> None:
    s = np.linspace(-0.4, 1.2, 30)
    theta = 3.0 + 0.5 * s
    plain, turned = ThetaRls(RLS), ThetaRls(RLS)
    for rls, turns in ((plain, (0, 0, 0)), (turned, (0, 1, -2))):
        for k in turns:
            if rls.line is None:
                rls.start(s, theta, np.ones(30), 0.2, 1e-4)
            rls.update(s, theta + k * math.tau, np.ones(30))
    assert plain.line is not None
    assert turned.line is not None
    np.testing.assert_allclose(turned.line.coefficients_rad, plain.line.coefficients_rad, atol=1e-9)


def test_few_points_bend_nothing() -> None:
    """A short piece with noise: the prior keeps the far end from running away."""
    rng = np.random.default_rng(8)
    s = np.linspace(0.0, 0.15, 6)
    held, free = ThetaRls(RLS), ThetaRls(FREE)
    theta = 0.1 + rng.normal(0.0, 0.02, 6)
    for rls in (held, free):
        rls.start(s, theta, np.full(6, 2500.0), 0.2, 1e-4)
    assert held.line is not None
    assert free.line is not None
    assert max(abs(w) for w in held.line.coefficients_rad[1:]) < 0.5
    assert max(abs(w) for w in free.line.coefficients_rad[1:]) > 5.0


def test_with_the_prior_it_is_ridge_regression_on_all_points() -> None:
    """Not on each frame's: the prior counts once, however many frames there are."""
    rng = np.random.default_rng(3)
    rls = ThetaRls(replace(RLS, memory_lanes=1e9))
    every_phi, every_theta = [], []
    for frame in range(6):
        s = rng.uniform(0.0, 0.5, 8)
        theta = 0.2 + 0.9 * s + rng.normal(0.0, 0.05, 8)
        if frame == 0:
            rls.start(s, theta, np.full(8, 4.0), 0.2, 1e-4)
        else:
            rls.update(s, theta, np.full(8, 4.0))
        every_phi.append(np.vander(s / rls.scale_m, 4, increasing=True))
        every_theta.append(theta)
    prior = np.diag([0.0, 1.0, 1.0, 1.0]) / RLS.prior_rad
    rows = np.vstack((2.0 * np.concatenate(every_phi), prior))
    wanted = np.concatenate((2.0 * np.concatenate(every_theta), np.zeros(4)))
    assert rls.line is not None
    np.testing.assert_allclose(rls.line.coefficients_rad, np.linalg.lstsq(rows, wanted, rcond=None)[0], atol=1e-8)


def numbers(rls: ThetaRls) -> np.ndarray:
    assert rls.line is not None
    s = np.linspace(-1.0, 2.0, 9)
    return np.concatenate(
        (
            rls.line.points(s).reshape(-1),
            rls.line.heading(s),
            rls.samples(s)[1],
            [rls.line.lateral_m, rls.lateral_variance_m2],
        )
    )


def test_one_point_is_enough_and_none_is_no_trouble() -> None:
    rls = ThetaRls(RLS)
    none = np.empty(0)
    rls.update(none, none, none, 0.2, 1e-4)
    rls.predict(STILL, 0.1, 0.1)
    assert rls.line is None
    rls.start(none, none, none, 0.2, 1e-4)
    assert rls.line is None
    rls.start(np.array((0.3,)), np.array((0.2,)), np.ones(1), 0.2, 1e-4)
    assert rls.line is not None
    assert rls.line.heading_at(0.0) == pytest.approx(0.2, abs=0.05)
    assert np.isfinite(numbers(rls)).all()
    for _ in range(400):
        rls.predict(SE2.arc(0.1, 0.05).inverse(), 0.1, 0.1)
        rls.update(none, none, none)
    assert np.isfinite(numbers(rls)).all()
    rls.forget()
    assert rls.line is None


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_change_nothing(bad: float) -> None:
    rls = ThetaRls(RLS)
    s = np.linspace(-0.4, 1.2, 20)
    rls.start(s, 0.4 * s, np.ones(20), 0.2, 1e-4)
    before = numbers(rls)
    spoilt = s.copy()
    spoilt[7] = bad
    rls.update(spoilt, 0.4 * s, np.ones(20))
    rls.update(s, spoilt, np.ones(20))
    rls.update(s, 0.4 * s, spoilt)
    rls.update(s[:0], s[:0], s[:0], bad, 1e-4)
    rls.update(s[:0], s[:0], s[:0], 0.3, bad)
    rls.predict(SE2(bad, 0.0, 0.0), 0.1, 0.1)
    rls.predict(SE2(), bad, 0.1)
    np.testing.assert_array_equal(numbers(rls), before)
    rls.start(spoilt, s, np.ones(20), 0.2, 1e-4)
    assert rls.line is None


@pytest.mark.parametrize("field", ["lane_width_m", "scale_lanes", "memory_lanes", "model_rad"])
def test_scales_must_be_positive(field: str) -> None:
    wrong: dict[str, Any] = {field: 0.0}
    with pytest.raises(ValueError, match="positive"):
        replace(RLS, **wrong)


def test_samples_need_a_line() -> None:
    with pytest.raises(ValueError, match="start"):
        ThetaRls(RLS).samples(np.zeros(3))
