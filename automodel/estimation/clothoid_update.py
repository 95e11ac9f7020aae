"""The loops of a clothoid tracker's step: the drive's prediction, and the robust correction by what was found."""

from __future__ import annotations

import math

import numpy as np

from automodel.compiled import compiled
from automodel.curves.arcs import foot_on_circle
from automodel.estimation.clothoid_pair import Parameter
from automodel.estimation.update_laws import gauss_newton, gradient_descent
from automodel.types import Bools, FloatArray, Floats, Ints

OFFSET, HEADING, WIDTH, CURVATURE = (int(p) for p in Parameter)

_foot_on_circle = compiled(foot_on_circle)


@compiled
def drive(x: Floats, p: Floats, dx: float, dy: float, phase_m: float, spacing_m: float) -> float:
    """Carry parameters and covariance on to the foot of body point (`dx`, `dy`) [m] from the reference point's.

    The foot lies on the circle of the road's curvature on the way there. That way [m]; directions stay in the old body
    frame.
    """
    cos, sin = math.cos(x[HEADING]), math.sin(x[HEADING])
    ahead, left = dx * cos + dy * sin, dy * cos - dx * sin + x[OFFSET]
    last = len(x) - CURVATURE - 1
    place = min(max((phase_m + 0.5 * ahead) / spacing_m, 0.0), float(last))
    j = min(int(place), last - 1)
    share = place - j
    station, after = CURVATURE + j, CURVATURE + j + 1
    kappa = (1.0 - share) * x[station] + share * x[after]
    way, x[OFFSET] = _foot_on_circle(ahead, left, kappa)
    x[HEADING] += kappa * way
    this, that = (1.0 - share) * way, share * way
    for k in range(len(x)):  # the derivatives of both, from the left
        p[OFFSET, k] -= ahead * p[HEADING, k]
        p[HEADING, k] += this * p[station, k] + that * p[after, k]
    for k in range(len(x)):  # and from the right
        p[k, OFFSET] -= ahead * p[k, HEADING]
        p[k, HEADING] += this * p[k, station] + that * p[k, after]
    return float(way)


@compiled
def correct(
    descend: bool,
    before: Floats,
    covariance: Floats,
    prior: Floats,
    prior_covariance: Floats,
    jacobian: Floats,
    noise: Floats,
    nodes: Ints,
    residual: Floats,
    found: Floats,
    scales: tuple[float, float, float, float],
) -> tuple[Floats, Floats, int, Bools, int, float]:
    """Parameters, covariance, iterations, which nodes (k,) carry the lane, how many do not though found, and `moved_m`.

    The nodes were looked for from `before` and its covariance; both priors are the prediction. The other arrays are as
    `ClothoidTracker` has them. Robust weights are renewed once, where what is left of the residuals is not small.
    """
    gate, agreed, bend, lever_m = scales
    k = len(nodes)
    rows, aim, ratio2, precision, limit = _linearise(
        before, covariance, prior, jacobian, noise, nodes, residual, found, gate
    )
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
        if worst <= agreed * agreed:
            break
    parameters = np.empty_like(prior)
    for a in range(len(prior)):
        parameters[a] = prior[a] + change[a]
        if a >= CURVATURE:
            parameters[a] = min(max(parameters[a], -bend), bend)
    carrying, missed = np.empty(k, np.bool_), 0
    for i in range(k):
        carrying[i] = weight[i] > 0.1 * precision[i]
        missed += int(found[i] > 0.0) - int(carrying[i])
    moved_m = abs(parameters[OFFSET] - before[OFFSET]) + abs(parameters[HEADING] - before[HEADING]) * lever_m
    return parameters, after, iterations, carrying, missed, float(moved_m)


@compiled
def age(p: Floats, walk: Floats, floor: Floats, way: float, offset: float, heading: float) -> None:
    """Add what `way` [lane widths] and a frame bring, and these variances of offset and heading."""
    for i in range(len(p)):
        p[i, i] += walk[i] * way + floor[i]
    p[OFFSET, OFFSET] += offset
    p[HEADING, HEADING] += heading


@compiled
def _linearise(
    before: Floats,
    covariance: Floats,
    prior: Floats,
    jacobian: Floats,
    noise: Floats,
    nodes: Ints,
    residual: Floats,
    found: Floats,
    gate: float,
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """The measurements (2 k,) of an update, told from the prediction `prior` and linearised at `before`.

    The arguments as `ClothoidTracker` has them. Jacobian (2 k, m), residuals, their squares in units of what is
    believed, precision, and the limit for what is left of them.
    """
    n, size, k = len(jacobian) // 3, len(before), len(nodes)
    rows, aim = np.empty((2 * k, size), before.dtype), np.empty(2 * k, before.dtype)
    ratio2, precision = np.empty(2 * k, before.dtype), np.empty(2 * k, before.dtype)
    limit = np.empty(2 * k, before.dtype)
    for i in range(2 * k):
        row = nodes[i] if i < k else 2 * n + nodes[i - k] % n
        told, spread2 = residual[i], noise[0, row]
        for a in range(size):
            rows[i, a] = jacobian[row, a]
            told += jacobian[row, a] * (before[a] - prior[a])
            for b in range(size):
                spread2 += jacobian[row, a] * covariance[a, b] * jacobian[row, b]
        aim[i], ratio2[i] = told, residual[i] * residual[i] / (spread2 * gate * gate)
        precision[i], limit[i] = found[i] / noise[0, row], noise[1, row]
    return rows, aim, ratio2, precision, limit


@compiled
def _weigh(rows: Floats, aim: Floats, ratio2: Floats, precision: Floats) -> tuple[Floats, Floats, Floats]:
    """Information (m, m), pull (m,) and weights (2 k,) by Tukey: nothing is left of what reaches its limit (1)."""
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


@compiled
def heading_turned(p: Floats) -> FloatArray:
    """The covariance (3, 3) of offset, -heading and width."""
    turned = np.empty((CURVATURE, CURVATURE))
    for i in range(CURVATURE):
        for j in range(CURVATURE):
            turned[i, j] = p[i, j] if (i == HEADING) == (j == HEADING) else -p[i, j]
    return turned
