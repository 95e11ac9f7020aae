"""What is believed of the lane: where it lies beside the car, and how its road bends ahead; tested on sighted lines.

The car's offset d from the centerline (left positive) [m], the lane's heading theta in the body frame [rad], its
width w [m], and the centerline's curvature [1/m] at stations of the road ahead: linear between them, a random walk from
one to the next. The stations stay where they are while the car drives past them, so that what was seen of a bend is
known when the car comes to it. All lines of a road are parallel: two lines far ahead still measure the width. The
points of a line share one error besides their own, because a whole line can be one wrong thing.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from automodel.config import ContourConfig
from automodel.curves import DeferredCurve
from automodel.estimation.road import ANY_BEND, BEHIND, LOST_PACE, LOST_STEP, LOST_TURN_RAD, TAPER, WALK
from automodel.geometry.lane_path import OFFSET, PITCH, ROAD, THETA, WIDTH, curvature, line_of_path, next_lane
from automodel.perception.line_scan import SightedLine
from automodel.perception.markings.reflections import ReflectionConfig
from automodel.signals import LanePose, MotionSource
from automodel.tracking.evidence import Equations, Prior, Streak, innovation, own_thing, posterior, settled, whitened
from automodel.tracking.lane_motion import (
    Drift,
    Part,
    arc,
    aside,
    beside_car,
    lateral_variance,
    line_beside,
    merged,
    moved,
)
from automodel.tracking.stories import ROLES, Things, beside_lane, departure, possible, stories
from automodel.types import FloatArray

STATION = 0.5  # lane widths between two stations: a bend that begins at once is one half a lane width later
STATIONS = 13  # from behind the car to six lane widths ahead, beyond which the road goes on as it does there


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadModel:
    """What roads, cars and line-like things are like; lengths in lane widths.

    `eye_m`: the camera's place ahead of the rear axle and above the ground, `pitch_rad`: sigma of its pitch and of its
    nod, by which what lies aside seems the further aside the further ahead it lies. `bend_walk`: variance that the
    curvature gains per lane width of road, [1 / lane width^2]: a bend of three lane widths' radius (the Carolo-Cup's
    tightest has 2.5) that begins or ends every 5.5; `LearntRoad` learns the real one. `radius_lanes`: of the
    road's tightest bend, which may begin or end however straight it was. `line_sigma`: error
    common to a line's points. `point_markings`: scale of a single point's error, in marking widths, which is Student's
    with two degrees of freedom: of 44,000 points of scanned lines on three drives it is 0.04 to 0.06; neighbours'
    errors are alike, so that it counts twice. `pixel_rad`: sigma of its direction, by the camera's pixels. `step`,
    `turn_rad`: sigmas gained over a lane width of driving by odometry (`LearntRoad` learns the second); `pace`: share
    by which its speed may be wrong. `lost_step`, `lost_turn_rad`: over a second of unknown motion, at a speed of at
    most `lost_pace` [lane widths / s]. `width_sigma`: of the lane's width about the one that is configured;
    `width_walk`: what it changes by over a lane width of driving. `news`: way after which a frame is a new witness:
    worn paint and lamps move the same points again. An error's correlation with that of the same place, seen 0.4,
    0.65, 1.0 and 1.5 lane widths later, is 0.5, 0.4, 0.3 and 0.1 (28,000 pairs of points in 14 random worlds); its
    integral to both sides is 1.2. `anywhere`, `any_turn_rad`, `any_bend`: sigmas of a thing that is no line of this
    lane: lateral place, direction, curvature; the last is a road's too.
    """

    lane_width_m: float
    marking_width_m: float
    eye_m: tuple[float, float] = (0.0, 1.0)
    pitch_rad: float = 0.0
    pixel_rad: float = 0.0
    bend_walk: float = 0.02
    radius_lanes: float = ContourConfig().radius_lanes
    line_sigma: float = 0.02
    point_markings: float = 0.1
    step: float = 0.01
    turn_rad: float = WALK
    pace: float = 0.1
    lost_step: float = LOST_STEP
    lost_turn_rad: float = LOST_TURN_RAD
    lost_pace: float = LOST_PACE
    width_sigma: float = 0.12
    width_walk: float = TAPER
    news: float = 1.2
    anywhere: float = 1.2
    any_turn_rad: float = 0.4
    any_bend: float = ANY_BEND

    drift: Drift = field(init=False, repr=False, compare=False)  # what gets uncertain on the way

    def __post_init__(self) -> None:
        drift = Drift(
            unit_m=self.lane_width_m,
            step=self.step,
            turn_rad=self.turn_rad,
            pace=self.pace,
            lost_step=self.lost_step,
            lost_turn_rad=self.lost_turn_rad,
            lost_pace=self.lost_pace,
            width_sigma=self.width_sigma,
            width_walk=self.width_walk,
            any_bend=self.any_bend,
            forgets=self.bend_walk / (2.0 * self.any_bend**2),  # all roads turn straight again
        )
        object.__setattr__(self, "drift", drift)

    def news_of(self, lines: int, way: float) -> FloatArray:
        """The share (n,) that is news of lines that were seen so many lane widths ago."""
        return np.full(lines, min(way / self.news, 1.0))


class MeanSquare:
    """A mean square over the way that was driven.

    What is assumed counts as fifty lane widths, so that a straight is not soon taken for a road without bends, and what
    was learnt fades over five hundred.
    """

    ASSUMED, REMEMBERED = 50.0, 500.0  # lane widths

    def __init__(self, assumed: float) -> None:
        self._way, self._squares = self.ASSUMED, self.ASSUMED * assumed

    def add(self, square: float, way: float) -> None:
        """Take what was found over so many lane widths."""
        kept = math.exp(-way / self.REMEMBERED)
        self._way, self._squares = kept * self._way + way, kept * self._squares + square

    @property
    def per_lane(self) -> float:
        """The mean per lane width."""
        return self._squares / self._way


class LearntRoad:
    """Learns how winding the road is, and how well the odometry tells turns.

    The first is the mean square of the curvature's changes, the second that of what the car has turned in its lane as
    an estimator sees it that sees both lines, less what it has by odometry on that road. The estimator's own noise is
    in both: they are learnt too large rather than too small.

    `road` is the model with the first, `reckoning` with both, for dead reckoning alone. While lines are followed the
    assumed noise of turns also covers what their model does not know: with the learnt one worn paint that draws a line
    aside is followed with a smaller bound.
    """

    TURN = 3.0  # lane widths between two looks at the turn, by lines none of which it saw before

    def __init__(self, road: RoadModel) -> None:
        self._assumed = road
        self.reset()

    def reset(self) -> None:
        """Forget what was learnt."""
        self.road = self.reckoning = self._assumed
        self._bends = MeanSquare(self._assumed.bend_walk)
        self._turns: dict[MotionSource, MeanSquare] = {}
        self._bend_way = self._turn_way = self._turned_rad = 0.0  # since the last look
        self._bend: float | None = None
        self._heading_rad: float | None = None  # in the lane, at the last look
        self._curvature_per_m = 0.0
        self._source = MotionSource.NONE

    def move(self, distance_m: float, turn_rad: float, source: MotionSource) -> None:
        """The car has driven, forward positive; what is learnt of one source's turns says nothing of another's."""
        way = abs(distance_m) / self._assumed.lane_width_m
        self._bend_way += way
        self._turn_way += way
        self._turned_rad += turn_rad - self._curvature_per_m * distance_m
        if source is not self._source:
            self._source, self._heading_rad = source, None
            self._learn()

    def see(self, curvature_per_m: float, heading_rad: float | None) -> None:
        """The road's curvature beside the car, and the car's direction in the lane where both lines show it."""
        self._curvature_per_m = curvature_per_m
        if self._bend_way >= STATION:
            bend = curvature_per_m * self._assumed.lane_width_m
            if self._bend is not None:
                self._bends.add((bend - self._bend) ** 2, self._bend_way)
                self._learn()
            self._bend, self._bend_way = bend, 0.0
        if heading_rad is None or (self._heading_rad is not None and self._turn_way < self.TURN):
            return
        if self._heading_rad is not None and self._turn_way < 2.0 * self.TURN:
            self._turns_told().add((heading_rad - self._heading_rad - self._turned_rad) ** 2, self._turn_way)
            self._learn()
        self._heading_rad, self._turn_way, self._turned_rad = heading_rad, 0.0, 0.0

    def lose(self) -> None:
        """Where the car is in the lane is in doubt: what it turns is not known."""
        self._heading_rad = None

    def _learn(self) -> None:
        self.road = replace(self._assumed, bend_walk=self._bends.per_lane)
        self.reckoning = replace(self.road, turn_rad=math.sqrt(self._turns_told().per_lane))

    def _turns_told(self) -> MeanSquare:
        """What was learnt of the odometry in use."""
        return self._turns.setdefault(self._source, MeanSquare(self._assumed.turn_rad**2))


class Assigned(NamedTuple):
    """A sighted line and the role it plays: its distance to the left of the centerline, in lane widths."""

    line: SightedLine
    role: float


@dataclass(frozen=True, slots=True, eq=False)
class LaneBelief:
    """A lane: `state` (4 + stations,): offset, theta, width, the camera's pitch in sigmas, and the curvature at each
    station, with its `covariance`.

    The stations lie `STATION` lane widths apart on the centerline, the first `start_m` behind the reference point's
    foot.
    """

    state: FloatArray
    covariance: FloatArray
    start_m: float
    road: RoadModel
    reference_x_m: float

    @classmethod
    def arc(cls, mean: FloatArray, covariance: FloatArray, road: RoadModel, reference_x_m: float) -> LaneBelief:
        """A lane of which only what lies beside the car is known: mean (4,) in the order of `Part`, covariance (4, 4).

        The farther ahead, the less is known of its curvature.
        """
        walk = STATION * road.bend_walk / road.lane_width_m**2
        beside = np.array(mean, np.float64), np.array(covariance, np.float64)  # of the one layout that is compiled
        return cls(*arc(*beside, STATIONS, walk), 0.0, road, reference_x_m)

    @property
    def offset_m(self) -> float:
        """The car's distance to the left of the centerline [m]."""
        return float(self.state[OFFSET])

    @property
    def heading_rad(self) -> float:
        """The car's direction relative to the centerline, left positive [rad]."""
        return -float(self.state[THETA])

    @property
    def curvature_per_m(self) -> float:
        """The centerline's curvature beside the car [1/m]."""
        return curvature(self.state, self.start_m, STATION * self.road.lane_width_m)

    @property
    def width_m(self) -> float:
        """The lane's width [m]."""
        return float(self.state[WIDTH])

    @property
    def mean(self) -> FloatArray:
        """What lies beside the car (4,), in the order of `Part`."""
        return self._beside_car()[0]

    @property
    def spread(self) -> FloatArray:
        """Covariance (4, 4) of `mean`."""
        return self._beside_car()[1]

    def on(self, road: RoadModel) -> LaneBelief:
        """The belief on a road that is thought of otherwise."""
        return LaneBelief(self.state, self.covariance, self.start_m, road, self.reference_x_m)

    def without_road(self) -> LaneBelief:
        """What is believed of the lane beside the car alone."""
        return LaneBelief.arc(*self._beside_car(), self.road, self.reference_x_m)

    def of_new_bend(self, ahead_m: float) -> LaneBelief:
        """What is believed of a road of which a bend begins or ends, and shows so far ahead of the reference point [m].

        It begins within the lane width before: so far a line hardly departs from where it would go on. From there on
        the curvature is another one.
        """
        unit, covariance = self.road.lane_width_m, self.covariance.copy()
        shows = (ahead_m + self.start_m) / (STATION * unit)
        for station in range(math.ceil(shows - 1.0 / STATION), math.ceil(shows) + 1):
            first = ROAD + min(max(station, 0), STATIONS - 1)
            covariance[first:, first:] += (self.road.radius_lanes * unit) ** -2.0
        return replace(self, covariance=covariance)

    def displaced(self, left_m: float, turn_rad: float, covariance: FloatArray) -> LaneBelief:
        """What is believed of the lane if it lies elsewhere: by so much to the left beside the body frame's origin [m],
        and turned to the left about that, with the covariance (2, 2) of both.
        """
        by = np.array(((-1.0, -self.reference_x_m), (0.0, 1.0)))
        state, spread = self.state.copy(), self.covariance.copy()
        state[:2] += by @ (left_m, turn_rad)
        spread[:2, :2] += by @ covariance @ by.T
        return replace(self, state=state, covariance=spread)

    def of_any_width(self) -> LaneBelief:
        """What is believed of a lane whose width may be any: a line that was seen stays where it is."""
        unit = self.road.lane_width_m
        known = float(self.covariance[WIDTH, WIDTH])
        moves = self.covariance[WIDTH] / known  # what the state changes by with the width
        more = (self.road.width_sigma * unit) ** 2 - known
        state = self.state + moves * (unit - self.width_m)
        return replace(self, state=state, covariance=self.covariance + more * np.outer(moves, moves))

    @property
    def pitch_rad(self) -> tuple[float, float]:
        """By how much the camera looks further down than it was taken to, and the standard deviation of that."""
        unit = self.road.pitch_rad
        return unit * float(self.state[PITCH]), unit * math.sqrt(float(self.covariance[PITCH, PITCH]))

    def pitched(self) -> LaneBelief:
        """What is believed by a camera that is taken to look down by as much more as `pitch_rad` says."""
        state = self.state.copy()
        state[PITCH] = 0.0
        return replace(self, state=state)

    def sigma(self, part: Part) -> float:
        """Standard deviation of one part of the mean."""
        return math.sqrt(max(float(self.spread[part, part]), 0.0))

    def lateral_variance(self, ahead_m: float) -> float:
        """Of the centerline's place so far ahead of the reference point's foot [m^2]."""
        spacing = STATION * self.road.lane_width_m
        return lateral_variance(self.state, self.covariance, self.start_m, spacing, self.reference_x_m, ahead_m)

    def beside(self, s_m: FloatArray, role: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Where a line runs at arc lengths (n,): points (n, 2) [m], headings (n,) [rad], sigmas (n,) [m]."""
        spacing = STATION * self.road.lane_width_m
        return line_beside(self.state, self.covariance, self.start_m, spacing, self.reference_x_m, role, s_m)

    def aside(self, points_m: FloatArray) -> FloatArray:
        """How far points (n, 2) [m] lie to the left of the centerline (n,) [m]."""
        spacing = STATION * self.road.lane_width_m  # a copy has the one layout that is compiled
        return aside(self.state, self.start_m, spacing, self.reference_x_m, points_m.copy())

    @property
    def pose(self) -> LanePose:
        """The car's pose, which states no bounds."""
        sign = np.array((1.0, -1.0, 1.0))  # a heading is the road's, turned about
        return LanePose(
            offset_m=self.offset_m,
            heading_rad=self.heading_rad,
            width_m=self.width_m,
            curvature_per_m=self.curvature_per_m,
            covariance=self.covariance[:3, :3] * np.outer(sign, sign),
        )

    def curve(self, role: float, ahead_m: float) -> DeferredCurve:
        """The curve so many lane widths to the left of the centerline, from behind the car."""
        spacing_m = STATION * self.road.lane_width_m
        step_m = 0.5 * spacing_m
        span, place = (math.ceil(2.0 * BEHIND / STATION), math.ceil(ahead_m / step_m)), (self.start_m, spacing_m)
        return line_of_path(self.state, *place, self.reference_x_m, role * self.width_m, span, step_m)

    def beside_it(self, side: int) -> LaneBelief:
        """The lane on a side, +1 left or -1 right, of which no more is known than of any: its width is its own."""
        width_sigma_m = self.road.width_sigma * self.road.lane_width_m
        state, covariance = next_lane(self.state, self.covariance, side, width_sigma_m)
        return replace(self, state=state, covariance=covariance)

    def between(self, left: float, right: float) -> LaneBelief:
        """The lane between two lines that lie so many lane widths to the left of this one's centerline."""
        change = np.eye(len(self.state))
        change[OFFSET, WIDTH], change[WIDTH, WIDTH] = -0.5 * (left + right), left - right
        return replace(self, state=change @ self.state, covariance=change @ self.covariance @ change.T)

    def moved(self, distance_m: float, turn_rad: float, dt_s: float, known: bool) -> LaneBelief:
        """The belief after a motion along an arc; an unknown motion counts as none, with much noise."""
        spacing, here = STATION * self.road.lane_width_m, (self.state, self.covariance, self.start_m)
        after = moved(*here, spacing, self.reference_x_m, self.road.drift, distance_m, turn_rad, dt_s, known)
        return LaneBelief(*after, self.road, self.reference_x_m)

    def update(self, assigned: Sequence[Assigned], way: float = math.inf) -> tuple[LaneBelief, float]:
        """The belief after a frame's lines, and the logarithm of how likely they are [nats].

        `way`: lane widths driven since the last frame; of one that shows what the last one showed, little is news.
        """
        if not assigned:
            return self, 0.0
        evidence = Evidence(self)
        looks = [evidence.look(line, role) for line, role in assigned]
        return evidence.update(assigned, self.road.news_of(len(assigned), way)), evidence.log_likelihood(looks)

    def anything(self) -> Clutter:
        """What weighs lines that are things of their own, anywhere in the view."""
        return _clutter(self.road, self.reference_x_m)

    def merged(self, other: LaneBelief, others: float) -> LaneBelief:
        """The moments of two beliefs of the same lane, `others` being the other's share."""
        spacing = STATION * self.road.lane_width_m
        here, there = (self.state, self.covariance, self.start_m), (other.state, other.covariance, other.start_m)
        return LaneBelief(*merged(*here, *there, spacing, others), self.start_m, self.road, self.reference_x_m)

    def _beside_car(self) -> tuple[FloatArray, FloatArray]:
        return beside_car(self.state, self.covariance, self.start_m, STATION * self.road.lane_width_m)


class Look(NamedTuple):
    """A line in a role, and what it says about a belief.

    `place` (n + 1,): where it puts the lane, whitened. `squares`: squared innovation of its points over its covariance;
    `volume`: logarithm of that covariance's determinant.
    """

    line: SightedLine
    role: float
    equations: Equations
    place: FloatArray
    squares: float
    volume: float

    @property
    def log_likelihood(self) -> float:
        """The logarithm of how likely the line is [nats]."""
        return -0.5 * (self.squares + self.volume)


class Played(NamedTuple):
    """A line that plays a role in a story, or the part of it that does: of which of all lines."""

    line: SightedLine
    role: float
    of: int


def prior_of(belief: LaneBelief) -> Prior:
    """A belief as lines are weighed against it."""
    road, unit = belief.road, belief.road.lane_width_m
    point_variance = (road.point_markings * road.marking_width_m) ** 2
    return Prior(
        state=belief.state,
        start_m=belief.start_m,
        spacing_m=STATION * unit,
        reference_x_m=belief.reference_x_m,
        root=whitened(np.ascontiguousarray(belief.covariance)),
        point_variance=point_variance,
        pixel_share=road.pixel_rad**2 / point_variance,
        line_share=(road.line_sigma * unit) ** 2 / point_variance,
        eye_m=road.eye_m,
        pitch_rad=road.pitch_rad,
    )


class Evidence:
    """What lines say about a `belief`.

    The points of a line share an error, which is taken out of each line's normal equations, and all lines share the
    camera's nod, its pitch in this frame alone, which is one more unknown. Each line's equations are linearised where
    the line alone puts the lane, so that bends count that the belief did not know.
    """

    def __init__(self, belief: LaneBelief) -> None:
        self.belief, self._prior = belief, prior_of(belief)
        self._looks: dict[tuple[int, float], Look] = {}  # each is asked for more than once; it keeps its line alive

    def look(self, line: SightedLine, role: float) -> Look:
        """A line in a role."""
        known = self._looks.get((id(line), role))
        if known is None:
            equations, place = self._settled(((line, role),), np.ones(1))
            known = self._looks[id(line), role] = Look(line, role, equations, place, *innovation(equations))
        return known

    def stories(
        self, lines: Sequence[SightedLine], things: Things, clutter: FloatArray, kinds: FloatArray, news: FloatArray
    ) -> list[tuple[list[Played], float, float]]:
        """The likeliest assignments of lines to roles, with their odds and what of these counts, as `stories`."""
        points = [line.points_m for line in lines]
        starts = [0, *itertools.accumulate(map(len, points))]
        ends, painted_m = np.array(starts[1:]), np.array([line.painted_m for line in lines])
        reflections = np.array([line.reflection for line in lines])
        found = stories(self._prior, things, np.concatenate(points), ends, painted_m, clutter, reflections, kinds, news)

        def played(look: int) -> Played:
            of, start, stop = int(found.line[look]), int(found.start[look]), int(found.stop[look])
            line, role = lines[of], float(found.role[look])
            if stop - start < len(line.points_m):
                its = line.points_m[start - starts[of] : stop - starts[of]]
                line = replace(line, points_m=its, painted_m=line.painted_m * len(its) / len(points[of]), span_m=0.0)
            return Played(line, role, of)

        return [
            ([played(look) for look in looks if look >= 0], odds, counted)
            for looks, odds, counted in zip(
                found.looks.tolist(), found.odds.tolist(), found.counted.tolist(), strict=True
            )
        ]

    def nearest_role(self, line: SightedLine) -> float | None:
        """The role that a line may rather play than any other; None where it may play none."""
        points, unit = line.points_m.copy(), self.belief.road.lane_width_m  # a copy has the one layout that is compiled
        left_m, bend_m, _ = beside_lane(self._prior, points)
        role = min(ROLES, key=lambda role: abs(left_m - bend_m - role * self.belief.width_m))
        return role if possible(self._prior, points, role, unit) else None

    def departs_m(self, line: SightedLine, role: float) -> float | None:
        """How far ahead of the reference point [m] a line departs from its role; None where all of it fits.

        One that does from its first point on may do so anywhere on the way there.
        """
        look = self.look(line, role)
        at = departure(self._prior, look.squares, look.place, line.points_m.copy(), role, Clutter.CORNERS)
        x, y = line.points_m[max(at, 0)].tolist()
        ahead_m = math.hypot(x - self.belief.reference_x_m, y)
        return None if at == 0 else ahead_m if at > 0 else 0.5 * ahead_m

    def log_likelihood(self, looks: Sequence[Look]) -> float:
        """The logarithm of how likely lines are [nats]."""
        if len(looks) == 1:
            return looks[0].log_likelihood
        together = Equations(*map(np.concatenate, zip(*(look.equations for look in looks), strict=True)))
        squares, volume = innovation(together)
        return -0.5 * (squares + volume)

    def explained(self, lines: Sequence[Assigned], gate: float) -> tuple[list[Assigned], float]:
        """The lines that fit their role and are likelier there than as things of their own; and by how much [nats].

        One whose squared innovation is beyond the `gate` does not fit: it may be two things in one, such as a line
        that goes on as another, which is unlikely as clutter too.
        """
        anything, explained, total = self.belief.anything(), [], 0.0
        for line, role in lines:
            look = self.look(line, role)
            odds = look.log_likelihood - anything.of_line(line)
            if look.squares < gate and odds > 0.0:
                explained.append(Assigned(line, role))
                total += odds
        return explained, total

    def update(self, lines: Sequence[tuple[SightedLine, float]], shares: FloatArray) -> LaneBelief:
        """The belief after lines in their roles, of each of which a share (n,) is news, 0 .. 1."""
        state, covariance = posterior(self._prior, *self._settled(lines, shares), shares)
        belief = self.belief
        return LaneBelief(state, covariance, belief.start_m, belief.road, belief.reference_x_m)

    def _settled(self, lines: Sequence[tuple[SightedLine, float]], shares: FloatArray) -> tuple[Equations, FloatArray]:
        points = [line.points_m for line, _ in lines]
        ends = np.array(list(itertools.accumulate(map(len, points))))
        return settled(self._prior, np.concatenate(points), ends, np.array([role for _, role in lines]), shares)


class Clutter:
    """How likely lines are as things of their own: most are as smooth as roads, a few have corners.

    The points of one with corners lie anywhere. Those of a reflection, as likely as each line says, lie on a ray from
    below the camera.
    """

    CORNERS = 4.0  # [nats] one thing in 50 has

    def __init__(self, somewhere: LaneBelief) -> None:
        self.prior = prior_of(somewhere)
        road = replace(somewhere.road, bend_walk=0.0)  # rays are straight, from a camera in the middle of the car
        straight = LaneBelief.arc(np.zeros(4), np.diag((1.0, road.any_turn_rad**2, 0.0, 0.0)), road, road.eye_m[0])
        self.streak = Streak(prior_of(straight), ReflectionConfig().pointing_rad)
        self.sigma_m = somewhere.road.anywhere * somewhere.road.lane_width_m

    def of_line(self, line: SightedLine) -> float:
        """The logarithm of how likely a line is [nats]."""
        points = line.points_m.copy()
        return own_thing(self.prior, self.streak, points, self.sigma_m, self.CORNERS, line.reflection)


@functools.lru_cache(maxsize=8)
def _clutter(road: RoadModel, reference_x_m: float) -> Clutter:
    unit = road.lane_width_m
    prior = np.square((road.anywhere * unit, road.any_turn_rad, road.any_bend / unit, 0.0))
    return Clutter(LaneBelief.arc(np.zeros(4), np.diag(prior), road, reference_x_m))


@functools.cache
def warm_up() -> None:
    """Compile what is compiled, or load it, before the first frame: a car that drives cannot wait for it."""
    road = RoadModel(lane_width_m=1.0, marking_width_m=0.05)
    belief = LaneBelief.arc(np.array((0.0, 0.0, 0.0, 1.0)), 0.01 * np.eye(len(Part)), road, 0.0)
    points, _, _ = belief.beside(np.linspace(0.0, 3.0, 4), 0.5)
    lines = (Assigned(SightedLine(points_m=points, painted_m=3.0, span_m=3.0), 0.5),)
    after, _ = belief.update(lines)
    Evidence(after).explained(lines, math.inf)
    Evidence(after).departs_m(SightedLine(points_m=2.0 * points, painted_m=6.0, span_m=6.0), 0.5)
    anything = after.anything()
    things = Things(anything.prior, anything.streak, anything.sigma_m, anything.CORNERS, 0.0, 0.0, 0.0, 1.0, 1)
    Evidence(after).stories([line for line, _ in lines], things, np.zeros(1), np.zeros((1, len(ROLES))), np.ones(1))
    Evidence(after).nearest_role(lines[0].line)
    after.moved(0.1, 0.0, 0.01, True).merged(belief, 0.5).without_road().beside_it(+1)
    _ = belief.lateral_variance(1.0), belief.aside(points), belief.pose
