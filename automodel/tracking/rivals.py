"""Lines beside a lane's own ones that may be its own instead, as a tape inside it or a kerb beyond its line may.

A lane whose lines are both followed is the one that it was; which two lines these are was decided when it began, by
what was in view then. A line that runs along them all the while, at the distance of a lane's other line, may have been
the right one. One that comes into view later is none: the lane was there without it. What was in view with both of the
lane's lines is another thing, and stays one in doubts, until it has ended.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from automodel.perception.line_scan import SightedLine
from automodel.signals import EXCEEDED
from automodel.tracking.belief import LaneBelief
from automodel.tracking.hypotheses import HypothesesConfig
from automodel.tracking.road_profile import RoadProfileConfig
from automodel.tracking.stories import LEFT, RIGHT
from automodel.types import FloatArray


@dataclass(slots=True)
class _Rival:
    """A line `role` lane widths to the left of the centerline; in so many looks at its place it was not found.

    `before` it was found first, and of `late`, where it was found in others: a line may be hidden or worn for a while.
    `other`: both of the lane's own lines were in view with it.
    """

    role: float
    before: float
    late: float = 0.0
    other: bool = False


class Rivals:
    """The lines that may be one of a lane's own, since it began."""

    def __init__(self, config: HypothesesConfig, width_sigma: float) -> None:
        self._config = config
        self._missed = math.log(1.0 - RoadProfileConfig().found)  # [nats] a look at a line that is in view
        widest = 1.0 + width_sigma * math.sqrt(-2.0 * math.log(EXCEEDED))
        self._places: FloatArray = np.arange(0.5 - widest, widest - 0.5, config.same)
        self.reset()

    def reset(self) -> None:
        """A lane begins."""
        self._rivals: list[_Rival] = []
        self.begin_anew()

    def begin_anew(self) -> None:
        """The same lane begins anew: what was another thing is one still."""
        self._looks = np.zeros(len(self._places))
        self._rivals = [rival for rival in self._rivals if rival.other]

    @property
    def settled(self) -> bool:
        """Whether there is none, and none may come: it would have been seen oftener than a bound may be exceeded."""
        return not self._rivals and float(self._looks.min()) * self._missed < math.log(EXCEEDED)

    def others(self, belief: LaneBelief, lines: Sequence[SightedLine]) -> tuple[SightedLine, ...]:
        """The lines that run where none of those does that were in view with both of the lane's own.

        Where one of these is out of view, the other line would make another lane, a narrower one if it lies inside.
        """
        known = [rival.role for rival in self._rivals if rival.other]
        return tuple(line for line in lines if not known or not self._is_one_of(known, belief, line))

    def _is_one_of(self, known: Sequence[float], belief: LaneBelief, line: SightedLine) -> bool:
        """Whether a line runs where one of these does, rather than where the lane's own run."""
        role = float(np.median(belief.aside(line.points_m))) / belief.width_m
        away = min(abs(other - role) for other in known)
        return away <= self._config.same and away < min(abs(role - LEFT), abs(role - RIGHT))

    def look(
        self,
        belief: LaneBelief,
        lines: Sequence[SightedLine],
        news: float,
        in_view_m: Callable[[Sequence[float]], FloatArray],
    ) -> None:
        """All lines in view, of which a share is news: one that was in view before tells nothing new.

        `in_view_m`: of lines that run so many lane widths to the left, how much of each would be in view. A view
        without the lane's own lines tells of no others.
        """
        unit = belief.road.lane_width_m
        roles = [(self._role(belief, line), line.painted_m / unit) for line in lines]
        along = [(role, length) for role, length in roles if role is not None]
        own = [side for side in (LEFT, RIGHT) if any(abs(role - side) <= self._config.same for role, _ in along)]
        if not own:
            return
        both = len(own) == len((LEFT, RIGHT))
        found = [
            role
            for role, length in along
            if min(abs(role - LEFT), abs(role - RIGHT)) > self._config.same and self._is_line(length)
        ]
        unseen = np.flatnonzero(self._looks * self._missed >= math.log(EXCEEDED))
        lateral = [rival.role for rival in self._rivals] + self._places[unseen].tolist()
        shows = [self._is_line(length) for length in (in_view_m(lateral) / unit).tolist()] if lateral else []
        known, others = shows[: len(self._rivals)], shows[len(self._rivals) :]
        for rival, would_show in zip(self._rivals, known, strict=True):
            nearest = min(found, key=lambda role: abs(role - rival.role), default=math.inf)
            if abs(nearest - rival.role) < self._config.same:
                rival.role, rival.late, rival.other = nearest, max(rival.late - news, 0.0), rival.other or both
                found.remove(nearest)
            elif would_show:
                rival.late += news
        before = np.interp(found, self._places, self._looks).tolist()
        self._rivals += [_Rival(role, looks, other=both) for role, looks in zip(found, before, strict=True)]
        self._rivals = [rival for rival in self._rivals if self._is_there(belief, rival)]
        self._looks[unseen[others]] += news

    def _is_there(self, belief: LaneBelief, rival: _Rival) -> bool:
        """Whether a line may be one of the lane's own, or is another thing, still there, that would make a lane."""
        if self._lanes_of(belief, rival, rival.before + 0.5 * rival.late):  # it may be hidden, not for ever
            return True
        return rival.other and bool(self._lanes_of(belief, rival, rival.late))

    def lanes(self, belief: LaneBelief) -> list[LaneBelief]:
        """The lanes that may be meant instead of the believed one, as likely as a bound may be exceeded."""
        missed = [(rival, rival.before + rival.late) for rival in self._rivals]
        return [lane for rival, looks in missed for lane in self._lanes_of(belief, rival, looks)]

    def _lanes_of(self, belief: LaneBelief, rival: _Rival, missed: float) -> list[LaneBelief]:
        lanes = [belief.between(LEFT, rival.role), belief.between(rival.role, RIGHT)]
        least = self._width_odds(belief) + math.log(EXCEEDED) - missed * self._missed
        return [lane for lane in lanes if abs(lane.offset_m) < 0.5 * lane.width_m and self._width_odds(lane) > least]

    @staticmethod
    def _width_odds(lane: LaneBelief) -> float:
        """The logarithm of how likely a lane is so wide, but for a factor."""
        unit = lane.road.lane_width_m
        return -0.5 * ((lane.width_m - unit) / (lane.road.width_sigma * unit)) ** 2

    def _role(self, belief: LaneBelief, line: SightedLine) -> float | None:
        """Where a line runs, in lane widths to the left of the centerline.

        None for one that does not run along.
        """
        length, left = line.painted_m / belief.road.lane_width_m, belief.aside(line.points_m) / belief.width_m
        return None if np.ptp(left) > self._config.same * max(length, 1.0) else float(np.median(left))

    def _is_line(self, length: float) -> bool:
        """Whether a thing of so many lane widths is rather a line, by its length."""
        line, other = self._config.line, self._config.other
        return length * (1.0 / other - 1.0 / line) > math.log(line / other)
