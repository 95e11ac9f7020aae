"""The correction of a clothoid pair: robust least squares by Gauss-Newton or by gradient descent, compiled.

Both solvers minimise 1/2 x^T P^-1 x + 1/2 x^T A x - b^T x over the change x (m,) of the parameters. P (m, m) is the
covariance of the prediction; A (m, m) and b (m,), `information` and `pull`, are those of the weighted measurements.
Gauss-Newton solves this in one step. Plain gradient descent in many cheap steps is the thesis's choice (Smith 2024,
section 1.3). Both return x, its covariance (A + P^-1)^-1 (m, m), and the number of iterations.
"""

from __future__ import annotations

import numpy as np

from automodel.compiled import compiled
from automodel.estimation.clothoid.clothoid_pair import CURVATURE, HEADING, OFFSET
from automodel.geometry.elimination import solve
from automodel.types import Bools, Floats, Ints

State = tuple[Floats, Floats, Floats, Floats]  # as `correct` takes them
Sightings = tuple[Floats, Floats, Ints, Floats, Floats]

MOST_STEPS = 1000
CONVERGED = 1e-5  # [sigmas of the prediction] gradient descent ends when no parameter moves further in a step


@compiled
def posterior(information: Floats, covariance: Floats) -> Floats:
    """Covariance (A + P^-1)^-1 = (1 + P A)^-1 P; 1 + P A has no eigenvalue below 1, so P may be singular."""
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
    """The minimum, in one step."""
    after = posterior(information, covariance)
    return _times(after, pull), after, 1


@compiled
def gradient_descent(
    information: Floats, pull: Floats, covariance: Floats, most_steps: int = MOST_STEPS
) -> tuple[Floats, Floats, int]:
    """Steps down the gradient, each parameter in units of its predicted sigma, until a step is small."""
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
    largest = 0.0  # bound of the eigenvalues (Gershgorin), so that a step of 1 / largest never diverges
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


@compiled
def correct(
    descend: bool, state: State, seen: Sightings, scales: tuple[float, float, float]
) -> tuple[Floats, Floats, int, Bools, float]:
    """Correct the parameters by measurements that were taken at an estimate, with robust weights.

    The weights are renewed once where a residual remains beyond its limit. `state`: parameters (m,) and covariance
    (m, m) of the estimate, then those of the prediction. `seen`: the Jacobian (3 n, m) of `PairShape`; the variances of
    its rows and their largest residuals (2, 3 n); nodes (k,), residuals and found (2 k,) as in
    `ClothoidTracker.update`. `scales`: the gate [sigmas], the largest curvature [1/m], and the lever [m] that turns a
    change of heading into a distance.

    Returns the parameters, their covariance, the iterations, which nodes (k,) support the lane, and how far it moved
    [m].
    """
    gate, bend, lever_m = scales
    before, _, prior, prior_covariance = state
    found, k = seen[4], len(seen[2])
    rows, aim, ratio2, precision, limit = _linearise(state, seen, gate)
    iterations, worst = 0, 0.0
    for _ in range(2):
        information, pull, weight = _weigh(rows, aim, ratio2, precision)
        if descend:
            change, after, count = gradient_descent(information, pull, prior_covariance)
        else:
            change, after, count = gauss_newton(information, pull, prior_covariance)
        iterations += count
        for i in range(2 * k):
            left = aim[i]
            for a in range(len(change)):
                left -= rows[i, a] * change[a]
            ratio2[i] = (left / limit[i]) ** 2
            worst = max(worst, ratio2[i] * found[i])
        if worst <= 1.0:
            break
    parameters = np.empty_like(prior)
    for a in range(len(prior)):
        parameters[a] = prior[a] + change[a]
        if a >= CURVATURE:
            parameters[a] = min(max(parameters[a], -bend), bend)
    carrying = np.empty(k, np.bool_)
    for i in range(k):
        carrying[i] = weight[i] > 0.1 * precision[i]
    moved_m = abs(parameters[OFFSET] - before[OFFSET]) + abs(parameters[HEADING] - before[HEADING]) * lever_m
    return parameters, after, iterations, carrying, float(moved_m)


@compiled
def _linearise(state: State, seen: Sightings, gate: float) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """The measurements (2 k,) relative to the prediction `prior`, linearised at the estimate.

    Returns the Jacobian (2 k, m), the residuals (2 k,), the squares of their ratio to the gate, which counts sigmas of
    the estimate and of the measurement together, the precisions, and the limits of what may remain of the residuals.
    """
    before, covariance, prior, _ = state
    jacobian, noise, nodes, residual, found = seen
    n, size, k = len(jacobian) // 3, len(before), len(nodes)
    rows, aim = np.empty((2 * k, size), before.dtype), np.empty(2 * k, before.dtype)
    ratio2, precision = np.empty(2 * k, before.dtype), np.empty(2 * k, before.dtype)
    limit = np.empty(2 * k, before.dtype)
    for i in range(2 * k):
        row = nodes[i] if i < k else 2 * n + nodes[i - k] % n
        measured, spread2 = residual[i], noise[0, row]
        for a in range(size):
            rows[i, a] = jacobian[row, a]
            measured += jacobian[row, a] * (before[a] - prior[a])
            for b in range(size):
                spread2 += jacobian[row, a] * covariance[a, b] * jacobian[row, b]
        aim[i], ratio2[i] = measured, residual[i] * residual[i] / (spread2 * gate * gate)
        precision[i], limit[i] = found[i] / noise[0, row], noise[1, row]
    return rows, aim, ratio2, precision, limit


@compiled
def _weigh(rows: Floats, aim: Floats, ratio2: Floats, precision: Floats) -> tuple[Floats, Floats, Floats]:
    """Information (m, m), pull (m,) and weights (2 k,) by Tukey's biweight, which is 0 from a ratio of 1 on."""
    size = rows.shape[1]
    information, pull, weight = np.zeros((size, size), aim.dtype), np.zeros(size, aim.dtype), np.empty_like(aim)
    for i in range(len(aim)):
        share = max(1.0 - ratio2[i], 0.0)
        weight[i] = share * share * precision[i]
        for a in range(size):
            weighted = weight[i] * rows[i, a]
            pull[a] += weighted * aim[i]
            for b in range(size):
                information[a, b] += weighted * rows[i, b]
    return information, pull, weight


SOLVERS = {"gauss_newton": gauss_newton, "gradient_descent": gradient_descent}
