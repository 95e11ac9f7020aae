"""What is believed of the lane: an arc beside the car with its covariance, moved by odometry, tested on sighted lines.

The lane at the reference point: the car's offset d (left positive) [m], the lane's heading theta in the body frame
[rad], its curvature kappa [1/m] and its width w [m]. Away from the car the curvature is a random walk along the road,
so that the centerline's lateral deviation from the arc is a Gaussian process, the random walk integrated twice:

    cov(g(s), g(s')) = q / 4 int_0^m (s - u)^2 (s' - u)^2 du = q / 4 (m^5 / 5 + D m^4 / 2 + D^2 m^3 / 3)

with m the smaller of s and s', and D their distance (Rasmussen and Williams 2006, section 6.3, one order higher). All
lines of a road are parallel: they share g, so that two lines far ahead still measure the width. The points of a line
share one error besides their own, because a whole line can be one wrong thing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from automodel.curves.foot import foot_on_circle
from automodel.perception.line_scan import SightedLine
from automodel.types import FloatArray

# A road's bends do not grow everywhere: most of it goes on as it is, and some places are where a bend begins or ends.
BEND_SHARE, BEND_CALM, BEND_SUDDEN = 0.2, 0.25, 4.0  # of such places; factors of `bend_walk` elsewhere, and there


class Part(IntEnum):
    """Indices of the belief's mean."""

    OFFSET = 0
    THETA = 1
    KAPPA = 2
    WIDTH = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadModel:
    """What roads, cars and line-like things are like; lengths in lane widths.

    `eye_m`: the camera's place ahead of the rear axle and above the ground, `pitch_rad`: sigma of its pitch, by which
    what lies aside seems the further aside the further ahead it lies. `bend_walk`: variance that the curvature gains
    per lane width of road, [1 / lane width^2]: a bend of three lane widths' radius (the Carolo-Cup's tightest has 2.5)
    that begins or ends every five or six; `Bends` learns the real one. `line_sigma`: error common to a line's points.
    `point_markings`: error of a single point, in marking widths. `step`, `turn_rad`: sigmas gained over a lane width of
    driving by odometry. `lost_step`, `lost_turn_rad`: over a second of unknown motion. `width_walk`: of the width, over
    a lane width of driving. `news`: way after which a frame is a new witness: shorter, and its errors are those of the
    frame before. `anywhere`, `any_turn_rad`, `any_bend`: sigmas of a thing that is no line of this lane:
    lateral place, direction, curvature.
    """

    lane_width_m: float
    marking_width_m: float
    eye_m: tuple[float, float] = (0.0, 1.0)
    pitch_rad: float = 0.0
    bend_walk: float = 0.02
    line_sigma: float = 0.02
    point_markings: float = 0.1
    step: float = 0.01
    turn_rad: float = 0.02
    lost_step: float = 0.5
    lost_turn_rad: float = 1.0
    width_walk: float = 0.03
    news: float = 0.25
    anywhere: float = 1.2
    any_turn_rad: float = 0.4
    any_bend: float = 0.3


class Bends:
    """Learns how winding the road is: the mean square of the curvature's changes, over the way that was driven.

    `road` is the model with what was learnt. What is assumed counts as fifty lane widths of road, so that a straight is
    not soon taken for a road without bends, and what was learnt fades over five hundred.
    """

    ASSUMED, REMEMBERED, STEP = 50.0, 500.0, 0.5  # lane widths; the last: between two looks at the curvature

    def __init__(self, road: RoadModel) -> None:
        self._assumed = road
        self.reset()

    def reset(self) -> None:
        """Forget what was learnt."""
        self.road = self._assumed
        self._way, self._squares = self.ASSUMED, self.ASSUMED * self._assumed.bend_walk
        self._since = 0.0
        self._last: float | None = None

    def move(self, distance_m: float) -> None:
        """The car has driven on."""
        self._since += distance_m / self._assumed.lane_width_m

    def see(self, curvature_per_m: float) -> None:
        """The road's curvature beside the car."""
        if self._since < self.STEP:
            return
        here = curvature_per_m * self._assumed.lane_width_m
        if self._last is not None:
            kept = math.exp(-self._since / self.REMEMBERED)
            self._way = kept * self._way + self._since
            self._squares = kept * self._squares + (here - self._last) ** 2
            self.road = replace(self._assumed, bend_walk=self._squares / self._way)
        self._last, self._since = here, 0.0


class Assigned(NamedTuple):
    """A sighted line and the role it plays: its distance to the left of the centerline, in lane widths."""

    line: SightedLine
    role: float


@dataclass(frozen=True, slots=True, eq=False)
class LaneBelief:
    """Mean (4,) in the order of `Part`, and covariance (4, 4)."""

    mean: FloatArray
    covariance: FloatArray
    road: RoadModel
    reference_x_m: float

    @property
    def offset_m(self) -> float:
        """The car's distance to the left of the centerline [m]."""
        return float(self.mean[Part.OFFSET])

    @property
    def heading_rad(self) -> float:
        """The car's direction relative to the centerline, left positive [rad]."""
        return -float(self.mean[Part.THETA])

    @property
    def curvature_per_m(self) -> float:
        """The centerline's curvature beside the car [1/m]."""
        return float(self.mean[Part.KAPPA])

    @property
    def width_m(self) -> float:
        """The lane's width [m]."""
        return float(self.mean[Part.WIDTH])

    def sigma(self, part: Part) -> float:
        """Standard deviation of one part of the mean."""
        return math.sqrt(max(float(self.covariance[part, part]), 0.0))

    def beside(self, s_m: FloatArray, role: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Where a line runs at arc lengths (n,) of the arc: points (n, 2) [m], headings (n,) [rad], sigmas (n,) [m]."""
        d, theta, kappa, width = self.mean.tolist()
        heading, half = theta + kappa * s_m, 0.5 * kappa * s_m
        chord = s_m * np.sinc(half / math.pi)
        left = role * width
        x = self.reference_x_m + d * math.sin(theta) + chord * np.cos(theta + half) - left * np.sin(heading)
        y = -d * math.cos(theta) + chord * np.sin(theta + half) + left * np.cos(heading)
        rows = _rows(s_m, np.full(len(s_m), role))
        return np.column_stack((x, y)), heading, np.sqrt(np.einsum("ni,ij,nj->n", rows, self.covariance, rows))

    def moved(self, distance_m: float, turn_rad: float, dt_s: float, known: bool) -> LaneBelief:
        """The belief after a motion along an arc; an unknown motion counts as none, with much noise."""
        road, unit = self.road, self.road.lane_width_m
        d, theta, kappa, width = self.mean.tolist()
        step = abs(distance_m) / unit
        if known:
            half = 0.5 * turn_rad
            chord = distance_m * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
            x = chord * math.cos(half) + self.reference_x_m * (math.cos(turn_rad) - 1.0)
            y = chord * math.sin(half) + self.reference_x_m * math.sin(turn_rad)
            cos, sin = math.cos(theta), math.sin(theta)
            along, d = foot_on_circle(x * cos + y * sin, y * cos - x * sin + d, kappa, 0.05)
            theta += kappa * along - turn_rad
        else:
            along = 0.0
        f = np.eye(4)
        f[Part.OFFSET, Part.THETA], f[Part.OFFSET, Part.KAPPA] = -along, -0.5 * along * along
        f[Part.THETA, Part.KAPPA] = along
        covariance = f @ self.covariance @ f.T
        covariance[Part.KAPPA, Part.KAPPA] += road.bend_walk * step / unit**2
        covariance[Part.OFFSET, Part.OFFSET] += (road.step * unit) ** 2 * step
        covariance[Part.THETA, Part.THETA] += road.turn_rad**2 * step
        covariance[Part.WIDTH, Part.WIDTH] += (road.width_walk * unit) ** 2 * step
        if not known:
            covariance[Part.OFFSET, Part.OFFSET] += (road.lost_step * unit) ** 2 * dt_s
            covariance[Part.THETA, Part.THETA] += road.lost_turn_rad**2 * dt_s
        mean = np.array((d, math.remainder(theta, math.tau), kappa, width))
        return replace(self, mean=mean, covariance=covariance)

    def update(self, assigned: Sequence[Assigned], way: float = math.inf, rounds: int = 3) -> tuple[LaneBelief, float]:
        """The belief after a frame's lines, and the logarithm of how likely they are [nats].

        `way`: lane widths driven since the last frame; of one that shows what the last one showed, little is news. A
        point is a new witness after the way to it: until then the same bends lie between. The road is a mixture of two,
        one that goes on as it is and one on which a bend begins or ends; the result has the mixture's moments.
        """
        if not assigned:
            return self, 0.0
        afters, odds = [], []
        for chance, factor in ((1.0 - BEND_SHARE, BEND_CALM), (BEND_SHARE, BEND_SUDDEN)):
            belief = replace(self, road=replace(self.road, bend_walk=factor * self.road.bend_walk))
            after, log_likelihood = belief._updated(assigned, way, rounds)
            afters.append(after)
            odds.append(log_likelihood + math.log(chance))
        total = float(np.logaddexp(odds[0], odds[1]))
        calm, sudden = afters
        sudden_share = math.exp(odds[1] - total)
        away = sudden.mean - calm.mean
        covariance = (1.0 - sudden_share) * calm.covariance + sudden_share * sudden.covariance
        covariance += sudden_share * (1.0 - sudden_share) * np.outer(away, away)
        return replace(self, mean=calm.mean + sudden_share * away, covariance=covariance), total

    def _updated(self, assigned: Sequence[Assigned], way: float, rounds: int) -> tuple[LaneBelief, float]:
        """`update` on a road whose bends are as likely everywhere."""
        after, log_likelihood = self, 0.0
        for turn in range(rounds):
            s, left = after._along(np.concatenate([line.points_m for line, _ in assigned]))
            roles = np.repeat([role for _, role in assigned], [len(line.points_m) for line, _ in assigned])
            rows = _rows(s, roles)
            residual = left - roles * after.mean[Part.WIDTH] + rows @ (after.mean - self.mean)
            noise, known = self._noise(s, assigned), rows @ self.covariance @ rows.T
            if turn == 0:
                log_likelihood = _log_density(residual, np.linalg.cholesky(known + noise))
            looks = np.sqrt(np.maximum(np.maximum(s / self.road.lane_width_m, self.road.news) / max(way, 1e-6), 1.0))
            factor = np.linalg.cholesky(known + noise * np.outer(looks, looks))
            gain = np.linalg.solve(factor, rows @ self.covariance)
            change = gain.T @ np.linalg.solve(factor, residual)
            mean, covariance = self.mean + change, self.covariance - gain.T @ gain
            after = replace(self, mean=mean, covariance=0.5 * (covariance + covariance.T))
        return after, log_likelihood

    def explains(self, assigned: Assigned) -> bool:
        """Whether a line is likelier in its role than as a thing of its own."""
        return self.update((assigned,), rounds=1)[1] > self.clutter(assigned.line)

    def clutter(self, line: SightedLine) -> float:
        """The logarithm of how likely a line is that is a thing of its own [nats], anywhere in the view."""
        road, unit = self.road, self.road.lane_width_m
        s, left = line.points_m[:, 0] - self.reference_x_m, line.points_m[:, 1]
        rows = _rows(s, np.zeros(len(s)))[:, :3]
        prior = np.diag(((road.anywhere * unit) ** 2, road.any_turn_rad**2, (road.any_bend / unit) ** 2))
        return _log_density(left, np.linalg.cholesky(rows @ prior @ rows.T + self._noise(s, [Assigned(line, 0.0)])))

    def _noise(self, s: FloatArray, assigned: Sequence[Assigned]) -> FloatArray:
        """Covariance (n, n) [m^2] of the points' places: the road's bends, each line's error, each point's."""
        road, unit = self.road, self.road.lane_width_m
        ahead = np.maximum(s, 0.0)
        low, high = np.minimum(ahead[:, None], ahead), np.maximum(ahead[:, None], ahead)
        apart = high - low
        bends = low**5 / 5.0 + apart * low**4 / 2.0 + apart * apart * low**3 / 3.0
        noise = (0.25 * road.bend_walk / unit**3) * bends
        x, y = np.concatenate([line.points_m for line, _ in assigned]).T
        wedge = (road.pitch_rad / road.eye_m[1]) * y * (x - road.eye_m[0])
        noise += np.outer(wedge, wedge)
        start = 0
        for line, _ in assigned:
            stop = start + len(line.points_m)
            noise[start:stop, start:stop] += (road.line_sigma * unit) ** 2
            start = stop
        noise.flat[:: len(s) + 1] += (road.point_markings * road.marking_width_m) ** 2
        return noise

    def _along(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Arc length from the reference point's foot and distance to the left of the arc (n,) [m] of body points."""
        d, theta, kappa, _ = self.mean.tolist()
        cos, sin = math.cos(theta), math.sin(theta)
        x, y = points_m[:, 0] - self.reference_x_m, points_m[:, 1]
        ahead, left = x * cos + y * sin, y * cos - x * sin + d
        if abs(kappa) < 1e-9:
            return ahead, left
        a, b = kappa * ahead, np.maximum(1.0 - kappa * left, 0.05)
        return np.arctan2(a, b) / kappa, (2.0 * left - kappa * (left * left + ahead * ahead)) / (1.0 + np.hypot(a, b))


def _rows(s: FloatArray, roles: FloatArray) -> FloatArray:
    """Jacobian (n, 4) of points' distances to the left of the believed arc for the belief's parts."""
    return np.column_stack((-np.ones_like(s), s, 0.5 * s * s, roles))


def _log_density(residual: FloatArray, factor: FloatArray) -> float:
    white = np.linalg.solve(factor, residual)
    return -0.5 * float(white @ white) - float(np.log(np.diag(factor)).sum()) - 0.5 * len(white) * math.log(math.tau)
