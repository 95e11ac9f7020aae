"""`centerline`: Cudrano et al. 2020, "Advances in centerline estimation for autonomous lateral control".

Line mask (U-Net) -> feature points in the bird's-eye view -> window line following with recovery -> of each line:
memory by odometry, smoothing spline, s-theta model, recursive least squares -> centerline -> relative pose -> EKF.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import cv2
import numpy as np

from automodel.config import CarConfig, CenterlineConfig
from automodel.estimation.theta.tracked_lane import TrackedLane
from automodel.estimation.theta.tracked_line import SeenLine, TrackedLine
from automodel.geometry import SE2, GroundCamera
from automodel.perception.markings.binary_views import FeaturePoints, adaptive_threshold, road_view
from automodel.perception.markings.marking_width import MarkingWidth
from automodel.perception.markings.ridge import RidgeFilter
from automodel.perception.markings.unet import MarkingNetwork, UnetConfig
from automodel.perception.windows.line_following import FollowedLine, LineFollowing
from automodel.perception.windows.line_initialisation import LineInitialisation
from automodel.perception.windows.window_tracker import ExpectedLine
from automodel.pipelines.stages import StageClock
from automodel.signals import Frame, LaneEstimate, LaneLine, LanePose, LaneStatus, Motion
from automodel.types import Bools, FloatArray, Image

NO_POINTS: FloatArray = np.empty((0, 2))


class Markings(Protocol):
    """Finds line markings: a grey image (h, w) -> a mask of any size, the probability of a marking, 0 .. 255."""

    def step(self, grey: Image) -> Image:
        """The mask of one image."""


class Lines(NamedTuple):
    """A frame's left and right line, and which of them the lane's estimate uses."""

    left: SeenLine
    right: SeenLine
    used: tuple[bool, bool]


def make_markings(car: CarConfig) -> Markings:
    """The network or the ridge filter, as configured; raises ValueError for a network that cannot be used."""
    options = car.pipeline.centerline
    if options.markings == "ridge":
        camera = GroundCamera.from_config(car.camera)
        return RidgeFilter.of_camera(camera, car.lane.marking_width_m, markings=car.lane.markings)
    return MarkingNetwork(
        UnetConfig(model=options.model, size=options.network, providers=options.providers, threads=options.threads),
        car.lane.markings,
    )


class Centerline:
    """The pipeline of Cudrano et al. 2020; `notice` is a line for the user, which may be empty."""

    name = "centerline"
    MAX_GAP_NS = 500_000_000  # a longer gap between frames restarts the pipeline
    MAX_DISTANCE_LANES, MAX_TURN_RAD = 6.0, 1.5  # between two frames; a larger motion is not a car's
    MIN_MARKING_LANES = 0.03  # a mask shows no thinner lines: far away its pixels are wider than a marking
    SEEN_POINTS = 2  # that make a line seen
    START_POINTS = 4  # on each line of a pair that starts a lane
    SINGLE_POINTS = 6  # on a single line that starts a lane
    CONFIRM_FRAMES = 3  # consecutive, in which a lane started from one line must be seen before it is reported
    REACH_LANES = 0.1  # lateral distance from its expected place in which a line is searched
    BLIND_REACH = 0.1  # growth of that per distance without a line
    UNKNOWN_REACH_LANES = 0.25  # that distance while the car's motion is unknown
    MIN_SPACING_LANES = 0.4  # between the two lines
    SHORT_POINTS = 6  # a line of fewer is also searched beside the centerline
    END_LANES = 0.8  # a line that is not visible over this distance, where it should be, has ended
    REPLACE_LANES = 0.4  # distance without a line from which on another lane may replace the tracked one
    REPLACE_FRAMES = 3  # consecutive, in which it must be seen
    REPLACE_BY_LINE = 0.2, 0.2  # largest difference of a lane with one line: offset [lane widths], heading [rad]

    def __init__(self, car: CarConfig, markings: Markings | None = None) -> None:
        options, lane = car.pipeline.centerline, car.lane
        self._car, self._camera = car, GroundCamera.from_config(car.camera)
        self._options, self._unit, self._reference_x_m = options, lane.width_m, car.vehicle.reference_x_m
        self._size = (car.camera.height_px, car.camera.width_px)
        ahead_m = self._camera.first_visible_x_m() + options.view_ahead_lanes * lane.width_m
        self._ahead_m = ahead_m - self._reference_x_m
        self._markings = make_markings(car) if markings is None else markings
        self._width = MarkingWidth(self._camera, lane, self._reference_x_m)
        self._look_for(lane.marking_width_m)
        self.notice = _provider_notice(self._markings, options)
        self.stages = StageClock()
        self.reset()

    def _look_for(self, marking_m: float) -> None:
        """Look for markings of this width from now on."""
        options, unit, self._marking_m = self._options, self._unit, marking_m
        shown_m = max(marking_m, self.MIN_MARKING_LANES * unit)
        self.view = road_view(
            self._camera,
            options.view_ahead_lanes * unit,
            options.view_half_lanes * unit,
            shown_m / options.marking_px,
        )
        if isinstance(self._markings, RidgeFilter):
            self._markings = RidgeFilter.of_camera(self._camera, marking_m, markings=self._car.lane.markings)
        self._features = FeaturePoints(self._car.camera, self.view, marking_m, options.threshold)
        self._initialisation = LineInitialisation(self.view, unit, shown_m, self._reference_x_m)
        self._following = LineFollowing(self.view, unit, shown_m, self._features.visible)

    @property
    def warning(self) -> str:
        """A line for the user after a run, which may be empty."""
        return self._width.warning

    def reset(self) -> None:
        """Forget the lane and the markings' measured width."""
        self._width.reset()
        if self._marking_m != self._width.width_m:
            self._look_for(self._width.width_m)
        self._lane: TrackedLane | None = None
        self._last_t_ns: int | None = None
        self._seen_t_ns = 0
        self._unconfirmed = self._replacing = 0  # frames: until the lane is reported; with another lane

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        """The lane in this frame, body frame; LOST for an image of another size than the camera's."""
        self.stages.start()
        self._predict(frame.t_ns, motion)  # odometry: lines, centerline and pose
        self.stages.lap("prediction")
        if frame.image.shape[:2] != self._size:
            return self._lost(frame)
        if self._width.step(frame.image):
            self._look_for(self._width.width_m)
        mask = self._line_mask(frame.image)  # U-Net, or ridge filter
        self.stages.lap("markings")
        features = self._feature_points(mask)  # adaptive threshold, bird's-eye view, morphological cleaning
        self.stages.lap("birdseye")
        if self._lane is None:
            found = self._find(features)  # line initialisation, first lane
            if found is None:
                return self._lost(frame)
            self._lane, lines = found
            self._unconfirmed = 0 if self._lane.left.line and self._lane.right.line else self.CONFIRM_FRAMES
            self.stages.lap("following")
        else:
            followed = self._follow_lines(features, self._lane)  # window line following
            self.stages.lap("following")
            lines = self._update(self._lane, *followed)  # spline, s-theta, RLS, centerline, relative pose, EKF
            lines = self._replaced(features, self._lane, lines)
        self.stages.lap("estimation")
        estimate = self._estimate(frame, self._lane, lines)
        self.stages.lap("estimate")
        return estimate

    def _predict(self, t_ns: int, motion: Motion) -> None:
        """Move the lane by the motion since the last frame; a gap, or time that goes back, drops it."""
        last, self._last_t_ns = self._last_t_ns, t_ns
        if last is None or self._lane is None:
            return
        dt_ns = t_ns - last
        if not 0 < dt_ns <= self.MAX_GAP_NS:
            self._lane = None
            return
        dt_s = dt_ns * 1e-9
        distance, turn = motion.speed_mps * dt_s, motion.yaw_rate_radps * dt_s
        known = motion.known and abs(distance) < self.MAX_DISTANCE_LANES * self._unit and abs(turn) < self.MAX_TURN_RAD
        if not known:  # also where it is not finite
            distance = turn = 0.0
        self._lane.move(SE2.arc(distance, turn).inverse(), distance, dt_s, known)

    def _line_mask(self, image: Image) -> Image:
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        return self._markings.step(np.asarray(grey, dtype=np.uint8))

    def _feature_points(self, mask: Image) -> Image:
        if isinstance(self._markings, MarkingNetwork):
            mask = adaptive_threshold(mask)
        return self._features.step(mask)

    def _find(self, features: Image) -> tuple[TrackedLane, Lines] | None:
        """A lane from this frame alone: from a pair of lines, or from one."""
        starts = self._initialisation.step(features)
        seen = [SeenLine(points_m=NO_POINTS, sigma_m=np.empty(0)) for _ in starts]
        for i, start in enumerate(starts):
            if start is not None:
                followed = self._following.follow(features, start)
                if len(followed) >= (self.SINGLE_POINTS if None in starts else self.START_POINTS):
                    seen[i] = self._seen(followed)
        left, right = seen
        lane = TrackedLane(self._unit, self._reference_x_m)
        if not lane.start(left, right) or not self._plausible(lane):
            return None
        return lane, Lines(left, right, (len(left.points_m) > 0, len(right.points_m) > 0))

    def _follow_lines(self, features: Image, lane: TrackedLane) -> tuple[SeenLine, SeenLine]:
        """Both lines; where they are so close that they must be one, the longer keeps it."""
        left, right = (self._follow_line(features, lane, side) for side in (+1.0, -1.0))
        if not (len(left.points_m) and len(right.points_m)):
            return left, right
        apart = left.points_m[:, None] - right.points_m
        near = np.einsum("ijk,ijk->ij", apart, apart) < (self.MIN_SPACING_LANES * self._unit) ** 2
        if not near.any():
            return left, right
        if len(left.points_m) >= len(right.points_m):
            return left, _cut(right, int(near.any(axis=0).argmax()))
        return _cut(left, int(near.any(axis=1).argmax())), right

    def _follow_line(self, features: Image, lane: TrackedLane, side: float) -> SeenLine:
        """A line's points from where its own model expects it; from the centerline's if that gives clearly more."""
        seen = self._follow_expected(features, lane, side, True)
        if len(seen.points_m) < self.SHORT_POINTS and lane.on_its_own(side):
            other = self._follow_expected(features, lane, side, False)
            if len(other.points_m) > len(seen.points_m) + self.START_POINTS:
                return other
        return seen

    def _follow_expected(self, features: Image, lane: TrackedLane, side: float, alone: bool) -> SeenLine:
        points, heading, known_m = lane.expected(side, self._ahead_m + 0.5 * self._unit, alone)
        reach = self.REACH_LANES if lane.motion_known else self.UNKNOWN_REACH_LANES
        reach = reach * self._unit + self.BLIND_REACH * min(lane.blind_m, 2.0 * self._unit)
        expected = ExpectedLine(points_m=points, heading_rad=heading, known_m=known_m)
        return self._seen(self._following.follow(features, expected=expected, reach_m=reach))

    def _seen(self, followed: FollowedLine) -> SeenLine:
        """The line, and whether it ended within the view."""
        points = followed.points_m
        ended = False
        if len(points) > 1:
            last = points[-1] - points[max(len(points) - 4, 0)]
            beyond = points[-1] + last * (self.END_LANES * self._unit / max(float(np.hypot(*last)), 1e-9))
            ended = bool(self._inside(np.array((beyond, 0.5 * (points[-1] + beyond)))).all())
        return SeenLine(points_m=points, sigma_m=followed.sigma_m, ended=ended)

    def _inside(self, points_m: FloatArray) -> Bools:
        """Which points (n, 2) [m] the camera sees within the view."""
        column, row = np.rint(self.view.to_px(points_m)).astype(np.intp).T
        inside = (column >= 0) & (column < self.view.width_px) & (row >= 0) & (row < self.view.height_px)
        inside[inside] = self._features.visible[row[inside], column[inside]] > 0
        return inside

    def _update(self, lane: TrackedLane, left: SeenLine, right: SeenLine) -> Lines:
        """Correct the lane; one that should be visible and is not goes straight on."""
        used = lane.update(left, right)
        if not any(used) and self._in_view(lane):
            lane.end()
        return Lines(left, right, used)

    def _in_view(self, lane: TrackedLane) -> bool:
        """Whether one of the lines should be visible over more than `END_LANES`."""
        for side in (+1.0, -1.0):
            points, _, _ = lane.expected(side, self._ahead_m)
            if self._inside(points).mean() * self._ahead_m > self.END_LANES * self._unit:
                return True
        return False

    def _replaced(self, features: Image, lane: TrackedLane, lines: Lines) -> Lines:
        """The lines of another lane, once it was seen in `REPLACE_FRAMES` beside one without a line, else `lines`."""
        replacing, self._replacing = self._replacing, 0
        if any(lines.used) or lane.blind_m < self.REPLACE_LANES * self._unit:
            return lines
        found = self._find(features)
        if found is None or not self._may_be(found[0], lane):
            return lines
        if replacing + 1 < self.REPLACE_FRAMES:
            self._replacing = replacing + 1
            return lines
        self._lane, lines = found
        return lines

    def _may_be(self, other: TrackedLane, lane: TrackedLane) -> bool:
        """Whether `other` may be the tracked lane: a larger difference than dead reckoning's error is another lane."""
        blind = lane.blind_m / self._unit
        lateral = abs(other.pose.offset_m - lane.pose.offset_m) / self._unit
        turned = abs(other.pose.heading_rad - lane.pose.heading_rad)
        if other.left.line is None or other.right.line is None:
            return lateral < self.REPLACE_BY_LINE[0] and turned < self.REPLACE_BY_LINE[1]
        return lateral < min(0.15 + 0.1 * blind, 0.3) and turned < 0.25

    def _estimate(self, frame: Frame, lane: TrackedLane, lines: Lines) -> LaneEstimate:
        left, right = (
            used and len(line.points_m) >= self.SEEN_POINTS for used, line in zip(lines.used, lines[:2], strict=True)
        )
        if left or right:
            self._seen_t_ns = frame.t_ns
            self._unconfirmed = max(self._unconfirmed - 1, 0)
        blind_ns = frame.t_ns - self._seen_t_ns
        too_long = (
            (self._unconfirmed and blind_ns > 0)
            or blind_ns * 1e-9 > self._options.coast_s
            or lane.blind_m > self._options.coast_lanes * self._unit
        )
        if too_long or not self._plausible(lane):
            self._lane = None
            return self._lost(frame)
        if self._unconfirmed:
            return self._lost(frame)
        centerline, pose = lane.centerline, lane.pose
        return LaneEstimate(
            t_ns=frame.t_ns,
            status=(LaneStatus.COASTING, LaneStatus.ONE_LINE, LaneStatus.TRACKING)[int(left) + int(right)],
            left=self._line(lane.left, lines.left, left, lane, +0.5),
            right=self._line(lane.right, lines.right, right, lane, -0.5),
            centerline=centerline.curve(-lane.REACH_LANES * self._unit, self._ahead_m),
            pose=LanePose(
                offset_m=pose.offset_m,
                heading_rad=pose.heading_rad,
                width_m=pose.width_m,
                curvature_per_m=centerline.curvature_at(0.0),
                covariance=pose.covariance,
            ),
            frame_age_ns=blind_ns,
        )

    def _line(self, tracked: TrackedLine, line: SeenLine, seen: bool, lane: TrackedLane, side: float) -> LaneLine:
        """A line's own curve, or the lane's edge where there is none."""
        if tracked.line is not None:
            curve = tracked.line.curve(0.0, self._ahead_m)
        else:
            curve = lane.centerline.curve(0.0, self._ahead_m, side * lane.pose.width_m)
        return LaneLine(curve=curve, points_m=line.points_m if seen else NO_POINTS, seen=seen)

    def _plausible(self, lane: TrackedLane) -> bool:
        unit, pose = self._unit, lane.pose
        return bool(
            np.isfinite(pose.state).all()
            and 0.6 * unit < pose.width_m < 1.5 * unit
            and abs(pose.offset_m) < 0.9 * unit
            and abs(pose.heading_rad) < math.radians(60.0)
        )

    def _lost(self, frame: Frame) -> LaneEstimate:
        return LaneEstimate(t_ns=frame.t_ns, status=LaneStatus.LOST, frame_age_ns=max(frame.t_ns - self._seen_t_ns, 0))


def _provider_notice(markings: Markings, options: CenterlineConfig) -> str:
    """The provider of the network and why; empty where it is the CPU and no provider was configured."""
    configured = options.providers != CenterlineConfig().providers
    if not isinstance(markings, MarkingNetwork) or (markings.provider == "cpu" and not configured):
        return ""
    return markings.notice


def _cut(line: SeenLine, count: int) -> SeenLine:
    """The first points of a line."""
    return SeenLine(points_m=line.points_m[:count], sigma_m=line.sigma_m[:count])
