"""`centerline`: Cudrano et al. 2020, "Advances in centerline estimation for autonomous lateral control" (seed 001).

Line mask (U-Net) -> bird's-eye view, feature points -> window line following with recovery -> memory by odometry,
smoothing spline, s-theta, RLS with forgetting -> centerline -> relative pose -> EKF.
"""

from __future__ import annotations

import math
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.config import CarConfig, CenterlineConfig
from automodel.estimation.theta.tracked_lane import TrackedLane
from automodel.estimation.theta.tracked_line import SeenLine, TrackedLine
from automodel.geometry import SE2, GroundCamera, View
from automodel.perception.markings.binary_views import FeaturePoints, adaptive_threshold
from automodel.perception.markings.ridge import RidgeFilter
from automodel.perception.markings.unet import MarkingNetwork, UnetConfig
from automodel.perception.windows.line_following import FollowedLine, LineFollowing
from automodel.perception.windows.line_initialisation import LineInitialisation
from automodel.perception.windows.window_tracker import ExpectedLine
from automodel.pipelines.stages import StageClock
from automodel.signals import Frame, LaneEstimate, LaneLine, LanePose, LaneStatus, Motion
from automodel.types import FloatArray, Image

NO_POINTS: FloatArray = np.empty((0, 2))


class Markings(Protocol):
    """What finds line markings: a grey picture (h, w) -> how sure each pixel is one (any size), 0 .. 255."""

    def step(self, grey: Image) -> Image:
        """The mask of one picture."""


def make_markings(car: CarConfig) -> Markings:
    """The network or the ridge filter, as configured; raises ValueError for a network that cannot be used."""
    options = car.pipeline.centerline
    if options.markings == "ridge":
        camera = GroundCamera.from_config(car.camera)
        return RidgeFilter.of_camera(camera, car.lane.marking_width_m, dark=car.lane.dark_markings)
    return MarkingNetwork(
        UnetConfig(model=options.model, size=options.network, providers=options.providers, threads=options.threads)
    )


class Centerline:
    """Seed 001 as a pipeline: `step` one frame, `reset`."""

    name = "centerline"
    MAX_GAP_NS = 500_000_000  # a longer gap between frames: start again
    MAX_WAY_LANES, MAX_TURN_RAD = 6.0, 1.5  # between two frames; more is no motion of a car
    MAX_ROWS = 240  # of the bird's-eye view; a long view is coarser along the road than across
    LEAST_MARKING_LANES = 0.03  # a mask shows no thinner lines: far out its pixels are broader than a marking
    SEEN_POINTS = 2  # that make a line seen
    START_POINTS = 4  # a line of a pair that starts a lane
    SINGLE_POINTS = 6  # and of a line alone
    CONFIRM_FRAMES = 3  # running in which a lane that started from one line must be seen before it is told
    BREADTH_LANES, BLIND_LANES = 0.1, 0.1  # how far beside its place a line is looked for; growth with the blind way
    UNKNOWN_LANES = 0.25  # the same while the car's motion is not known
    PARTED_LANES = 0.4  # the two lines are never nearer to each other
    SHORT_POINTS = 6  # a line of fewer is looked for a second way
    END_LANES = 0.8  # a line that is not seen so far on, where it should be in the picture, has ended
    RIVAL_LANES = 0.4  # blind way from which another lane may take over
    RIVAL_FRAMES = 3  # running in which it must be seen
    RIVAL_ALONE = 0.2, 0.2  # how far off [lane widths, rad] a lane of which one line is seen may be

    def __init__(self, car: CarConfig, markings: Markings | None = None) -> None:
        options, lane = car.pipeline.centerline, car.lane
        near = GroundCamera.from_config(car.camera).first_visible_x_m()
        marking = max(lane.marking_width_m, self.LEAST_MARKING_LANES * lane.width_m)
        across = marking / options.marking_px
        self.view = View(
            x_near_m=near,
            x_far_m=near + options.view_ahead_lanes * lane.width_m,
            half_width_m=options.view_half_lanes * lane.width_m,
            m_per_px=across,
            m_per_row=max(across, options.view_ahead_lanes * lane.width_m / self.MAX_ROWS),
        )
        self._options, self._unit, self._reference_x_m = options, lane.width_m, car.vehicle.reference_x_m
        self._size = (car.camera.height_px, car.camera.width_px)
        self._ahead_m = self.view.x_far_m - self._reference_x_m
        self._markings = make_markings(car) if markings is None else markings
        self._features = FeaturePoints(car.camera, self.view, lane.marking_width_m, options.threshold)
        self._initialisation = LineInitialisation(self.view, lane.width_m, marking, self._reference_x_m)
        self._following = LineFollowing(self.view, lane.width_m, marking, self._features.visible)
        self.notice = _worth_telling(self._markings, options)
        self.stages = StageClock()
        self.reset()

    def reset(self) -> None:
        """Forget the lane."""
        self._lane: TrackedLane | None = None
        self._last_t_ns: int | None = None
        self._seen_t_ns = 0
        self._unconfirmed = self._rivals = 0

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        """The lane in this frame (LOST for a picture of another size than the camera's)."""
        self.stages.begin()
        self._advance(frame.t_ns, motion)
        self.stages.lap("prediction")
        if frame.image.shape[:2] != self._size:
            return self._lost(frame)
        grey = frame.image if frame.image.ndim == 2 else cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
        mask = self._markings.step(np.asarray(grey, dtype=np.uint8))
        self.stages.lap("markings")
        if isinstance(self._markings, MarkingNetwork):
            mask = adaptive_threshold(mask)
        features = self._features.step(mask)
        self.stages.lap("birdseye")
        if self._lane is None:
            found = self._find(features)
            if found is None:
                return self._lost(frame)
            self._lane, left, right = found
            self._unconfirmed = 0 if self._lane.left.line and self._lane.right.line else self.CONFIRM_FRAMES
            seen = len(left.points_m) > 0, len(right.points_m) > 0
            self.stages.lap("following")
        else:
            left, right = (self._follow(features, self._lane, side) for side in (+1.0, -1.0))
            left, right = self._parted(left, right)
            self.stages.lap("following")
            seen = self._lane.update(left, right)
            if not any(seen) and self._in_view(self._lane):
                self._lane.end()
            left, right, seen = self._challenged(features, left, right, seen)
        self.stages.lap("estimation")
        estimate = self._estimate(frame, self._lane, (left, right), seen)
        self.stages.lap("estimate")
        return estimate

    def _advance(self, t_ns: int, motion: Motion) -> None:
        """Carry the lane over the motion since the frame before; a gap or time that goes back starts again."""
        last, self._last_t_ns = self._last_t_ns, t_ns
        if last is None or self._lane is None:
            return
        dt_ns = t_ns - last
        if not 0 < dt_ns <= self.MAX_GAP_NS:
            self._lane = None
            return
        dt_s = dt_ns * 1e-9
        way_m, turn = motion.speed_mps * dt_s, motion.yaw_rate_radps * dt_s
        known = motion.known and abs(way_m) < self.MAX_WAY_LANES * self._unit and abs(turn) < self.MAX_TURN_RAD
        if not known:  # nor is what no car can have done between two frames, or is not finite
            way_m = turn = 0.0
        self._lane.move(SE2.arc(way_m, turn).inverse(), way_m, dt_s, known)

    def _find(self, features: Image) -> tuple[TrackedLane, SeenLine, SeenLine] | None:
        """A lane from this frame alone: a pair of lines, or one."""
        starts = self._initialisation.step(features)
        seen = [SeenLine(points_m=NO_POINTS, sigma_m=np.empty(0)) for _ in starts]
        for i, start in enumerate(starts):
            if start is not None:
                followed = self._following.follow(features, start)
                if len(followed) >= (self.SINGLE_POINTS if None in starts else self.START_POINTS):
                    seen[i] = self._seen(followed)
        lane = TrackedLane(self._unit, self._reference_x_m)
        if not lane.start(*seen) or not self._plausible(lane):
            return None
        return lane, seen[0], seen[1]

    def _follow(self, features: Image, lane: TrackedLane, side: float) -> SeenLine:
        """A line's points from where it is expected; where its own model soon loses it, the centerline's may not."""
        seen = self._guided(features, lane, side, True)
        if len(seen.points_m) < self.SHORT_POINTS and lane.on_its_own(side):
            other = self._guided(features, lane, side, False)
            if len(other.points_m) > len(seen.points_m) + self.START_POINTS:
                return other
        return seen

    def _guided(self, features: Image, lane: TrackedLane, side: float, alone: bool) -> SeenLine:
        points, heading, known_m = lane.expected(side, self._ahead_m + 0.5 * self._unit, alone)
        breadth = self.BREADTH_LANES if lane.motion_known else self.UNKNOWN_LANES
        breadth = breadth * self._unit + self.BLIND_LANES * min(lane.blind_m, 2.0 * self._unit)
        expected = ExpectedLine(points_m=points, heading_rad=heading, known_m=known_m)
        return self._seen(self._following.follow(features, expected=expected, reach_m=breadth))

    def _parted(self, left: SeenLine, right: SeenLine) -> tuple[SeenLine, SeenLine]:
        """Both lines; where they come so near to each other that they must be one, the longer keeps it."""
        if not (len(left.points_m) and len(right.points_m)):
            return left, right
        apart = left.points_m[:, None] - right.points_m
        near = np.einsum("ijk,ijk->ij", apart, apart) < (self.PARTED_LANES * self._unit) ** 2
        if not near.any():
            return left, right
        if len(left.points_m) >= len(right.points_m):
            return left, _cut(right, int(near.any(axis=0).argmax()))
        return _cut(left, int(near.any(axis=1).argmax())), right

    def _seen(self, followed: FollowedLine) -> SeenLine:
        points = followed.points_m
        ended = False
        if len(points) > 1:
            way = points[-1] - points[max(len(points) - 4, 0)]
            beyond = points[-1] + way * (self.END_LANES * self._unit / max(float(np.hypot(*way)), 1e-9))
            ended = bool(self._inside(np.array((beyond, 0.5 * (points[-1] + beyond)))).all())
        return SeenLine(points_m=points, sigma_m=followed.sigma_m, ended=ended)

    def _inside(self, points_m: FloatArray) -> NDArray[np.bool_]:
        """Which points (n, 2) [m] are in the picture and the view."""
        column, row = np.rint(self.view.to_px(points_m)).astype(np.intp).T
        inside = (column >= 0) & (column < self.view.width_px) & (row >= 0) & (row < self.view.height_px)
        inside[inside] = self._features.visible[row[inside], column[inside]] > 0
        return inside

    def _in_view(self, lane: TrackedLane) -> bool:
        """Whether one of the lines should be seen for a while."""
        for side in (+1.0, -1.0):
            points, _, _ = lane.expected(side, self._ahead_m)
            if self._inside(points).mean() * self._ahead_m > self.END_LANES * self._unit:
                return True
        return False

    def _challenged(
        self, features: Image, left: SeenLine, right: SeenLine, seen: tuple[bool, bool]
    ) -> tuple[SeenLine, SeenLine, tuple[bool, bool]]:
        """Lines that were seen several frames running beside a lane that nothing supports take over."""
        lane = self._lane
        if lane is None or any(seen) or lane.blind_m < self.RIVAL_LANES * self._unit:
            self._rivals = 0
            return left, right, seen
        found = self._find(features)
        if found is None or not self._rivals_with(found[0], lane):
            self._rivals = 0
            return left, right, seen
        self._rivals += 1
        if self._rivals < self.RIVAL_FRAMES:
            return left, right, seen
        self._rivals = 0
        self._lane, left, right = found
        return left, right, (len(left.points_m) > 0, len(right.points_m) > 0)

    def _rivals_with(self, other: TrackedLane, lane: TrackedLane) -> bool:
        """Whether what was found may be the lane: what dead reckoning cannot have got so wrong is another lane."""
        blind = lane.blind_m / self._unit
        aside = abs(other.pose.offset_m - lane.pose.offset_m) / self._unit
        turned = abs(other.pose.heading_rad - lane.pose.heading_rad)
        if other.left.line is None or other.right.line is None:
            return aside < self.RIVAL_ALONE[0] and turned < self.RIVAL_ALONE[1]
        return aside < min(0.15 + 0.1 * blind, 0.3) and turned < 0.25

    def _estimate(
        self, frame: Frame, lane: TrackedLane, lines: tuple[SeenLine, SeenLine], taken: tuple[bool, bool]
    ) -> LaneEstimate:
        left, right = (
            there and len(line.points_m) >= self.SEEN_POINTS for there, line in zip(taken, lines, strict=True)
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
        middle, pose = lane.centerline, lane.pose
        return LaneEstimate(
            t_ns=frame.t_ns,
            status=(LaneStatus.COASTING, LaneStatus.ONE_LINE, LaneStatus.TRACKING)[int(left) + int(right)],
            left=self._line(lane.left, lines[0], left, lane, +0.5),
            right=self._line(lane.right, lines[1], right, lane, -0.5),
            centerline=middle.deferred(-lane.REACH_LANES * self._unit, self._ahead_m),
            pose=LanePose(
                offset_m=pose.offset_m,
                heading_rad=pose.heading_rad,
                width_m=pose.width_m,
                curvature_per_m=middle.curvature_at(0.0),
                covariance=pose.covariance,
            ),
            frame_age_ns=blind_ns,
        )

    def _line(self, tracked: TrackedLine, line: SeenLine, seen: bool, lane: TrackedLane, side: float) -> LaneLine:
        """A line's own curve, or the lane's edge where it is not kept."""
        if tracked.line is not None:
            curve = tracked.line.deferred(0.0, self._ahead_m)
        else:
            curve = lane.centerline.beside(side * lane.pose.width_m, 0.0, self._ahead_m)
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


def _worth_telling(markings: Markings, options: CenterlineConfig) -> str:
    """Which provider runs the network and why, where that was chosen; nothing on a computer that has only the CPU."""
    chosen = options.providers != CenterlineConfig().providers
    if not isinstance(markings, MarkingNetwork) or (markings.provider == "cpu" and not chosen):
        return ""
    return markings.notice


def _cut(line: SeenLine, count: int) -> SeenLine:
    """The first points of a line."""
    return SeenLine(points_m=line.points_m[:count], sigma_m=line.sigma_m[:count])
