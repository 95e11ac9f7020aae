"""The centerline whose curvature is linear between stations, as short arcs, and how it moves with what is believed.

A path (arcs, 9) has, of each arc, its start's arc length [m] from the reference point's foot, x, y [m] and heading
[rad] in the body frame, its curvature [1/m], the cosine and sine of that heading, and x, y [m] of the arc's middle. The
state (4 + stations,) is that of `belief.LaneBelief`.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from automodel.compiled import compiled
from automodel.curves.sampled import DeferredCurve, Table, beside
from automodel.types import FloatArray

OFFSET, THETA, WIDTH, PITCH, ROAD = range(5)  # indices of the state; from the last one on, the stations
ARCS = 2  # between two stations


@compiled
def station(at_m: float, spacing_m: float, stations: int) -> tuple[int, float]:
    """The station before a place so far from the first one, and the share of the next one's curvature there."""
    at = min(max(at_m / spacing_m, 0.0), stations - 1.0)
    first = min(int(at), stations - 2)
    return first, at - first


@compiled
def curvature(state: FloatArray, at_m: float, spacing_m: float) -> float:
    """The curvature [1/m] at a place so far from the first station."""
    first, share = station(at_m, spacing_m, len(state) - ROAD)
    return (1.0 - share) * state[ROAD + first] + share * state[ROAD + first + 1]


@compiled
def _cos_and_sinc(turn: float) -> tuple[float, float]:
    """cos(turn) and sin(turn) / turn; up to 0.2 rad by their series, which are as exact there and faster."""
    square = turn * turn
    if square > 0.04:
        return math.cos(turn), math.sin(turn) / turn
    cos = 1.0 - square * (1.0 / 2.0 - square * (1.0 / 24.0 - square * (1.0 / 720.0 - square / 40320.0)))
    return cos, 1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0 - square * (1.0 / 5040.0 - square / 362880.0)))


@compiled
def lane_path(state: FloatArray, start_m: float, spacing_m: float, reference_x_m: float) -> FloatArray:
    """The centerline of a state, whose first station lies `start_m` behind the reference point's foot."""
    arcs = ARCS * (len(state) - ROAD - 1)
    path, step = np.empty((arcs, 9)), spacing_m / ARCS
    heading = state[THETA]
    cos, sin = math.cos(heading), math.sin(heading)
    x, y = reference_x_m + state[OFFSET] * sin, -state[OFFSET] * cos
    for i in range(arcs):
        kappa = curvature(state, (i + 0.5) * step + start_m, spacing_m)
        path[i, 0], path[i, 1], path[i, 2], path[i, 3], path[i, 4] = i * step, x, y, heading, kappa
        path[i, 5], path[i, 6] = cos, sin
        turn = 0.25 * kappa * step  # to the middle the arc turns twice, to its end four times as much
        c, sinc = _cos_and_sinc(turn)
        s, chord = turn * sinc, 0.5 * step * sinc
        along, aside = chord * c, chord * s
        path[i, 7], path[i, 8] = x + along * cos - aside * sin, y + along * sin + aside * cos
        chord = step * sinc * c
        c, s = c * c - s * s, 2.0 * s * c
        along, aside = chord * c, chord * s
        x, y = x + along * cos - aside * sin, y + along * sin + aside * cos
        c, s = c * c - s * s, 2.0 * s * c
        cos, sin = cos * c - sin * s, sin * c + cos * s
        heading += kappa * step
    return path


@compiled
def _on_arc(kappa: float, s_m: float) -> tuple[float, float]:
    """Where an arc is after a length, along and to the left of its first direction [m]."""
    half = 0.5 * kappa * s_m
    chord = s_m if abs(half) < 1e-9 else s_m * math.sin(half) / half
    return chord * math.cos(half), chord * math.sin(half)


@compiled
def place_on(path: FloatArray, s_m: float) -> tuple[float, float, float]:
    """x, y [m] and heading [rad] of a path at an arc length; before and beyond it its first and last arc go on."""
    arc = min(max(int(s_m / path[1, 0]), 0), len(path) - 1)
    beyond = s_m - path[arc, 0]
    along, aside = _on_arc(path[arc, 4], beyond)
    cos, sin = path[arc, 5], path[arc, 6]
    return (
        path[arc, 1] + along * cos - aside * sin,
        path[arc, 2] + along * sin + aside * cos,
        path[arc, 3] + path[arc, 4] * beyond,
    )


@compiled
def foot_on(path: FloatArray, x_m: float, y_m: float) -> tuple[float, float]:
    """Arc length of the foot of a point, and the point's distance to the left of the path [m]."""
    nearest, arc = np.inf, 0
    for i in range(len(path)):
        away_x, away_y = x_m - path[i, 7], y_m - path[i, 8]
        square = away_x * away_x + away_y * away_y
        if square < nearest:
            nearest, arc = square, i
    cos, sin, kappa = path[arc, 5], path[arc, 6], path[arc, 4]
    x, y = x_m - path[arc, 1], y_m - path[arc, 2]
    ahead, left = x * cos + y * sin, y * cos - x * sin
    if abs(kappa) < 1e-9:
        return path[arc, 0] + ahead, left
    a, b = kappa * ahead, max(1.0 - kappa * left, 0.05)
    s = math.atan2(a, b) / kappa
    return path[arc, 0] + s, (2.0 * left - kappa * (left * left + ahead * ahead)) / (1.0 + math.hypot(a, b))


@compiled
def path_row(
    row: FloatArray, path: FloatArray, start_m: float, spacing_m: float, reference_x_m: float, s_m: float
) -> tuple[float, float, float]:
    """Fill a row with the derivatives of the path's place, to its left, at an arc length; returns that place.

    The row (4 + stations,) is that of the state; width and pitch do not move the path.
    """
    x, y, heading = place_on(path, s_m)
    cos, sin = math.cos(heading), math.sin(heading)
    row[:] = 0.0
    row[OFFSET] = -math.cos(heading - path[0, 3])
    row[THETA] = (x - reference_x_m) * cos + y * sin
    step, last = path[1, 0], len(path) - 1
    for i in range(last + 1):
        passed = s_m - path[i, 0]
        if passed <= 0.0:
            break
        turns_x, turns_y = path[i, 7], path[i, 8]
        if passed < step or i == last:
            along, aside = _on_arc(path[i, 4], 0.5 * passed)
            turns_x = path[i, 1] + along * path[i, 5] - aside * path[i, 6]
            turns_y = path[i, 2] + along * path[i, 6] + aside * path[i, 5]
        else:
            passed = step
        moved = passed * ((x - turns_x) * cos + (y - turns_y) * sin)
        first, share = station(path[i, 0] + 0.5 * step + start_m, spacing_m, len(row) - ROAD)
        row[ROAD + first] += (1.0 - share) * moved
        row[ROAD + first + 1] += share * moved
    return x, y, heading


def next_lane(
    state: FloatArray, covariance: FloatArray, side: int, width_sigma_m: float
) -> tuple[FloatArray, FloatArray]:
    """State (n,) and covariance (n, n) of the neighbour lane on a side, +1 left or -1 right, by those of a lane.

    `width_sigma_m`: by how much its width differs from this one's.
    """
    away = np.eye(len(state))
    away[OFFSET, WIDTH] = -side
    own = np.zeros(len(state))  # of its width, half of which lies this side of its middle
    own[OFFSET], own[WIDTH] = -0.5 * side, 1.0
    return away @ state, away @ covariance @ away.T + width_sigma_m**2 * np.outer(own, own)


def line_of_path(
    state: FloatArray,
    start_m: float,
    spacing_m: float,
    reference_x_m: float,
    lateral_m: float,
    span: tuple[int, int],
    step_m: float,
) -> DeferredCurve:
    """The line `lateral_m` to the left of a state's `lane_path`, sampled every `step_m`, body frame.

    `span`: how many steps before the reference point's foot it begins, and how many beyond it ends. `state`
    must not be written to any more.
    """
    return DeferredCurve(partial(_path_table, state, start_m, spacing_m, reference_x_m, lateral_m, span, step_m))


def _path_table(
    state: FloatArray,
    start_m: float,
    spacing_m: float,
    reference_x_m: float,
    lateral_m: float,
    span: tuple[int, int],
    step_m: float,
) -> Table:
    behind, ahead = span
    s_m = step_m * np.arange(-behind, ahead + 1, dtype=np.float64)
    path = lane_path(state, start_m, spacing_m, reference_x_m)
    places = np.array([place_on(path, one) for one in s_m.tolist()])
    kappa = np.interp(s_m + start_m, spacing_m * np.arange(len(state) - ROAD), state[ROAD:])
    table = s_m - s_m[0], places[:, :2], places[:, 2], kappa
    return beside(table, lateral_m) if lateral_m else table
