"""Both lines of a lane as a pair of clothoids of one shape: their places, and the Jacobian for the parameters.

After Smith 2024, eq. (2.1)-(2.7): a heading theta(s) at N nodes, positions by the trapezoidal rule,
one shape for both lines. Two things differ. The lines lie half a lane width beside the centerline *along its normal*:
shifted along y, as in the thesis, the two curves approach each other where the road turns. And the curvature is
piecewise linear between stations that are fixed to the road, a chain of clothoids: a single clothoid cannot follow a
straight road into an arc, at the cost of the pose. With stations farther apart than the nodes reach this is the
thesis's model.

Parameters, body frame: (d, theta, w, w', kappa_0 .. kappa_m-1). d: distance of the reference point to the left of the
centerline [m]; theta: heading of the centerline at the foot of the reference point, s = 0 [rad]; w: lane width there
[m]; w': its change per metre ahead, because a lane that narrows or widens has no parallel lines; kappa_j: curvature at
the station s = j h - phase [1/m]. So c(0) = p_ref - d n(theta), c' = (cos, sin)(theta + int_0^s kappa).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from automodel.compiled import compiled
from automodel.curves.foot import LEAST_STRETCH
from automodel.curves.sampled import Table
from automodel.types import Complexes, FloatArray, Floats


class Parameter(IntEnum):
    """Indices of the parameters."""

    OFFSET = 0  # [m]
    HEADING = 1  # [rad]
    WIDTH = 2  # [m]
    TAPER = 3  # [m/m]
    CURVATURE = 4  # [1/m], the first of m


OFFSET, HEADING, WIDTH, TAPER, CURVATURE = (int(p) for p in Parameter)  # for compiled functions


@dataclass(slots=True, eq=False)
class PairShape:
    """The centerline at the measured nodes (n,) in the body frame, and its Jacobian for the parameters (4 + m,).

    `place` (n,) is x + i y [m], `along` (n,) the unit tangent, as complex numbers. `jacobian` (3 n, 4 + m): movement to
    the left of the left line's nodes [m], of the right line's nodes [m], and turn of the nodes' heading [rad], per unit
    of each parameter. The next call of `shape` overwrites it.
    """

    place: Complexes
    along: Complexes
    jacobian: Floats


class ClothoidPair:
    """A fixed set of nodes and stations; `shape` evaluates the pair there.

    `nodes_m` (n,): rising arc lengths ahead of the reference point at which the lines are measured; `spacing_m` is h.
    Between the reference point and the first node more points are added for the integration. Raises ValueError for
    nodes that do not rise from above 0 and for a spacing that is not positive.
    """

    PHASES = 16  # tabulated phases per spacing; linear interpolation between them errs by (h / 16)^2 / 8 kappa / h

    def __init__(
        self, nodes_m: Floats, spacing_m: float, reference_x_m: float, dtype: type[np.floating[Any]] = np.float64
    ) -> None:
        nodes = np.asarray(nodes_m, dtype=np.float64)
        if nodes.ndim != 1 or len(nodes) < 2 or not (np.diff(nodes, prepend=0.0) > 0).all() or not spacing_m > 0:
            raise ValueError(f"nodes_m: expected rising numbers above 0 and a positive spacing, got {nodes_m}")
        self.nodes_m: Floats = nodes.astype(dtype)
        self.spacing_m, self.reference_x_m, self.dtype = spacing_m, reference_x_m, dtype
        self.count = len(nodes)
        self.stations = int(np.ceil(nodes[-1] / spacing_m)) + 2  # the last one lies beyond the last node at any phase
        self._first = max(int(np.ceil(nodes[0] / (0.5 * spacing_m))), 1)
        s = np.concatenate((np.linspace(0.0, nodes[0], self._first, endpoint=False), nodes))
        self._none: Complexes = np.empty(0, np.result_type(dtype, np.complex64))  # gives the compiled function the type
        self._steps: Floats = np.diff(s).astype(dtype)
        self._parts, self._slopes = self._tables(s)
        n, size = self.count, CURVATURE + self.stations
        self._jacobian: Floats = np.zeros((3 * n, size), dtype)
        self._jacobian[:n, WIDTH], self._jacobian[n : 2 * n, WIDTH] = 0.5, -0.5
        self._jacobian[:n, TAPER], self._jacobian[n : 2 * n, TAPER] = 0.5 * nodes, -0.5 * nodes
        self._jacobian[2 * n :, HEADING] = 1.0

    def shape(self, parameters: Floats, phase_m: float) -> PairShape:
        """The pair of `parameters` (4 + m,) while the reference point is `phase_m` past station 0."""
        at = phase_m / self.spacing_m * self.PHASES
        tables = self._parts, self._slopes, self._steps
        place, along = _lay(parameters, at, tables, self._first, self.reference_x_m, self._jacobian, self._none)
        return PairShape(place=place, along=along, jacobian=self._jacobian)

    def _tables(self, s: FloatArray) -> tuple[Floats, Floats]:
        """Turn per unit of heading and of each curvature (q, k, 1 + m) for phases (q,) at points (k,); its differences.

        The hat function of station j is max(1 - |t|, 0) with t = (s + phase) / h - j; up to a constant its integral is
        h (t - t |t| / 2) for t in -1 .. 1.
        """
        phases = np.arange(self.PHASES + 1) / self.PHASES
        t = s[:, None] / self.spacing_m + phases[:, None, None] - np.arange(self.stations)
        t = np.clip(t, -1.0, 1.0)
        turns = self.spacing_m * (t - 0.5 * t * np.abs(t))
        turns -= turns[:, :1].copy()
        parts = np.concatenate((np.ones((*turns.shape[:2], 1)), turns), axis=2).astype(self.dtype)
        return parts, np.diff(parts, axis=0)

    def table(
        self, parameters: Floats, phase_m: float, lateral_m: float = 0.0, behind_m: float = 0.0, taper: float = 0.0
    ) -> Table:
        """The curve `lateral_m` left of the centerline, and `taper` more per metre ahead.

        It runs from `behind_m` before the reference point to the last node.
        """
        x = np.asarray(parameters, dtype=np.float64)
        stations = np.arange(self.stations) * self.spacing_m - phase_m
        end = float(self.nodes_m[-1])
        step = 0.125 * self.spacing_m
        before, after = max(math.ceil(behind_m / step), 0), math.ceil(end / step)
        s = np.concatenate((np.linspace(-behind_m, 0.0, before, endpoint=False), np.linspace(0.0, end, after + 1)))
        fine = np.linspace(s[:-1], s[1:], 5, axis=1)  # (k - 1, 5): Boole's rule needs five points an interval
        kappa = np.interp(fine, stations, x[CURVATURE:])
        quarter = np.diff(fine, axis=1)
        turns = np.concatenate(
            (np.zeros((len(fine), 1)), np.cumsum(0.5 * quarter * (kappa[:, 1:] + kappa[:, :-1]), axis=1)), axis=1
        )
        theta0 = np.concatenate(([0.0], np.cumsum(turns[:, -1])))
        theta0 += x[HEADING] - theta0[before]
        theta = theta0[:-1, None] + turns
        weights = np.diff(s)[:, None] * (np.array((7.0, 32.0, 12.0, 32.0, 7.0)) / 90.0)
        steps = np.stack(((np.cos(theta) * weights).sum(axis=1), (np.sin(theta) * weights).sum(axis=1)), axis=1)
        points = np.concatenate((np.zeros((1, 2)), np.cumsum(steps, axis=0)))
        normal = np.stack((-np.sin(theta0), np.cos(theta0)), axis=1)
        foot = np.array((self.reference_x_m, 0.0)) - x[OFFSET] * normal[before]
        points += foot - points[before]
        kappa0 = np.interp(s, stations, x[CURVATURE:])
        if lateral_m == taper == 0.0:
            return s - s[0], points, theta0, kappa0
        left, left0 = lateral_m + taper * fine, lateral_m + taper * s
        stretch = np.hypot(np.maximum(1.0 - left * kappa, LEAST_STRETCH), taper)
        lengths = (stretch * weights).sum(axis=1)
        lengths = np.concatenate(([0.0], np.cumsum(lengths)))
        ahead = np.maximum(1.0 - left0 * kappa0, LEAST_STRETCH)
        return lengths, points + left0[:, None] * normal, theta0 + np.arctan2(taper, ahead), kappa0 / ahead


@compiled
def _lay(
    x: Floats,
    at: float,
    tables: tuple[Floats, Floats, Floats],
    first: int,
    reference_x_m: float,
    jacobian: Floats,
    none: Complexes,
) -> tuple[Complexes, Complexes]:
    """`place` and `along` (n,) of `PairShape`, of the type of `none`; fills `jacobian`.

    Eq. (2.4)-(2.6): headings at the points of integration (k,), of which the last n are the nodes, and the trapezoidal
    rule. `at` is the phase as a place in the tables of turns (q, k, 1 + m) and their differences; the third one holds
    the steps of integration (k - 1,) [m].
    """
    parts, slopes, steps = tables
    q = min(int(at), len(slopes) - 1)
    share = at - q
    points, size, n = parts.shape[1], parts.shape[2], len(jacobian) // 3
    place, along = np.empty(n, none.dtype), np.empty(n, none.dtype)
    turns, turns_before = np.empty(size, x.dtype), np.zeros(size, x.dtype)
    moments = np.zeros((size, 2), x.dtype)  # integrals of the tangent times each parameter's turn
    cos = sin = cos_before = sin_before = start_cos = start_sin = 0.0
    for i in range(points):
        angle = 0.0
        for j in range(size):
            turns[j] = parts[q, i, j] + share * slopes[q, i, j]
            angle += turns[j] * x[HEADING if j == 0 else CURVATURE - 1 + j]
        cos, sin = math.cos(angle), math.sin(angle)
        if i == 0:
            start_cos, start_sin = cos, sin
        else:
            half = 0.5 * steps[i - 1]
            for j in range(size):
                moments[j, 0] += half * (cos * turns[j] + cos_before * turns_before[j])
                moments[j, 1] += half * (sin * turns[j] + sin_before * turns_before[j])
        for j in range(size):
            turns_before[j] = turns[j]
        cos_before, sin_before = cos, sin
        node = i - first
        if node < 0:
            continue
        place[node] = complex(reference_x_m + moments[0, 0] + x[0] * start_sin, moments[0, 1] - x[0] * start_cos)
        along[node] = complex(cos, sin)
        for row in (node, node + n):  # both lines move alike, except with the width
            jacobian[row, 0] = -(cos * start_cos + sin * start_sin)
            jacobian[row, 1] = cos * moments[0, 0] + sin * moments[0, 1] + x[0] * (cos * start_sin - sin * start_cos)
            for j in range(1, size):
                jacobian[row, CURVATURE - 1 + j] = cos * moments[j, 0] + sin * moments[j, 1]
        for j in range(1, size):
            jacobian[node + 2 * n, CURVATURE - 1 + j] = turns[j]
    return place, along
