"""The clothoid pair over time: predicted with the car's motion, corrected by the nodes that were found in each frame.

A Kalman filter on the parameters of `ClothoidPair`. The stations are fixed to the road: a motion along the lane leaves
the curvatures unchanged and moves offset and heading by the odometry. After each station spacing h the station behind
the car is dropped and one ahead is added. So the lane under the car is remembered as the curvature that was measured
when the camera saw it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from automodel.compiled import compiled
from automodel.curves.foot import foot_on_circle
from automodel.estimation.clothoid.clothoid_pair import (
    CURVATURE,
    HEADING,
    OFFSET,
    TAPER,
    WIDTH,
    ClothoidPair,
    PairShape,
)
from automodel.estimation.clothoid.solvers import SOLVERS, Sightings, State, correct, gradient_descent
from automodel.estimation.road import TAPER as ROAD_TAPER
from automodel.estimation.road import TAPER_LANES
from automodel.geometry.elimination import solve
from automodel.types import Bools, FloatArray, Floats, Ints


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerConfig:
    """Noise of the filter; lengths in lane widths, so that one set serves scale cars and highways.

    The sigma of a random walk is the one after a lane width of distance. Curvatures are shares of the tightest bend's.
    """

    lane_width_m: float
    radius_lanes: float  # of the tightest bend
    gate: float  # [sigmas of the estimate and the measurement together]
    solver: str = "gauss_newton"  # a key of `SOLVERS`
    walk: float = 0.012  # of offset, and heading [rad]; with 0.02 a wrong speed is noticed too late
    width_walk: float = 0.002
    curvature_walk: float = 0.03  # of a station's value: what was measured gets out of date
    curvature_step: float = 0.4  # from station to station, per root lane width of road
    straighten: float = 0.95  # share of a curvature that is expected to remain half a lane width further on
    unknown: float = 0.05  # added to the offset, and to the heading [rad], in a frame without odometry
    unknown_curvature: float = 0.8  # share that is kept then of a curvature out of sight: the car may have passed it
    unknown_share: float = 0.1  # share of the variance of roads' curvature that is added in its place


_foot_on_circle = compiled(foot_on_circle)


@compiled
def advance(x: Floats, p: Floats, dx: float, dy: float, phase_m: float, spacing_m: float) -> float:
    """Move the origin to the foot of the point (`dx`, `dy`) [m] ahead and left of the reference point, in place.

    The foot is taken on the circle of the road's mean curvature up to there. Returns the distance along the lane [m];
    directions stay those of the old body frame.
    """
    cos, sin = math.cos(x[HEADING]), math.sin(x[HEADING])
    ahead, left = dx * cos + dy * sin, dy * cos - dx * sin + x[OFFSET]
    last = len(x) - CURVATURE - 1
    place = min(max((phase_m + 0.5 * ahead) / spacing_m, 0.0), float(last))
    j = min(int(place), last - 1)
    share = place - j
    station, after = CURVATURE + j, CURVATURE + j + 1
    kappa = (1.0 - share) * x[station] + share * x[after]
    distance, x[OFFSET] = _foot_on_circle(ahead, left, kappa)
    x[HEADING] += kappa * distance
    x[WIDTH] += distance * x[TAPER]
    here, beyond = (1.0 - share) * distance, share * distance
    for k in range(len(x)):  # P <- F P: the derivatives of offset and heading
        p[OFFSET, k] -= ahead * p[HEADING, k]
        p[HEADING, k] += here * p[station, k] + beyond * p[after, k]
        p[WIDTH, k] += distance * p[TAPER, k]
    for k in range(len(x)):  # P <- P F^T
        p[k, OFFSET] -= ahead * p[k, HEADING]
        p[k, HEADING] += here * p[k, station] + beyond * p[k, after]
        p[k, WIDTH] += distance * p[k, TAPER]
    return float(distance)


@compiled
def add_process_noise(p: Floats, walk: Floats, floor: Floats, distance: float) -> None:
    """Add the process noise of `distance` [lane widths] and a frame."""
    for i in range(len(p)):
        p[i, i] += walk[i] * distance + floor[i]


@compiled
def _sigma(jacobian: Floats, p: Floats) -> Floats:
    """Standard deviations (2 n,) of the first rows of the Jacobian (3 n, m)."""
    sigma = np.empty(2 * len(jacobian) // 3, p.dtype)
    for i in range(len(sigma)):
        variance = 0.0
        for a in range(len(p)):
            for b in range(len(p)):
                variance += jacobian[i, a] * p[a, b] * jacobian[i, b]
        sigma[i] = math.sqrt(max(variance, 0.0))
    return sigma


@compiled
def _half_m(x: Floats, nodes_m: Floats) -> Floats:
    """Half the lane's width (n,) at arc lengths (n,)."""
    half = np.empty_like(nodes_m)
    for i in range(len(half)):
        half[i] = max(0.5 * (x[WIDTH] + x[TAPER] * nodes_m[i]), 0.0)
    return half


@compiled
def _pose_covariance(p: Floats) -> FloatArray:
    """The covariance (3, 3) of offset, -heading and width."""
    turned = np.empty((TAPER, TAPER))
    for i in range(TAPER):
        for j in range(TAPER):
            turned[i, j] = p[i, j] if (i == HEADING) == (j == HEADING) else -p[i, j]
    return turned


@compiled
def _of_known_width(p: Floats, side: float) -> tuple[Floats, Floats]:
    """The covariance (m, m) of a lane whose width and taper are known, and how the lane moves with these (m, 2).

    A lone line, on the left (`side` +1) or right (-1), says nothing of width and taper, only the model's errors would:
    they are not estimated from it, and offset and heading err with them so that the line stays where it is (Schmidt
    1966, a filter with parameters that it considers).
    """
    size = len(p)
    both, right = np.empty((2, 2)), np.empty((2, size))
    for a in range(2):
        for b in range(2):
            both[a, b] = p[WIDTH + a, WIDTH + b]
        for j in range(size):
            right[a, j] = p[WIDTH + a, j]
    rest = solve(both, right)
    alone, moved = np.empty_like(p), np.zeros((size, 2), p.dtype)
    for i in range(size):
        for j in range(size):
            alone[i, j] = p[i, j] - (p[i, WIDTH] * rest[0, j] + p[i, TAPER] * rest[1, j])
    for k in (WIDTH, TAPER):
        for i in range(size):
            alone[k, i] = alone[i, k] = 0.0
    for k in (WIDTH, TAPER):
        alone[k, k] = 1e-6 * p[k, k]  # known, but not singular
    moved[OFFSET, 0], moved[HEADING, 1] = 0.5 * side, -0.5 * side
    moved[WIDTH, 0] = moved[TAPER, 1] = 1.0
    return alone, moved


@compiled
def _corrected(
    descend: bool, state: State, seen: Sightings, scales: tuple[float, float, float]
) -> tuple[Floats, Floats, int, Bools, float]:
    """As `correct`, which it does anew, with width and taper known, where one line alone was seen."""
    before, covariance, prior, p = state
    parameters, after, count, carrying, moved_m = correct(descend, state, seen, scales)
    nodes, lefts = seen[2], len(seen[0]) // 3
    left = right = False
    for i in range(len(nodes)):
        if carrying[i] and nodes[i] < lefts:
            left = True
        elif carrying[i]:
            right = True
    if left == right:
        return parameters, after, count, carrying, moved_m
    alone, moved = _of_known_width(p, 1.0 if left else -1.0)
    parameters, after, again, carrying, moved_m = correct(descend, (before, covariance, prior, alone), seen, scales)
    for i in range(len(p)):
        for j in range(len(p)):
            for a in range(2):
                for b in range(2):
                    after[i, j] += moved[i, a] * p[WIDTH + a, WIDTH + b] * moved[j, b]
    return parameters, after, count + again, carrying, moved_m


class ClothoidTracker:
    """One lane, tracked from frame to frame.

    `parameters` (m,) is None while there is no lane; `covariance` (m, m) is theirs. `advance_m` is the distance
    of the last `move` along the lane, `moved_m` how far the last `update` moved the lane halfway along. `iterations`
    counts those of the solver since `move`.
    """

    def __init__(self, pair: ClothoidPair, config: TrackerConfig, sigma: Floats) -> None:
        """`sigma` (3 n,): standard deviations of the nodes' places [m] and headings [rad], rows as in `PairShape`."""
        self.pair, self.config = pair, config
        self._descend = SOLVERS[config.solver] is gradient_descent
        dtype, unit = pair.dtype, config.lane_width_m
        self._bend = bend = 1.0 / (config.radius_lanes * unit)
        slack = np.repeat((0.02 * unit, 0.0), (2 * pair.count, pair.count))
        self._noise: Floats = np.stack((sigma * sigma, 3.0 * sigma + slack)).astype(dtype)  # variance, and the limit
        size = CURVATURE + pair.stations
        self._one: Floats = np.eye(size, dtype=dtype)
        self._lever_m = float(pair.nodes_m[pair.count // 2])
        walk = np.full(size, config.curvature_walk * bend)
        walk[:TAPER] = config.walk * unit, config.walk, config.width_walk * unit
        walk[TAPER] = ROAD_TAPER * math.sqrt(2.0 / TAPER_LANES)
        self._walk: Floats = (walk**2).astype(dtype)
        floor = np.full(size, 1e-4 * bend)
        floor[:CURVATURE] = 0.0005 * unit, 0.0003, 0.0001 * unit, 0.0001
        self._floor: Floats = (floor**2).astype(dtype)
        step = pair.spacing_m / unit
        self._kept = config.straighten ** (2.0 * step)
        self._new_variance = (config.curvature_step * bend) ** 2 * step
        away = np.abs(np.subtract.outer(np.arange(pair.stations), np.arange(pair.stations)))
        stationary = self._new_variance / (1.0 - self._kept**2)
        self._road: Floats = (stationary * self._kept**away).astype(dtype)
        self.forget()

    def forget(self) -> None:
        """Drop the lane."""
        self.parameters: Floats | None = None
        self.covariance: Floats = self._one
        self._prior: tuple[Floats, Floats] = self._one[0], self._one
        self.phase_m = self.advance_m = self.moved_m = 0.0
        self.iterations = 0

    def start(self, mean: FloatArray, covariance: FloatArray) -> None:
        """Start about a belief: (offset, heading of the lane, curvature, width) (4,), and its covariance (4, 4)."""
        self.forget()
        guess = np.full(len(self._one), mean[2], self.pair.dtype)
        guess[:CURVATURE] = *mean[[0, 1, 3]], 0.0
        spread = np.zeros_like(self._one)
        spread[:TAPER, :TAPER] = covariance[np.ix_((0, 1, 3), (0, 1, 3))]
        spread[TAPER, TAPER] = ROAD_TAPER**2
        spread[CURVATURE:, CURVATURE:] = self._road
        self.parameters, self.covariance = guess, spread
        self._prior = guess, spread

    def move(self, distance_m: float, turn_rad: float, known: bool) -> None:
        """Move the lane into the body frame after a motion along an arc; `known` is False without odometry."""
        self.iterations = 0
        if self.parameters is None:
            return
        x, p = self.parameters.copy(), self.covariance.copy()
        self.advance_m = 0.0
        if known:
            self._advance(x, p, distance_m, turn_rad)
        unit, config = self.config.lane_width_m, self.config
        add_process_noise(p, self._walk, self._floor, self.advance_m / unit)
        if not known:
            p[OFFSET, OFFSET] += (config.unknown * unit) ** 2
            p[HEADING, HEADING] += config.unknown**2
            self._relax(x, p)
        self.parameters, self.covariance = x, p
        self._prior = x, p

    def _advance(self, x: Floats, p: Floats, distance_m: float, turn_rad: float) -> None:
        """Offset and heading at the foot of the reference point after the motion."""
        reference, h = self.pair.reference_x_m, self.pair.spacing_m
        half = 0.5 * turn_rad
        chord = distance_m * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
        dx = chord * math.cos(half) + reference * (math.cos(turn_rad) - 1.0)
        dy = chord * math.sin(half) + reference * math.sin(turn_rad)
        distance = advance(x, p, dx, dy, self.phase_m, h)
        self.advance_m = abs(distance)
        kept = math.exp(-self.advance_m / (TAPER_LANES * self.config.lane_width_m))
        x[TAPER] *= kept
        p[TAPER, :] *= kept
        p[:, TAPER] *= kept
        self.phase_m += distance
        while self.phase_m >= h:
            self._roll(x, p, +1)
        while self.phase_m < 0.0:
            self._roll(x, p, -1)
        x[HEADING] -= turn_rad

    def _relax(self, x: Floats, p: Floats) -> None:
        """Without odometry, pull curvatures out of sight towards the first one in sight; all become less certain.

        The lane keeps its place there and turns about it below the car.
        """
        kept, n, m = self.config.unknown_curvature, self.pair.count, self.pair.stations
        place, heading = self.pair.shape(x, self.phase_m).jacobian[[0, 2 * n]]
        seen = min(round((float(self.pair.nodes_m[0]) + self.phase_m) / self.pair.spacing_m), m - 1)
        mix = self._one[CURVATURE:, CURVATURE:].copy()
        mix[:seen] *= kept
        mix[:seen, seen] += 1.0 - kept
        change = mix @ x[CURVATURE:] - x[CURVATURE:]
        x[CURVATURE:] += change
        turn = -float(heading[CURVATURE:] @ change)
        x[HEADING] += turn
        x[OFFSET] -= (float(place[CURVATURE:] @ change) + float(place[HEADING]) * turn) / float(place[OFFSET])
        p[CURVATURE:] = mix @ p[CURVATURE:]
        p[:, CURVATURE:] = p[:, CURVATURE:] @ mix.T
        p[CURVATURE:, CURVATURE:] += (1.0 - kept * kept) * self.config.unknown_share * self._road

    def _roll(self, x: Floats, p: Floats, direction: int) -> None:
        """Drop the station behind the car and add one ahead (`direction` +1), or the reverse (-1)."""
        self.phase_m -= direction * self.pair.spacing_m
        first, kept = CURVATURE, self._kept
        old, new = (slice(first + 1, None), slice(first, -1))[::direction]
        x[new] = x[old].copy()
        p[new] = p[old].copy()
        p[:, new] = p[:, old].copy()
        fresh = -1 if direction > 0 else first
        x[fresh] *= kept
        p[fresh, :] *= kept
        p[:, fresh] *= kept
        p[fresh, fresh] += self._new_variance

    @property
    def width_m(self) -> float:
        """The lane's width."""
        return float(self.known()[WIDTH])

    @property
    def taper(self) -> float:
        """How much wider the lane becomes for each metre ahead."""
        return float(self.known()[TAPER])

    def half_m(self) -> Floats:
        """Half the lane's width (n,) at the nodes."""
        return _half_m(self.known(), self.pair.nodes_m)

    def sigma_m(self, shape: PairShape) -> Floats:
        """Standard deviations (2 n,) [m] of the places of both lines' nodes."""
        return _sigma(shape.jacobian, self.covariance)

    def curvature(self) -> float:
        """The centerline's curvature [1/m] at the reference point's foot."""
        share = self.phase_m / self.pair.spacing_m
        first, second = self.known()[CURVATURE : CURVATURE + 2].tolist()
        return float((1.0 - share) * first + share * second)

    def pose(self) -> tuple[float, float, float, FloatArray]:
        """Offset [m], the lane's heading [rad] and width [m]; covariance (3, 3) of (offset, -heading, width)."""
        offset, heading, width = self.known()[:TAPER].tolist()
        return offset, heading, width, _pose_covariance(self.covariance)

    def known(self) -> Floats:
        """The parameters; raises ValueError while there are none."""
        if self.parameters is None:
            raise ValueError("nothing is tracked; call start first")
        return self.parameters

    def shape(self) -> PairShape:
        """The pair now; raises ValueError while there is none."""
        return self.pair.shape(self.known(), self.phase_m)

    def update(self, shape: PairShape, nodes: Ints, residual: Floats, found: Floats) -> Bools:
        """Correct the lane by the nodes that were searched for; returns which of them (k,) support it.

        `nodes` (k,) are indices into the 2 n nodes, the left line's first. `residual` (2 k,): the distances to the left
        of `shape` at which lines were found [m], then their angles to the left of it [rad]; valid where `found` (2 k,)
        is 1, not 0.
        """
        self.parameters, self.covariance, count, carrying, self.moved_m = _corrected(
            self._descend,
            (self.known(), self.covariance, *self._prior),
            (shape.jacobian, self._noise, nodes, residual, found),
            (self.config.gate, self._bend, self._lever_m),
        )
        self.iterations += count
        return carrying
