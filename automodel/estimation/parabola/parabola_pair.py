"""The lane as a parabola pair: both lines bend alike, lie a width apart, and converge or part a little.

After the stereo paper's stages 5 and 6. Its models are nested, and so they are here one model whose prior says how
much each next one must explain: parallel lines (offset, heading, width), independent lines (taper), parabolas
(curvature). A parabola in the lane's own coordinates is an arc: the same near the car, and right in a tight bend too.
A lone line says nothing of width and taper: they are held, and the lane keeps its width.

State: the car's offset d from the centerline (left positive) [m], the lane's heading theta in the body frame [rad], its
curvature kappa [1/m], width w [m] and taper w' [m/m], at the foot of the reference point. Further ahead a road may
bend in another way than beside the car. How, is estimated in each frame from its prior, a random walk of the curvature:
both lines do it alike, so that the far ones tell width and taper, but little of the arc; and the arc follows the bends
as the car comes to them.
"""

from __future__ import annotations

import math
from enum import IntEnum
from functools import partial
from typing import NamedTuple

import numpy as np

from automodel.compiled import compiled
from automodel.curves import DeferredCurve
from automodel.curves.sampled import Table, beside
from automodel.estimation.road import BEHIND, LOST_PACE, LOST_STEP, LOST_TURN_RAD, NODE, TAPER_LANES, WALK
from automodel.estimation.road import TAPER as ROAD_TAPER
from automodel.geometry.elimination import solve
from automodel.types import Bools, Complexes, FloatArray, Floats

ROUNDS = 5  # of linearisation; the limit of a residual halves in each
CUT_LANES = 0.06  # distance at which Tukey's biweight becomes 0
BENDS = 4  # sections of the view in which the curvature may change, linearly in each


class Part(IntEnum):
    """Indices of the state."""

    OFFSET = 0  # [m]
    THETA = 1  # [rad]
    KAPPA = 2  # [1/m]
    WIDTH = 3  # [m]
    TAPER = 4  # [m/m]


OFFSET, THETA, KAPPA, WIDTH, TAPER = (int(part) for part in Part)  # for compiled functions


class Foot(NamedTuple):
    """A point beside an arc: its distance to the left [m], the foot's arc length [m], the turn up to there [rad]."""

    left_m: float
    s_m: float
    turn_rad: float


@compiled
def foot_on_arc(state: Floats, reference_x_m: float, x: float, y: float) -> Foot:
    """The foot of a body point (x, y) [m] on the centerline.

    With t, l the point's place along and beside the tangent at the start: left = (2 l - kappa (t^2 + l^2)) / (1 + q),
    q = sqrt((1 - kappa l)^2 + kappa^2 t^2), which holds for a straight line too.
    """
    cos, sin, kappa = math.cos(state[THETA]), math.sin(state[THETA]), state[KAPPA]
    dx, dy = x - reference_x_m, y
    t, left = dx * cos + dy * sin, dy * cos - dx * sin + state[OFFSET]
    q = math.hypot(1.0 - kappa * left, kappa * t)
    away = (2.0 * left - kappa * (t * t + left * left)) / (1.0 + q)
    turn = math.atan2(kappa * t, 1.0 - kappa * left)
    s = turn / kappa if abs(turn) > 1e-6 else t / max(1.0 - kappa * left, 0.05)
    return Foot(away, s, turn)


@compiled
def residual(
    state: Floats, reference_x_m: float, x: float, y: float, side: float, slope: Floats
) -> tuple[float, float]:
    """How far a body point lies to the left of the line on a `side` (+1 left, -1 right) [m], and the foot's s [m].

    `slope` (5,) is filled with its derivatives.
    """
    foot = foot_on_arc(state, reference_x_m, x, y)
    s, turn, kappa = foot.s_m, foot.turn_rad, state[KAPPA]
    cos, sin = math.cos(turn), math.sin(turn)
    ahead = (x - reference_x_m) * math.cos(state[THETA]) + y * math.sin(state[THETA])
    left = y * math.cos(state[THETA]) - (x - reference_x_m) * math.sin(state[THETA])
    slope[OFFSET] = cos
    slope[THETA] = -sin * left - cos * ahead
    slope[KAPPA] = -(1.0 - cos) / (kappa * kappa) if abs(turn) > 1e-3 else -0.5 * s * s
    slope[WIDTH], slope[TAPER] = -0.5 * side, -0.5 * side * s
    return foot.left_m - 0.5 * side * (state[WIDTH] + state[TAPER] * s), s


@compiled
def _beside_bend(s: float, section: int, section_m: float) -> float:
    """How far to the left [m] a road lies at arc length s whose curvature rises by 1 / m in a section, and stays."""
    since, after = max(s - section * section_m, 0.0), max(s - (section + 1) * section_m, 0.0)
    return (since**3 - after**3) / (6.0 * section_m)


@compiled
def _spread(slope: Floats, covariance: Floats, s: float, bend: float) -> float:
    """Variance [m^2] of a line's place at arc length s by that of the state, and by the road's bends."""
    spread = bend * abs(s) ** 5 / 20.0
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
    section_m: float,
    cut: float,
) -> tuple[FloatArray, FloatArray, Bools]:
    """State and bends (5 + BENDS,), the state's covariance (5, 5), and inliers (n,) after points (n, 2).

    Robust Gauss-Newton with the prior. `bend` [1/m^3]: variance that the curvature gains per metre of road, in sections
    of `section_m`. Its integral is the variance, bend s^5 / 20, by which a road leaves its arc.
    """
    count, parts = len(points), len(prior)
    size = parts + BENDS
    known = np.zeros((size, size))
    known[:parts, :parts] = solve(covariance.copy(), np.eye(parts))
    for j in range(parts, size):
        known[j, j] = 1.0 / (bend * section_m)
    state, keep, limit = np.zeros(size), np.zeros(count), np.zeros(count)
    mean = np.zeros(size)
    mean[:parts] = state[:parts] = prior
    slope, variance = np.zeros(size), np.empty(count)
    information = known.copy()
    for turn in range(ROUNDS):
        information, gradient = known.copy(), np.zeros((size, 1))
        for i in range(size):
            for j in range(size):
                gradient[i, 0] += known[i, j] * (state[j] - mean[j])
        for k in range(count):
            rest, s = residual(state, reference_x_m, points[k, 0], points[k, 1], side[k], slope)
            for j in range(BENDS):
                slope[parts + j] = -_beside_bend(s, j, section_m)
                rest += slope[parts + j] * state[parts + j]
            if turn == 0:
                within = bend * min(abs(s), section_m) ** 5 / 45.0  # of a walk about its chord
                variance[k] = sigma[k] ** 2 + within
                limit[k] = 3.0 * math.sqrt(variance[k] + _spread(slope, covariance, s, bend))
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
    return state, solve(information, np.eye(size))[:parts, :parts].copy(), keep > 0.1


@compiled
def _off_lines(
    state: FloatArray,
    covariance: FloatArray,
    reference_x_m: float,
    points: FloatArray,
    bend: float,
    cut: float,
    most: float,
) -> FloatArray:
    """How far points (n, 2) lie off the left and the right line (n, 2), over the distance at which they may."""
    off, slope = np.empty((len(points), 2)), np.empty(len(covariance))
    for k in range(len(points)):
        for column in range(2):
            side = 1.0 - 2.0 * column
            rest, s = residual(state, reference_x_m, points[k, 0], points[k, 1], side, slope)
            room = 3.0 * math.sqrt(_spread(slope, covariance, s, bend))
            off[k, column] = abs(rest) / min(max(cut, room), most)
    return off


class ParabolaPair:
    """One lane, tracked from frame to frame: `state` (5,) and `covariance` (5, 5) in the order of `Part`."""

    def __init__(self, lane_width_m: float, reference_x_m: float, far_m: float) -> None:
        """`far_m`: arc length up to which points are given [m]."""
        self._unit, self._reference_x_m, self._far_m = lane_width_m, reference_x_m, far_m
        self._section_m = far_m / BENDS
        self.forget()

    def forget(self) -> None:
        """A straight lane about the car, of which nothing is known."""
        self.start(np.array((0.0, 0.0, 0.0, self._unit)), np.eye(4))

    def start(self, mean: FloatArray, covariance: FloatArray) -> None:
        """Start about a lane: (offset, theta, curvature, width) (4,) and its covariance (4, 4)."""
        self.state: FloatArray = np.append(mean, 0.0)
        self._bends: FloatArray = np.zeros(BENDS)
        self.covariance: FloatArray = np.zeros((len(Part), len(Part)))
        self.covariance[:TAPER, :TAPER] = covariance
        self.covariance[TAPER, TAPER] = ROAD_TAPER**2

    def move(self, distance_m: float, turn_rad: float, dt_s: float, known: bool, bend_walk: float) -> None:
        """Move the lane into the body frame after a motion along an arc; an unknown motion counts as none.

        `bend_walk`: variance that the curvature gains per lane width of road [1 / lane width^2].
        """
        unit, way = self._unit, abs(distance_m) / self._unit + dt_s  # noise and light are new to a car that stands
        if known:
            self._advance(distance_m, turn_rad)
        else:
            way += LOST_PACE * dt_s
        walk = np.square((WALK * unit, WALK, 0.0, WALK * unit, ROAD_TAPER * math.sqrt(2.0 / TAPER_LANES))) * way
        walk[KAPPA] = bend_walk / unit**2 * way
        if not known:
            walk[[OFFSET, THETA]] += dt_s * (LOST_STEP * unit) ** 2, dt_s * LOST_TURN_RAD**2
        self.covariance[np.diag_indices(len(Part))] += walk
        self._bends = np.zeros(BENDS)

    def _advance(self, distance_m: float, turn_rad: float) -> None:
        """The rear axle's centre drives an arc; the reference point is carried along with the body."""
        half, reference = 0.5 * turn_rad, self._reference_x_m
        chord = distance_m * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
        x = chord * math.cos(half) + reference * math.cos(turn_rad)
        y = chord * math.sin(half) + reference * math.sin(turn_rad)
        slope = np.empty(len(Part))
        residual(self.state, reference, x, y, 0.0, slope)
        foot = foot_on_arc(self.state, reference, x, y)
        kept = math.exp(-abs(foot.s_m) / (TAPER_LANES * self._unit))
        change = np.eye(len(Part))
        change[OFFSET, : KAPPA + 1] = slope[: KAPPA + 1]
        change[THETA, KAPPA] = foot.s_m
        change[WIDTH, TAPER], change[TAPER, TAPER] = foot.s_m, kept
        self.state = np.array(
            (
                foot.left_m,
                self.state[THETA] + foot.turn_rad - turn_rad,
                self.state[KAPPA] + float(self._bends[0]) * min(max(foot.s_m / self._section_m, 0.0), 1.0),
                self.state[WIDTH] + foot.s_m * self.state[TAPER],
                kept * self.state[TAPER],
            )
        )
        self.covariance = change @ self.covariance @ change.T

    def update(self, points_m: FloatArray, side: FloatArray, sigma_m: FloatArray, bend_walk: float) -> Bools:
        """Take points (n, 2) [m] of the lines on `side` (n,), +1 left or -1 right; returns the inliers (n,).

        `sigma_m` (n,): standard deviations; `bend_walk` as in `move`.
        """
        unit, before = self._unit, self.state
        bend, cut = bend_walk / unit**3, CUT_LANES * unit
        both, covariance, inliers = _updated(
            before, self.covariance, self._reference_x_m, points_m, side, sigma_m, bend, self._section_m, cut
        )
        after, self._bends = both[: len(Part)], both[len(Part) :]
        sides = np.unique(side[inliers])
        if len(sides) == 1:  # the line stays where it is, and the width as it was
            width, taper = (before - after)[[WIDTH, TAPER]].tolist()
            after = after + np.array((-0.5 * sides[0] * width, 0.5 * sides[0] * taper, 0.0, width, taper))
        self.state, self.covariance = after, covariance
        return inliers

    def ahead(self, s_m: FloatArray) -> tuple[Complexes, Complexes]:
        """The centerline at arc lengths (n,): places x + i y [m] in the body frame, and unit tangents."""
        d, theta, kappa = self.state[: KAPPA + 1].tolist()
        start = self._reference_x_m - 1j * d * np.exp(1j * theta)
        turn = kappa * s_m
        chord = s_m * np.sinc(turn / (2.0 * np.pi)) * np.exp(1j * (theta + 0.5 * turn))
        return start + chord, np.exp(1j * (theta + turn))

    def side_of(self, points_m: FloatArray, bend_walk: float) -> float:
        """Which line the points (n, 2) [m] of a stripe lie on: +1 left, -1 right, 0 neither; `bend_walk` as in `move`.

        The points come near to far. Its near half decides, where bends are known best: it lies on a line where most of
        it is within three sigmas of the predicted one, and nearer to it than a quarter lane.
        """
        bend, reference, unit = bend_walk / self._unit**3, self._reference_x_m, self._unit
        off = _off_lines(
            self.state,
            self.covariance,
            reference,
            points_m[: (len(points_m) + 1) // 2],
            bend,
            CUT_LANES * unit,
            0.25 * unit,
        )
        left, right = np.median(off, axis=0).tolist()
        return 0.0 if min(left, right) > 1.0 else 1.0 if left < right else -1.0

    def curve(self, lanes: float) -> DeferredCurve:
        """The curve so many `lanes` widths left of the centerline, from behind the car to the farthest points."""
        return DeferredCurve(partial(self._table, self.state, self._bends, lanes))

    def _table(self, state: FloatArray, bends: FloatArray, lanes: float) -> Table:
        behind = BEHIND * self._unit
        zero = math.ceil(BEHIND / NODE) * 2
        step = behind / zero
        s = np.arange(-zero, math.ceil(self._far_m / step) + 1) * step
        ramp = np.clip(s[:, None] / self._section_m - np.arange(BENDS), 0.0, 1.0)
        kappa = state[KAPPA] + ramp @ bends
        turn = np.concatenate(([0.0], np.cumsum(0.5 * (kappa[1:] + kappa[:-1]) * step)))
        theta = state[THETA] + turn - turn[zero]
        chords = step * np.exp(0.5j * (theta[1:] + theta[:-1]))
        place = np.concatenate(([0.0], np.cumsum(chords)))
        place += self._reference_x_m - 1j * state[OFFSET] * np.exp(1j * state[THETA]) - place[zero]
        table = s - s[0], np.column_stack((place.real, place.imag)), theta, kappa
        return beside(table, lanes * float(state[WIDTH])) if lanes else table
