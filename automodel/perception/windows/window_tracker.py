"""The track of one line from window to window, along the path where the line is expected, and over gaps.

`track` does it all, compiled. Its window's pose (5,) is x, y [m], heading [rad], the curvature [1/m] of its track, and
the mean turn [rad] of the last points from the expected line.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from automodel.compiled import compiled
from automodel.geometry import View
from automodel.perception.line_scan import ScanConfig
from automodel.perception.windows.line_windows import (
    Layout,
    LineWindows,
    WindowHit,
    beside_piece,
    in_sight,
    is_empty,
    look,
    remainder,
)
from automodel.types import Bools, FloatArray, Image

HEADING, BEND, TURNED = range(2, 5)  # indices of a pose; of a node the first
MISSED, LATERAL = HEADING, BEND  # and of a point
NO_PATH = ~0  # the node of a path that has ended


class FollowConfig(NamedTuple):
    """How a line is followed; lengths in lane widths, so that one set serves scale cars and full-size ones.

    The effects are those of `automodel bench sensitivity`, of half and one and a half times the value.

    - `turn_rad`: largest direction of a piece relative to the track's, and of the track relative to the expected line.
    - `gap_turn_rad`: the first of these after a gap, when the piece may lead into another road. One angle for both
      loses the lane in the chicane.
    - `odd_rad`: a point beside a gap that is turned by more from the line's usual direction lies on the corner of
      another road. Without such points' removal the error in full-size circuits grows by a sixth.
    - `spread`: widening of the search per distance, as uncertain as the direction of the expected line is. 0.12: the
      neighbour's line is taken in one of twenty worlds.
    - `heading_gain`: share of a window's lateral error that corrects its heading; the curvature's follows from it, as
      in an alpha-beta-gamma filter whose alpha is 1 (Kalata 1984). Without the first the lane is lost in the chicane,
      without the second an S-bend is not followed to its end.
    """

    turn_rad: float = math.radians(35.0)
    gap_turn_rad: float = math.radians(17.0)
    odd_rad: float = math.radians(8.0)
    spread: float = ScanConfig().turn_rad
    heading_gain: float = 0.5


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
        points, heading = (np.array(a, dtype=np.float64, order="C") for a in (self.points_m, self.heading_rad))
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2 or heading.shape != points.shape[:1]:
            raise ValueError(
                f"ExpectedLine: expected points (n, 2) and headings (n,), got {points.shape} and {heading.shape}"
            )
        if not (np.isfinite(points).all() and np.isfinite(heading).all()):
            raise ValueError("ExpectedLine: points and headings must be finite")
        points.flags.writeable = heading.flags.writeable = False
        object.__setattr__(self, "points_m", points)
        object.__setattr__(self, "heading_rad", heading)


class TrackScales(NamedTuple):
    """What a `FollowConfig` means for a track in a view."""

    marking_m: float
    step_m: float
    spacing_m: float  # between the windows of a search
    max_turn_rad: float  # on one step
    max_shift_m: float  # lateral, of a line not lost
    max_steps: int
    config: FollowConfig


def track_scales(view: View, lane_width_m: float, marking_width_m: float) -> TrackScales:
    """The scales for a view."""
    config = FollowConfig()
    step_m = LineWindows.ALONG * marking_width_m
    max_turn_rad = step_m / lane_width_m  # in a bend about a point on the lane's other line
    length_m = view.x_far_m - view.x_near_m + 2.0 * view.half_width_m
    return TrackScales(
        marking_m=marking_width_m,
        step_m=step_m,
        spacing_m=0.6 * LineWindows.ACROSS * marking_width_m,
        max_turn_rad=max_turn_rad,
        max_shift_m=0.5 * (step_m * max_turn_rad + marking_width_m),
        max_steps=math.ceil(1.5 * length_m / step_m),
        config=config,
    )


class Path(NamedTuple):
    """The expected line, near which a line must lie: within `reach_m` and what the distance from `from_m` on adds.

    `nodes` (n, 3) are x, y [m] and heading [rad] at equal steps of arc length. Beyond `known_m` the line is a guess.
    """

    nodes: FloatArray
    step_m: float
    known_m: float
    reach_m: float
    from_m: float


class _Scene(NamedTuple):
    """A binary view (h, w), its windows, and the path along which a line is followed in it."""

    features: Image
    layout: Layout
    scales: TrackScales
    path: Path


@compiled
def resampled(points_m: FloatArray, heading_rad: FloatArray, step_m: float, max_steps: int) -> FloatArray:
    """The nodes (k, 3) of a `Path` through points (n, 2); a line of more than `max_steps` is cut."""
    s = np.zeros(len(points_m))
    for i in range(1, len(s)):
        s[i] = s[i - 1] + math.hypot(points_m[i, 0] - points_m[i - 1, 0], points_m[i, 1] - points_m[i - 1, 1])
    places = np.arange(0.0, min(max(s[-1], 1e-9), max_steps * step_m), step_m)
    nodes = np.empty((len(places), 3))
    nodes[:, 0] = np.interp(places, s, np.ascontiguousarray(points_m[:, 0]))
    nodes[:, 1] = np.interp(places, s, np.ascontiguousarray(points_m[:, 1]))
    nodes[:, 2] = np.interp(places, s, heading_rad)
    return nodes


@compiled
def beside(path: Path, at: int, x_m: float, y_m: float) -> int:
    """The node of a path beside (x, y) [m], from a node on; `NO_PATH` at the path's end."""
    while at + 1 < len(path.nodes):
        x, y, heading = path.nodes[at]
        if (x_m - x) * math.cos(heading) + (y_m - y) * math.sin(heading) <= 0.5 * path.step_m:
            return at
        at += 1
    return NO_PATH


@compiled
def _is_known(path: Path, at: int) -> bool:
    """Whether the path is no guess at a node."""
    return at * path.step_m <= path.known_m


@compiled
def _lateral(pose: FloatArray, x_m: float, y_m: float) -> float:
    """Distance [m] of (x, y) to the left of a pose, or of the tangent at a node of a path: x, y [m] and heading."""
    return (y_m - pose[1]) * math.cos(pose[HEADING]) - (x_m - pose[0]) * math.sin(pose[HEADING])


@compiled
def _shift(pose: FloatArray, left_m: float) -> None:
    """Move a pose to the left."""
    pose[0] -= left_m * math.sin(pose[HEADING])
    pose[1] += left_m * math.cos(pose[HEADING])


@compiled
def track(
    features: Image,
    layout: Layout,
    scales: TrackScales,
    points_m: FloatArray,
    heading_rad: FloatArray,
    known_m: float,
    reach_m: float,
) -> tuple[FloatArray, float, float]:
    """Follow a line along the expected one, points (n, 2) [m] and headings (n,), until it leaves the view or is lost.

    Returns its points (k, 5): x, y [m], the number of windows missed before it, and its offset [m] and turn [rad] from
    the expected line; and where it is lost within the view, x, y [m], else NaN.
    """
    nodes, at = resampled(points_m, heading_rad, scales.step_m, scales.max_steps), 0
    while at + 1 < len(nodes) and not in_sight(layout, nodes[at, 0], nodes[at, 1]):
        at += 1
    if at + 1 >= len(nodes):
        return np.empty((0, 5)), math.nan, math.nan
    pose = np.array((nodes[at, 0], nodes[at, 1], nodes[at, 2], 0.0, 0.0))
    scene = _Scene(features, layout, scales, Path(nodes, scales.step_m, known_m, reach_m, at * scales.step_m))
    at = beside(scene.path, at, pose[0], pose[1])
    points, guided = np.empty((scales.max_steps, 5)), at != NO_PATH
    count = missed = 0  # points, and windows without the line since it was last seen
    seen = False  # the track has come into sight
    lost_x = lost_y = math.nan
    for _ in range(scales.max_steps):
        hit = _search(scene, at, pose, count, missed)
        accepted = not math.isnan(hit.x_m)
        if accepted:
            accepted, at, count, missed = _accept(scene, at, pose, hit, points, count, missed)
        if accepted:
            seen, missed = True, 0
        elif in_sight(layout, pose[0], pose[1]):
            seen, missed = True, missed + 1
            if at == NO_PATH:
                lost_x, lost_y = pose[0], pose[1]
                break
        elif seen:
            break
        at = _advance(scene, at, pose, _is_lost(count, missed))
    if guided:
        return without_corners(points[:count], scales, missed > 0), lost_x, lost_y
    return points[:count], lost_x, lost_y


@compiled
def _is_lost(count: int, missed: int) -> bool:
    """Whether the line was not in the last window, or has not been seen yet."""
    return missed > 0 or count == 0


@compiled
def _search(scene: _Scene, at: int, pose: FloatArray, count: int, missed: int) -> WindowHit:
    """The line in the window, or, if it is lost, in windows to both sides, the nearest first."""
    scales = scene.scales
    if not _is_lost(count, missed):
        return _look(scene, at, pose, 0.0, scales.max_shift_m, False)
    reach = scales.config.spread * missed * scales.step_m + (scene.path.reach_m if count == 0 else 0.0)
    if is_empty(scene.features, scene.layout, pose[0], pose[1], reach):
        return WindowHit(math.nan, math.nan, math.nan)
    most = reach + scales.marking_m
    hit = _look(scene, at, pose, 0.0, most, True)
    for k in range(1, math.ceil(reach / scales.spacing_m) + 1):
        if not math.isnan(hit.x_m):
            break
        left = min(k * scales.spacing_m, reach)
        hit, other = _look(scene, at, pose, left, most, True), _look(scene, at, pose, -left, most, True)
        nearer = abs(_lateral(pose, other.x_m, other.y_m)) < abs(_lateral(pose, hit.x_m, hit.y_m))
        if nearer or math.isnan(hit.x_m):
            hit = other
    return hit


@compiled
def _look(scene: _Scene, at: int, pose: FloatArray, left_m: float, most_m: float, lost: bool) -> WindowHit:
    """The content of a window `left_m` to the left, if it can be the line, up to `most_m` beside the pose."""
    features, layout, scales, path = scene
    nothing, heading = WindowHit(math.nan, math.nan, math.nan), pose[HEADING]
    hit = look(features, layout, pose[0] - left_m * math.sin(heading), pose[1] + left_m * math.cos(heading), heading)
    if math.isnan(hit.x_m) or abs(_lateral(pose, hit.x_m, hit.y_m)) > most_m:
        return nothing
    if lost:  # the line again if the piece is long enough for a direction, and no bar of a zebra between two others
        if math.isnan(hit.direction_rad):
            return nothing
        if min(beside_piece(features, layout, hit.x_m, hit.y_m, hit.direction_rad)) >= layout.fill:
            return nothing
    if abs(hit.direction_rad - heading) > (scales.config.gap_turn_rad if lost else scales.config.turn_rad):  # not NaN
        return nothing
    if at != NO_PATH and (lost or _is_known(path, at)):
        away_m = path.reach_m + scales.marking_m + scales.config.spread * (at * path.step_m - path.from_m)
        if abs(_lateral(path.nodes[at], hit.x_m, hit.y_m)) > away_m:
            return nothing
    return hit


@compiled
def _accept(
    scene: _Scene, at: int, pose: FloatArray, hit: WindowHit, points: FloatArray, count: int, missed: int
) -> tuple[bool, int, int, int]:
    """Move onto the line, and add its point; False where it has turned away from the expected line.

    Returns also the node of the path, and the numbers of points and of missed windows.
    """
    scales, path, lost = scene.scales, scene.path, _is_lost(count, missed)
    error, step = _lateral(pose, hit.x_m, hit.y_m), scales.step_m
    _shift(pose, error)
    if not lost:
        pose[HEADING] += scales.config.heading_gain * error / step
        pose[BEND] += 0.5 * (scales.config.heading_gain / step) ** 2 * error
    seen_rad = pose[HEADING] if math.isnan(hit.direction_rad) else hit.direction_rad
    lateral = turned = 0.0
    if at != NO_PATH:
        lateral = _lateral(path.nodes[at], pose[0], pose[1])
        turned = remainder(0.5 * (pose[HEADING] + seen_rad) - path.nodes[at, HEADING], math.tau)
        if lost or _is_known(path, at):
            if abs(turned) > scales.config.turn_rad:
                return False, at, *_turned_back(scales, path.nodes[at], pose, points[:count], missed)
            pose[TURNED] += (turned - pose[TURNED]) / (count + 2)
        elif abs(turned - pose[TURNED]) > scales.config.odd_rad:  # the line leaves the guessed part
            at, turned = NO_PATH, pose[TURNED]
    points[count, 0], points[count, 1], points[count, MISSED] = hit.x_m, hit.y_m, missed
    points[count, LATERAL], points[count, TURNED] = lateral, turned
    return True, at, count + 1, missed


@compiled
def _turned_back(
    scales: TrackScales, node: FloatArray, pose: FloatArray, points: FloatArray, missed: int
) -> tuple[int, int]:
    """Go on beside the expected line as before the last points, which led away from it.

    Returns how many points are left, and how many windows are missed.
    """
    odd, count = _odd(points, scales.config.odd_rad), len(points)
    while count and odd[count - 1]:
        count -= 1
        missed += 1 + int(points[count, MISSED])
    pose[TURNED] = _median_turn(points[:count])
    pose[0], pose[1], pose[HEADING] = node[0], node[1], node[HEADING] + pose[TURNED]
    if count:
        _shift(pose, points[count - 1, LATERAL])
    return count, missed


@compiled
def _advance(scene: _Scene, at: int, pose: FloatArray, lost: bool) -> int:
    """Move to the next window, with the expected line's curvature if there is one, else with the line's own.

    Returns the node of the path beside it.
    """
    scales, path, step = scene.scales, scene.path, scene.scales.step_m
    if at != NO_PATH and (lost or _is_known(path, at)):
        pose[BEND] = (path.nodes[at + 1, HEADING] - path.nodes[at, HEADING]) / step
        if lost:
            pose[HEADING] += remainder(path.nodes[at, HEADING] + pose[TURNED] - pose[HEADING], math.tau)
    turn = min(max(pose[BEND] * step, -scales.max_turn_rad), scales.max_turn_rad)
    middle = pose[HEADING] + 0.5 * turn
    pose[0] += step * math.cos(middle)
    pose[1] += step * math.sin(middle)
    pose[HEADING] += turn
    return beside(path, at, pose[0], pose[1]) if at != NO_PATH else NO_PATH


@compiled
def _median_turn(points: FloatArray) -> float:
    """The median turn of points (n, 5) from the expected line: some may lie on the corner of another road."""
    return np.sort(points[:, TURNED])[len(points) // 2] if len(points) else 0.0


@compiled
def _odd(points: FloatArray, odd_rad: float) -> Bools:
    """Which of points (n, 5) have another direction than the line."""
    return np.abs(points[:, TURNED] - _median_turn(points)) > odd_rad


@compiled
def without_corners(points: FloatArray, scales: TrackScales, lost: bool) -> FloatArray:
    """Points (n, 5) of a line less the odd ones beside a gap: at a junction they lie on another road's corner.

    `lost`: there is such a gap beyond the last point.
    """
    count, odd, kept = len(points), _odd(points, scales.config.odd_rad), np.ones(len(points), np.bool_)
    for gap in range(1, count + 1):
        if not (lost if gap == count else points[gap, MISSED] > 0.0):
            continue
        i = gap
        while i < count and odd[i]:
            kept[i] = False
            i += 1
        i = gap - 1
        while i >= 0 and odd[i]:
            kept[i] = False
            i -= 1
    return points[kept]
