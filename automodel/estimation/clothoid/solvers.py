"""Two ways to the least of 1/2 x^T P^-1 x + 1/2 x^T A x - x^T b, the prior and the weighted squared distances.

Gauss-Newton solves for it in one step. Plain gradient descent is the thesis's choice (Smith, section 1.3): many cheap
steps. Both give x (m,), its covariance (A + P^-1)^-1 (m, m), and the number of iterations.
"""

from __future__ import annotations

import numpy as np

from automodel.compiled import compiled
from automodel.types import Floats

MOST_STEPS = 1000
CONVERGED = 1e-5  # of a prior's sigma: steps below that are the end


@compiled
def solve(matrix: Floats, right: Floats) -> Floats:
    """X (m, k) of `matrix` (m, m) X = `right` (m, k), by elimination with row pivots; both are overwritten.

    A library's solver would take longer to be called than this takes for matrices of this size.
    """
    m, k = right.shape
    for c in range(m):
        pivot = c
        for r in range(c + 1, m):
            if abs(matrix[r, c]) > abs(matrix[pivot, c]):
                pivot = r
        for j in range(c, m):
            matrix[c, j], matrix[pivot, j] = matrix[pivot, j], matrix[c, j]
        for j in range(k):
            right[c, j], right[pivot, j] = right[pivot, j], right[c, j]
        for r in range(c + 1, m):
            share = matrix[r, c] / matrix[c, c]
            for j in range(c + 1, m):
                matrix[r, j] -= share * matrix[c, j]
            for j in range(k):
                right[r, j] -= share * right[c, j]
    for c in range(m - 1, -1, -1):
        for j in range(k):
            for r in range(c + 1, m):
                right[c, j] -= matrix[c, r] * right[r, j]
            right[c, j] /= matrix[c, c]
    return right


@compiled
def posterior(information: Floats, covariance: Floats) -> Floats:
    """(A + P^-1)^-1 = (1 + P A)^-1 P, where 1 + P A has no eigenvalue below 1."""
    m = len(covariance)
    matrix = np.empty_like(covariance)
    for i in range(m):
        for j in range(m):
            matrix[i, j] = 1.0 if i == j else 0.0
            for k in range(m):
                matrix[i, j] += covariance[i, k] * information[k, j]
    after = solve(matrix, covariance.copy())
    for i in range(m):
        for j in range(i):
            after[i, j] = after[j, i] = 0.5 * (after[i, j] + after[j, i])
    return after


@compiled
def gauss_newton(information: Floats, pull: Floats, covariance: Floats) -> tuple[Floats, Floats, int]:
    """The least itself."""
    after = posterior(information, covariance)
    return _times(after, pull), after, 1


@compiled
def gradient_descent(
    information: Floats, pull: Floats, covariance: Floats, most_steps: int = MOST_STEPS
) -> tuple[Floats, Floats, int]:
    """Steps down the gradient, each parameter in units of its prior's sigma, until a step is small."""
    m = len(pull)
    sigma, slope, at = np.empty_like(pull), np.empty_like(pull), np.zeros_like(pull)
    prior, hessian = np.empty_like(covariance), np.zeros_like(covariance)
    for i in range(m):
        sigma[i] = np.sqrt(covariance[i, i])
        slope[i] = pull[i] * sigma[i]
        hessian[i, i] = 1.0
    for i in range(m):
        for j in range(m):
            prior[i, j] = covariance[i, j] / (sigma[i] * sigma[j])
    hessian = solve(prior, hessian)
    largest = 0.0  # no eigenvalue is larger (Gershgorin)
    for i in range(m):
        row = 0.0
        for j in range(m):
            hessian[i, j] += information[i, j] * sigma[i] * sigma[j]
            row += abs(hessian[i, j])
        largest = max(largest, row)
    count, moved = 0, CONVERGED
    while count < most_steps and moved >= CONVERGED:
        descent, moved = _times(hessian, at), 0.0
        for i in range(m):
            step = (slope[i] - descent[i]) / largest
            at[i] += step
            moved = max(moved, abs(step))
        count += 1
    for i in range(m):
        at[i] *= sigma[i]
    return at, posterior(information, covariance), count


@compiled
def _times(matrix: Floats, values: Floats) -> Floats:
    product = np.zeros_like(values)
    for i in range(len(values)):
        for j in range(len(values)):
            product[i] += matrix[i, j] * values[j]
    return product


SOLVERS = {"gauss_newton": gauss_newton, "gradient_descent": gradient_descent}
