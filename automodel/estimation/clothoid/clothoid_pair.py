"""Both lines of a lane as a pair of clothoids with one shape: where they run, and how that depends on the parameters.

After Smith, "Efficient Lateral Lane Position Sensing using Active Contour Modeling", eq. (2.1)-(2.7): a heading
theta(s) along N nodes, positions by the trapezoidal rule, one shape for both lines. Two things differ. The lines lie at
half the lane's width beside the centerline *along its normal*: shifted sideways, as in the thesis, two curves come
closer where the road turns away. And the curvature is linear between stations that lie fixed on the road, a chain of
clothoids: one clothoid cannot follow a straight road into an arc, and the pose at the car pays for it; with
stations further apart than the nodes reach it is the thesis's model.

Parameters, body frame: (d, theta, w, kappa_0 .. kappa_m-1). d: the reference point's distance to the left of the
centerline; theta: the centerline's direction at its foot, where s = 0; w: the lane's width; kappa_j: curvature at the
stations s = j h - phase. So c(0) = p_ref - d n(theta), c' = (cos, sin)(theta + int_0^s kappa).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from automodel.compiled import compiled
from automodel.types import Complexes, FloatArray, Floats

_LEAST_STRETCH = 0.05  # of an arc length beside the centerline: nearer to the centre of curvature no curve is drawn


class Parameter(IntEnum):
    """Where a parameter stands."""

    OFFSET = 0  # [m]
    HEADING = 1  # [rad]
    WIDTH = 2  # [m]
    CURVATURE = 3  # [1/m], this one and all that follow


@dataclass(slots=True, eq=False)
class PairShape:
    """The centerline at the measured nodes (n,), body frame, and what the parameters (3 + m,) do there.

    `place` (n,) is x + i y [m], `along` (n,) the unit tangent, also as complex numbers. `jacobian` (3 n, 3 + m):
    movement to the left [m] of the left line's nodes, of the right line's, and change of the nodes' heading [rad], per
    unit of each parameter; the next `shape` overwrites it.
    """

    place: Complexes
    along: Complexes
    jacobian: Floats


class ClothoidPair:
    """A fixed set of nodes and stations; `shape` lays the pair through them.

    `nodes_m` (n,) rising arc lengths that are measured, ahead of the reference point; `spacing_m` is h. Between the
    reference point and the first of them nodes are added, for the integration alone.
    """

    PHASES = (
        16  # for which the stations' parts are tabulated; in between they are interpolated, to (h / 16)^2 / 8 kappa / h
    )

    def __init__(
        self, nodes_m: Floats, spacing_m: float, reference_x_m: float, dtype: type[np.floating[Any]] = np.float64
    ) -> None:
        nodes = np.asarray(nodes_m, dtype=np.float64)
        if nodes.ndim != 1 or len(nodes) < 2 or not (np.diff(nodes, prepend=0.0) > 0).all() or not spacing_m > 0:
            raise ValueError(f"nodes_m: rising numbers above 0 and a positive spacing are wanted, not {nodes_m}")
        self.nodes_m: Floats = nodes.astype(dtype)
        self.spacing_m, self.reference_x_m, self.dtype = spacing_m, reference_x_m, dtype
        self.count = len(nodes)
        self.stations = int(np.ceil(nodes[-1] / spacing_m)) + 2  # the last one ahead of the last node at any phase
        self._first = max(int(np.ceil(nodes[0] / (0.5 * spacing_m))), 1)
        s = np.concatenate((np.linspace(0.0, nodes[0], self._first, endpoint=False), nodes))
        self._none: Complexes = np.empty(0, np.result_type(dtype, np.complex64))  # tells the type of what is laid
        self._steps: Floats = np.diff(s).astype(dtype)
        self._parts, self._slopes = self._tables(s)
        n, size = self.count, Parameter.CURVATURE + self.stations
        self._jacobian: Floats = np.zeros((3 * n, size), dtype)
        self._jacobian[:n, Parameter.WIDTH], self._jacobian[n : 2 * n, Parameter.WIDTH] = 0.5, -0.5
        self._jacobian[2 * n :, Parameter.HEADING] = 1.0

    def shape(self, parameters: Floats, phase_m: float) -> PairShape:
        """The pair that `parameters` (3 + m,) mean while the reference point is `phase_m` past station 0."""
        at = phase_m / self.spacing_m * self.PHASES
        tables = self._parts, self._slopes, self._steps
        place, along = _lay(parameters, at, *tables, self._first, self.reference_x_m, self._jacobian, self._none)
        return PairShape(place=place, along=along, jacobian=self._jacobian)

    def _tables(self, s: FloatArray) -> tuple[Floats, Floats]:
        """For phases (q,), at nodes (k,): turns per unit of heading and of each curvature (q, k, 1 + m); their slopes.

        The hat function of station j is max(1 - |t|, 0) with t = (s + phase) / h - j; its integral is h (t - t |t| / 2)
        for t in -1 .. 1, but for a constant.
        """
        phases = np.arange(self.PHASES + 1) / self.PHASES
        t = s[:, None] / self.spacing_m + phases[:, None, None] - np.arange(self.stations)
        t = np.clip(t, -1.0, 1.0)
        turns = self.spacing_m * (t - 0.5 * t * np.abs(t))
        turns -= turns[:, :1].copy()
        parts = np.concatenate((np.ones((*turns.shape[:2], 1)), turns), axis=2).astype(self.dtype)
        return parts, np.diff(parts, axis=0)

    def table(
        self, parameters: Floats, phase_m: float, aside_m: float = 0.0, behind_m: float = 0.0
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """The curve `aside_m` left of the centerline, from `behind_m` before the reference point to the last node.

        Arc lengths from 0 (k,), points (k, 2) [m], headings [rad] and curvatures [1/m] (k,), as `TabulatedCurve` has
        them.
        """
        x = np.asarray(parameters, dtype=np.float64)
        stations = np.arange(self.stations) * self.spacing_m - phase_m
        end = float(self.nodes_m[-1])
        step = 0.125 * self.spacing_m
        before, after = max(math.ceil(behind_m / step), 0), math.ceil(end / step)
        s = np.concatenate((np.linspace(-behind_m, 0.0, before, endpoint=False), np.linspace(0.0, end, after + 1)))
        fine = np.linspace(s[:-1], s[1:], 5, axis=1)  # (k - 1, 5): Boole's rule needs five points an interval
        kappa = np.interp(fine, stations, x[Parameter.CURVATURE :])
        quarter = np.diff(fine, axis=1)
        turns = np.concatenate(
            (np.zeros((len(fine), 1)), np.cumsum(0.5 * quarter * (kappa[:, 1:] + kappa[:, :-1]), axis=1)), axis=1
        )
        theta0 = np.concatenate(([0.0], np.cumsum(turns[:, -1])))
        theta0 += x[Parameter.HEADING] - theta0[before]
        theta = theta0[:-1, None] + turns
        weights = np.diff(s)[:, None] * (np.array((7.0, 32.0, 12.0, 32.0, 7.0)) / 90.0)
        steps = np.stack(((np.cos(theta) * weights).sum(axis=1), (np.sin(theta) * weights).sum(axis=1)), axis=1)
        points = np.concatenate((np.zeros((1, 2)), np.cumsum(steps, axis=0)))
        normal = np.stack((-np.sin(theta0), np.cos(theta0)), axis=1)
        foot = np.array((self.reference_x_m, 0.0)) - x[Parameter.OFFSET] * normal[before]
        points += foot - points[before]
        kappa0 = np.interp(s, stations, x[Parameter.CURVATURE :])
        if aside_m == 0.0:
            return s - s[0], points, theta0, kappa0
        stretch = np.maximum(1.0 - aside_m * kappa, _LEAST_STRETCH)
        lengths = (stretch * weights).sum(axis=1)
        s = np.concatenate(([0.0], np.cumsum(lengths)))
        return s, points + aside_m * normal, theta0, kappa0 / np.maximum(1.0 - aside_m * kappa0, _LEAST_STRETCH)


@compiled
def _lay(
    x: Floats,
    at: float,
    parts: Floats,
    slopes: Floats,
    steps: Floats,
    first: int,
    reference_x_m: float,
    jacobian: Floats,
    none: Complexes,
) -> tuple[Complexes, Complexes]:
    """`place` and `along` (n,), as `PairShape` has them and of the type of `none`; `jacobian` is filled in.

    By eq. (2.4)-(2.6): headings at the integration's points (k,), of which the last n are measured, and trapezoids
    `steps` (k - 1,) apart. `at` is the place in the tables of the turns (k, 1 + m) and of their slopes.
    """
    q = min(int(at), len(slopes) - 1)
    share = at - q
    points, size, n = parts.shape[1], parts.shape[2], len(jacobian) // 3
    place, along = np.empty(n, none.dtype), np.empty(n, none.dtype)
    turns, turns_before = np.empty(size, x.dtype), np.zeros(size, x.dtype)
    moments = np.zeros((size, 2), x.dtype)  # of the unit tangent times each parameter's turn
    cos = sin = cos_before = sin_before = start_cos = start_sin = 0.0
    for i in range(points):
        angle = 0.0
        for j in range(size):
            turns[j] = parts[q, i, j] + share * slopes[q, i, j]
            angle += turns[j] * x[1 if j == 0 else 2 + j]
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
        for row in (node, node + n):  # the left line moves as the right one does, but for the width
            jacobian[row, 0] = -(cos * start_cos + sin * start_sin)
            jacobian[row, 1] = cos * moments[0, 0] + sin * moments[0, 1] + x[0] * (cos * start_sin - sin * start_cos)
            for j in range(1, size):
                jacobian[row, 2 + j] = cos * moments[j, 0] + sin * moments[j, 1]
        for j in range(1, size):
            jacobian[node + 2 * n, 2 + j] = turns[j]
    return place, along
