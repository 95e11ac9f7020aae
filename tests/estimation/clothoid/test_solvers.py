"""Both solvers against the minimum of the cost that they share, found without them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from automodel.estimation.clothoid.solvers import SOLVERS, gauss_newton, gradient_descent, posterior
from automodel.geometry.elimination import solve
from automodel.types import FloatArray

SCALES = np.array([0.02, 0.3, 1.0, 5.0])  # sigmas of very different units


def problem(seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Information of six measurements (4, 4), their pull (4,), and a correlated prior covariance (4, 4)."""
    rng = np.random.default_rng(seed)
    rows, values = rng.normal(size=(6, 4)) / SCALES, rng.normal(size=6)
    mixed = np.eye(4) + 0.3 * rng.normal(size=(4, 4))
    return rows.T @ rows, rows.T @ values, mixed @ mixed.T * np.outer(SCALES, SCALES)


def least(information: FloatArray, pull: FloatArray, covariance: FloatArray) -> FloatArray:
    """Where the gradient of the cost is zero, by least squares over the stacked square roots of both terms."""
    white = np.linalg.solve(np.linalg.cholesky(covariance), np.eye(4))
    root = np.linalg.cholesky(information).T
    aim = np.linalg.solve(root.T, pull)
    stacked, wanted = np.concatenate((white, root)), np.concatenate((np.zeros(4), aim))
    return np.asarray(np.linalg.lstsq(stacked, wanted, rcond=None)[0])


@pytest.mark.parametrize("solver", sorted(SOLVERS))
@pytest.mark.parametrize("seed", range(4))
def test_each_solver_reaches_the_least_cost(solver: str, seed: int) -> None:
    information, pull, covariance = problem(seed)
    found, after, count = SOLVERS[solver](information, pull, covariance)
    assert found / SCALES == pytest.approx(least(information, pull, covariance) / SCALES, abs=2e-3)
    assert after == pytest.approx(posterior(information, covariance))
    assert count >= 1


def test_gauss_newton_needs_one_step_and_gradient_descent_many() -> None:
    parts = problem(1)
    assert gauss_newton(*parts)[2] == 1
    assert gradient_descent(*parts)[2] > 10


def test_gradient_descent_stops_after_the_most_steps() -> None:
    information, pull, covariance = problem(1)
    found, _, count = gradient_descent(information, pull, covariance, 3)
    assert count == 3

    def cost(x: NDArray[np.floating[Any]]) -> float:
        return float(0.5 * x @ (np.linalg.solve(covariance, x) + information @ x) - x @ pull)

    assert cost(least(information, pull, covariance)) < cost(found) < 0.0  # on the way down, not there yet


def test_the_posterior_is_what_scalar_updates_one_by_one_give() -> None:
    rng = np.random.default_rng(5)
    rows, variances = rng.normal(size=(6, 4)) / SCALES, rng.uniform(0.1, 2.0, 6)
    prior = problem(5)[2]
    wanted = prior.copy()
    for row, variance in zip(rows, variances, strict=True):
        gain = wanted @ row / (row @ wanted @ row + variance)
        keep = np.eye(4) - np.outer(gain, row)
        wanted = keep @ wanted @ keep.T + variance * np.outer(gain, gain)
    found = posterior((rows / variances[:, None]).T @ rows, prior)
    units = np.outer(SCALES, SCALES)
    assert found / units == pytest.approx(wanted / units, abs=1e-9)
    assert np.array_equal(found, found.T)


def test_what_is_known_for_sure_is_not_moved() -> None:
    information, pull, covariance = problem(2)
    covariance[2, :] = covariance[:, 2] = 0.0
    found, after, _ = gauss_newton(information, pull, covariance)
    assert found[2] == pytest.approx(0.0, abs=1e-12)
    assert after[2] == pytest.approx(np.zeros(4), abs=1e-12)
    assert np.abs(found[[0, 1, 3]]).min() > 0.0


@pytest.mark.parametrize("solver", sorted(SOLVERS))
def test_nothing_measured_leaves_the_prior(solver: str) -> None:
    covariance = problem(3)[2]
    found, after, _ = SOLVERS[solver](np.zeros((4, 4)), np.zeros(4), covariance)
    assert not found.any()
    assert after == pytest.approx(covariance)


def test_elimination_swaps_rows_where_it_must() -> None:
    matrix = np.array([[0.0, 2.0, 1.0], [1e-9, 1.0, 0.0], [3.0, 0.0, -1.0]])
    wanted = np.arange(6.0).reshape(3, 2) - 2.0
    assert solve(matrix.copy(), matrix @ wanted) == pytest.approx(wanted)
