"""The track of one line from window to window, along the path where the line is expected, and over gaps.

`PathCursor` moves along the expected line, `WindowTracker` moves the window; `LineFollowing` sets both up.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from automodel.geometry import View
from automodel.perception.windows.line_windows import LineWindows, WindowHit
from automodel.types import FloatArray, Image


@dataclass(frozen=True, slots=True, kw_only=True)
class FollowConfig:
    """How a line is followed; lengths in lane widths, so that one set serves scale cars and full-size ones.

    The effects are those of `automodel bench sensitivity`, of half and one and a half times the value.

    - `step_lanes`: least distance between windows. 0.05: no effect; 0.15: the offset's error grows by a half, because a
      window no longer reaches what the line turns within a step.
    - `gap_lanes`: a line that is not seen for longer is lost: the length of an intersection. 2: in one world of twenty
      the far side is not found again, and the neighbour's line is taken.
    - `wide_gap_lanes`: a gap that is a junction's, not one between two dashes, which are half a lane width apart on
      roads. Effect below 0.1 % of the lane's width.
    - `radius_lanes`: radius of the tightest bend that a line is followed into. No effect but on roads that are tighter.
    - `turn_rad`, `gap_turn_rad`: largest direction of a piece relative to the track's, and after a gap, when it may
      lead into another road. One angle for both loses the lane in the chicane.
    - `away_rad`: a line that turns away from the expected one by more is given up. 12 degrees: error plus a tenth.
    - `odd_rad`: a point beside a wide gap that is turned by more from the line's usual direction lies on the corner of
      another road. Without such points' removal the error in full-size circuits grows by a sixth.
    - `spread`: widening of the search per distance, as uncertain as the direction of the expected line is. 0.12: the
      neighbour's line is taken in one of twenty worlds.
    - `heading_gain`, `curvature_gain`: shares of a window's lateral error that correct its heading and curvature.
      Without the first the lane is lost in the chicane, without the second an S-bend is not followed to its end.
    - `own_gain`, `found_gain`: share of a piece's own direction in the window's heading; of one found after a gap.
      With 0.5 for both the lane is lost in the chicane; otherwise below 0.1 %.
    - `covered`, `flanked`: a line found again covers this share of its window's length, and has less than this share of
      a line on one of its sides: it is none of a zebra's bars. Without them other paint is followed at intersections.
    """

    step_lanes: float = 0.1
    gap_lanes: float = 4.0
    wide_gap_lanes: float = 0.6
    radius_lanes: float = 1.0
    turn_rad: float = math.radians(35.0)
    gap_turn_rad: float = math.radians(17.0)
    away_rad: float = math.radians(25.0)
    odd_rad: float = math.radians(8.0)
    spread: float = 0.06
    heading_gain: float = 0.5
    curvature_gain: float = 0.1
    own_gain: float = 0.25
    found_gain: float = 0.5
    covered: float = 0.7
    flanked: float = 0.4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExpectedLine:
    """Points (n, 2) [m] of a line in the body frame, the nearest along the line first, and its headings (n,) [rad].

    Headings are continuous, past pi too. Beyond the arc length `known_m` from its first point the line is a guess,
    which a line that is visible without a gap may leave. Raises ValueError for fewer than two points, other shapes,
    and values that are not finite.
    """

    points_m: FloatArray
    heading_rad: FloatArray
    known_m: float = math.inf

    def __post_init__(self) -> None:
        points, heading = (np.array(a, dtype=np.float64) for a in (self.points_m, self.heading_rad))
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2 or heading.shape != points.shape[:1]:
            raise ValueError(
                f"ExpectedLine: expected points (n, 2) and headings (n,), got {points.shape} and {heading.shape}"
            )
        if not (np.isfinite(points).all() and np.isfinite(heading).all()):
            raise ValueError("ExpectedLine: points and headings must be finite")
        points.flags.writeable = heading.flags.writeable = False
        object.__setattr__(self, "points_m", points)
        object.__setattr__(self, "heading_rad", heading)


class PathCursor:
    """A place on an expected line, which is resampled at equal steps.

    `x_m`, `y_m`, `heading_rad` are the line's there, `s_m` is the arc length from the line's first point, `turn_rad`
    the line's turn over the next step. `ended`: there is no next step. `known`: the line is no guess there.
    """

    def __init__(self, expected: ExpectedLine, step_m: float, max_steps: int) -> None:
        """A line of more than `max_steps` is cut."""
        points, heading = expected.points_m, expected.heading_rad
        s = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
        places = np.arange(0.0, min(max(float(s[-1]), 1e-9), max_steps * step_m), step_m)
        columns = (np.interp(places, s, column) for column in (points[:, 0], points[:, 1], heading))
        self._nodes: list[tuple[float, float, float]] = list(zip(*(c.tolist() for c in columns), strict=True))
        self._step_m, self._known_m = step_m, expected.known_m
        self._go(0)

    def _go(self, at: int) -> None:
        self._at = at
        self.x_m, self.y_m, self.heading_rad = self._nodes[at]
        self.s_m = at * self._step_m
        self.known = self.s_m <= self._known_m
        self.ended = at + 1 >= len(self._nodes)
        self.turn_rad = 0.0 if self.ended else self._nodes[at + 1][2] - self.heading_rad
        self._cos, self._sin = math.cos(self.heading_rad), math.sin(self.heading_rad)

    def next(self) -> None:
        """Advance by one step; does nothing at the end."""
        if not self.ended:
            self._go(self._at + 1)

    def advance_to(self, x_m: float, y_m: float) -> None:
        """Advance to the place beside (x, y)."""
        half = 0.5 * self._step_m
        while not self.ended and (x_m - self.x_m) * self._cos + (y_m - self.y_m) * self._sin > half:
            self._go(self._at + 1)

    def lateral(self, x_m: float, y_m: float) -> float:
        """Distance [m] of (x, y) to the left of the line's tangent at the cursor."""
        return (y_m - self.y_m) * self._cos - (x_m - self.x_m) * self._sin


class TrackerSettings:
    """Lengths of a track in a view."""

    def __init__(self, view: View, lane_width_m: float, marking_width_m: float) -> None:
        self.config = config = FollowConfig()
        self.marking_m = marking_width_m
        self.step_m = max(LineWindows.ALONG * marking_width_m, config.step_lanes * lane_width_m)
        self.spacing_m = 0.6 * LineWindows.ACROSS * marking_width_m  # between the windows of a search
        self.max_gap_m = config.gap_lanes * lane_width_m
        self.max_turn_rad = self.step_m / (config.radius_lanes * lane_width_m)  # on one step
        self.max_shift_m = 0.5 * (self.step_m * self.max_turn_rad + marking_width_m)  # lateral, of a line not lost
        self.wide_gap = math.ceil(config.wide_gap_lanes * lane_width_m / self.step_m)  # windows
        length = view.x_far_m - view.x_near_m + 2.0 * view.half_width_m
        self.max_steps = math.ceil(1.5 * length / self.step_m)


class WindowPose:
    """The place (x, y) [m] of a window in the body frame, its heading, and the curvature of its track."""

    __slots__ = ("cos", "curvature_per_m", "heading_rad", "sin", "x_m", "y_m")

    def __init__(self, x_m: float, y_m: float, heading_rad: float, curvature_per_m: float = 0.0) -> None:
        self.x_m, self.y_m, self.heading_rad, self.curvature_per_m = x_m, y_m, heading_rad, curvature_per_m
        self.cos, self.sin = math.cos(heading_rad), math.sin(heading_rad)

    def turn(self, angle_rad: float) -> None:
        """Turn to the left."""
        self.heading_rad += angle_rad
        self.cos, self.sin = math.cos(self.heading_rad), math.sin(self.heading_rad)

    def lateral(self, x_m: float, y_m: float) -> float:
        """Distance [m] of (x, y) to the left of the window's axis."""
        return (y_m - self.y_m) * self.cos - (x_m - self.x_m) * self.sin

    def shift(self, left_m: float) -> None:
        """Move to the left."""
        self.x_m -= left_m * self.sin
        self.y_m += left_m * self.cos

    def advance(self, distance_m: float, turn_rad: float) -> None:
        """Move ahead along an arc."""
        middle = self.heading_rad + 0.5 * turn_rad
        self.x_m += distance_m * math.cos(middle)
        self.y_m += distance_m * math.sin(middle)
        self.turn(turn_rad)


class TrackedPoint(NamedTuple):
    """A point of the line, the number of windows missed before it, and its offset and turn from the expected line."""

    x_m: float
    y_m: float
    missed: int
    lateral_m: float
    turned_rad: float


def _median_turn(points: list[TrackedPoint]) -> float:
    """The points' median turn from the expected line: some may lie on the corner of another road."""
    return sorted(p.turned_rad for p in points)[len(points) // 2] if points else 0.0


def _odd(points: list[TrackedPoint], odd_rad: float) -> list[bool]:
    """Which points have another direction than the line."""
    usual = _median_turn(points)
    return [abs(p.turned_rad - usual) > odd_rad for p in points]


def without_corners(points: list[TrackedPoint], wide_gap: int, lost: bool, odd_rad: float) -> list[TrackedPoint]:
    """The points of a line less the odd ones beside a wide gap: at a junction they lie on another road's corner.

    `wide_gap` [windows]; `lost`: there is such a gap beyond the last point; `odd_rad`: turn of an odd one.
    """
    gaps = [i for i in range(1, len(points)) if points[i].missed >= wide_gap] + [len(points)] * lost
    if not gaps:
        return points
    odd = _odd(points, odd_rad)
    dropped: set[int] = set()
    for gap in gaps:
        dropped.update(itertools.takewhile(lambda i: odd[i], range(gap, len(points))))
        dropped.update(itertools.takewhile(lambda i: odd[i], range(gap - 1, -1, -1)))
    return [p for i, p in enumerate(points) if i not in dropped]


class WindowTracker:
    """Tracks one line; `run` fills `points` and, where the line is lost within the view, `lost_m`.

    `path` is a cursor on the expected line, near which the line must lie: within `reach_m` and what the distance adds.
    """

    def __init__(
        self,
        settings: TrackerSettings,
        windows: LineWindows,
        features: Image,
        pose: WindowPose,
        path: PathCursor | None,
        reach_m: float,
    ) -> None:
        self.points: list[TrackedPoint] = []
        self.lost_m: tuple[float, float] | None = None
        self._set, self._windows, self._features = settings, windows, features
        self._pose, self._path, self._reach_m = pose, path, reach_m  # `_path` is None once the expected line has ended
        self._missed = 0  # windows without the line since it was last seen
        self._lost = True  # the line was not in the last window, or has not been seen yet
        self._follow_path()
        self._from_m = path.s_m if path is not None else 0.0
        self._turned_rad = 0.0  # of the line from the expected one, mean of the last points
        self._max_lateral_m = 0.0  # of a lost line from the window's axis

    def run(self) -> None:
        """Step until the line leaves the view or is lost."""
        guided = self._path is not None
        self._track()
        if guided:
            wide, lost = self._set.wide_gap, self._missed >= self._set.wide_gap
            self.points = without_corners(self.points, wide, lost, self._set.config.odd_rad)

    def _track(self) -> None:
        pose = self._pose
        seen = False  # the track has come into sight
        for _ in range(self._set.max_steps):
            hit = self._search() if self._lost else self._look(0.0)
            if hit is not None and self._accept(hit):
                seen = True
            elif self._windows.in_sight(pose.x_m, pose.y_m):
                seen = True
                self._missed += 1
                self._lost = True
                if self._path is None or self._missed * self._set.step_m > self._set.max_gap_m:
                    self.lost_m = (pose.x_m, pose.y_m)
                    return
            elif seen:
                return
            self._advance()

    def _search(self) -> WindowHit | None:
        """The line in the window or in windows to both sides, the nearest first."""
        pose = self._pose
        config = self._set.config
        reach = config.spread * self._missed * self._set.step_m + (0.0 if self.points else self._reach_m)
        self._max_lateral_m = reach + self._set.marking_m
        if self._windows.is_empty(self._features, pose.x_m, pose.y_m, reach):
            return None
        hit = self._look(0.0)
        if hit is not None:
            return hit
        for k in range(1, math.ceil(reach / self._set.spacing_m) + 1):
            left = min(k * self._set.spacing_m, reach)
            found = [h for h in (self._look(left), self._look(-left)) if h is not None]
            if found:
                return min(found, key=lambda h: abs(pose.lateral(h.x_m, h.y_m)))
        return None

    def _look(self, left_m: float) -> WindowHit | None:
        """The content of a window `left_m` to the left, if it can be the line."""
        pose, path = self._pose, self._path
        x, y = pose.x_m - left_m * pose.sin, pose.y_m + left_m * pose.cos
        hit = self._windows.look(self._features, x, y, pose.heading_rad)
        if hit is None:
            return None
        most = self._max_lateral_m if self._lost else self._set.max_shift_m
        if abs(pose.lateral(hit.x_m, hit.y_m)) > most:
            return None
        direction = hit.direction_rad
        if self._lost and (direction is None or not self._is_line_again(hit, direction)):
            return None
        most_rad = self._set.config.gap_turn_rad if self._lost else self._set.config.turn_rad
        if direction is not None and abs(direction - pose.heading_rad) > most_rad:
            return None
        if path is not None and (self._lost or path.known):
            most = self._reach_m + self._set.marking_m + self._set.config.spread * (path.s_m - self._from_m)
            if abs(path.lateral(hit.x_m, hit.y_m)) > most:
                return None
        return hit

    def _is_line_again(self, hit: WindowHit, direction_rad: float) -> bool:
        """Whether a piece may be the lost line: whole, and none of a zebra's bars."""
        around = self._windows.surroundings(self._features, hit.x_m, hit.y_m, direction_rad)
        return around.covered >= self._set.config.covered and min(around.flanks) < self._set.config.flanked

    def _accept(self, hit: WindowHit) -> bool:
        """Move onto the line; False where it has turned away from the expected line."""
        pose, path = self._pose, self._path
        error = pose.lateral(hit.x_m, hit.y_m)
        pose.shift(error)
        if not self._lost:
            pose.turn(self._set.config.heading_gain * error / self._set.step_m)
            pose.curvature_per_m += self._set.config.curvature_gain * error / self._set.step_m**2
        seen_rad = pose.heading_rad
        if hit.direction_rad is not None:
            seen_rad = hit.direction_rad
            gain = self._set.config.found_gain if self._lost else self._set.config.own_gain
            pose.turn(gain * (seen_rad - pose.heading_rad))
        lateral = turned = 0.0
        if path is not None:
            lateral = path.lateral(pose.x_m, pose.y_m)
            turned = math.remainder(0.5 * (pose.heading_rad + seen_rad) - path.heading_rad, math.tau)
            if self._lost or path.known:
                if abs(turned) > self._set.config.away_rad:
                    self._turn_back(path)
                    return False
                self._turned_rad += (turned - self._turned_rad) / (len(self.points) + 2)
            elif abs(turned - self._turned_rad) > self._set.config.odd_rad:  # the line leaves the guessed part
                self._path = None
                turned = self._turned_rad
        self.points.append(TrackedPoint(hit.x_m, hit.y_m, self._missed, lateral, turned))
        self._missed, self._lost = 0, False
        return True

    def _turn_back(self, path: PathCursor) -> None:
        """Drop the last points, which led away from the expected line, and go on beside it as before them."""
        odd = _odd(self.points, self._set.config.odd_rad)
        while odd and odd.pop():
            self._missed += 1 + self.points.pop().missed
        pose = self._pose
        pose.x_m, pose.y_m = path.x_m, path.y_m
        self._turned_rad = _median_turn(self.points)
        pose.turn(path.heading_rad + self._turned_rad - pose.heading_rad)
        pose.shift(self.points[-1].lateral_m if self.points else 0.0)

    def _advance(self) -> None:
        """Move to the next window, with the expected line's curvature if there is one, else with the line's own."""
        pose, step, path, most = self._pose, self._set.step_m, self._path, self._set.max_turn_rad
        if path is not None and (self._lost or path.known):
            pose.curvature_per_m = path.turn_rad / step
            if self._lost:
                wanted = path.heading_rad + self._turned_rad
                pose.turn(math.remainder(wanted - pose.heading_rad, math.tau))
        pose.advance(step, min(max(pose.curvature_per_m * step, -most), most))
        self._follow_path()

    def _follow_path(self) -> None:
        """Move the cursor on the expected line beside the window; drop it at the line's end."""
        if self._path is not None:
            self._path.advance_to(self._pose.x_m, self._pose.y_m)
            if self._path.ended:
                self._path = None
