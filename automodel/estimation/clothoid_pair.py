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
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]
FloatArray = NDArray[np.float64]
Complexes = NDArray[np.complexfloating[Any, Any]]
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
        complexes = np.result_type(dtype, np.complex64)
        self._sums: Complexes = _trapezoids(s)[self._first :].astype(complexes)
        self._parts, self._slopes = self._tables(s)
        self._turning = np.array([Parameter.HEADING, *range(Parameter.CURVATURE, Parameter.CURVATURE + self.stations)])
        n, size = self.count, Parameter.CURVATURE + self.stations
        self._jacobian: Floats = np.zeros((3 * n, size), dtype)
        self._jacobian[:n, Parameter.WIDTH], self._jacobian[n : 2 * n, Parameter.WIDTH] = 0.5, -0.5
        self._jacobian[2 * n :, Parameter.HEADING] = 1.0

    def shape(self, parameters: Floats, phase_m: float) -> PairShape:
        """The pair that `parameters` (3 + m,) mean while the reference point is `phase_m` past station 0."""
        n, first, jacobian = self.count, self._first, self._jacobian
        at = phase_m / self.spacing_m * self.PHASES
        q = min(int(at), self.PHASES - 1)
        turns = self._slopes[q] * (at - q)
        turns += self._parts[q]
        unit = np.exp(1j * (turns @ parameters.take(self._turning)))
        moments = self._sums @ (unit[:, None] * turns)  # of the unit tangent, and of it times each station's turn
        start, along = unit[0], unit[first:]
        back = along.conj()
        swing = (back[:, None] * moments).real
        back *= start
        offset = float(parameters[0])
        left = jacobian[:n]
        left[:, 3:] = swing[:, 1:]
        np.add(swing[:, 0], back.imag * offset, out=left[:, 1])
        np.negative(back.real, out=left[:, 0])
        jacobian[n : 2 * n, :2] = left[:, :2]
        jacobian[n : 2 * n, 3:] = swing[:, 1:]
        jacobian[2 * n :, 3:] = turns[first:, 1:]
        place = moments[:, 0] + (self.reference_x_m - 1j * offset * start)
        return PairShape(place=place, along=along, jacobian=jacobian)

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


def _trapezoids(s: FloatArray) -> FloatArray:
    """Matrix (k, k) that integrates values at `s` (k,) from the first to each of them: eq. (2.5)-(2.6)."""
    sums = np.zeros((len(s), len(s)))
    for i, step in enumerate(np.diff(s), 1):
        sums[i] = sums[i - 1]
        sums[i, i - 1 : i + 1] += 0.5 * step
    return sums
