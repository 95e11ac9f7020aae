"""Both lines, the centerline between them and the car's pose over time (Cudrano et al. 2020, sections IV and V)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from automodel.estimation.road import LOST_PACE, NODE, TAPER
from automodel.estimation.theta.centerline_fusion import CenterlineFusion
from automodel.estimation.theta.heading_polynomial import HeadingPolynomial
from automodel.estimation.theta.line_spline import MIN_POINTS
from automodel.estimation.theta.pose_filter import LanePoseFilter, LinePoint, PoseFilterConfig
from automodel.estimation.theta.theta_rls import ThetaRlsConfig
from automodel.estimation.theta.tracked_line import LEAST_NEWS, SeenLine, TrackedLine, move_line
from automodel.geometry import SE2
from automodel.types import FloatArray


class TrackedLane:
    """One lane from frame to frame: `start`, then `move` and `update` in each frame.

    `centerline` is its curve and `pose` the filter of the car's pose in it, once `start` has returned True.
    `blind_m` is the distance driven since a line was seen; `motion_known` is that of the last `move`.
    """

    KEPT_LANES = 1.0  # unseen distance after which a line's own estimate is dropped
    REACH_LANES = 0.2  # lateral distance from its expected place in which a line is searched
    KNOWN_RAD = REACH_LANES / 2  # two sigma of an unseen line's direction lead out of that within a lane width

    def __init__(self, lane_width_m: float, reference_x_m: float) -> None:
        self.unit, self.reference_x_m = lane_width_m, reference_x_m
        config = ThetaRlsConfig(lane_width_m=lane_width_m, reference_x_m=reference_x_m)
        self.left, self.right = TrackedLine(config), TrackedLine(config)
        self._fusion = CenterlineFusion(config)
        self.pose = LanePoseFilter(PoseFilterConfig(lane_width_m=lane_width_m, reference_x_m=reference_x_m))
        self.blind_m = 0.0
        self.motion_known = True
        self._since_width_m = math.inf  # the distance driven since the width was measured ahead

    @property
    def centerline(self) -> HeadingPolynomial:
        """The centerline in the body frame; raises ValueError before `start`."""
        line = self._fusion.rls.line
        if line is None:
            raise ValueError("centerline: no lane; call start first")
        return line

    def start(self, left: SeenLine, right: SeenLine, mean: FloatArray, covariance: FloatArray) -> bool:
        """Start with one frame's lines, of which one may be missing; False if they make no lane.

        They lie about a belief: (offset, direction of the lane, curvature, width) (4,), and its covariance (4, 4).
        """
        for tracked, seen in ((self.left, left), (self.right, right)):
            tracked.update(seen)
        offset, theta, _, width = mean.tolist()
        sigma = np.sqrt(np.diag(covariance))
        self._fusion.update(self.left.rls, self.right.rls, width, float(covariance[3, 3]))
        if self._fusion.rls.line is None:
            return False
        spread = (float(sigma[1]), float(sigma[0]) / self.unit, float(sigma[3]) / self.unit)
        self.pose.start(offset, -theta, width, spread)
        self._correct((self.left.line is not None, self.right.line is not None))
        return True

    def move(self, after_from_before: SE2, distance_m: float, dt_s: float, known: bool) -> None:
        """Move everything into the body frame after a motion."""
        self.pose.predict(after_from_before, self.centerline.curvature_at(0.0), dt_s, known)
        self.left.move(after_from_before, distance_m, dt_s, known)
        self.right.move(after_from_before, distance_m, dt_s, known)
        move_line(self._fusion.rls, after_from_before, distance_m, dt_s, known)
        self.blind_m += abs(distance_m) if known else LOST_PACE * self.unit * dt_s
        self.motion_known = known
        self._since_width_m += abs(distance_m)

    def update(self, left: SeenLine, right: SeenLine) -> tuple[bool, bool]:
        """Update by a frame's lines; returns which of them were seen."""
        seen = self._take(self.left, left), self._take(self.right, right)
        if not any(seen):
            return seen
        for tracked in (self.left, self.right):
            if tracked.unseen_m > self.KEPT_LANES * self.unit:
                tracked.forget()
        self._fusion.update(self.left.rls, self.right.rls, self.pose.width_m, float(self.pose.covariance[2, 2]))
        self._correct(seen, self._width_ahead(left, right) if all(seen) else None)
        self.blind_m = 0.0
        return seen

    def end(self) -> None:
        """Take the lines to have ended, because none was seen where they should be: the road goes straight on."""
        for tracked in (self.left, self.right):
            tracked.end(True)
        self._fusion.rls.line = replace(self.centerline, arc_ahead_m=0.0)

    def expected(self, side: float, ahead_m: float) -> tuple[FloatArray, FloatArray, float]:
        """Predicted line on `side` (+1 left, -1 right) up to arc length `ahead_m`.

        It follows its own model while that is known or was seen just now, else it lies beside the centerline.
        Returns points (n, 2) [m], headings (n,) [rad], and the arc length from the first point up to which they are
        supported by measurements.
        """
        own = self._own(side)
        model = own or self.centerline
        first = -0.5 * self.unit
        s = np.linspace(first, ahead_m, 30)
        theta, points = model.heading(s), model.points(s)
        if own is None:
            lateral = 0.5 * side * self.pose.width_m
            points[:, 0] -= lateral * np.sin(theta)
            points[:, 1] += lateral * np.cos(theta)
        return points, theta, model.s_max_m - first

    def _own(self, side: float) -> HeadingPolynomial | None:
        tracked = self.left if side > 0 else self.right
        if tracked.unseen_m <= TrackedLine.STEP_LANES * self.unit:
            return tracked.line
        known = tracked.line is not None and tracked.rls.heading_variance_here() < self.KNOWN_RAD**2
        return tracked.line if known and tracked.unseen_m < self.KEPT_LANES * self.unit else None

    def _take(self, tracked: TrackedLine, seen: SeenLine) -> bool:
        enough = 1 if tracked.line is not None else MIN_POINTS
        return len(seen.points_m) >= enough and tracked.update(seen)

    def _width_ahead(self, left: SeenLine, right: SeenLine) -> tuple[float, float] | None:
        """The lane's width where a line begins that is not seen back to the car [m], and its variance [m^2]; or None.

        Up to there the lane may taper, which is the same error in frames that follow each other: what one tells anew is
        the share of that way that was driven since the last one. A line that was seen for less than `STEP_LANES` may be
        anything.
        """
        sides = (self.left, left, self.right), (self.right, right, self.left)
        tracked, seen, other = sides[0] if self.left.hidden_m > self.right.hidden_m else sides[1]
        hidden = tracked.hidden_m > NODE * self.unit
        if not hidden or tracked.known_m < TrackedLine.STEP_LANES * self.unit or other.line is None:
            return None
        point = seen.points_m[0].tolist()
        s, distance = other.line.foot(tuple(point), float(point[0]) - self.reference_x_m)
        if not 0.0 < s <= other.line.s_max_m:
            return None
        variance = 2.0 * float(seen.sigma_m[0]) ** 2 + (TAPER * s) ** 2
        news, self._since_width_m = min(self._since_width_m / s, 1.0), 0.0
        return abs(distance), variance / max(news, LEAST_NEWS)

    def _correct(self, seen: tuple[bool, bool], width: tuple[float, float] | None = None) -> None:
        """Update the pose by the points in which the seen lines meet the perpendicular, eq. (22)-(25)."""
        lines = [tracked if there else None for tracked, there in zip((self.left, self.right), seen, strict=True)]
        there = [tracked for tracked in lines if tracked is not None and tracked.line is not None]
        arc = max((t.line.arc_ahead_m for t in there if t.line is not None), default=math.inf)
        last = max((t.line.s_max_m for t in there if t.line is not None), default=math.inf)
        self._fusion.rls.line = self.centerline.ending(last, arc)
        theta = self.centerline.heading_at(0.0)
        hidden = min((tracked.heading_sigma_rad for tracked in there), default=0.0)
        variance = self._fusion.rls.heading_variance_here() + hidden * hidden
        self.pose.update(self._point(lines[0], theta), self._point(lines[1], theta), (theta, variance), width)

    def _point(self, tracked: TrackedLine | None, theta_rad: float) -> LinePoint | None:
        if tracked is None or tracked.line is None:
            return None
        _, distance = tracked.line.crossing(theta_rad)
        return LinePoint.beside(
            tracked.line.reference_m,
            theta_rad,
            distance,
            tracked.rls.lateral_variance_m2 + tracked.lateral_sigma_m**2,
            tracked.rls.heading_variance_here() + tracked.heading_sigma_rad**2,
        )
