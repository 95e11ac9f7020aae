"""Whether lines have moved since a moment ago as the odometry says: paint stands still.

Most of what is in view was in view a moment ago. A line's points of then, brought to now by the odometry, lie on the
line as it is now, wherever the lane is and however its road bends, because the same paint is seen twice. They lie away
from it by

    d = y + psi x + t_then n_then - t_now n_now + e

where the car has moved aside by y and turned by psi besides what the odometry says, or the lines are no paint, or the
camera has turned. n: the camera's nod in either frame, by which what lies aside seems further aside (t). The two are
told by generalised least squares (Aitken 1936) of both lines' points; their square over their covariance, with that of
an odometry that is right, is chi-square with two degrees of freedom.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from automodel.compiled import compiled
from automodel.geometry.se2 import SE2
from automodel.tracking.belief import RoadModel
from automodel.tracking.evidence import backward, factor, forward, tilt
from automodel.tracking.frame_motion import FrameMotion
from automodel.types import FloatArray, Ints

LEAST_POINTS = 3  # that both frames show: to one line's points a motion aside, a turn and a nod always fit


class Slip(NamedTuple):
    """What lines have moved by besides the odometry: to the left [m] beside the body frame's origin, and turned [rad].

    `covariance` (2, 2): of both, and of a right odometry. `square`: of both over it, chi-square with two degrees of
    freedom where the paint stood still.
    """

    left_m: float
    turn_rad: float
    covariance: FloatArray
    square: float


class Errors(NamedTuple):
    """Variances between two frames: of a point [m^2], by `pixel` r^2 more at a distance of r; of a whole line [m^2]; of
    the odometry's `step` aside [m^2] and `turn`; of the `nod` of a camera whose place ahead and above is `eye_m`.
    """

    point: float
    pixel: float
    line: float
    step: float
    turn: float
    nod: float
    eye_m: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """Lines' points (n, 2) [m] in the body frame at `pose`, by the odometry; line i ends at `ends[i]`. `way`: driven
    until then [lane widths].
    """

    points_m: FloatArray
    ends: Ints
    pose: SE2
    way: float


class StillPaint:
    """Compares the lines of a frame with those of one that is a half to a whole `RoadModel.news` older.

    Where they contradict the odometry, the older one stays as long as both frames show the same ground.
    """

    def __init__(self, lane_width_m: float) -> None:
        self._unit = lane_width_m
        _warm_up()
        self.reset()

    def reset(self) -> None:
        """Forget all lines."""
        self._seen: list[Seen] = []  # the oldest first
        self._pose, self._way = SE2(), 0.0

    def move(self, motion: FrameMotion) -> None:
        """The car has moved, by the odometry; one that says nothing forgets all lines."""
        if not motion.known:
            self.reset()
        self._pose = self._pose @ motion.before_from_after
        self._way += abs(motion.distance_m) / self._unit

    def look(self, lines: Sequence[FloatArray], road: RoadModel, contradicts: float) -> Slip | None:
        """What the left and the right line (n, 2) [m] have moved by; None where too little of them is seen twice.

        A line that is not seen is empty. `contradicts`: the square from which on the odometry is contradicted.
        """
        points, ends = np.concatenate(lines), np.cumsum([len(line) for line in lines])
        slip, seen = self._slip(points, ends, road), self._seen
        if len(points) >= LEAST_POINTS and (not seen or 2.0 * (self._way - seen[-1].way) >= road.news):
            seen.append(Seen(points_m=points, ends=ends, pose=self._pose, way=self._way))
        stays = slip is not None and slip.square > contradicts
        if len(seen) > 1 and not stays and 2.0 * (self._way - seen[1].way) >= road.news:
            del seen[0]
        return slip

    def _slip(self, points: FloatArray, ends: Ints, road: RoadModel) -> Slip | None:
        if not self._seen:
            return None
        old, unit = self._seen[0], self._unit
        way, now_from_then = self._way - old.way, self._pose.inverse() @ old.pose
        errors = Errors(
            point=2.0 * (road.point_markings * road.marking_width_m) ** 2,
            pixel=2.0 * road.pixel_rad**2,
            line=2.0 * float(road.news_of(1, way)[0]) * (road.line_sigma * unit) ** 2,  # the rest is in both frames
            step=(road.step * unit) ** 2 * way,
            turn=road.turn_rad**2 * way,
            nod=road.pitch_rad**2,
            eye_m=road.eye_m,
        )
        place = now_from_then.x_m, now_from_then.y_m, now_from_then.yaw_rad
        left_m, turn_rad, covariance, square, count = _compared(old.points_m, old.ends, place, points, ends, errors)
        if count >= LEAST_POINTS:
            return Slip(left_m, turn_rad, covariance, square)
        if len(points) and now_from_then.apply(old.points_m)[:, 0].max() < points[:, 0].min():
            del self._seen[0]  # the car has passed them
        return None


@compiled
def _beside(line: FloatArray, x: float, y: float) -> tuple[bool, float, float]:
    """How far a polyline (n, 2) runs to the left of a point, and its heading there; False where it does not."""
    found, least, left, heading = False, math.inf, 0.0, 0.0
    for k in range(len(line) - 1):
        along_x, along_y = line[k + 1, 0] - line[k, 0], line[k + 1, 1] - line[k, 1]
        length = math.hypot(along_x, along_y)
        if length == 0.0:
            continue
        cos, sin = along_x / length, along_y / length
        along = (x - line[k, 0]) * cos + (y - line[k, 1]) * sin
        aside = (x - line[k, 0]) * sin - (y - line[k, 1]) * cos
        if 0.0 <= along <= length and abs(aside) < least:
            found, least, left, heading = True, abs(aside), aside, math.atan2(sin, cos)
    return found, left, heading


@compiled
def _compared(
    old: FloatArray,
    old_ends: Ints,
    now_from_then: tuple[float, float, float],
    new: FloatArray,
    new_ends: Ints,
    errors: Errors,
) -> tuple[float, float, FloatArray, float, int]:
    """The motion to the left and the turn of lines since they were seen before, in an older body frame, by generalised
    least squares; their covariance (2, 2) and its square, as `Slip`; and the number of points that both frames show.
    """
    most = len(old)
    away, rows, nods, noise = np.empty(most), np.empty((most, 2)), np.empty((most, 2)), np.empty(most)
    x_m, y_m, turn = now_from_then
    of, count, cos, sin = np.empty(most, np.int64), 0, math.cos(turn), math.sin(turn)
    for line in range(len(old_ends)):
        first = new_ends[line - 1] if line else 0
        now = new[first : new_ends[line]]
        for k in range(old_ends[line - 1] if line else 0, old_ends[line]):
            x = x_m + cos * old[k, 0] - sin * old[k, 1]
            y = y_m + sin * old[k, 0] + cos * old[k, 1]
            found, left, heading = _beside(now, x, y)
            if not found:
                continue
            across, along = math.cos(heading), math.sin(heading)
            away[count], of[count] = left, line
            rows[count, 0], rows[count, 1] = across, x * across + y * along
            nods[count, 0] = tilt(errors.eye_m, old[k, 0], old[k, 1], heading - turn)
            nods[count, 1] = -tilt(errors.eye_m, x, y, heading)
            then_x, now_x = old[k, 0] - errors.eye_m[0], x - errors.eye_m[0]
            far = 0.5 * (then_x * then_x + old[k, 1] * old[k, 1] + now_x * now_x + y * y)
            noise[count] = errors.point + errors.pixel * far
            count += 1
    information, slip = np.zeros((2, 2)), np.zeros(2)
    if count < LEAST_POINTS:
        return 0.0, 0.0, information, 0.0, count
    spread = np.empty((count, count))
    for i in range(count):
        for j in range(i + 1):
            spread[i, j] = errors.nod * (nods[i, 0] * nods[j, 0] + nods[i, 1] * nods[j, 1])
            spread[i, j] += errors.line if of[i] == of[j] else 0.0
        spread[i, i] += noise[i]
    root = factor(spread)
    white = forward(root, away[:count].copy())
    columns = np.empty((2, count))
    for a in range(2):
        columns[a] = forward(root, rows[:count, a].copy())
    for a in range(2):
        for i in range(count):
            slip[a] += columns[a, i] * white[i]
            for b in range(2):
                information[a, b] += columns[a, i] * columns[b, i]
    known = factor(information)
    slip = backward(known, forward(known, slip))
    covariance = np.eye(2)
    for a in range(2):
        covariance[a] = backward(known, forward(known, covariance[a].copy()))
    covariance[0, 0] += errors.step
    covariance[1, 1] += errors.turn
    white = forward(factor(covariance), slip)
    return slip[0], slip[1], covariance, white[0] * white[0] + white[1] * white[1], count


@functools.cache
def _warm_up() -> None:
    """Compile what is compiled, or load it, before the first frame."""
    points, errors = np.stack((np.arange(4.0), np.zeros(4)), axis=1), Errors(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, (0.0, 1.0))
    _compared(points, np.array((4, 4)), (0.0, 0.0, 0.0), points, np.array((4, 4)), errors)
