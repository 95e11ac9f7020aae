"""One line of the lane over time: remembered points, a smoothing spline, and theta(s) by recursive least squares."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from automodel.curves.foot import nearest_samples
from automodel.estimation.road import ANY_BEND, BEHIND, LOST_PACE, LOST_STEP, NODE, WALK
from automodel.estimation.theta.heading_polynomial import HeadingPolynomial
from automodel.estimation.theta.line_spline import MIN_POINTS, smooth
from automodel.estimation.theta.theta_rls import ThetaRls, ThetaRlsConfig
from automodel.geometry import SE2
from automodel.types import FloatArray

LEAST_NEWS = 1e-6  # share of what is seen that counts as none, of a car that stands


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenLine:
    """One frame's points (n, 2) [m] of a line, near to far, and their standard deviations (n,) [m].

    `ended`: the end of the line was seen.
    """

    points_m: FloatArray
    sigma_m: FloatArray
    ended: bool = False


def move_line(rls: ThetaRls, after_from_before: SE2, distance_m: float, dt_s: float, known: bool) -> None:
    """Move a line into the body frame after a motion; an unknown motion adds to its uncertainty."""
    rls.predict(after_from_before, distance_m if known else LOST_PACE * rls.config.lane_width_m * dt_s, dt_s)
    if not known:
        rls.lateral_variance_m2 += LOST_STEP**2 * rls.config.lane_width_m**2 * dt_s


class TrackedLine:
    """The estimate of one line from its selected points (Cudrano et al. 2020, section IV).

    The camera sees the ground only ahead of the car. So that points lie beside the car too, the nearest ones of each
    frame are remembered, moved by the odometry, and dropped some distance behind the car. `line` is None until `update`
    has made one; `unseen_m` is the distance driven since. `lateral_sigma_m`, `heading_sigma_rad`: uncertainty due to a
    bend that cannot be seen where no points lie beside the car, up to the nearest in `hidden_m`. `known_m` is the
    distance driven since the first update.
    """

    STEP_LANES = NODE / 5  # spacing of the spline's samples, five to a node, and of remembered points

    def __init__(self, config: ThetaRlsConfig) -> None:
        self.unit = config.lane_width_m
        self._reference_x_m = config.reference_x_m
        self._behind_m = config.reference_x_m - BEHIND * self.unit
        self.rls = ThetaRls(config)
        self.forget()

    def forget(self) -> None:
        """Drop the line and all remembered points."""
        self.rls.forget()
        self._memory: FloatArray = np.empty((0, 3))  # x, y, sigma
        self._since_kept_m = np.inf
        self.unseen_m = 0.0
        self.lateral_sigma_m = self.heading_sigma_rad = 0.0
        self.hidden_m, self.known_m = math.inf, 0.0

    @property
    def line(self) -> HeadingPolynomial | None:
        """The line in the body frame."""
        return self.rls.line

    def move(self, after_from_before: SE2, distance_m: float, dt_s: float, known: bool) -> None:
        """Move line and points into the body frame after a motion; an unknown motion drops the points."""
        move_line(self.rls, after_from_before, distance_m, dt_s, known)
        self.unseen_m += abs(distance_m) if known else LOST_PACE * self.unit * dt_s
        self._since_kept_m += abs(distance_m)
        self.known_m += abs(distance_m) if self.line is not None else 0.0
        if not known:
            self._memory = self._memory[:0]
        elif len(self._memory):
            self._memory[:, :2] = after_from_before.apply(self._memory[:, :2])
            self._memory[:, 2] += WALK * abs(distance_m)
            self._memory = self._memory[self._memory[:, 0] >= self._behind_m]

    def update(self, seen: SeenLine) -> bool:
        """Update by a frame's points; False if they make no line."""
        points_m, sigma_m = seen.points_m, seen.sigma_m
        moved_m = math.inf if self.line is None else self.unseen_m
        points = np.concatenate((self._memory[:, :2], points_m))
        sigma = np.concatenate((self._memory[:, 2], sigma_m))
        s = self._along(points)
        if len(self._memory):
            order = np.argsort(s, kind="stable")
            points, sigma = points[order], sigma[order]
        unit = self.unit
        sampled = smooth(points, sigma, self.STEP_LANES * unit, NODE * unit, math.hypot(ANY_BEND, ANY_BEND) / unit**2)
        if sampled is None:
            return False
        self.rls.take(sampled)
        self.end(seen.ended, float(s.max()))
        self._set_hidden_bend(s, moved_m)
        self.unseen_m = 0.0
        if self._since_kept_m >= self.STEP_LANES * unit:
            kept = slice(0, MIN_POINTS)  # the nearest, which leave the image next
            self._memory = np.concatenate((self._memory, np.column_stack((points_m[kept], sigma_m[kept]))))
            self._since_kept_m = 0.0
        return True

    def end(self, ended: bool, last_m: float = math.inf) -> None:
        """Set whether the end of the line was seen, and the arc length of its last point."""
        if self.rls.line is None:
            return
        self.rls.line = self.rls.line.ending(last_m, 0.0 if ended else math.inf)

    def _set_hidden_bend(self, s_m: FloatArray, moved_m: float) -> None:
        """Uncertainty by a bend between the car and the points next to it.

        Frames that miss the same stretch make the same error. What each one tells anew is the share of the stretch that
        the car has driven since the last one, `moved_m`; all frames of a stretch weigh as one.
        """
        ahead, behind = s_m[s_m >= 0.0], -s_m[s_m < 0.0]
        b = float(ahead.min()) if len(ahead) else math.inf
        a = float(behind.min()) if len(behind) else math.inf
        near, far = min(a, b), min(max(a, b), 2.0 * min(a, b))
        kappa = ANY_BEND / self.unit
        self.hidden_m = near
        if near > moved_m:
            kappa /= math.sqrt(max(moved_m / near, LEAST_NEWS))
        self.lateral_sigma_m, self.heading_sigma_rad = 0.5 * kappa * near * far, kappa * near

    def _along(self, points_m: FloatArray) -> FloatArray:
        """Arc length (n,) along the known line, accurate enough to sort points."""
        line = self.line
        if line is None:
            return points_m[:, 0]
        s = np.linspace(min(line.s_min_m, self._behind_m), line.s_max_m + self.unit, 48)
        grid, theta = line.points(s), line.heading(s)
        near = nearest_samples(grid, points_m)
        away = points_m - grid[near]
        return np.asarray(s[near] + away[:, 0] * np.cos(theta[near]) + away[:, 1] * np.sin(theta[near]))
