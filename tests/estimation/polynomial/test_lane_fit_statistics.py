"""What the lane's fit makes of noise, outliers, priors and bearings."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from automodel.estimation.polynomial.lane_fit import LaneFit, LaneFitConfig, LineSamples
from tests.support.fitted_lanes import FIT, LANES, REFERENCE_M, S0, WIDTH_M, loose_prior, samples_of, true_parameters
from tests.support.world_lanes import WorldLane


def test_a_third_of_the_points_may_lie() -> None:
    rng = np.random.default_rng(11)
    for name, lane in LANES.items():
        clean = samples_of(lane, lane.car(S0, 0.04, 0.1, REFERENCE_M))
        wrong = rng.permutation(len(clean.side)) < int(0.3 * len(clean.side))
        off = rng.choice((-1.0, 1.0), len(wrong)) * rng.uniform(0.06, 0.16, len(wrong)) * wrong
        s = np.tile(np.linspace(S0 - 0.4, S0 + 1.4, 20), 2)
        car = lane.car(S0, 0.04, 0.1, REFERENCE_M)
        pairs = zip(s, clean.side * 0.2 + off, strict=True)
        points = car.inverse().apply([lane.beside(at, lateral) for at, lateral in pairs])
        prior = loose_prior(FIT, true_parameters(FIT, lane, S0, 0.045, 0.08))
        sigma = np.concatenate(([0.01, 0.02], np.full(len(FIT.nodes_m), 0.3), [0.004, 0.003]))
        found = FIT.solve(clean._replace(points_m=points), replace(prior, sigma=sigma), rounds=8)
        assert found.offset_m == pytest.approx(0.04, abs=0.003), name
        assert found.heading_rad == pytest.approx(0.1, abs=math.radians(1.0)), name
        assert (found.inliers & wrong).sum() <= 2, name  # at the far end nothing contradicts one
        assert (~found.inliers & ~wrong).sum() <= 2, name


def enlarged(curvature: Callable[[np.ndarray], np.ndarray], factor: float) -> Callable[[np.ndarray], np.ndarray]:
    """The curvature of the same road, `factor` times as long."""
    return lambda s_m: curvature(s_m / factor) / factor


@pytest.mark.parametrize("name", ["straight", "left", "clothoid"])
def test_lane_widths_are_the_unit_of_length(name: str) -> None:
    results = []
    for unit in (0.4, 3.7):
        fit = LaneFit(LaneFitConfig(lane_width_m=unit, reference_x_m=0.3 * unit))
        lane = WorldLane(enlarged(LANES[name].curvature, unit / WIDTH_M), 25.0 * unit, unit)
        s0, s = S0 / WIDTH_M * unit, np.linspace(-1.0, 3.5, 15) * unit
        car = lane.car(s0, 0.11 * unit, -0.2, 0.3 * unit)
        points = np.concatenate([lane.seen_from(car, s0 + s, side) for side in (+1, -1)])
        points += np.random.default_rng(1).normal(0.0, 0.01, points.shape) * unit
        samples = LineSamples(
            points_m=points, side=np.repeat((1.0, -1.0), len(s)), sigma_m=np.full(len(points), 0.01 * unit)
        )
        found = fit.solve(samples, loose_prior(fit, fit.start(0.0, 0.0, 0.0, unit)), rounds=6)
        p = found.parameters
        covariance = fit.covariance(found) / np.outer((unit, 1.0, unit), (unit, 1.0, unit))
        results.append((np.concatenate(([p[0] / unit, p[1]], p[2:-2] * unit, [p[-2] / unit])), covariance))
    # the iteration may stop at another step
    np.testing.assert_allclose(results[0][0][[0, 1, -1]], results[1][0][[0, 1, -1]], atol=1.5e-3)
    np.testing.assert_allclose(results[0][0][2:-1], results[1][0][2:-1], atol=0.03)
    np.testing.assert_allclose(np.diag(results[0][1]), np.diag(results[1][1]), rtol=0.1)


def test_the_covariance_tells_the_spread() -> None:
    rng = np.random.default_rng(17)
    lane = LANES["left"]
    clean = samples_of(lane, lane.car(S0, 0.02, 0.1, REFERENCE_M), sigma_m=0.003, from_m=0.25)
    prior = loose_prior(FIT, true_parameters(FIT, lane, S0, 0.02, 0.1))
    found = []
    for _ in range(150):
        noisy = clean._replace(points_m=clean.points_m + rng.normal(0.0, 0.003, clean.points_m.shape))
        solution = FIT.solve(noisy, prior, rounds=4)
        found.append((solution.offset_m, solution.heading_rad, solution.width_m))
    claimed, spread = FIT.covariance(solution), np.cov(np.array(found).T)
    ratio = np.sqrt(np.diag(claimed) / np.diag(spread))
    assert ((ratio > 0.7) & (ratio < 3.0)).all(), ratio  # with the prior's variance
    correlations = (
        claimed[0, 1] / np.sqrt(claimed[0, 0] * claimed[1, 1]),
        spread[0, 1] / np.sqrt(spread[0, 0] * spread[1, 1]),
    )
    assert abs(correlations[1]) > 0.5  # all points lie ahead: turning the lane shifts it at the car
    assert correlations[0] == pytest.approx(correlations[1], abs=0.3)
    np.testing.assert_allclose(claimed, claimed.T, atol=1e-15)
    assert (np.linalg.eigvalsh(claimed) > 0).all()


def test_the_fit_is_unbiased_under_noise() -> None:
    rng = np.random.default_rng(23)
    lane = LANES["right"]
    clean = samples_of(lane, lane.car(S0, -0.05, 0.2, REFERENCE_M), sigma_m=0.003)
    prior = loose_prior(FIT, FIT.start(0.0, -0.2, 0.0, WIDTH_M))
    errors = []
    for _ in range(60):
        noisy = clean._replace(points_m=clean.points_m + rng.normal(0.0, 0.003, clean.points_m.shape))
        solution = FIT.solve(noisy, prior, rounds=6)
        errors.append((solution.offset_m + 0.05, solution.heading_rad - 0.2, solution.width_m - WIDTH_M))
    assert (np.abs(np.mean(errors, axis=0)) < (0.0007, math.radians(0.25), 0.0007)).all()


NOTHING = LineSamples(points_m=np.empty((0, 2)), side=np.empty(0), sigma_m=np.empty(0))


def test_without_points_the_prior_stays() -> None:
    straight = FIT.start(0.05, -0.1, 0.6, 0.41)  # of even curvature: nothing to smooth
    found = FIT.solve(NOTHING, loose_prior(FIT, straight))
    np.testing.assert_allclose(found.parameters, straight, atol=1e-9)
    assert found.offset_m == pytest.approx(0.05)
    assert found.heading_rad == pytest.approx(0.1)
    assert found.width_m == pytest.approx(0.41)
