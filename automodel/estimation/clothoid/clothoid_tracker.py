"""The clothoid pair over time: predicted with the car's motion, corrected by what was found around it.

A Kalman filter whose parameters are those of `ClothoidPair`. Stations lie fixed on the road: moving the car along the
lane by ds leaves the curvatures alone, changes offset and heading by the odometry, and once h of way is passed the
station behind the car is dropped and one ahead is added. So the lane under the car, which the camera saw earlier, is
remembered as curvature that was measured then.

What a clothoid tracker is told: the scales of its filter, and a lane to start with.

The loops of a clothoid tracker's step: the drive's prediction, and the robust correction by what was found.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

import numpy as np

from automodel.compiled import compiled
from automodel.curves.foot import foot_on_circle
from automodel.estimation.clothoid.clothoid_pair import ClothoidPair, PairShape, Parameter
from automodel.estimation.clothoid.solvers import SOLVERS, gauss_newton, gradient_descent, posterior
from automodel.geometry import SE2
from automodel.geometry.se2 import wrap_angle
from automodel.types import Bools, FloatArray, Floats, Ints


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerConfig:
    """Scales of the filter; lengths in lane widths, so that one set holds from scale car to highway.

    A random walk's sigma is that after one lane width of way; curvatures are in 1 / lane width.
    """

    lane_width_m: float
    law: str = "gauss_newton"
    offset_walk: float = 0.01
    heading_walk_rad: float = 0.012
    blind_offset: float = 0.03  # and these come on top while no line is seen
    blind_heading_rad: float = 0.03
    width_walk: float = 0.002
    radius_lanes: float = 1.1  # of the tightest bend; the two that follow are shares of its curvature
    curvature_walk: float = 0.03  # of a station's value: maps age
    curvature_step: float = 0.4  # from station to station, per root lane width of road
    straighten: float = 0.95  # what is left of a curvature half a lane width further on, where nothing was seen yet
    start_offset: float = 0.08  # how well a guess is known to start with
    start_heading_rad: float = 0.1
    start_width: float = 0.05
    unknown_offset: float = 0.05  # a frame without odometry
    unknown_heading_rad: float = 0.05
    unknown_curvature: float = 0.8  # what is left then of a curvature that is not seen: it may have been passed
    unknown_share: float = 0.1  # of the road's variety that may have come in its place
    yaw_rate_sigma_radps: float = 0.01
    agreed: float = 0.3  # of what a residual may be: when none is larger, weights are not renewed
    gate: float = 3.5  # sigmas of prediction and measurement together
    doubt: float = 0.03  # growth a frame of place and heading while a line lies where it is not believed
    doubt_nodes: int = 4  # that make such a line


@dataclass(frozen=True, slots=True, kw_only=True)
class ArcLane:
    """An arc to start with: offset [m] and the lane's heading [rad] in the body frame, at the reference point.

    It is right some way ahead of it, at `sure_m`; `share` is what is left there of the usual sigmas of place and
    heading.
    """

    offset_m: float
    heading_rad: float
    width_m: float
    curvature_per_m: float
    sure_m: float
    share: float = 1.0


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
def _pose_covariance(p: Floats) -> FloatArray:
    """The covariance (3, 3) of offset, -heading and width."""
    turned = np.empty((CURVATURE, CURVATURE))
    for i in range(CURVATURE):
        for j in range(CURVATURE):
            turned[i, j] = p[i, j] if (i == HEADING) == (j == HEADING) else -p[i, j]
    return turned


class ClothoidTracker:
    """One lane, carried from frame to frame.

    `parameters` (m,) and `covariance` (m, m) are None while there is no lane; `blind_m` is the way since lines were
    seen, `advance_m` that of the last `move`, along the lane; `moved_m` is how far the last `update` carried
    it, halfway along. `iterations` counts the update law's since `move`.
    """

    def __init__(self, pair: ClothoidPair, config: TrackerConfig, sigma: Floats) -> None:
        """`sigma` (3 n,): how well a node's place [m], and its heading [rad], is measured; rows as in `PairShape`."""
        self.pair, self.config = pair, config
        self._descend = SOLVERS[config.law] is gradient_descent
        dtype, unit = pair.dtype, config.lane_width_m
        self._bend = bend = 1.0 / (config.radius_lanes * unit)
        slack = np.repeat((0.02 * unit, 0.0), (2 * pair.count, pair.count))
        self._noise: Floats = np.stack((sigma * sigma, 3.0 * sigma + slack)).astype(dtype)  # variance, and the limit
        size = CURVATURE + pair.stations
        self._one: Floats = np.eye(size, dtype=dtype)
        self._lever_m = float(pair.nodes_m[pair.count // 2])
        walk = np.full(size, config.curvature_walk * bend)
        walk[:CURVATURE] = config.offset_walk * unit, config.heading_walk_rad, config.width_walk * unit
        self._walk: Floats = (walk**2).astype(dtype)
        floor = np.full(size, 1e-4 * bend)
        floor[:CURVATURE] = 0.0005 * unit, 0.0003, 0.0001 * unit
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
        self.phase_m = self.blind_m = self.advance_m = self.moved_m = 0.0
        self.iterations = 0

    def start(self, rough: ArcLane) -> None:
        """Start with a lane that is roughly right at `rough.sure_m`; of the way there little is known."""
        self.forget()
        config, unit, n = self.config, self.config.lane_width_m, self.pair.count
        guess = np.full(len(self._one), rough.curvature_per_m, self.pair.dtype)
        guess[:CURVATURE] = rough.offset_m, rough.heading_rad, rough.width_m
        mean, covariance = guess.copy(), np.zeros_like(self._one)
        mean[CURVATURE:] = 0.0
        for parameter, sigma in ((OFFSET, unit), (HEADING, 1.0), (WIDTH, config.start_width * unit)):
            covariance[parameter, parameter] = sigma**2
        covariance[CURVATURE:, CURVATURE:] = self._road
        node = self._node(rough.sure_m)
        rows = self.pair.shape(guess, 0.0).jacobian[[node, node + n, node + 2 * n]]
        precision = np.array((config.start_offset * unit, config.start_offset * unit, config.start_heading_rad)) ** -2.0
        weighted = (rows * (precision / rough.share**2)[:, None].astype(guess.dtype)).T
        self.covariance = posterior(weighted @ rows, covariance)
        self.parameters = mean + self.covariance @ (weighted @ (rows @ (guess - mean)))
        self._prior = self.parameters, self.covariance

    def difference(self, rough: ArcLane) -> tuple[float, float]:
        """How far a lane lies to the left of this one [m], and is turned to the left [rad], where it is sure."""
        shape, node, s = self.shape(), self._node(rough.sure_m), rough.sure_m
        place = complex(shape.place[node])
        here = SE2(place.real, place.imag, cmath.phase(shape.along[node]))
        foot = SE2(self.pair.reference_x_m, 0.0, rough.heading_rad) @ SE2(0.0, -rough.offset_m)
        off = here.inverse() @ foot @ SE2.arc(s, rough.curvature_per_m * s)
        return off.y_m, wrap_angle(off.yaw_rad)

    def move(self, distance_m: float, turn_rad: float, dt_s: float, known: bool) -> None:
        """Carry the lane over to the body frame after a drive along an arc; `known` is False without odometry."""
        self.iterations = 0
        if self.parameters is None:
            return
        x, p = self.parameters.copy(), self.covariance.copy()
        self.advance_m = 0.0
        if known:
            self._drive(x, p, distance_m, turn_rad)
        blind = self.blind_m > 0.0
        self.blind_m += abs(distance_m)
        unit, config = self.config.lane_width_m, self.config
        way, offset_m, heading_rad = self.advance_m / unit, config.blind_offset * unit, config.blind_heading_rad
        age(
            p,
            self._walk,
            self._floor,
            way,
            offset_m**2 * way if blind else 0.0,
            (heading_rad**2 * way if blind else 0.0) + (config.yaw_rate_sigma_radps * dt_s) ** 2,
        )
        if not known:
            p[OFFSET, OFFSET] += (config.unknown_offset * unit) ** 2
            p[HEADING, HEADING] += config.unknown_heading_rad**2
            self._relax(x, p)
        self.parameters, self.covariance = x, p
        self._prior = x, p

    def _drive(self, x: Floats, p: Floats, distance_m: float, turn_rad: float) -> None:
        """Offset and heading at the reference point's new foot, on the circle of the road's curvature on the way."""
        reference, h = self.pair.reference_x_m, self.pair.spacing_m
        half = 0.5 * turn_rad
        chord = distance_m * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
        dx = chord * math.cos(half) + reference * (math.cos(turn_rad) - 1.0)
        dy = chord * math.sin(half) + reference * math.sin(turn_rad)
        way = drive(x, p, dx, dy, self.phase_m, h)
        self.advance_m = abs(way)
        self.phase_m += way
        while self.phase_m >= h:
            self._roll(x, p, +1)
        while self.phase_m < 0.0:
            self._roll(x, p, -1)
        x[HEADING] -= turn_rad

    def _relax(self, x: Floats, p: Floats) -> None:
        """Where the camera does not see it, take the road's curvature for that of the first place in sight, by and by.

        There the lane stays where it is, and swings below the car. Everywhere the curvature is less sure.
        """
        kept, n, m = self.config.unknown_curvature, self.pair.count, self.pair.stations
        place, heading = self.pair.shape(x, self.phase_m).jacobian[[0, 2 * n]]
        seen = min(round((float(self.pair.nodes_m[0]) + self.phase_m) / self.pair.spacing_m), m - 1)
        mix = self._one[CURVATURE:, CURVATURE:].copy()
        mix[:seen] *= kept
        mix[:seen, seen] += 1.0 - kept
        change = mix @ x[CURVATURE:] - x[CURVATURE:]
        x[CURVATURE:] += change
        swing = -float(heading[CURVATURE:] @ change)
        x[HEADING] += swing
        x[OFFSET] -= (float(place[CURVATURE:] @ change) + float(place[HEADING]) * swing) / float(place[OFFSET])
        p[CURVATURE:] = mix @ p[CURVATURE:]
        p[:, CURVATURE:] = p[:, CURVATURE:] @ mix.T
        p[CURVATURE:, CURVATURE:] += (1.0 - kept * kept) * self.config.unknown_share * self._road

    def _roll(self, x: Floats, p: Floats, way: int) -> None:
        """Drop the station behind the car and add one ahead; the other way round where the car drives backwards."""
        self.phase_m -= way * self.pair.spacing_m
        first, kept = CURVATURE, self._kept
        old, new = (slice(first + 1, None), slice(first, -1))[::way]
        x[new] = x[old].copy()
        p[new] = p[old].copy()
        p[:, new] = p[:, old].copy()
        fresh = -1 if way > 0 else first
        x[fresh] *= kept
        p[fresh, :] *= kept
        p[:, fresh] *= kept
        p[fresh, fresh] += self._new_variance

    @property
    def width_m(self) -> float:
        """The lane's width."""
        return float(self.known()[WIDTH])

    def curvature(self) -> float:
        """The centerline's curvature [1/m] at the reference point's foot."""
        share = self.phase_m / self.pair.spacing_m
        first, second = self.known()[CURVATURE : CURVATURE + 2].tolist()
        return float((1.0 - share) * first + share * second)

    def pose(self) -> tuple[float, float, float, FloatArray]:
        """Offset [m], the lane's heading in the body frame [rad], width [m].

        And the covariance (3, 3) of offset, -heading and width.
        """
        offset, heading, width = self.known()[:CURVATURE].tolist()
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
        """Correct the lane; tells which nodes (k,) carry it.

        `nodes` (k,) are those that were looked for, of 2 n, the left line's first; `residual` (2 k,) is how far to the
        left of `shape` they are [m], and how far their line is turned to the left of it [rad], where `found` (2 k,) is
        1, not 0.
        """
        before, (prior, p) = self.known(), self._prior
        config = self.config
        self.parameters, self.covariance, count, carrying, missed, self.moved_m = correct(
            self._descend,
            before,
            self.covariance,
            prior,
            p,
            shape.jacobian,
            self._noise,
            nodes,
            residual,
            found,
            (config.gate, config.agreed, self._bend, self._lever_m),
        )
        self.iterations += count
        if missed >= config.doubt_nodes:
            self._doubt(nodes < self.pair.count, found[: len(nodes)] > 0.0, carrying)
        return carrying

    def _doubt(self, left: Bools, found: Bools, carrying: Bools) -> None:
        """Where a line was found and not believed, the lane's place is less sure than it seemed."""
        config = self.config
        for side in (left, ~left):
            there = found & side
            if np.count_nonzero(there) >= config.doubt_nodes > 2 * np.count_nonzero(there & carrying):
                self.covariance[OFFSET, OFFSET] += (config.doubt * config.lane_width_m) ** 2
                self.covariance[HEADING, HEADING] += config.doubt**2

    def _node(self, s_m: float) -> int:
        return int(np.abs(self.pair.nodes_m - s_m).argmin())
