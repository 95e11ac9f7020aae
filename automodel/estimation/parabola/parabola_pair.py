"""The lane as a parabola pair: both lines bend alike, lie a width apart, and converge or part a little.

After the stereo paper's stages 5 and 6. Its models are nested, and so they are here one model whose prior says how
much each next one must explain: parallel lines (offset, heading, width), independent lines (taper), parabolas
(curvature). A parabola in the lane's own coordinates is an arc: the same near the car, and right in a tight bend too.
A lone line says nothing of width and taper: the lane keeps its width.

State: the car's offset d from the centerline (left positive) [m], the lane's heading theta in the body frame [rad], its
width w [m] and taper w' [m/m], at the foot of the reference point, and its curvature [1/m] at stations of the road:
linear in between, a random walk before it is seen. Both lines bend alike, so that the far ones tell width and taper,
but little of the arc beside the car. The stations stay where they are while the car drives past them, so that what was
seen of a bend is known when it gets there.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from automodel.compiled import compiled
from automodel.curves import DeferredCurve
from automodel.estimation.road import (
    ANY_BEND,
    BEHIND,
    LOST_PACE,
    LOST_STEP,
    LOST_TURN_RAD,
    NODE,
    OUTLIER,
    TAPER_LANES,
    WALK,
)
from automodel.estimation.road import TAPER as ROAD_TAPER
from automodel.geometry.elimination import solve
from automodel.geometry.lane_path import (
    curvature,
    foot_on,
    lane_path,
    line_of_path,
    next_lane,
    path_row,
    place_on,
    station,
)
from automodel.types import Bools, Complexes, FloatArray, Floats, Ints

ROUNDS = 5  # of linearisation; the limit of a residual halves in each
SECTIONS = 6  # of the view, between stations
FORGOTTEN = 0.1  # share of the walk by which what was seen of the road is uncertain again
TURNED = 0.4  # sine of the angle between a stripe and its line, at most, beyond what is uncertain


class Part(IntEnum):
    """Indices of the state; from the last one on, the stations."""

    OFFSET = 0  # [m]
    THETA = 1  # [rad]
    WIDTH = 2  # [m]
    TAPER = 3  # [m/m]
    ROAD = 4  # [1/m]


OFFSET, THETA, WIDTH, TAPER, ROAD = (int(part) for part in Part)  # for compiled functions
STATIONS = SECTIONS + 2  # one of them behind the car
SIZE = ROAD + STATIONS  # of the state


@compiled
def residual(
    path: FloatArray,
    state: Floats,
    start_m: float,
    section_m: float,
    reference_x_m: float,
    point: FloatArray,
    side: float,
    slope: FloatArray,
) -> tuple[float, float]:
    """How far a body point (2,) [m] lies to the left of the line on a `side` (+1 left, -1 right) [m], and its foot's
    arc length [m].

    `path`: `lane_path` of the state, whose first station lies `start_m` behind the reference point's foot. `slope`
    (SIZE,) is filled with the derivatives.
    """
    s, left = foot_on(path, point[0], point[1])
    path_row(slope, path, start_m, section_m, reference_x_m, s)
    for i in range(len(slope)):
        slope[i] = -slope[i]
    slope[WIDTH], slope[TAPER] = -0.5 * side, -0.5 * side * s
    return left - 0.5 * side * (state[WIDTH] + state[TAPER] * s), s


@compiled
def _spread(slope: Floats, covariance: Floats) -> float:
    """Variance [m^2] of a line's place by that of the state."""
    spread = 0.0
    for i in range(len(covariance)):
        for j in range(len(covariance)):
            spread += slope[i] * covariance[i, j] * slope[j]
    return spread


@compiled
def _updated(
    prior: FloatArray,
    covariance: FloatArray,
    reference_x_m: float,
    points: FloatArray,
    side: FloatArray,
    sigma: FloatArray,
    bend: float,
    start_m: float,
    section_m: float,
    cut: float,
) -> tuple[FloatArray, FloatArray, Bools]:
    """The state (SIZE,), its covariance, and the inliers (n,) after points (n, 2).

    Robust Gauss-Newton with the prior. `bend` [1/m^3]: variance that the curvature gains per metre of road, also
    within a section of `section_m`, where that is taken to be linear.
    """
    count, size = len(points), len(prior)
    known = solve(covariance.copy(), np.eye(size))
    state, keep, limit = prior.copy(), np.zeros(count), np.zeros(count)
    slope, variance = np.zeros(size), np.empty(count)
    information = known.copy()
    for turn in range(ROUNDS):
        path = lane_path(state, start_m, section_m, reference_x_m)
        information, gradient = known.copy(), np.zeros((size, 1))
        for i in range(size):
            for j in range(size):
                gradient[i, 0] += known[i, j] * (state[j] - prior[j])
        for k in range(count):
            rest, s = residual(path, state, start_m, section_m, reference_x_m, points[k], side[k], slope)
            if turn == 0:
                within = bend * min(abs(s), section_m) ** 5 / 45.0  # of a walk about its chord
                variance[k] = sigma[k] ** 2 + within
                limit[k] = 3.0 * math.sqrt(variance[k] + _spread(slope, covariance))
            room = max(limit[k] * 0.5**turn, cut, 3.0 * math.sqrt(variance[k]))
            keep[k] = max(1.0 - (rest / room) ** 2, 0.0) ** 2
            weight = keep[k] / variance[k]
            for i in range(size):
                gradient[i, 0] += weight * slope[i] * rest
                for j in range(size):
                    information[i, j] += weight * slope[i] * slope[j]
        step = solve(information.copy(), gradient)
        for i in range(size):
            state[i] -= step[i, 0]
    return state, solve(information, np.eye(size)).astype(np.float64), keep > 0.1


@compiled
def _off_lines(
    path: FloatArray,
    state: FloatArray,
    covariance: FloatArray,
    reference_x_m: float,
    points: FloatArray,
    start_m: float,
    section_m: float,
    cut: float,
    most: float,
) -> tuple[float, float]:
    """How far points (n, 2) lie off the left and the right line, over the distance at which they may: the median.

    Infinite for points along a line that leads elsewhere. `path`: `lane_path` of the state.
    """
    count = len(points)
    off, rest, slope = np.empty(count), np.empty(count), np.empty(len(covariance))
    found = (math.inf, math.inf)
    length = math.hypot(points[count - 1, 0] - points[0, 0], points[count - 1, 1] - points[0, 1])
    for side in (1.0, -1.0):
        room = 0.0
        for k in range(count):
            rest[k] = residual(path, state, start_m, section_m, reference_x_m, points[k], side, slope)[0]
            room = 3.0 * math.sqrt(_spread(slope, covariance))
            off[k] = abs(rest[k]) / min(max(cut, room), most)
        away = abs(rest[count - 1] - rest[0]) > TURNED * length + max(room, cut)
        median = math.inf if away else float(np.median(off))
        found = (median, found[1]) if side > 0.0 else (found[0], median)
    return found


@compiled
def _apart(one: FloatArray, other: FloatArray) -> float:
    """The median distance [m] of those points of `other` (m, 2) that lie beside a line `one` (n, 2); 0 for none."""
    apart, count = np.empty(len(other)), 0
    for k in range(len(other)):
        least = math.inf
        for i in range(len(one) - 1):
            along = one[i + 1] - one[i]
            away = other[k] - one[i]
            share = (away[0] * along[0] + away[1] * along[1]) / max(along[0] ** 2 + along[1] ** 2, 1e-12)
            if 0.0 <= share <= 1.0:
                least = min(least, math.hypot(away[0] - share * along[0], away[1] - share * along[1]))
        if least < math.inf:
            apart[count] = least
            count += 1
    return float(np.median(apart[:count])) if count else 0.0


@compiled
def _sides(
    state: FloatArray,
    covariance: FloatArray,
    reference_x_m: float,
    points: FloatArray,
    ends: Ints,
    start_m: float,
    section_m: float,
    cut: float,
    most: float,
) -> FloatArray:
    """See `ParabolaPair.sides_of`; of the points (n, 2) of lines (l,) that end at `ends` (l,)."""
    path, sides = lane_path(state, start_m, section_m, reference_x_m), np.zeros(len(ends))
    starts = np.zeros(len(ends), np.intp)
    starts[1:] = ends[:-1]
    for k in np.argsort(starts - ends, kind="mergesort"):
        line = points[starts[k] : ends[k]]
        half = line[: (len(line) + 1) // 2]
        left, right = _off_lines(path, state, covariance, reference_x_m, half, start_m, section_m, cut, most)
        if min(left, right) > 1.0:
            continue
        side, free = 1.0 if left < right else -1.0, True
        for other in range(len(ends)):
            if sides[other] == side:
                free = free and _apart(points[starts[other] : ends[other]], line) <= cut
        sides[k] = side if free else 0.0
    return sides


@compiled
def _places(path: FloatArray, s_m: FloatArray) -> Complexes:
    """The places (n,) x + i y [m] on a `lane_path` at arc lengths (n,) [m]."""
    places = np.empty(len(s_m), np.complex128)
    for k in range(len(s_m)):
        x, y, _ = place_on(path, s_m[k])
        places[k] = complex(x, y)
    return places


class ParabolaPair:
    """One lane, tracked from frame to frame: `state` and `covariance`, of `SIZE`, in the order of `Part`."""

    def __init__(
        self, lane_width_m: float, width_sigma_m: float, reference_x_m: float, far_m: float, bend_walk: float
    ) -> None:
        """`width_sigma_m`: by how much lanes differ from `lane_width_m` and from each other [m]; `far_m`: arc length
        up to which points are given [m]; `bend_walk`: variance that the curvature gains per lane width of road
        [1 / lane width^2].
        """
        self._unit, self._width_sigma_m = lane_width_m, width_sigma_m
        self._reference_x_m, self._far_m = reference_x_m, far_m
        self._section_m, self._bend = far_m / SECTIONS, bend_walk / lane_width_m**3
        self.forget()

    def forget(self) -> None:
        """A straight lane about the car, of which nothing is known."""
        self.start(np.array((0.0, 0.0, 0.0, self._unit)), np.eye(4))

    def start(self, mean: FloatArray, covariance: FloatArray) -> None:
        """Start about a lane: (offset, theta, curvature, width) (4,) and its covariance (4, 4)."""
        spread = np.zeros((SIZE, 4))
        spread[[OFFSET, THETA, WIDTH], [0, 1, 3]] = spread[ROAD:, 2] = 1.0
        self.start_m = 0.0  # from the first station to the reference point's foot
        self.state: FloatArray = spread @ mean
        self.covariance: FloatArray = spread @ covariance @ spread.T
        self.covariance[TAPER, TAPER] = ROAD_TAPER**2
        for last in range(ROAD, SIZE - 1):
            self._go_on(last)

    def change_lane(self, side: int) -> None:
        """The neighbour lane on a side, +1 left or -1 right, becomes the lane."""
        self.state, self.covariance = next_lane(self.state, self.covariance, side, self._width_sigma_m)

    @property
    def curvature_per_m(self) -> float:
        """The centerline's curvature beside the car [1/m]."""
        return curvature(self.state, self.start_m, self._section_m)

    def move(self, distance_m: float, turn_rad: float, dt_s: float, known: bool) -> None:
        """Move the lane into the body frame after a motion along an arc; an unknown motion counts as none."""
        unit, way = self._unit, abs(distance_m) / self._unit + dt_s  # noise and light are new to a car that stands
        if known:
            self._advance(distance_m, turn_rad)
        else:
            way += LOST_PACE * dt_s
        walk = np.full(SIZE, FORGOTTEN * self._bend * unit * way)
        walk[:ROAD] = np.square((WALK * unit, WALK, WALK * unit, ROAD_TAPER * math.sqrt(2.0 / TAPER_LANES))) * way
        if not known:
            walk[[OFFSET, THETA]] += dt_s * (LOST_STEP * unit) ** 2, dt_s * LOST_TURN_RAD**2
            walk[ROAD:] += self._bend * unit * way
        self.covariance[np.diag_indices(SIZE)] += walk
        self._bound_width()

    def _bound_width(self) -> None:
        """However long no line told it, the width is known as well as any lane's."""
        known, most = self.covariance[WIDTH, WIDTH], self._width_sigma_m**2
        if known > most:
            gain = self.covariance[:, WIDTH] / known
            self.covariance -= np.outer(gain, gain) * (known - most)

    def _advance(self, distance_m: float, turn_rad: float) -> None:
        """The rear axle's centre drives an arc; the reference point is carried along with the body."""
        half, reference, section = 0.5 * turn_rad, self._reference_x_m, self._section_m
        chord = distance_m * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
        point = np.array((chord * math.cos(half) + reference * math.cos(turn_rad), 0.0))
        point[1] = chord * math.sin(half) + reference * math.sin(turn_rad)
        path, slope = lane_path(self.state, self.start_m, section, reference), np.empty(SIZE)
        left, s = residual(path, self.state, self.start_m, section, reference, point, 0.0, slope)
        kept = math.exp(-abs(s) / (TAPER_LANES * self._unit))
        first, share = station(self.start_m + 0.5 * s, section, STATIONS)
        change = np.eye(SIZE)
        change[OFFSET] = slope
        change[THETA, ROAD + first : ROAD + first + 2] = s * (1.0 - share), s * share
        change[WIDTH, TAPER], change[TAPER, TAPER] = s, kept
        state = change @ self.state
        state[OFFSET], state[THETA] = left, place_on(path, s)[2] - turn_rad
        self.state, self.covariance = state, change @ self.covariance @ change.T
        self.start_m += s
        while self.start_m > section:
            self._leave_station()
        self.start_m = max(self.start_m, 0.0)

    def _leave_station(self) -> None:
        """Forget the first station, and add one where the road goes on."""
        order = np.array([*range(ROAD), *range(ROAD + 1, SIZE), SIZE - 1])
        self.state, self.covariance = self.state[order], self.covariance[np.ix_(order, order)]
        self._go_on(SIZE - 2)
        self.start_m -= self._section_m

    def _go_on(self, last: int) -> None:
        """The station after the `last` one: the road goes on as there, and turns straight after a while."""
        kept = math.exp(-self._section_m * self._bend * self._unit**2 / (2.0 * ANY_BEND**2) * self._unit)
        self.state[last + 1] = kept * self.state[last]
        self.covariance[last + 1] = kept * self.covariance[last]
        self.covariance[:, last + 1] = self.covariance[last + 1]
        self.covariance[last + 1, last + 1] = kept**2 * self.covariance[last, last] + self._bend * self._section_m

    def update(self, points_m: FloatArray, side: FloatArray, sigma_m: FloatArray) -> Bools:
        """Take points (n, 2) [m] of the lines on `side` (n,), +1 left or -1 right; returns the inliers (n,).

        `sigma_m` (n,): standard deviations.
        """
        before = self.state
        after, self.covariance, inliers = _updated(
            before,
            self.covariance,
            self._reference_x_m,
            points_m,
            side,
            sigma_m,
            self._bend,
            self.start_m,
            self._section_m,
            OUTLIER * self._unit,
        )
        sides = np.unique(side[inliers])
        if len(sides) == 1:  # the line stays where it is, the width as it was, and the other line parallel
            width, taper = float(before[WIDTH] - after[WIDTH]), -float(after[TAPER])
            after[:ROAD] += (-0.5 * sides[0] * width, 0.5 * sides[0] * taper, width, taper)
        self.state = after
        return inliers

    def ahead(self, s_m: FloatArray) -> Complexes:
        """The centerline's places (n,) x + i y [m] at arc lengths (n,), in the body frame."""
        return _places(lane_path(self.state, self.start_m, self._section_m, self._reference_x_m), s_m)

    def sides_of(self, lines: list[FloatArray]) -> FloatArray:
        """Which line each of these (n, 2) [m] lies on (l,): +1 left, -1 right, 0 neither.

        The points come near to far. The near half decides, where bends are known best: it lies on a line where most of
        it is within three sigmas of the predicted one, and nearer to it than a quarter lane, and leads where that does.
        A line is at one place: of two stripes beside each other the longer one is it, which is less likely by chance.
        """
        return _sides(
            self.state,
            self.covariance,
            self._reference_x_m,
            np.concatenate((*lines, np.empty((0, 2)))),
            np.cumsum([len(line) for line in lines], dtype=np.intp),
            self.start_m,
            self._section_m,
            OUTLIER * self._unit,
            0.25 * self._unit,
        )

    def curve(self, lanes: float) -> DeferredCurve:
        """The curve so many `lanes` widths left of the centerline, from behind the car to the farthest points."""
        behind = math.ceil(BEHIND / NODE) * 2
        step_m, lateral_m = BEHIND * self._unit / behind, lanes * float(self.state[WIDTH])
        span, place = (behind, math.ceil(self._far_m / step_m)), (self.start_m, self._section_m, self._reference_x_m)
        return line_of_path(self.state, *place, lateral_m, span, step_m)
