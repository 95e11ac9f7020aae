"""The walk of one line's windows over one view: from window to window, over gaps, past what turns away.

An expected line: last frame's model, moved by the odometry, as the line following reads it.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from automodel.perception.windows.line_windows import Glimpse, LineWindows
from automodel.types import FloatArray, Image


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExpectedLine:
    """Points (n, 2) [m] of a line in the body frame, the nearest along the line first, and its headings (n,) [rad].

    Headings go on steadily, past pi too. Beyond the arc length `known_m` from its beginning the line is a guess, which
    a line that is seen without a gap may leave. Raises ValueError for less than two points, for one that is not finite
    and for headings that are not as many.
    """

    points_m: FloatArray
    heading_rad: FloatArray
    known_m: float = math.inf

    def __post_init__(self) -> None:
        points, heading = (np.array(a, dtype=np.float64) for a in (self.points_m, self.heading_rad))
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2 or heading.shape != points.shape[:1]:
            raise ValueError(
                f"ExpectedLine: points {points.shape} and headings {heading.shape}; (n, 2) and (n,) wanted"
            )
        if not (np.isfinite(points).all() and np.isfinite(heading).all()):
            raise ValueError("ExpectedLine: points and headings must be finite")
        points.flags.writeable = heading.flags.writeable = False
        object.__setattr__(self, "points_m", points)
        object.__setattr__(self, "heading_rad", heading)


class Guide:
    """An expected line at equal steps, and the place on it where the following has come to.

    `x_m`, `y_m`, `heading_rad` are the line's there, `way_m` is the arc length to there from the line's beginning,
    `turn_rad` how much the line turns on the next step, `ended` says that there is no next one, and `known` that the
    line is no guess there.
    """

    MOST = 4096  # steps; a line that is longer is cut

    __slots__ = (
        "_at", "_cos", "_known_m", "_nodes", "_sin", "_step_m", "ended", "heading_rad", "known", "turn_rad", "way_m",
        "x_m", "y_m",
    )  # fmt: skip

    def __init__(self, expected: ExpectedLine, step_m: float) -> None:
        points, heading = expected.points_m, expected.heading_rad
        s = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
        places = np.arange(0.0, min(max(float(s[-1]), 1e-9), self.MOST * step_m), step_m)
        columns = (np.interp(places, s, column) for column in (points[:, 0], points[:, 1], heading))
        self._nodes: list[tuple[float, float, float]] = list(zip(*(c.tolist() for c in columns), strict=True))
        self._step_m, self._known_m = step_m, expected.known_m
        self._go(0)

    def _go(self, at: int) -> None:
        self._at = at
        self.x_m, self.y_m, self.heading_rad = self._nodes[at]
        self.way_m = at * self._step_m
        self.known = self.way_m <= self._known_m
        self.ended = at + 1 >= len(self._nodes)
        self.turn_rad = 0.0 if self.ended else self._nodes[at + 1][2] - self.heading_rad
        self._cos, self._sin = math.cos(self.heading_rad), math.sin(self.heading_rad)

    def next(self) -> None:
        """Go on by a step; does nothing at the end."""
        if not self.ended:
            self._go(self._at + 1)

    def come(self, x_m: float, y_m: float) -> None:
        """Go on to where (x, y) lies beside the line."""
        half = 0.5 * self._step_m
        while not self.ended and (x_m - self.x_m) * self._cos + (y_m - self.y_m) * self._sin > half:
            self._go(self._at + 1)

    def aside(self, x_m: float, y_m: float) -> float:
        """How far [m] (x, y) lies to the left of the line at the place."""
        return (y_m - self.y_m) * self._cos - (x_m - self.x_m) * self._sin


@dataclass(frozen=True, slots=True, kw_only=True)
class WalkSettings:
    """Lengths of a walk: see `LineFollowing`."""

    step_m: float
    spacing_m: float  # between the windows of a search
    marking_m: float
    max_gap_m: float
    max_blind_gap_m: float  # without an expected line
    max_turn_rad: float  # on one step
    max_leap_m: float  # to the side of a line that is not lost
    max_steps: int
    wide_gap: int  # windows; one so wide is more than that between two dashes


class Walker:
    """Where the next window goes: a place (x, y) [m] of the body frame, a heading and a bend."""

    __slots__ = ("cos", "curvature_per_m", "heading_rad", "sin", "x_m", "y_m")

    def __init__(self, x_m: float, y_m: float, heading_rad: float, curvature_per_m: float = 0.0) -> None:
        self.x_m, self.y_m, self.heading_rad, self.curvature_per_m = x_m, y_m, heading_rad, curvature_per_m
        self.cos, self.sin = math.cos(heading_rad), math.sin(heading_rad)

    def turn(self, angle_rad: float) -> None:
        """Turn to the left."""
        self.heading_rad += angle_rad
        self.cos, self.sin = math.cos(self.heading_rad), math.sin(self.heading_rad)

    def aside(self, x_m: float, y_m: float) -> float:
        """How far [m] (x, y) lies to the left of the window's middle."""
        return (y_m - self.y_m) * self.cos - (x_m - self.x_m) * self.sin

    def shift(self, aside_m: float) -> None:
        """Move to the left."""
        self.x_m -= aside_m * self.sin
        self.y_m += aside_m * self.cos

    def go(self, way_m: float, turn_rad: float) -> None:
        """Go ahead along an arc."""
        middle = self.heading_rad + 0.5 * turn_rad
        self.x_m += way_m * math.cos(middle)
        self.y_m += way_m * math.sin(middle)
        self.turn(turn_rad)


class WalkPoint(NamedTuple):
    """A point of the line, the windows missed before it, and how it lies to the expected line: beside, turned from."""

    x_m: float
    y_m: float
    missed: int
    aside_m: float
    turned_rad: float


ODD_RAD = math.radians(8.0)


def _usual_turn(points: list[WalkPoint]) -> float:
    """How the line is turned from the expected one: the points' median, for some may lie on another road's corner."""
    return sorted(p.turned_rad for p in points)[len(points) // 2] if points else 0.0


def _odd(points: list[WalkPoint]) -> list[bool]:
    """Which points have another direction than the line has."""
    usual = _usual_turn(points)
    return [abs(p.turned_rad - usual) > ODD_RAD for p in points]


def without_corners(points: list[WalkPoint], wide_gap: int, lost: bool) -> list[WalkPoint]:
    """The points of a line but for the odd ones beside a wide gap: at a junction they lie on another road's corner.

    `wide_gap` counts windows; `lost`: there is such a gap beyond the last point.
    """
    gaps = [i for i in range(1, len(points)) if points[i].missed >= wide_gap] + [len(points)] * lost
    if not gaps:
        return points
    odd = _odd(points)
    dropped: set[int] = set()
    for gap in gaps:
        dropped.update(itertools.takewhile(lambda i: odd[i], range(gap, len(points))))
        dropped.update(itertools.takewhile(lambda i: odd[i], range(gap - 1, -1, -1)))
    return [p for i, p in enumerate(points) if i not in dropped]


class LineWalk:
    """One line's walk; `run` fills `points` and, where the line is lost within the view, `lost_m`."""

    TURN_RAD = math.radians(35.0)  # a piece's direction off the walk's, at most
    GAP_TURN_RAD, BLIND_GAP_TURN_RAD = math.radians(17.0), math.radians(25.0)  # after a gap; without an expected line
    COVERED = 0.7  # share of its window's length on which a piece is seen that is the line found again
    FLANKED = 0.4  # share of a line that lies on both sides of what is one of several, a zebra's bars
    AWAY_RAD = math.radians(25.0)  # off the expected line's direction: given up
    SPREAD_PER_M, BLIND_SPREAD_PER_M = 0.06, 0.12  # widening of the search, a metre of gap; without an expected line
    ASIDE_PER_M = 0.08  # widening of what may lie beside the expected line, a metre of way along it
    HEADING_GAIN, BEND_GAIN = 0.5, 0.1  # share of a window's surprise that goes to the direction and to the bend
    OWN_GAIN, FOUND_GAIN = 0.25, 0.5  # share of the piece's own direction; of one found after a gap
    STRAIGHTEN = 0.9  # of the bend is left after a step over a gap
    REJOIN = 0.3  # share of the turn back to the line's usual direction on a step over a gap
    TURNED_GAIN = 0.15  # share of a point in what is usual
    HIDDEN = 2  # windows out of sight that end the walk

    def __init__(
        self,
        settings: WalkSettings,
        windows: LineWindows,
        features: Image,
        walker: Walker,
        guide: Guide | None,
        breadth_m: float,
    ) -> None:
        self.points: list[WalkPoint] = []
        self.lost_m: tuple[float, float] | None = None
        self._set, self._windows, self._features = settings, windows, features
        self._walker, self._whole_guide, self._breadth_m = walker, guide, breadth_m
        self._missed = 0  # windows without the line since it was last seen
        self._lost = True  # the line was not in the last window, or has not been seen yet
        self._guide: Guide | None = None  # the expected line up to its end
        self._come()
        self._from_m = guide.way_m if guide is not None else 0.0
        self._turned_rad = 0.0  # of the line from the expected one, on the mean of the last points
        self._most_aside_m = 0.0  # that a lost line may lie beside the window's middle

    def run(self) -> None:
        """Step until the line leaves the view or is lost."""
        guided = self._guide is not None
        self._step_on()
        if guided:
            self.points = without_corners(self.points, self._set.wide_gap, self._missed >= self._set.wide_gap)

    def _step_on(self) -> None:
        walker = self._walker
        hidden = -self._set.max_steps  # until the walk comes into sight
        for _ in range(self._set.max_steps):
            glimpse = self._search() if self._lost else self._look(0.0)
            if glimpse is not None and self._take(glimpse):
                hidden = 0
            elif self._windows.in_sight(walker.x_m, walker.y_m):
                hidden = 0
                self._missed += 1
                self._lost = True
                most = self._set.max_blind_gap_m if self._guide is None else self._set.max_gap_m
                if self._missed * self._set.step_m > most:
                    self.lost_m = (walker.x_m, walker.y_m)
                    return
            else:
                hidden += 1
                if hidden >= self.HIDDEN:
                    return
            self._advance()

    def _search(self) -> Glimpse | None:
        """The line in the window or in windows to both sides, the nearest first."""
        walker = self._walker
        spread = self.BLIND_SPREAD_PER_M if self._guide is None else self.SPREAD_PER_M
        reach = spread * self._missed * self._set.step_m + (0.0 if self.points else self._breadth_m)
        self._most_aside_m = reach + self._set.marking_m
        if self._windows.is_bare(self._features, walker.x_m, walker.y_m, reach):
            return None
        glimpse = self._look(0.0)
        if glimpse is not None:
            return glimpse
        for k in range(1, math.ceil(reach / self._set.spacing_m) + 1):
            aside = min(k * self._set.spacing_m, reach)
            found = [g for g in (self._look(aside), self._look(-aside)) if g is not None]
            if found:
                return min(found, key=lambda g: abs(walker.aside(g.x_m, g.y_m)))
        return None

    def _look(self, aside_m: float) -> Glimpse | None:
        """What a window `aside_m` to the left shows, if it can be the line."""
        walker, guide = self._walker, self._guide
        x, y = walker.x_m - aside_m * walker.sin, walker.y_m + aside_m * walker.cos
        glimpse = self._windows.look(self._features, x, y, walker.heading_rad)
        if glimpse is None:
            return None
        most = self._most_aside_m if self._lost else self._set.max_leap_m
        if abs(walker.aside(glimpse.x_m, glimpse.y_m)) > most:
            return None
        if self._lost and not self._is_found(glimpse):
            return None
        if glimpse.direction_rad is not None and abs(glimpse.direction_rad - walker.heading_rad) > self.TURN_RAD:
            return None
        if guide is not None and (self._lost or guide.known):
            most = self._breadth_m + self._set.marking_m + self.ASIDE_PER_M * (guide.way_m - self._from_m)
            if abs(guide.aside(glimpse.x_m, glimpse.y_m)) > most:
                return None
        return glimpse

    def _is_found(self, glimpse: Glimpse) -> bool:
        """Whether a piece may be the lost line: whole, in its direction, and none of a zebra's bars."""
        walker, windows, direction = self._walker, self._windows, glimpse.direction_rad
        most = self.BLIND_GAP_TURN_RAD if self._guide is None else self.GAP_TURN_RAD
        if direction is None or abs(direction - walker.heading_rad) > most:
            return False
        around = windows.around(self._features, glimpse.x_m, glimpse.y_m, direction)
        return around.covered >= self.COVERED and min(around.flanks) < self.FLANKED

    def _take(self, glimpse: Glimpse) -> bool:
        """Move onto the line; False where it has turned away from the expected line."""
        walker, step, guide = self._walker, self._set.step_m, self._guide
        aside = walker.aside(glimpse.x_m, glimpse.y_m)
        walker.shift(aside)
        turn = 0.0
        if not self._lost:
            turn = self.HEADING_GAIN * aside / step
            walker.curvature_per_m += self.BEND_GAIN * aside / (step * step)
        seen_rad = walker.heading_rad + turn
        if glimpse.direction_rad is not None:
            seen_rad = glimpse.direction_rad
            turn += (self.FOUND_GAIN if self._lost else self.OWN_GAIN) * (seen_rad - walker.heading_rad - turn)
        walker.turn(turn)
        beside = turned = 0.0
        if guide is not None:
            beside = guide.aside(walker.x_m, walker.y_m)
            turned = math.remainder(0.5 * (walker.heading_rad + seen_rad) - guide.heading_rad, math.tau)
            if self._lost or guide.known:
                if abs(turned) > self.AWAY_RAD:
                    self._turn_back(guide)
                    return False
                self._turned_rad += max(self.TURNED_GAIN, 1.0 / (len(self.points) + 2)) * (turned - self._turned_rad)
            elif abs(turned - self._turned_rad) > ODD_RAD:  # the line leaves what was a guess
                self._guide = self._whole_guide = None
                turned = self._turned_rad
        self.points.append(WalkPoint(glimpse.x_m, glimpse.y_m, self._missed, beside, turned))
        self._missed, self._lost = 0, False
        return True

    def _turn_back(self, guide: Guide) -> None:
        """Give up the last points, which led away from the expected line, and go on beside it as before them."""
        odd = _odd(self.points)
        while odd and odd.pop():
            self._missed += 1 + self.points.pop().missed
        walker = self._walker
        walker.x_m, walker.y_m = guide.x_m, guide.y_m
        self._turned_rad = _usual_turn(self.points)
        walker.turn(guide.heading_rad + self._turned_rad - walker.heading_rad)
        walker.shift(self.points[-1].aside_m if self.points else 0.0)

    def _advance(self) -> None:
        """To the next window's place: along the expected line's bend if there is one, else along the line's own."""
        walker, step, guide, most = self._walker, self._set.step_m, self._guide, self._set.max_turn_rad
        if guide is not None and (self._lost or guide.known):
            walker.curvature_per_m = guide.turn_rad / step
            if self._lost:
                wanted = guide.heading_rad + self._turned_rad
                walker.turn(self.REJOIN * math.remainder(wanted - walker.heading_rad, math.tau))
        elif self._lost:
            walker.curvature_per_m *= self.STRAIGHTEN
        walker.go(step, min(max(walker.curvature_per_m * step, -most), most))
        self._come()

    def _come(self) -> None:
        """The expected line's place beside the walker; None once the expected line has ended."""
        guide = self._whole_guide
        if guide is not None:
            guide.come(self._walker.x_m, self._walker.y_m)
            if guide.ended:
                self._guide = self._whole_guide = None
            else:
                self._guide = guide
