"""`contour`: a clothoid pair tracked on a few image rows, after the active contour of Smith 2024.

Prediction by speed and yaw rate -> projection of the pair's nodes into the image -> ridges on short runs of rows about
them -> robust least squares -> pose. The whole image is never processed, and nothing of it is projected onto the
ground: under 2 % of the pixels are read while tracking, about as many when a lane is searched on whole rows, and as
many again in the frames in which the markings' width is measured.
"""

from __future__ import annotations

import copy
import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from automodel.config import CarConfig
from automodel.curves import DeferredCurve
from automodel.curves.lanes import ArcLane
from automodel.estimation.clothoid.clothoid_pair import ClothoidPair, PairShape
from automodel.estimation.clothoid.clothoid_tracker import ClothoidTracker, TrackerConfig
from automodel.estimation.odometry_monitor import OdometryMonitor
from automodel.geometry import GroundCamera
from automodel.geometry.line_projection import LineProjection
from automodel.perception.markings.marking_width import MarkingWidth
from automodel.perception.rows.brightness import Brightness
from automodel.perception.rows.lane_pair_search import InitialLane, LaneSearchConfig
from automodel.perception.rows.row_hough import RowHough
from automodel.perception.rows.row_search import NodeMeasurements, RowSearch
from automodel.pipelines.stages import StageClock
from automodel.signals import Frame, LaneEstimate, LaneLine, LanePose, LaneStatus, Motion
from automodel.types import Bools, FloatArray, Floats, Image

PRECISIONS: dict[str, type[np.floating[Any]]] = {"double": np.float64, "single": np.float32}


class Tracked(NamedTuple):
    """A frame's clothoid pair, what was measured about it, and which measurements (k,) are inliers."""

    shape: PairShape
    measured: NodeMeasurements
    inliers: Bools

    def counts(self) -> tuple[int, int]:
        """The number of inliers on the left and on the right line."""
        return self.measured.count(self.shape, self.inliers)


class Contour:
    """The pipeline of Smith 2024, "Efficient Lateral Lane Position Sensing using Active Contour Modeling"."""

    name = "contour"
    MAX_GAP_NS = 500_000_000  # a longer gap between frames restarts the pipeline
    CONFIRM_NS = 50_000_000  # an uncertain lane is reported once it was seen for so long
    ROUNDS, START_ROUNDS = 3, 4  # iterations of measurement and correction, at most
    SETTLED = 0.5  # markings: a correction that moves no node further ends the iteration
    SINGLE_NODES, PAIR_NODES, SURE_NODES = 4, 4, 10  # of a new lane: on one line; of a certain one: on each, on both
    START_OFFSET, START_HEADING_RAD = 0.4, 0.7  # lane widths: limits of a car's pose in its own lane
    LINE_NODES = 2  # that make a line seen
    MAX_DISTANCE, MAX_TURN_RAD = 3.0, 0.8  # lane widths, radians a frame: a larger motion is not a car's
    MARKING_SIGMA, RANGE_SIGMA, TURN_SIGMA_RAD = 0.06, 0.006, 0.3  # of a ridge: markings, per metre away, direction
    BLIND = 0.5  # lane widths of distance without a line from which on the lane is also searched on whole rows
    EVERY = 8  # frames between two searches for both lines while only one was ever seen
    LATERAL, TURNED_RAD = 0.3, 0.3  # largest difference of such a lane from the tracked one: lane widths, direction
    UNSURE = 0.25  # lane widths: a lane without a line whose offset has a larger sigma is lost
    PIECES = 7  # maximum number of the pair's stations ahead
    MAX_OFFSET, MAX_NEW_OFFSET = 0.9, 0.55  # lane widths: of the car from the middle, and of a new lane
    NEW = 2.0  # lane widths of distance for which a lane is new
    MAX_HEADING_RAD = math.radians(60.0)
    BEHIND = 1.0  # lane widths of centerline behind the reference point

    def __init__(self, car: CarConfig) -> None:
        options, unit, marking = car.pipeline.contour, car.lane.width_m, car.lane.marking_width_m
        self._options, self._unit, self._settled_m = options, unit, self.SETTLED * marking
        camera = GroundCamera.from_config(car.camera)
        self._car, self._camera = car, camera
        self._size = (car.camera.height_px, car.camera.width_px)
        dtype = PRECISIONS[options.precision]
        self._nodes_m = self._nodes(camera, car)
        self._tracker = self._make_tracker(self._nodes_m, car, dtype)
        self._pair = self._tracker.pair
        self._projection = LineProjection(camera, dtype)
        self._width = MarkingWidth(camera, car.lane, car.vehicle.reference_x_m, options.colour)
        self._look_for(marking, car.lane.markings == "dark")
        self.stages = StageClock()
        self.reset()
        self._warm_up()

    def _look_for(self, marking_m: float, dark: bool) -> None:
        """Look for markings of this width from now on, and first of this polarity."""
        options, unit, self._marking_m = self._options, self._unit, marking_m
        brightness = Brightness(options.colour, dark)
        self._search = RowSearch(self._projection, brightness, options.contrast, self._nodes_m, marking_m, self._size)
        searched = LaneSearchConfig(
            lane_width_m=unit,
            marking_m=marking_m,
            reference_x_m=self._car.vehicle.reference_x_m,
            contrast=options.contrast,
            radius_lanes=options.radius_lanes,
            ahead=min(options.look_ahead_lanes, 2.0),
        )
        self._lane_search = RowHough(self._camera, searched, brightness, self._car.lane.markings == "both")

    @property
    def warning(self) -> str:
        """A line for the user after a run, which may be empty."""
        return self._width.warning

    def _make_tracker(self, nodes: Floats, car: CarConfig, dtype: type[np.floating[Any]]) -> ClothoidTracker:
        options, unit, reference = self._options, self._unit, car.vehicle.reference_x_m
        spacing = max(options.piece_lanes * unit, float(nodes[-1]) / self.PIECES)
        away = np.tile(nodes + reference - car.camera.extrinsics.x_m, 2)
        sigma = np.hypot(self.MARKING_SIGMA * car.lane.marking_width_m, self.RANGE_SIGMA * away)
        self._odometry = OdometryMonitor(sigma)
        return ClothoidTracker(
            ClothoidPair(nodes, spacing, reference, dtype),
            TrackerConfig(lane_width_m=unit, solver=options.update, radius_lanes=options.radius_lanes),
            np.concatenate((sigma, np.full(len(nodes), self.TURN_SIGMA_RAD))),
        )

    def reset(self) -> None:
        """Forget the lane and the markings' measured width."""
        self._width.reset()
        if self._marking_m != self._width.width_m:
            self._look_for(self._width.width_m, self._car.lane.markings == "dark")
        self._last_t_ns: int | None = None
        self._odometry.reset()
        self._odometry_used = self._odometry_rejected = False  # in this frame; up to this frame
        self._seen_t_ns = self._confirmed_ns = 0
        self._new_m = 0.0  # distance for which the lane is still new
        self._paired = False
        self._forget()

    @property
    def iterations(self) -> int:
        """Iterations of the update law in the last step."""
        return self._tracker.iterations

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        """The lane in this frame, body frame; LOST for an image of another size than the camera's."""
        self.stages.start()
        self._predict(frame.t_ns, motion)  # speed and yaw rate
        self.stages.lap("prediction")
        if frame.image.shape[:2] != self._size:
            return self._lost(frame)
        if self._width.step(frame.image):
            self._look_for(self._width.width_m, self._search.dark)
        self.stages.lap("width")
        fitted = False
        if self._tracker.parameters is None:
            started = self._start(frame)  # line integrals, row Hough transform
            if started is None:
                self._forget()
                return self._lost(frame)
            tracked, fitted = started
        else:
            # Projection of the nodes, ridges about them, robust least squares; repeated until the pair is settled.
            tracked = self._track(frame.image, self.ROUNDS, self._odometry_used)
            if self._needs_search(frame.index, tracked.counts()):
                tracked = self._reacquire(frame.image) or tracked
        left, right = tracked.counts()
        self._search.learn(tracked.measured, tracked.inliers)
        # A fitted initial lane has seen both lines, on more rows than there are nodes.
        seen = (fitted or left >= self.LINE_NODES, fitted or right >= self.LINE_NODES)
        estimate = self._estimate(frame, tracked, seen)
        self.stages.lap("estimate")
        return estimate

    def _warm_up(self) -> None:
        """Compile everything that a step calls, so that no step waits for it."""
        nothing = np.zeros(self._size, np.uint8)
        self._lane_search.step(nothing)
        straight = ArcLane(
            offset_m=0.0, heading_rad=0.0, width_m=self._unit, curvature_per_m=0.0, measured_at_m=self._unit
        )
        self._tracker.start(straight)
        self._tracker.move(0.0, 0.0, 0.0, True)
        self._tracker.pose()
        tracked = self._track(nothing, 1, True)
        tracked.counts()
        self._search.learn(tracked.measured, tracked.inliers)
        tracked.measured.points(tracked.shape, tracked.inliers, self._unit)
        self.reset()

    def _predict(self, t_ns: int, motion: Motion) -> None:
        """Move the lane by the odometry since the last frame; a gap, or time that goes back, drops it."""
        last, self._last_t_ns = self._last_t_ns, t_ns
        if last is None or self._tracker.parameters is None:
            return
        dt_ns = t_ns - last
        if self._odometry_rejected or not 0 < dt_ns <= self.MAX_GAP_NS:
            self._forget()
            return
        dt_s = dt_ns * 1e-9
        distance, turn = motion.speed_mps * dt_s, motion.yaw_rate_radps * dt_s
        possible = motion.known and abs(distance) < self.MAX_DISTANCE * self._unit and abs(turn) < self.MAX_TURN_RAD
        self._odometry_used = used = possible and self._odometry.trusted(t_ns)
        self._tracker.move(distance if used else 0.0, turn if used else 0.0, dt_s, used)
        self._new_m -= self._tracker.advance_m

    def _start(self, frame: Frame) -> tuple[Tracked, bool] | None:
        """A lane from this frame alone, and whether it was fitted; None where the frame shows none."""
        lane = self._search_lane(frame.image)
        if lane is None:
            return None
        self._restart(lane)
        tracked = self._track(frame.image, self.START_ROUNDS)
        counts = tracked.counts()
        if (max(counts) < self.SINGLE_NODES and not lane.fitted) or not self._within():
            return None
        self._confirmed_ns = frame.t_ns + (0 if lane.fitted or self._sure(counts) else self.CONFIRM_NS)
        return tracked, lane.fitted

    def _search_lane(self, image: Image) -> InitialLane | None:
        """A lane on whole rows, without prediction."""
        lane = self._lane_search.step(image)
        self.stages.lap("start")
        return lane

    def _restart(self, lane: InitialLane) -> None:
        self._tracker.start(lane)
        self._new_m = self.NEW * self._unit
        self._search.forget(lane.edge, lane.dark)
        self._paired = lane.pair

    def _within(self) -> bool:
        """Whether the car is in the lane and about parallel to it; else it is the neighbouring lane, or none."""
        offset, heading, width, _ = self._tracker.pose()
        return math.hypot(offset / (self.START_OFFSET * width), heading / self.START_HEADING_RAD) < 1.0

    def _track(self, image: Image, rounds: int, predicted: bool = False) -> Tracked:
        """Measure the pair and correct it, up to `rounds` times; `predicted`: the odometry is checked against it."""
        tracker, stages = self._tracker, self.stages
        for k in range(rounds):
            shape = tracker.shape()
            stages.lap("projection")
            seen = self._search.look(image, shape, tracker.width_m)
            if predicted and k == 0:
                t_ns = self._last_t_ns or 0
                self._odometry_rejected = self._odometry.rejects(t_ns, seen.nodes, seen.residual, seen.found)
            stages.lap("search")
            inliers = tracker.update(shape, seen.nodes, seen.residual, seen.found)
            stages.lap("update")
            if tracker.moved_m < self._settled_m:
                break
        return Tracked(shape, seen, inliers)

    def _needs_search(self, index: int, counts: tuple[int, int]) -> bool:
        """Whether to search on whole rows too: no line is seen, or only one ever was, and the width is unknown."""
        if max(counts) < self.LINE_NODES:
            return self._tracker.blind_m > self.BLIND * self._unit
        self._paired = self._paired or self._sure(counts)
        return not self._paired and index % self.EVERY == 0

    def _reacquire(self, image: Image) -> Tracked | None:
        """Both lines, searched on whole rows near the tracked lane; None, and no change, where they are not found."""
        lane = self._search_lane(image)
        if lane is None or not lane.pair:
            return None
        lateral, turned = self._tracker.difference(lane)
        if abs(lateral) > self.LATERAL * self._unit or abs(turned) > self.TURNED_RAD:
            return None
        before = copy.copy(self._tracker), copy.copy(self._search), self._paired, self._new_m
        self._restart(lane)
        tracked = self._track(image, self.START_ROUNDS)
        if self._sure(tracked.counts()):
            return tracked
        self._tracker, self._search, self._paired, self._new_m = before
        return None

    def _sure(self, counts: tuple[int, int]) -> bool:
        return min(counts) >= self.PAIR_NODES and sum(counts) >= self.SURE_NODES

    def _estimate(self, frame: Frame, tracked: Tracked, seen: tuple[bool, bool]) -> LaneEstimate:
        if seen[0] or seen[1]:
            self._seen_t_ns = frame.t_ns
            self._tracker.blind_m = 0.0
        pose = self._pose()
        if pose is None or self._too_blind(frame.t_ns, pose):
            self._forget()
            return self._lost(frame)
        if frame.t_ns < self._confirmed_ns:
            return self._lost(frame)
        half = 0.5 * pose.width_m
        points = tracked.measured.points(tracked.shape, tracked.inliers, half)
        return LaneEstimate(
            t_ns=frame.t_ns,
            status=(LaneStatus.COASTING, LaneStatus.ONE_LINE, LaneStatus.TRACKING)[seen[0] + seen[1]],
            left=LaneLine(curve=self._curve(half), points_m=points[0][: len(points[0]) * seen[0]], seen=seen[0]),
            right=LaneLine(curve=self._curve(-half), points_m=points[1][: len(points[1]) * seen[1]], seen=seen[1]),
            centerline=self._curve(0.0),
            pose=pose,
            frame_age_ns=frame.t_ns - self._seen_t_ns,
        )

    def _too_blind(self, t_ns: int, pose: LanePose) -> bool:
        """Whether the lane is lost: no line was seen for too long, or its offset is too uncertain."""
        blind_ns = t_ns - self._seen_t_ns
        if blind_ns == 0:
            return False
        return (
            t_ns < self._confirmed_ns
            or blind_ns * 1e-9 > self._options.coast_s
            or self._tracker.blind_m > self._options.coast_lanes * self._unit
            or pose.covariance[0, 0] > (self.UNSURE * self._unit) ** 2
        )

    def _pose(self) -> LanePose | None:
        """The car's pose in the lane, None where a car in its lane cannot have it.

        A new lane that the car is about to leave is the neighbouring lane.
        """
        offset, theta, width, covariance = self._tracker.pose()
        unit = self._unit
        max_offset = (self.MAX_NEW_OFFSET if self._new_m > 0.0 else self.MAX_OFFSET) * unit
        if not (0.65 * unit < width < 1.5 * unit and abs(offset) < max_offset and abs(theta) < self.MAX_HEADING_RAD):
            return None
        return LanePose(
            offset_m=offset,
            heading_rad=-theta,
            width_m=width,
            curvature_per_m=self._tracker.curvature(),
            covariance=covariance,
        )

    @staticmethod
    def _nodes(camera: GroundCamera, car: CarConfig) -> FloatArray:
        """Arc lengths (n,) [m] ahead of the reference point, log-spaced so that they are about even in the image."""
        options, reference, eye = car.pipeline.contour, car.vehicle.reference_x_m, car.camera.extrinsics
        near = max(camera.first_visible_x_m() - reference, 0.2 * car.lane.width_m)
        back = eye.z_m + reference - eye.x_m
        far = near + options.look_ahead_lanes * car.lane.width_m
        return np.geomspace(0.85 * near + back, far + back, options.nodes) - back

    def _curve(self, left_m: float) -> DeferredCurve:
        tracker = self._tracker
        behind = self.BEHIND * self._unit
        return DeferredCurve(partial(self._pair.table, tracker.known(), tracker.phase_m, left_m, behind))

    def _forget(self) -> None:
        self._tracker.forget()
        self._search.forget()
        self._paired = self._odometry_rejected = False

    def _lost(self, frame: Frame) -> LaneEstimate:
        return LaneEstimate(t_ns=frame.t_ns, status=LaneStatus.LOST, frame_age_ns=max(frame.t_ns - self._seen_t_ns, 0))
