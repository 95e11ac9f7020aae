"""The few stories that may be true of what is seen, with their odds: which line is which, and so which lane it is.

A hypothesis is a belief of the lane with a log-likelihood ratio against clutter. Each frame's lines are given roles:
the lane's own lines, the far lines of its neighbours, or none; a line without a role is clutter, of which there may be
any. What fits in more than one way branches, and time, the car's motion, the lane's width and the kind of its lines
decide (Reid 1979; here with one target and shared measurements).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from automodel.perception.line_scan import SightedLine
from automodel.signals import EXCEEDED
from automodel.tracking.belief import STATION, Assigned, Clutter, Evidence, LaneBelief, RoadModel
from automodel.tracking.seen_places import SeenPlaces
from automodel.tracking.stories import LEFT, RIGHT, ROLES, Things
from automodel.types import FloatArray

BENDING = 2  # lines of a frame that may tell of a new bend, the longest
STILL_LANES = 0.5  # a second counts as so much way, even of a car that stands: noise and light are new


@dataclass(frozen=True, slots=True)
class LineKinds:
    """Log-odds [nats] that the lane's own left and right line are dashed, not solid."""

    left: float = 0.0
    right: float = 0.0

    def of(self, role: float) -> float:
        """The log-odds of the line of a role; nothing is known of the neighbours' lines."""
        return self.left if role == LEFT else self.right if role == RIGHT else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A belief, its log-likelihood ratio against clutter [nats], and the last frame's lines with their roles.

    `news`: by how much the last frame spoke for it [nats], as if all of it were new; `counted`: by how much the odds
    rose, because what was seen before is no new witness. `placed`: it never was so uncertain that its lines might be
    those of another lane.
    """

    belief: LaneBelief
    log_odds: float = 0.0
    assigned: tuple[Assigned, ...] = ()
    news: float = 0.0
    counted: float = 0.0
    placed: bool = True

    def line(self, role: float) -> tuple[SightedLine, ...]:
        """The lines of the last frame that play a role."""
        return tuple(line for line, its in self.assigned if its == role)

    @property
    def bounds_a_lane(self) -> bool:
        """Whether the last frame showed both lines of a lane, the own one or a neighbour."""
        roles = sorted({role for _, role in self.assigned})
        return any(left - right == 1.0 for right, left in itertools.pairwise(roles))

    def merged(self, other: Hypothesis) -> Hypothesis:
        """This hypothesis with the doubt that a less likely one casts on it: the moments of both beliefs by their odds.

        The odds stay: both explain the same lines.
        """
        ahead = self.log_odds - other.log_odds + (self.news - self.counted) - (other.news - other.counted)
        others = 1.0 / (1.0 + math.exp(min(ahead, 50.0)))
        return replace(self, belief=self.belief.merged(other.belief, others))


@dataclass(frozen=True, slots=True, kw_only=True)
class HypothesesConfig:
    """`most`: hypotheses that live on, as many as there is time for: after 6 % of 3,100 views in 24 random worlds there
    were more, and with four bounds were exceeded in 0.5 % of the frames of 112 worlds, with 16 in 0.2 %. What all that
    find no room were worth together goes on to count against the others. `prune`: log of the odds [nats] to the
    best below which one dies: a bound may leave it out.

    `lines`: lines of a frame that are looked at, the longest first. `same` [lane widths, and radians]: hypotheses
    closer than this are one, and so are places on the ground. `neighbour_price` [nats]: a road may have no lane there.
    `line`, `other`: mean painted length of lines, and of other things that look like some [lane widths]; both are
    exponential, as 6,075 lines and 954 other things on seven drives with worn paint, lamps and zebras.
    """

    most: int = 16
    prune: float = -math.log(EXCEEDED)
    lines: int = 5
    same: float = 0.12
    neighbour_price: float = 1.5
    line: float = 1.2
    other: float = 0.42

    def things(self, anything: Clutter, lane_width_m: float) -> Things:
        """What lines are weighed by."""
        return Things(
            anywhere=anything.prior,
            streak=anything.streak,
            sigma_m=anything.sigma_m,
            corners=anything.CORNERS,
            length=math.log(self.other / self.line),
            length_per_lane=1.0 / self.other - 1.0 / self.line,
            neighbour=self.neighbour_price,
            lane_width_m=lane_width_m,
            most=self.most,
        )


class _Sighting(NamedTuple):
    """A line of a frame, the logarithm of how likely it is as clutter, and the shares of it that are news.

    `news`: to the odds of the hypotheses, `fresh`: to their beliefs.
    """

    line: SightedLine
    clutter: float
    news: float
    fresh: float


class _Child(NamedTuple):
    """A hypothesis after a frame whose lines play these roles; `shares` (lines,) of them are news to its belief."""

    parent: Hypothesis
    evidence: Evidence
    assigned: tuple[Assigned, ...]
    shares: FloatArray
    news: float
    counted: float

    @property
    def log_odds(self) -> float:
        return self.parent.log_odds + self.counted

    def learnt(self) -> Hypothesis:
        """The hypothesis, its belief after these lines."""
        belief = self.evidence.update(self.assigned, self.shares) if self.assigned else self.parent.belief
        return Hypothesis(belief, self.log_odds, self.assigned, self.news, self.counted, self.parent.placed)


class Hypotheses:
    """The hypotheses, the likeliest first; empty while nothing is believed."""

    def __init__(self, config: HypothesesConfig | None = None) -> None:
        self.config = config or HypothesesConfig()
        self.all: tuple[Hypothesis, ...] = ()
        self._places = SeenPlaces(self.config.same)
        self._first = True  # whether there was no frame since then
        self._dropped = -math.inf  # log-odds [nats] of all those together for which there was no room

    def start(self, beliefs: Sequence[tuple[LaneBelief, float]], *, learnt: bool = False) -> None:
        """Start with beliefs and their log-odds; to these the first frame is news as a whole.

        To the beliefs too, unless they have `learnt` from what was seen so far or is in `note`.
        """
        self.all = tuple(Hypothesis(belief, odds) for belief, odds in beliefs)
        self._first, self._dropped = True, -math.inf
        if not learnt:
            self._places = SeenPlaces(self.config.same)

    def note(self, lines: Sequence[SightedLine], road: RoadModel) -> None:
        """A frame's lines have taught what these hypotheses may start with."""
        self._places.see(lines, road)

    def move(self, road: RoadModel, distance_m: float, turn_rad: float, dt_s: float, known: bool) -> None:
        """Move every belief, and the places where lines were seen."""
        self.all = tuple(
            replace(one, belief=one.belief.moved(distance_m, turn_rad, dt_s, known), assigned=()) for one in self.all
        )
        driven = abs(distance_m) / road.lane_width_m if known else road.lost_pace * dt_s
        self._places.move(distance_m, turn_rad, max(driven, STILL_LANES * dt_s), known)

    def update(
        self, lines: Sequence[SightedLine], kinds: LineKinds, way: float | None = None, *, picked: bool = True
    ) -> float:
        """Assign a frame's lines, branch, and weigh; returns how much of the frame was news, 0 .. 1.

        `way`: lane widths since the beliefs learnt last, where they were not driven by these hypotheses. `picked`: the
        lines that play a role are picked out of all; False for a story whose lines were known before the frame.
        """
        if not self.all:
            return 0.0
        config, road = self.config, self.all[0].belief.road
        longest = sorted(lines, key=lambda line: -line.painted_m)[: config.lines]
        anything = self.all[0].belief.anything()  # as clutter, lines are as likely for every hypothesis
        self._things = config.things(anything, road.lane_width_m)
        fresh = self._places.see(longest, road)
        news = [1.0] * len(fresh) if self._first else fresh
        self._first = False
        seen = [
            _Sighting(line, anything.of_line(line), *shares) for line, *shares in zip(longest, news, fresh, strict=True)
        ]
        things = len(lines) if picked else None
        grown = list[_Child]()
        for one in self.all:
            evidence = Evidence(one.belief)
            children = self._children(one, evidence, seen, things, kinds, way)
            grown += children
            if not any(_explains(child, seen) for child in children):
                odds = one.log_odds + math.log(EXCEEDED)
                for ahead_m in _departures(evidence, [each.line for each in seen[:BENDING]]):
                    bending = replace(one, belief=one.belief.of_new_bend(ahead_m), log_odds=odds)
                    bent = self._children(bending, Evidence(bending.belief), seen, things, kinds, way)
                    grown += [child for child in bent if child.assigned]
        far_m = max((float(each.line.points_m[-1, 0]) for each in seen), default=0.0)
        self._keep(grown, far_m)
        counts = [len(each.line.points_m) for each in seen]
        return float(np.average([each.news for each in seen], weights=counts)) if seen else 1.0

    def condition(self, possible: Callable[[LaneBelief], float]) -> None:
        """Drop those that are less likely than a bound may be exceeded, each possible with a probability."""
        best, *others = zip(self.all, self.posterior(), strict=True)
        kept = [one for one, share in others if share * possible(one.belief) > EXCEEDED]
        self.all = (best[0], *kept)

    def displace(self, confusable: Callable[[LaneBelief], bool]) -> None:
        """Note which hypotheses are so uncertain now that a line of another lane may be taken for the lane's."""
        self.all = tuple(replace(one, placed=one.placed and not confusable(one.belief)) for one in self.all)

    @property
    def best(self) -> Hypothesis:
        """The likeliest, with the doubt that all others cast on it that put the lane where it does beside the car."""
        best, *others = self.all
        for other in others:
            if _beside_alike(best, other, self.config.same):
                best = best.merged(other)
        return best

    @property
    def certainty(self) -> float:
        """The probability that the lane is where the likeliest hypothesis puts it beside the car."""
        shares = zip(self.all, self.posterior(), strict=True)
        return sum(share for one, share in shares if _beside_alike(self.all[0], one, self.config.same))

    @property
    def agree(self) -> bool:
        """Whether all that a bound may not leave out take the same lines of the last frame for the lane's own."""
        own = [{(id(line), role) for line, role in one.assigned if role in (LEFT, RIGHT)} for one in self.all]
        shares = self.posterior()
        others = sum(share for share, lines in zip(shares, own, strict=True) if lines != own[0])
        return 1.0 - sum(shares) + others < EXCEEDED

    def posterior(self) -> list[float]:
        """Probabilities of the hypotheses, in their order; the rest is that of those for which there was no room."""
        best = max((one.log_odds for one in self.all), default=0.0)
        weights = [math.exp(one.log_odds - best) for one in self.all]
        total = sum(weights) + math.exp(min(self._dropped - best, 50.0))
        return [weight / total for weight in weights]

    def _children(
        self,
        parent: Hypothesis,
        evidence: Evidence,
        lines: Sequence[_Sighting],
        things: int | None,
        kinds: LineKinds,
        way: float | None,
    ) -> list[_Child]:
        """The parent with each plausible assignment of the lines, by the `evidence` about its belief, and as it was.

        `things`: how many are in view, out of which the lines that play a role are picked; None where they are not.
        """
        if not lines:
            return [_Child(parent, evidence, (), np.empty(0), 0.0, 0.0)]
        road = parent.belief.road
        of_kind = [[_kind(line, kinds.of(role), road.lane_width_m) for role in ROLES] for line, *_ in lines]
        clutter, news = (np.array([each[k] for each in lines]) for k in (1, 2))
        found = evidence.stories([each.line for each in lines], self._things, clutter, np.array(of_kind), news)
        children = []
        for looks, odds, counted in found:
            picked = 0.0 if things is None or not looks else _picked(things, len(looks))
            news_of, fresh_of = np.array([lines[look.of][2:] for look in looks]).reshape(-1, 2).T
            odds, counted = odds - picked, counted - picked * (float(news_of.mean()) if looks else 0.0)
            assigned = tuple(Assigned(look.line, look.role) for look in looks)
            shares = fresh_of.copy() if way is None else road.news_of(len(looks), way)
            children.append(_Child(parent, evidence, assigned, shares, odds, counted))
        return children

    def _keep(self, grown: list[_Child], far_m: float) -> None:
        """Keep the likeliest of all children that a bound may not leave out, those that say the same as one."""
        grown.sort(key=lambda each: -each.log_odds)
        least, kept = grown[0].log_odds - self.config.prune, list[Hypothesis]()
        for child in itertools.takewhile(lambda each: each.log_odds > least, grown):
            one = child.learnt()
            like = next((k for k, other in enumerate(kept) if self._same(one, other, far_m)), None)
            if like is not None:
                kept[like] = kept[like].merged(one)
            elif len(kept) < self.config.most:
                kept.append(one)
            else:
                self._dropped = float(np.logaddexp(self._dropped, one.log_odds))
        self.all = tuple(kept)

    def _same(self, one: Hypothesis, other: Hypothesis, far_m: float) -> bool:
        """Whether two say the same of the lane beside the car, and as far ahead as lines are in view."""
        unit, most = one.belief.road.lane_width_m, self.config.same
        if not _beside_alike(one, other, most):
            return False
        ahead = np.array((max(far_m - one.belief.reference_x_m, 0.0),))
        (here, course, _), (there, other_course, _) = one.belief.beside(ahead, 0.0), other.belief.beside(ahead, 0.0)
        return max(math.dist(here[0], there[0]) / unit, abs(float(course[0] - other_course[0]))) < most


def _beside_alike(one: Hypothesis, other: Hypothesis, most: float) -> bool:
    """Whether two put the lane at the same place beside the car, to so many lane widths and radians."""
    lateral = abs(one.belief.offset_m - other.belief.offset_m) / one.belief.road.lane_width_m
    return max(lateral, abs(one.belief.heading_rad - other.belief.heading_rad)) < most


def _departures(evidence: Evidence, lines: Sequence[SightedLine]) -> list[float]:
    """How far ahead of the reference point [m] a new bend may begin: where lines depart from the nearest role."""
    unit, at_m = evidence.belief.road.lane_width_m, dict[int, float]()
    for line in lines:
        role = evidence.nearest_role(line)
        ahead_m = None if role is None else evidence.departs_m(line, role)
        if ahead_m is not None:
            at_m[round(ahead_m / (STATION * unit))] = ahead_m
    return list(at_m.values())


def _explains(child: _Child, seen: Sequence[_Sighting]) -> bool:
    """Whether a hypothesis explains all lines of a frame, and each to its end."""
    return sum(len(line.points_m) for line, _ in child.assigned) == sum(len(each.line.points_m) for each in seen)


def _picked(things: int, lines: int) -> float:
    """How much likelier [nats] it is that all `things` in view are clutter than that so many of them are lines.

    By their number alone: of many things one lies by chance where a line would. Clutter is a Poisson process whose rate
    is not known; integrated over Jeffreys' prior of a rate (1 / sqrt(rate)) m things have Gamma(m + 1/2).
    """
    return math.lgamma(things + 0.5) - math.lgamma(things - lines + 0.5)


def _kind(line: SightedLine, dashed: float, lane_width_m: float) -> float:
    """How much likelier [nats] a line's paint is where it is dashed with these log-odds than if nothing is known."""
    if dashed == 0.0 or line.span_m <= 0.0:
        return 0.0
    looks, chance = math.exp(line.looks_dashed(lane_width_m)), 1.0 / (1.0 + math.exp(-dashed))
    return math.log(chance * looks + 1.0 - chance) - math.log(0.5 * looks + 0.5)
