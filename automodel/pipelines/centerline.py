"""`centerline`: Cudrano et al. 2020, "Advances in centerline estimation for autonomous lateral control".

Line mask (U-Net) -> feature points in the bird's-eye view -> window line following with recovery -> of each line:
memory by odometry, smoothing spline, s-theta model, recursive least squares -> centerline -> relative pose -> EKF.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, Protocol

import cv2
import numpy as np

from automodel.config import CarConfig, CenterlineConfig
from automodel.estimation.road import BEHIND
from automodel.estimation.theta.pose_filter import LEAST_WIDTH
from automodel.estimation.theta.tracked_lane import TrackedLane
from automodel.estimation.theta.tracked_line import SeenLine, TrackedLine
from automodel.geometry import BirdsEye, GroundCamera
from automodel.perception.line_scan import LineScan, ScanConfig
from automodel.perception.markings.binary_views import FeaturePoints, adaptive_threshold, road_view, share_above
from automodel.perception.markings.marking_width import MarkingWidth
from automodel.perception.markings.network_view import network_view
from automodel.perception.markings.ridge import RidgeFilter
from automodel.perception.markings.unet import BIRDSEYE, MarkingNetwork, UnetConfig
from automodel.perception.windows.line_following import FollowedLine, LineFollowing
from automodel.perception.windows.window_tracker import ExpectedLine
from automodel.pipelines.stages import SEEN, StageClock
from automodel.signals import Frame, LaneEstimate, LaneLine, LanePose, Motion
from automodel.tracking.belief import LaneBelief
from automodel.tracking.gentle_start import GentleStart
from automodel.tracking.lane_tracking import Followed, LaneTracking, TrackingConfig
from automodel.types import Bools, FloatArray, Image

NO_POINTS: FloatArray = np.empty((0, 2))


class Markings(Protocol):
    """Finds line markings: a grey image (h, w) -> a mask of any size, the probability of a marking, 0 .. 255.

    The image is the camera's, or the bird's-eye view for a network that looks from above.
    """

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
    return MarkingNetwork(network_config(car), car.lane.markings)


def network_config(car: CarConfig) -> UnetConfig:
    """The network of car.toml; of a picture it sees the rows that show the road up to the far end of the view."""
    options, unit, camera = car.pipeline.centerline, car.lane.width_m, GroundCamera.from_config(car.camera)
    view = road_view(camera, options.view_ahead_lanes * unit, options.view_half_lanes * unit, car.lane.marking_width_m)
    return UnetConfig(
        model=options.model,
        size=options.network,
        providers=options.providers,
        threads=options.threads,
        above=0.0 if options.network == BIRDSEYE else share_above(camera, view),
    )


class Centerline:
    """The pipeline of Cudrano et al. 2020; `notice` is a line for the user, which may be empty."""

    name = "centerline"
    MIN_MARKING_LANES = 0.03  # a mask shows no thinner lines: far away its pixels are wider than a marking
    END_LANES = ScanConfig().gap_lanes  # a line that is not visible over this distance, where it should be, has ended

    def __init__(self, car: CarConfig, markings: Markings | None = None) -> None:
        options, lane = car.pipeline.centerline, car.lane
        self._car, camera = car, GroundCamera.from_config(car.camera)
        self._options, self._unit, self._reference_x_m = options, lane.width_m, car.vehicle.reference_x_m
        self._size = (car.camera.height_px, car.camera.width_px)
        ahead_m = camera.first_visible_x_m() + options.view_ahead_lanes * lane.width_m
        self._ahead_m = ahead_m - self._reference_x_m
        self._markings = make_markings(car) if markings is None else markings
        self._width = MarkingWidth(camera, lane, self._reference_x_m)
        self._marking_m = lane.marking_width_m
        self._see_with(camera)
        coasting = TrackingConfig(coast_s=options.coast_s, coast_lanes=options.coast_lanes)
        self._tracking = LaneTracking(car, coasting, self._ahead_m)
        self.notice = _provider_notice(self._markings, options)
        self.stages = StageClock()
        self.reset()

    def _see_with(self, camera: GroundCamera) -> None:
        """From now on the camera is set so."""
        self._camera = camera
        self._width.see_with(camera)
        self._above = self._network_birdseye(camera)
        self._gentle = GentleStart(self._car, camera, self._options.view_ahead_lanes)
        self._look_for(self._marking_m)

    def _network_birdseye(self, camera: GroundCamera) -> BirdsEye | None:
        """The view that the network sees, if it looks from above."""
        if not (isinstance(self._markings, MarkingNetwork) and self._markings.from_above):
            return None
        ahead_m, half_m = (
            self._unit * lanes for lanes in (self._options.view_ahead_lanes, self._options.view_half_lanes)
        )
        return BirdsEye(camera, network_view(camera.first_visible_x_m(), ahead_m, half_m))

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
        seen_with = replace(self._car.camera, extrinsics=self._camera.extrinsics)
        self._features = FeaturePoints(seen_with, self.view, marking_m, options.threshold)
        self._following = LineFollowing(self.view, unit, shown_m, self._features.visible)
        # Nothing tests whether what the network takes for paint is a reflection: it is as likely as another thing.
        self._scan = LineScan(self.view, unit, shown_m, ScanConfig(reflection=1.0))
        self._gentle.look_for(marking_m)

    @property
    def warning(self) -> str:
        """A line for the user after a run, which may be empty."""
        return "; ".join(filter(None, (self._width.warning, self._tracking.warning)))

    def reset(self) -> None:
        """Forget the lane and the markings' measured width."""
        self._width.reset()
        self._tracking.reset()
        if self._marking_m != self._width.width_m:
            self._look_for(self._width.width_m)
        if self._camera is not self._tracking.camera:
            self._see_with(self._tracking.camera)
        self._lane: TrackedLane | None = None

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        """The lane in this frame, body frame; LOST for an image of another size than the camera's."""
        self.stages.start()
        self._predict(frame, motion)  # odometry, or the ground's own motion: lines, centerline and pose
        self.stages.lap("prediction")
        if frame.image.shape[:2] != self._size:
            return self._tracking.lost_estimate(frame)
        turned = self._tracking.turn_camera()
        if turned is not None:
            self._see_with(self._tracking.camera)
        if self._width.step(frame.image):
            self._look_for(self._width.width_m)
        mask = self._line_mask(frame.image)  # U-Net, or ridge filter
        self.stages.lap("markings")
        features = self._feature_points(mask)  # adaptive threshold, bird's-eye view, morphological cleaning
        self.stages.lap("birdseye")
        if self._lane is None:
            start = self._tracking.start(frame.t_ns, self._scan.step(features))  # lines in view, the lane's pair
            gentle = self._begin(frame.image)  # line integrals, where all bends are wide
            started = gentle or (self._restart(features, start) if start is not None else None)
            self.stages.lap("start")
            if started is None:
                if start is not None:
                    self._tracking.forget()
                return self._tracking.lost_estimate(frame)
            self._lane, lines = started
            if gentle is not None:
                self._tracking.begin(frame.t_ns, self._followed(self._lane, lines).pose)
        elif turned is not None and (begun := self._restart(features, turned)) is not None:
            self._lane, lines = begun
        else:
            both = self._follow_lines(features, self._lane)  # window line following
            self.stages.lap("following")
            lines = self._update(self._lane, *both)  # spline, s-theta, RLS, centerline, relative pose, EKF
        followed = self._followed(self._lane, lines)
        if self._tracking.looks_around(followed):  # which of all lines in view are the lane's?
            anew = self._tracking.judge(self._scan.step(features), followed)
            if anew is not None:
                self._lane, lines = self._restart(features, anew) or (self._lane, lines)
                followed = self._followed(self._lane, lines)
            self.stages.lap("doubt")
        self.stages.lap("estimation")
        estimate = self._tracking.follow(frame, followed)
        if self._tracking.lost:
            self._lane = None
        self.stages.lap("estimate")
        return estimate

    def _predict(self, frame: Frame, motion: Motion) -> None:
        """Move the lane by the motion since the last frame; a gap, or time that goes back, drops it."""
        moved = self._tracking.predict(frame, motion)
        if self._tracking.lost:
            self._lane = None
        if moved is not None and self._lane is not None:
            self._lane.move(moved.after_from_before, moved.distance_m, moved.dt_s, moved.known)

    def _line_mask(self, image: Image) -> Image:
        grey = np.asarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        return self._markings.step(grey if self._above is None else self._above.warp(grey))

    def _feature_points(self, mask: Image) -> Image:
        if isinstance(self._markings, MarkingNetwork):
            mask = adaptive_threshold(mask)
        return self._features.step(mask) if self._above is None else self._features.of_view(mask)

    def _begin(self, image: Image) -> tuple[TrackedLane, Lines] | None:
        """A lane from the lines of a start from the whole image."""
        found = self._gentle.step(image)
        if found is None:
            return None
        left = SeenLine(points_m=found.left_m, sigma_m=found.left_sigma_m)
        right = SeenLine(points_m=found.right_m, sigma_m=found.right_sigma_m)
        lane = TrackedLane(self._unit, self._reference_x_m)
        begun = lane.start(left, right, found.belief.mean, found.belief.spread)
        return (lane, Lines(left, right, (True, True))) if begun else None

    def _restart(self, features: Image, belief: LaneBelief) -> tuple[TrackedLane, Lines] | None:
        """A lane from the lines about a belief; None where there is no line."""
        s = np.linspace(0.0, self._ahead_m, 30)
        seen = []
        for side in (+0.5, -0.5):
            points, heading, sigma = belief.beside(s, side)
            expected = ExpectedLine(points_m=points, heading_rad=heading)
            reach = max(TrackedLane.REACH_LANES * self._unit, 2.0 * float(sigma[0]))
            line = self._seen(self._following.follow(features, expected=expected, reach_m=reach))
            if len(line.points_m) >= SEEN:
                line = _with_belief(line, points, sigma)
            seen.append(line)
        left, right = seen
        if not (len(left.points_m) or len(right.points_m)):
            return None
        lane = TrackedLane(self._unit, self._reference_x_m)
        if not lane.start(left, right, belief.mean, belief.spread):
            return None
        return lane, Lines(left, right, (lane.left.line is not None, lane.right.line is not None))

    def _follow_lines(self, features: Image, lane: TrackedLane) -> tuple[SeenLine, SeenLine]:
        """Both lines; where they are so close that they must be one, the longer keeps it."""
        left, right = (self._follow_line(features, lane, side) for side in (+1.0, -1.0))
        if not (len(left.points_m) and len(right.points_m)):
            return left, right
        apart = left.points_m[:, None] - right.points_m
        near = np.einsum("ijk,ijk->ij", apart, apart) < (LEAST_WIDTH * self._unit) ** 2
        if not near.any():
            return left, right
        if len(left.points_m) >= len(right.points_m):
            return left, _cut(right, int(near.any(axis=0).argmax()))
        return _cut(left, int(near.any(axis=1).argmax())), right

    def _follow_line(self, features: Image, lane: TrackedLane, side: float) -> SeenLine:
        """A line's points from where it is expected."""
        points, heading, known_m = lane.expected(side, self._ahead_m + 0.5 * self._unit)
        expected = ExpectedLine(points_m=points, heading_rad=heading, known_m=known_m)
        return self._seen(
            self._following.follow(features, expected=expected, reach_m=TrackedLane.REACH_LANES * self._unit)
        )

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

    def _followed(self, lane: TrackedLane, lines: Lines) -> Followed:
        left, right = (used and len(line.points_m) >= SEEN for used, line in zip(lines.used, lines[:2], strict=True))
        centerline, pose = lane.centerline, lane.pose
        return Followed(
            pose=LanePose(
                offset_m=pose.offset_m,
                heading_rad=pose.heading_rad,
                width_m=pose.width_m,
                curvature_per_m=centerline.curvature_at(0.0),
                covariance=pose.covariance,
            ),
            left=self._line(lane.left, lines.left, left, lane, +0.5),
            right=self._line(lane.right, lines.right, right, lane, -0.5),
            centerline=centerline.curve(-BEHIND * self._unit, self._ahead_m),
        )

    def _line(self, tracked: TrackedLine, line: SeenLine, seen: bool, lane: TrackedLane, side: float) -> LaneLine:
        """A line's own curve, or the lane's edge where there is none."""
        if tracked.line is not None:
            curve = tracked.line.curve(0.0, self._ahead_m)
        else:
            curve = lane.centerline.curve(0.0, self._ahead_m, side * lane.pose.width_m)
        return LaneLine(curve=curve, points_m=line.points_m if seen else NO_POINTS, seen=seen)


def _provider_notice(markings: Markings, options: CenterlineConfig) -> str:
    """The provider of the network and why; empty where it is the CPU and no provider was configured."""
    configured = options.providers != CenterlineConfig().providers
    if not isinstance(markings, MarkingNetwork) or (markings.provider == "cpu" and not configured):
        return ""
    return markings.notice


def _cut(line: SeenLine, count: int) -> SeenLine:
    """The first points of a line."""
    return SeenLine(points_m=line.points_m[:count], sigma_m=line.sigma_m[:count])


def _with_belief(line: SeenLine, points_m: FloatArray, sigma_m: FloatArray) -> SeenLine:
    """A line's points, and before them those (n, 2) where it is believed to run, with their sigmas (n,) [m]."""
    before = points_m[:, 0] < float(line.points_m[0, 0])
    return SeenLine(
        points_m=np.concatenate((points_m[before], line.points_m)),
        sigma_m=np.concatenate((sigma_m[before], line.sigma_m)),
        ended=line.ended,
    )
