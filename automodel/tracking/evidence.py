"""What a frame's lines say about a believed lane: normal equations, likelihoods and the belief after them.

With x the state, P = L L' its covariance, R that of the points' errors, r the lines' residuals and H their rows:

    log p = -1/2 (r' R^-1 r - v' (1 + A)^-1 v + log |R| + log |1 + A| + n log 2 pi)
    A = L' H' R^-1 H L,    v = L' H' R^-1 r

in the coordinates z of x = x0 + L z, in which the belief is a unit normal. A and v are sums over the lines, so that
every set of lines is weighed by one small factorisation (Bar-Shalom, Li, Kirubarajan 2001, section 3.2).

The points' errors are Student's with two degrees of freedom, because some are of another thing, which touches the line
or was joined to it: each point's row of R^-1 has a weight w = 3 / (2 + r^2 / variance), found in turns with z
(expectation maximisation, Lange, Little, Taylor 1989, "Robust Statistical Modeling Using the t Distribution"). With it
the point costs w r^2 / variance + 2 w - 3 log w - 3 + 3 log 1.5 = 3 log(1 + r^2 / 2 variance) [twice nats]. Such errors
leave several places likely: a road may bend through a single point that is another thing's. Where the place that is
found first costs much, a second one is searched from variances as large as the largest residual on, by which no road
bends (graduated non-convexity, Blake, Zisserman 1987), and the likelier of the two is taken. Of 400 lines with one or
two points 1.5 to 8 cm off, the best place known was missed by half a nat in 9 %, without this in 27 %.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from automodel.compiled import compiled
from automodel.geometry.lane_path import OFFSET, PITCH, WIDTH, foot_on, lane_path, path_row
from automodel.types import FloatArray, Ints

NARROWER = 100.0  # of the variances of points, from one round to the next: 10 and 1000 find as many modes
ROUNDS = 12  # of linearisation and weighing, at most
LEAST_STEP = 0.0625  # of a whole one: where less goes uphill, nothing is linear
LINEAR = 0.5  # [nats] by which a linearised likelihood may be wrong
NO_NEWS = 1e-12  # share of a line that counts as none
CERTAIN = 1e-8  # share of its variance by which what is known for certain stays invertible


def most_misfit(points: int, exceeded: float) -> float:
    """What a true line's points cost [twice nats] at most, but for a share of such lines, which exceed it."""
    costs = np.linspace(0.0, 100.0 * points, 1 << 12)
    share = np.diff(np.sqrt(-np.expm1(-costs / 3.0)), prepend=0.0)  # of points that cost up to so much: Student's
    of_all = np.fft.irfft(np.fft.rfft(share, 2 * len(share)) ** points)[: len(share)]
    return float(np.interp(1.0 - exceeded, np.cumsum(of_all), costs - 0.5 * points * costs[1]))  # middles of the bins


class Prior(NamedTuple):
    """A belief as lines are weighed against it; the last coordinate is the camera's nod, its pitch in this frame alone.

    `root` (n + 1, n + 1): square root of the covariance, in the order of the state and the nod. `point_variance` [m^2]:
    squared scale of a point's error; `pixel_share`: by how much more it is at a distance, in units of it and of that
    squared [1 / m^2]. `line_share`: variance of the error that a line's points have in common, in units of it. `eye_m`:
    the camera's place ahead and above; `pitch_rad`: sigma of its pitch.
    """

    state: FloatArray
    start_m: float
    spacing_m: float
    reference_x_m: float
    root: FloatArray
    point_variance: float
    pixel_share: float
    line_share: float
    eye_m: tuple[float, float]
    pitch_rad: float


class Equations(NamedTuple):
    """Normal equations of lines (m,) in the whitened coordinates: `information` (m, n + 1, n + 1), `vector` (m, n + 1).

    `misfit` (m,): of the points, weighted squares and what the weights cost. `log_volume` (m,): of the points' errors.
    """

    information: FloatArray
    vector: FloatArray
    misfit: FloatArray
    log_volume: FloatArray


class Streak(NamedTuple):
    """A reflection in a shiny floor: a straight `ray` from below the camera, to a sigma of `pointing_rad`."""

    ray: Prior
    pointing_rad: float


@compiled
def factor(matrix: FloatArray) -> FloatArray:
    """Lower triangular square root of a positive definite matrix (Cholesky)."""
    size = len(matrix)
    root, column = np.zeros((size, size)), np.empty(size)
    for i in range(size):
        for j in range(i + 1):
            root[i, j] = matrix[i, j]
    for k in range(size):  # what is left of the matrix without its first columns
        root[k, k] = math.sqrt(max(root[k, k], 1e-300))
        for i in range(k + 1, size):
            root[i, k] /= root[k, k]
            column[i] = root[i, k]
            for j in range(k + 1, i + 1):
                root[i, j] -= root[i, k] * column[j]
    return root


@compiled
def forward(root: FloatArray, right: FloatArray) -> FloatArray:
    """Solves root x = right for a lower triangular root."""
    x = right.copy()
    for i in range(len(x)):
        for k in range(i):
            x[i] -= root[i, k] * x[k]
        x[i] /= root[i, i]
    return x


@compiled
def backward(root: FloatArray, right: FloatArray) -> FloatArray:
    """Solves root' x = right for a lower triangular root."""
    x = right.copy()
    for i in range(len(x) - 1, -1, -1):
        for k in range(i + 1, len(x)):
            x[i] -= root[k, i] * x[k]
        x[i] /= root[i, i]
    return x


@compiled
def dot(one: FloatArray, other: FloatArray) -> float:
    """The scalar product of two vectors."""
    total = 0.0
    for i in range(len(one)):
        total += one[i] * other[i]
    return total


@compiled
def whitened(covariance: FloatArray) -> FloatArray:
    """Square root of a covariance (n, n) with the nod (n + 1, n + 1)."""
    size = len(covariance)
    full = np.zeros((size + 1, size + 1))
    full[:size, :size] = covariance
    full[size, size] = 1.0  # the nod, in sigmas of the pitch
    for i in range(size + 1):
        full[i, i] += CERTAIN * full[i, i] + CERTAIN**2
    return factor(full)


@compiled
def tilt(eye_m: tuple[float, float], x: float, y: float, heading: float) -> float:
    """How far a camera's pitch moves a point across a line of that heading [m / rad]."""
    ahead, up = x - eye_m[0], eye_m[1]
    return (y * ahead * math.cos(heading) - (ahead * ahead + up * up) * math.sin(heading)) / up


@compiled
def _noise(prior: Prior, points: FloatArray) -> FloatArray:
    """The variances (n,) of the errors of points (n, 2), in units of `prior.point_variance`."""
    noise = np.empty(len(points))
    for k in range(len(points)):
        noise[k] = 1.0 + prior.pixel_share * ((points[k, 0] - prior.eye_m[0]) ** 2 + points[k, 1] ** 2)
    return noise


@compiled
def _residuals(
    prior: Prior, path: FloatArray, state: FloatArray, nod: float, points: FloatArray, role: float, rest: FloatArray
) -> None:
    """Fill `rest` (n,) with how far a line's points lie from where a state and a nod put the line [m]."""
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        s, left = foot_on(path, x, y)
        arc = min(max(int(s / path[1, 0]), 0), len(path) - 1)
        heading = path[arc, 3] + path[arc, 4] * (s - path[arc, 0])
        rest[i] = left - role * state[WIDTH] - (state[PITCH] + nod) * prior.pitch_rad * tilt(prior.eye_m, x, y, heading)


@compiled
def _common(prior: Prior, rest: FloatArray, weights: FloatArray) -> float:
    """The error [m] that a line's weighted points have in common, by their residuals (n,)."""
    total, count = 0.0, 0.0
    for i in range(len(rest)):
        total += weights[i] * rest[i]
        count += weights[i]
    return prior.line_share / (1.0 + count * prior.line_share) * total


@compiled
def _misfit(prior: Prior, rest: FloatArray, weights: FloatArray) -> float:
    """Squared residuals (n,) of a line's weighted points over their errors."""
    common, squares = _common(prior, rest, weights), 0.0
    for i in range(len(rest)):
        squares += weights[i] * rest[i] * (rest[i] - common)
    return squares / prior.point_variance


@compiled
def _weigh(prior: Prior, rest: FloatArray, noise: FloatArray, wide: float, weights: FloatArray) -> float:
    """Weigh a line's points anew by their residuals (n,); returns what the weights themselves cost [twice nats].

    `noise` (n,) is the variance of each one's error, in units of `prior.point_variance`; all are `wide` times as large.
    """
    common, cost = _common(prior, rest, weights), 0.0
    for i in range(len(rest)):
        variance = wide * noise[i]
        weight = 3.0 / (2.0 + (rest[i] - common) ** 2 / (variance * prior.point_variance))
        cost += 2.0 * weight - 3.0 * math.log(weight) - 3.0 + 3.0 * math.log(1.5)
        weights[i] = weight / variance
    return cost


@compiled
def _rows(
    prior: Prior,
    path: FloatArray,
    state: FloatArray,
    points: FloatArray,
    role: float,
    white: FloatArray,
    rest: FloatArray,
) -> None:
    """Fill a line's whitened rows (k, n + 1) about a state with its path, and its residuals (k,) from the belief."""
    size, full = len(state), len(prior.root)
    away, row = state - prior.state, np.empty(full)
    for k in range(len(points)):
        x, y = points[k, 0], points[k, 1]
        s, left = foot_on(path, x, y)
        heading = path_row(row[:size], path, prior.start_m, prior.spacing_m, prior.reference_x_m, s)[2]
        across = prior.pitch_rad * tilt(prior.eye_m, x, y, heading)
        row[WIDTH], row[PITCH], row[size] = role, across, across
        rest[k] = left - role * state[WIDTH] - state[PITCH] * across + dot(row[:size], away)
        white[k] = 0.0
        for i in range(full):  # the root is triangular, and the curvature beyond the point moves it by nothing
            if row[i] != 0.0:
                for j in range(i + 1):
                    white[k, j] += row[i] * prior.root[i, j]


@compiled
def _equations(
    prior: Prior, white: FloatArray, rest: FloatArray, weights: FloatArray, information: FloatArray, vector: FloatArray
) -> None:
    """Fill information and vector of a line by its whitened rows (k, n + 1), residuals (k,) [m] and weights (k,)."""
    full = len(vector)
    white_sum, rest_sum, count = np.zeros(full), 0.0, 0.0
    information[:], vector[:] = 0.0, 0.0
    for k in range(len(rest)):
        weight = weights[k]
        rest_sum, count = rest_sum + weight * rest[k], count + weight
        for i in range(full):
            white_sum[i] += weight * white[k, i]
            vector[i] += weight * white[k, i] * rest[k]
            for j in range(i + 1):
                information[i, j] += weight * white[k, i] * white[k, j]
    shared = prior.line_share / (1.0 + count * prior.line_share)
    for i in range(full):
        vector[i] = (vector[i] - shared * white_sum[i] * rest_sum) / prior.point_variance
        for j in range(i + 1):
            total = information[i, j] - shared * white_sum[i] * white_sum[j]
            information[i, j] = information[j, i] = total / prior.point_variance


@compiled
def _together(information: FloatArray, vector: FloatArray, shares: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The lines' vector, and the square root of their information with the belief's own; each counts by its share."""
    all_information, all_vector = shares[0] * information[0], shares[0] * vector[0]
    for i in range(1, len(vector)):
        all_information += shares[i] * information[i]
        all_vector += shares[i] * vector[i]
    for i in range(len(all_vector)):
        all_information[i, i] += 1.0
    return all_vector, factor(all_information)


@compiled
def _solved(
    prior: Prior, white: FloatArray, rest: FloatArray, weights: FloatArray, ends: Ints, shares: FloatArray
) -> FloatArray:
    """The place z = W' (W W' + R)^-1 r by rows W (k, n + 1), residuals r (k,) [m] and weights (k,): a lane has more
    unknowns than lines have points.
    """
    count, z = len(rest), np.zeros(len(prior.root))
    spread = np.empty((count, count))
    for i in range(count):
        for j in range(i + 1):
            spread[i, j] = dot(white[i], white[j])
    first = 0
    for line in range(len(ends)):
        variance = prior.point_variance / max(shares[line], NO_NEWS)
        for i in range(first, ends[line]):
            spread[i, i] += variance / weights[i]
            for j in range(first, i + 1):
                spread[i, j] += variance * prior.line_share
        first = ends[line]
    root = factor(spread)
    parts = backward(root, forward(root, rest))
    for k in range(count):
        for i in range(len(z)):
            z[i] += parts[k] * white[k, i]
    return z


@compiled
def _moved(prior: Prior, z: FloatArray) -> FloatArray:
    """The change of the state and the nod (n + 1,) that whitened ones stand for: the root is triangular."""
    moved = np.zeros(len(z))
    for i in range(len(z)):
        for j in range(i + 1):
            moved[i] += prior.root[i, j] * z[j]
    return moved


@compiled
def _climbed(
    prior: Prior, points: FloatArray, ends: Ints, roles: FloatArray, shares: FloatArray, noise: FloatArray, wide: float
) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """What a place uphill from the belief costs [twice nats], that place, the points' weights, and what those cost.

    Newton's method on the posterior; each step is halved until it is one uphill. The points are weighed in each round;
    in the first their errors' variances are `wide` times as large as they are.
    """
    count, full = len(roles), len(prior.root)
    white, linear, rest = np.empty((len(points), full)), np.empty(len(points)), np.empty(len(points))
    actual, spent = np.empty(count), np.zeros(count)
    weights = 1.0 / (wide * noise)
    z, state = np.zeros(full), prior.state.copy()
    path = lane_path(state, prior.start_m, prior.spacing_m, prior.reference_x_m)
    best, linearised = np.inf, False
    for _ in range(ROUNDS):
        for i in range(count):
            its = slice(ends[i - 1] if i else 0, ends[i])
            _rows(prior, path, state, points[its], roles[i], white[its], linear[its])
        if best == np.inf:
            best = _cost(prior, linear, weights, ends, shares)
        aim = _solved(prior, white, linear, weights, ends, shares)
        for k in range(len(points)):
            linear[k] -= dot(white[k], aim)
        told = _cost(prior, linear, weights, ends, shares)  # there, if all were linear
        tried, uphill = 1.0, False
        while tried >= LEAST_STEP:
            at = z + tried * (aim - z)
            moved = _moved(prior, at)
            there = prior.state + moved[:-1]
            trial = lane_path(there, prior.start_m, prior.spacing_m, prior.reference_x_m)
            for i in range(count):
                its = slice(ends[i - 1] if i else 0, ends[i])
                _residuals(prior, trial, there, moved[full - 1], points[its], roles[i], rest[its])
            misfit = _cost(prior, rest, weights, ends, shares)
            if misfit + dot(at, at) < best:
                uphill = True
                break
            tried *= 0.5
        if uphill:
            z, state, path, best = at, there, trial, misfit + dot(at, at)
            linearised = tried == 1.0 and abs(misfit - told) < 2.0 * LINEAR
        last, wide, gain = wide == 1.0, max(wide / NARROWER, 1.0), 0.0
        for i in range(count):
            its = slice(ends[i - 1] if i else 0, ends[i])
            if not uphill:  # the residuals are those of a place that was tried in vain
                _residuals(prior, path, state, dot(prior.root[full - 1], z), points[its], roles[i], rest[its])
            before = _misfit(prior, rest[its], weights[its]) + spent[i]
            spent[i] = _weigh(prior, rest[its], noise[its], wide, weights[its])
            actual[i] = _misfit(prior, rest[its], weights[its])
            gain += shares[i] * (before - actual[i] - spent[i])
        best = dot(shares, actual) + dot(z, z)
        if last and (linearised or not uphill) and gain < 2.0 * LINEAR:
            break
    return best + dot(shares, spent), z, weights, spent


@compiled
def _cost(prior: Prior, rest: FloatArray, weights: FloatArray, ends: Ints, shares: FloatArray) -> float:
    """The squared residuals (k,) of lines' weighted points over their errors, each line's by its share."""
    total = 0.0
    for i in range(len(ends)):
        its = slice(ends[i - 1] if i else 0, ends[i])
        total += shares[i] * _misfit(prior, rest[its], weights[its])
    return total


@compiled
def settled(
    prior: Prior, points: FloatArray, ends: Ints, roles: FloatArray, shares: FloatArray
) -> tuple[Equations, FloatArray]:
    """Lines' equations, linearised where they and the belief together put the lane, and that place, whitened (n + 1,).

    The points (k, 2) of line i, which plays `roles[i]` and counts by `shares[i]`, end at `ends[i]`. Where a place costs
    more than a unit a point it is another's too, and a likelier place is searched from variances as large as the
    largest residual on.
    """
    count, full = len(roles), len(prior.root)
    noise, rest, all_points = _noise(prior, points), np.empty(len(points)), 0.0
    for i in range(count):
        all_points += shares[i] * (ends[i] - (ends[i - 1] if i else 0))
    cost, z, weights, spent = _climbed(prior, points, ends, roles, shares, noise, 1.0)
    if cost > all_points:
        wide, path = 1.0, lane_path(prior.state, prior.start_m, prior.spacing_m, prior.reference_x_m)
        for i in range(count):
            its = slice(ends[i - 1] if i else 0, ends[i])
            _residuals(prior, path, prior.state, 0.0, points[its], roles[i], rest[its])
            for k in range(its.start, its.stop):
                wide = max(wide, rest[k] * rest[k] / (noise[k] * prior.point_variance))
        other, z_other, weights_other, spent_other = _climbed(prior, points, ends, roles, shares, noise, wide)
        if other < cost:
            z, weights, spent = z_other, weights_other, spent_other
    state = prior.state + _moved(prior, z)[:-1]
    path = lane_path(state, prior.start_m, prior.spacing_m, prior.reference_x_m)
    information, vector = np.empty((count, full, full)), np.empty((count, full))
    white, misfit, log_volume = np.empty((len(points), full)), np.empty(count), np.empty(count)
    for i in range(count):
        its = slice(ends[i - 1] if i else 0, ends[i])
        _rows(prior, path, state, points[its], roles[i], white[its], rest[its])
        _equations(prior, white[its], rest[its], weights[its], information[i], vector[i])
        misfit[i] = spent[i] + _misfit(prior, rest[its], weights[its])
        log_volume[i] = math.log1p(weights[its].sum() * prior.line_share)
        for k in range(its.start, its.stop):
            log_volume[i] += math.log(8.0 * prior.point_variance * noise[k])
    return Equations(information, vector, misfit, log_volume), z


@compiled
def innovation(equations: Equations) -> tuple[float, float]:
    """Squared innovation of lines over its covariance S, which the belief and their errors give, and log |2 pi S|."""
    vector, root = _together(equations.information, equations.vector, np.ones(len(equations.vector)))
    white = forward(root, vector)
    volume = equations.log_volume.sum()
    for i in range(len(root)):
        volume += 2.0 * math.log(root[i, i])
    return equations.misfit.sum() - dot(white, white), volume


@compiled
def fit(prior: Prior, points: FloatArray, role: float) -> tuple[float, float]:
    """The `innovation` of one line, whose points (k, 2) play a role."""
    equations, _ = settled(prior, points, np.array((len(points),)), np.array((role,)), np.ones(1))
    return innovation(equations)


@compiled
def own_thing(
    prior: Prior, streak: Streak, points: FloatArray, sigma_m: float, corners: float, reflection: float
) -> float:
    """The logarithm of how likely a line's points (k, 2) [m] are as a thing of its own [nats].

    It is as smooth as a road of `prior`, or has `corners`, less likely by so many nats: its points lie anywhere with a
    lateral sigma. Or it is a `reflection`, so many times as likely as one of these by what is known of it otherwise.
    """
    squares, volume = fit(prior, points, 0.0)
    smooth, anywhere = -0.5 * (squares + volume), -corners
    for i in range(len(points)):
        anywhere -= 0.5 * (points[i, 1] / sigma_m) ** 2 + math.log(sigma_m * math.sqrt(math.tau))
    thing = _sum(smooth, anywhere)
    if reflection == 0.0:
        return thing
    return _sum(thing, _as_streak(streak, points) + math.log(reflection))


@compiled
def _as_streak(streak: Streak, points: FloatArray) -> float:
    """The logarithm of how likely points (k, 2) [m] are as those of a reflection [nats]."""
    ray, root = streak.ray, streak.ray.root.copy()
    away_m = math.hypot(points[:, 0].mean() - ray.eye_m[0], points[:, 1].mean())
    root[OFFSET, OFFSET] = streak.pointing_rad * away_m  # a direction that is off misses the foot of the camera by this
    place = ray.state, ray.start_m, ray.spacing_m, ray.reference_x_m, root
    errors = ray.point_variance, ray.pixel_share, ray.line_share, ray.eye_m, ray.pitch_rad
    squares, volume = fit(Prior(*place, *errors), points, 0.0)
    return -0.5 * (squares + volume)


@compiled
def _sum(one: float, other: float) -> float:
    """The logarithm of the sum of two likelihoods, by their logarithms."""
    return max(one, other) + math.log1p(math.exp(-abs(one - other)))


@compiled
def change(prior: Prior, points: FloatArray, role: float, z: FloatArray) -> int:
    """The point from which on a line's points (k, 2), which put it at z, fit otherwise than before; 0 if there is none.

    Positive where those before it fit better, negative where those from it on do. It is where the costs of the points
    less their mean have summed up the most (cumulative sums, Page 1954, "Continuous Inspection Schemes").
    """
    count = len(points)
    moved, rest, noise = _moved(prior, z), np.empty(count), _noise(prior, points)
    state = prior.state + moved[:-1]
    path = lane_path(state, prior.start_m, prior.spacing_m, prior.reference_x_m)
    _residuals(prior, path, state, moved[-1], points, role, rest)
    weights = 1.0 / noise
    _weigh(prior, rest, noise, 1.0, weights)
    common = _common(prior, rest, weights)
    costs = np.log1p((rest - common) ** 2 / (2.0 * noise * prior.point_variance))
    mean, total, most, at = costs.mean(), 0.0, 0.0, 0
    for k in range(count - 1):
        total += costs[k] - mean
        if abs(total) > most:
            most, at = abs(total), (k + 1 if total < 0.0 else -k - 1)
    return at


@compiled
def posterior(prior: Prior, equations: Equations, z: FloatArray, shares: FloatArray) -> tuple[FloatArray, FloatArray]:
    """State (n,) and covariance (n, n) after lines that count by their `shares` (m,) and put it at z."""
    root = _together(equations.information, equations.vector, shares)[1]
    size = len(root) - 1
    half, covariance = np.empty((size + 1, size)), np.zeros((size, size))  # half: root^-1 L'
    for i in range(size + 1):
        for j in range(size):
            half[i, j] = prior.root[j, i]
        for k in range(i):
            for j in range(size):
                half[i, j] -= root[i, k] * half[k, j]
        for j in range(size):
            half[i, j] /= root[i, i]
        for j in range(size):
            for k in range(size):
                covariance[j, k] += half[i, j] * half[i, k]
    return prior.state + _moved(prior, z)[:size], covariance
