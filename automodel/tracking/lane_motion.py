"""How a believed lane lies beneath the car and moves there: offset and heading, and its road's stations, which stay.

The state (4 + stations,) is that of `belief.LaneBelief`, its stations those of `lane_path`.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from automodel.compiled import compiled
from automodel.curves.foot import foot_on_circle
from automodel.geometry.lane_path import OFFSET, PITCH, ROAD, THETA, WIDTH, foot_on, lane_path, path_row, station
from automodel.types import FloatArray

_foot_on_circle = compiled(foot_on_circle)
LEAST_STRETCH = 0.05  # least 1 - curvature times offset: a car beyond the centre of a bend drives on a circle about it


class Drift(NamedTuple):
    """What gets uncertain on the way: the numbers of a `belief.RoadModel`, lengths in lane widths of `unit_m`.

    `forgets`: share of a curvature that is lost per lane width of road.
    """

    unit_m: float
    step: float
    turn_rad: float
    pace: float
    lost_step: float
    lost_turn_rad: float
    lost_pace: float
    width_sigma: float
    width_walk: float
    any_bend: float
    forgets: float


class Part(IntEnum):
    """What lies beside the car: indices of a belief's mean."""

    OFFSET = 0
    THETA = 1
    KAPPA = 2
    WIDTH = 3


_BESIDE = (OFFSET, THETA, ROAD, WIDTH)  # the state's index of each part; of the curvature, that of the first station


@compiled
def arc(mean: FloatArray, covariance: FloatArray, stations: int, walk: float) -> tuple[FloatArray, FloatArray]:
    """State (4 + stations,) and covariance of a lane of which only what lies beside the car is known.

    Mean (4,) and covariance (4, 4) are in the order of `Part`; `walk`: variance that the curvature gains from one
    station to the next.
    """
    size = ROAD + stations
    part, state, grown = np.full(size, Part.KAPPA.value), np.empty(size), np.empty((size, size))
    part[OFFSET], part[THETA], part[WIDTH] = Part.OFFSET.value, Part.THETA.value, Part.WIDTH.value
    for i in range(size):
        state[i] = 0.0 if i == PITCH else mean[part[i]]
        for j in range(size):
            nod = 1.0 if i == j else 0.0  # the camera's pitch in sigmas
            grown[i, j] = nod if PITCH in (i, j) else covariance[part[i], part[j]]
            if i >= ROAD and j >= ROAD:
                grown[i, j] += walk * min(i - ROAD, j - ROAD)
    return state, grown


@compiled
def beside_car(
    state: FloatArray, covariance: FloatArray, start_m: float, spacing_m: float
) -> tuple[FloatArray, FloatArray]:
    """Mean (4,) and covariance (4, 4) of what lies beside the car, in the order of `Part`."""
    first, share = station(start_m, spacing_m, len(state) - ROAD)
    mean, spread = np.empty(len(_BESIDE)), np.empty((len(_BESIDE), len(_BESIDE)))
    for a in range(len(_BESIDE)):
        i, after = _BESIDE[a], 0
        if i == ROAD:
            i, after = i + first, 1
        mean[a] = (1.0 - share * after) * state[i] + share * after * state[i + after]
        for b in range(len(_BESIDE)):
            j, beyond = _BESIDE[b], 0
            if j == ROAD:
                j, beyond = j + first, 1
            here = (1.0 - share * beyond) * covariance[i, j] + share * beyond * covariance[i, j + beyond]
            i1 = i + after
            there = (1.0 - share * beyond) * covariance[i1, j] + share * beyond * covariance[i1, j + beyond]
            spread[a, b] = (1.0 - share * after) * here + share * after * there
    return mean, spread


@compiled
def merged(
    state: FloatArray,
    covariance: FloatArray,
    start_m: float,
    other_state: FloatArray,
    other_covariance: FloatArray,
    other_start_m: float,
    spacing_m: float,
    others: float,
) -> tuple[FloatArray, FloatArray]:
    """The moments of two beliefs of the same lane about the first one's stations, `others` being the other's share."""
    size = len(state)
    turn, away, mixed = np.zeros((size, size)), np.empty(size), np.empty(size)
    for i in range(size):
        turn[i, i] = 1.0
        if i >= ROAD:
            first, share = station((i - ROAD) * spacing_m - start_m + other_start_m, spacing_m, size - ROAD)
            turn[i, i] = 0.0
            turn[i, ROAD + first], turn[i, ROAD + first + 1] = 1.0 - share, share
    for i in range(size):
        away[i] = -state[i]
        for j in range(size):
            away[i] += turn[i, j] * other_state[j]
        mixed[i] = state[i] + others * away[i]
    turned, both = np.empty((size, size)), np.empty((size, size))
    for i in range(size):
        for j in range(size):
            turned[i, j] = 0.0
        for k in range(size):
            if turn[i, k] != 0.0:
                for j in range(size):
                    turned[i, j] += turn[i, k] * other_covariance[k, j]
    for i in range(size):
        for j in range(size):
            theirs = 0.0
            for k in range(size):
                theirs += turned[i, k] * turn[j, k]
            between = others * (1.0 - others) * away[i] * away[j]
            both[i, j] = (1.0 - others) * covariance[i, j] + others * theirs + between
    return mixed, both


@compiled
def moved(
    state: FloatArray,
    covariance: FloatArray,
    start_m: float,
    spacing_m: float,
    reference_x_m: float,
    drift: Drift,
    distance_m: float,
    turn_rad: float,
    dt_s: float,
    known: bool,
) -> tuple[FloatArray, FloatArray, float]:
    """State, covariance and `start_m` after a motion along an arc; an unknown one counts as none, with much noise."""
    state, covariance = state.copy(), covariance.copy()
    size, unit, step = len(state), drift.unit_m, abs(distance_m) / drift.unit_m
    if known:
        half = 0.5 * turn_rad
        chord = distance_m * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
        x = chord * math.cos(half) + reference_x_m * (math.cos(turn_rad) - 1.0)
        y = chord * math.sin(half) + reference_x_m * math.sin(turn_rad)
        cos, sin = math.cos(state[THETA]), math.sin(state[THETA])
        first, share = station(0.5 * distance_m + start_m, spacing_m, size - ROAD)
        here, after = ROAD + first, ROAD + first + 1
        kappa = (1.0 - share) * state[here] + share * state[after]
        ahead, left = x * cos + y * sin, y * cos - x * sin + state[OFFSET]
        along, state[OFFSET] = _foot_on_circle(ahead, left, kappa, LEAST_STRETCH)
        turned = state[THETA] + kappa * along - turn_rad
        state[THETA] = math.atan2(math.sin(turned), math.cos(turned))
        start_m += along
        bent, half_bent = along, 0.5 * along * along  # by a curvature: the heading, and the offset
        for k in range(size):  # P <- F P: the derivatives of offset and heading
            between = (1.0 - share) * covariance[here, k] + share * covariance[after, k]
            covariance[OFFSET, k] -= along * covariance[THETA, k] + half_bent * between
            covariance[THETA, k] += bent * between
        for k in range(size):  # P <- P F'
            between = (1.0 - share) * covariance[k, here] + share * covariance[k, after]
            covariance[k, OFFSET] -= along * covariance[k, THETA] + half_bent * between
            covariance[k, THETA] += bent * between
    kept = math.exp(-step * drift.width_walk**2 / (2.0 * drift.width_sigma**2))
    state[WIDTH] += (1.0 - kept) * (unit - state[WIDTH])
    # By so many lane widths the road may lie elsewhere; what lay there before is known as well as that allows.
    same = math.exp(-drift.forgets * (drift.pace * step if known else drift.lost_pace * dt_s))
    shares = np.ones(size)
    shares[WIDTH], shares[ROAD:] = kept, same
    for i in range(size):
        for j in range(size):
            covariance[i, j] *= shares[i] * shares[j]
    covariance[OFFSET, OFFSET] += (drift.step * unit) ** 2 * step
    covariance[THETA, THETA] += drift.turn_rad**2 * step
    covariance[WIDTH, WIDTH] += (drift.width_sigma * unit) ** 2 * (1.0 - kept * kept)
    for i in range(ROAD, size):
        state[i] *= same
        covariance[i, i] += (drift.any_bend / unit) ** 2 * (1.0 - same * same)
    if not known:
        covariance[OFFSET, OFFSET] += (drift.lost_step * unit) ** 2 * dt_s
        covariance[THETA, THETA] += drift.lost_turn_rad**2 * dt_s
    passed = math.floor(start_m / spacing_m)
    if passed != 0:
        state, covariance = _rolled(state, covariance, passed, spacing_m, drift)
    return state, covariance, start_m - passed * spacing_m


@compiled
def _rolled(
    state: FloatArray, covariance: FloatArray, passed: int, spacing_m: float, drift: Drift
) -> tuple[FloatArray, FloatArray]:
    """State and covariance with stations that lie so many spacings farther on: the last ones are new, or gone."""
    size = len(state)
    order, same, beyond = np.arange(size), np.ones(size), np.zeros(size)
    for i in range(ROAD, size):
        at = i + passed
        order[i] = min(max(at, ROAD), size - 1)
        beyond[i] = (at - order[i]) * spacing_m / drift.unit_m  # lane widths from the known road, where it ends
        same[i] = math.exp(-drift.forgets * abs(beyond[i]))
    rolled, grown, variance = np.empty(size), np.empty((size, size)), (drift.any_bend / drift.unit_m) ** 2
    for i in range(size):
        rolled[i] = same[i] * state[order[i]]
        for j in range(size):
            grown[i, j] = same[i] * same[j] * covariance[order[i], order[j]]
            if beyond[i] * beyond[j] > 0.0:
                grown[i, j] += variance * (math.exp(-drift.forgets * abs(beyond[i] - beyond[j])) - same[i] * same[j])
    return rolled, grown


@compiled
def lateral_variance(
    state: FloatArray, covariance: FloatArray, start_m: float, spacing_m: float, reference_x_m: float, ahead_m: float
) -> float:
    """Of the centerline's place so far ahead of the reference point's foot [m^2]."""
    row = np.empty(len(state))
    path_row(row, lane_path(state, start_m, spacing_m, reference_x_m), start_m, spacing_m, reference_x_m, ahead_m)
    return _variance(row, covariance)


@compiled
def _variance(row: FloatArray, covariance: FloatArray) -> float:
    """Of a row times the state."""
    variance = 0.0
    for j in range(len(row)):
        if row[j] != 0.0:
            for k in range(len(row)):
                variance += row[j] * covariance[j, k] * row[k]
    return max(variance, 0.0)


@compiled
def aside(
    state: FloatArray, start_m: float, spacing_m: float, reference_x_m: float, points_m: FloatArray
) -> FloatArray:
    """How far points (n, 2) [m] lie to the left of the centerline (n,) [m]."""
    path, left = lane_path(state, start_m, spacing_m, reference_x_m), np.empty(len(points_m))
    for i in range(len(points_m)):
        _, left[i] = foot_on(path, points_m[i, 0], points_m[i, 1])
    return left


@compiled
def line_beside(
    state: FloatArray,
    covariance: FloatArray,
    start_m: float,
    spacing_m: float,
    reference_x_m: float,
    role: float,
    s_m: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Where a line, `role` lane widths left of the centerline, runs at arc lengths (n,), as `LaneBelief.beside`."""
    path = lane_path(state, start_m, spacing_m, reference_x_m)
    points, heading, sigma = np.empty((len(s_m), 2)), np.empty(len(s_m)), np.empty(len(s_m))
    row = np.empty(len(state))
    for i in range(len(s_m)):
        x, y, heading[i] = path_row(row, path, start_m, spacing_m, reference_x_m, s_m[i])
        row[WIDTH], row[PITCH] = role, 0.0
        points[i, 0] = x - role * state[WIDTH] * math.sin(heading[i])
        points[i, 1] = y + role * state[WIDTH] * math.cos(heading[i])
        sigma[i] = math.sqrt(_variance(row, covariance))
    return points, heading, sigma
