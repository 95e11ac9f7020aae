"""The regression against numpy's own, which uses another method (singular values of the design matrix)."""

from __future__ import annotations

import numpy as np
import pytest

from automodel.curves.regression import fit_polynomial, shift_polynomial


def test_agrees_with_polyfit() -> None:
    rng = np.random.default_rng(0)
    for degree in (0, 1, 2, 3):
        x, y = rng.uniform(-0.5, 2.0, 30), rng.normal(size=30)
        np.testing.assert_allclose(fit_polynomial(x, y, degree), np.polyfit(x, y, degree)[::-1], rtol=1e-7, atol=1e-8)


def test_weights_count_as_repeated_points() -> None:
    rng = np.random.default_rng(1)
    x, y, times = rng.uniform(0.0, 1.0, 12), rng.normal(size=12), rng.integers(0, 4, 12)
    weighted = fit_polynomial(x, y, 2, times)
    repeated = np.polyfit(np.repeat(x, times), np.repeat(y, times), 2)[::-1]
    np.testing.assert_allclose(weighted, repeated, rtol=1e-7)


def test_raw_rows_far_from_zero_are_no_trouble() -> None:
    rows = np.arange(1000.0, 1301.0, 3.0)
    column = 320.0 - 0.4 * (rows - 1150.0) + 2e-3 * (rows - 1150.0) ** 2
    fitted = fit_polynomial(rows, column, 2)
    np.testing.assert_allclose(np.polynomial.polynomial.polyval(rows, fitted), column, atol=1e-6)
    np.testing.assert_allclose(fitted, (320.0 + 0.4 * 1150.0 + 2e-3 * 1150.0**2, -0.4 - 4.6, 2e-3), rtol=1e-8)


@pytest.mark.parametrize(
    ("x", "y", "coefficients"),
    [
        ([0.7], [2.5], [2.5]),
        ([0.7, 0.7], [2.0, 3.0], [2.5]),
        ([1.0, 3.0], [2.0, 6.0], [0.0, 2.0]),
        ([1.0, 3.0, 3.0, 1.0], [2.0, 5.0, 7.0, 2.0], [0.0, 2.0]),
        ([0.0, 1.0, 2.0], [1.0, 0.0, 3.0], [1.0, -3.0, 2.0]),
    ],
)
def test_the_degree_falls_to_what_the_points_carry(x: list[float], y: list[float], coefficients: list[float]) -> None:
    np.testing.assert_allclose(fit_polynomial(x, y, 2), coefficients, atol=1e-9)


def test_no_points_are_refused() -> None:
    with pytest.raises(ValueError, match="no point"):
        fit_polynomial([], [], 2)


def test_shifted_polynomials_have_the_same_values() -> None:
    rng = np.random.default_rng(2)
    x = np.linspace(-2.0, 5.0, 9)
    for count in (1, 2, 3, 5):
        local = rng.normal(size=count)
        shifted = shift_polynomial(local, 1.7, 0.6)
        expected = sum(c * ((x - 1.7) / 0.6) ** k for k, c in enumerate(local))
        np.testing.assert_allclose(sum(c * x**k for k, c in enumerate(shifted)), expected, rtol=1e-9, atol=1e-9)
