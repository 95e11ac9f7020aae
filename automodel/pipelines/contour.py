"""`contour`: a clothoid pair followed on a few image rows (seed 004), for the cheapest board.

Prediction by speed and yaw rate -> nodes of the pair into the picture -> ridges on short runs of rows about them ->
robust least squares -> pose. Nothing touches the whole picture, and nothing of the picture is carried to the ground:
under 2 % of the pixels are read while tracking, about as many when a lane is looked for on whole rows.
"""

from __future__ import annotations

import copy
import math
from functools import partial
from typing import Any

import numpy as np

from automodel.config import CarConfig
from automodel.curves import DeferredCurve
from automodel.estimation.clothoid.clothoid_pair import ClothoidPair, PairShape
from automodel.estimation.clothoid.clothoid_tracker import ArcLane, ClothoidTracker, TrackerConfig
from automodel.estimation.odometry_monitor import OdometryMonitor
from automodel.geometry import GroundCamera
from automodel.geometry.line_projection import LineProjection
from automodel.perception.rows.row_hough import InitialLane, LaneSearchConfig, RowHough
from automodel.perception.rows.row_ridges import Brightness, RunRidges
from automodel.perception.rows.row_search import NodeMeasurements, RowSearch
from automodel.pipelines.stages import StageClock
from automodel.signals import Frame, LaneEstimate, LaneLine, LanePose, LaneStatus, Motion
from automodel.types import Bools, FloatArray, Floats, Image

Followed = tuple[PairShape, NodeMeasurements, Bools]
PRECISIONS: dict[str, type[np.floating[Any]]] = {"double": np.float64, "single": np.float32}


class Contour:
    """Seed 004 as a pipeline: `step` one frame, `reset`.

    `iterations` counts those of the update law in the last step.
    """

    name = "contour"
    MAX_GAP_NS = 500_000_000  # a longer gap between frames: start again
    CONFIRM_NS = 50_000_000  # a lane that is not sure is not told before it was seen for so long
    ROUNDS, START_ROUNDS = 3, 4  # of looking and correcting, at most
    SETTLED = 0.5  # markings: a correction that moves no node further is the last
    SINGLE_NODES, PAIR_NODES, SURE_NODES = 4, 4, 10  # that start a lane; that make it sure: on each line, on both
    START_OFFSET, START_HEADING_RAD = 0.4, 0.7  # lane widths: who stands further off stands in no lane of his own
    LINE_NODES = 2  # that make a line seen
    FITTED = 0.15  # of a guess's sigmas where it was fitted to both lines
    MOST_WAY, MOST_TURN_RAD = 3.0, 0.8  # lane widths, radians a frame: what is said beyond is not believed
    MARKING_SIGMA, RANGE_SIGMA, TURN_SIGMA_RAD = 0.06, 0.006, 0.3  # of a ridge: markings, per metre away, its direction
    BLIND = 0.5  # lane widths of way without a line: from then on the lane is looked for on whole rows too
    EVERY = 8  # frames: so often both lines are looked for while one alone was ever seen
    ASIDE, TURNED_RAD = 0.3, 0.3  # how far from where it is expected it may be found there: lane widths, its direction
    UNSURE = 0.25  # lane widths: a lane that is not seen and whose offset is less sure is lost
    PIECES = 7  # stations' spacings in the look-ahead, at most
    FARTHEST, FARTHEST_NEW = 0.9, 0.55  # lane widths that the car may be off the middle: at all, and of a new lane
    NEW = 2.0  # lane widths of way for which a lane is new
    STEEPEST_RAD = math.radians(60.0)
    BEHIND = 1.0  # lane widths of centerline behind the reference point

    def __init__(self, car: CarConfig) -> None:
        options, unit, marking = car.pipeline.contour, car.lane.width_m, car.lane.marking_width_m
        self._options, self._unit, self._settled_m = options, unit, self.SETTLED * marking
        camera = GroundCamera.from_config(car.camera)
        self._size = (car.camera.height_px, car.camera.width_px)
        dtype = PRECISIONS[options.precision]
        brightness = Brightness(options.colour, car.lane.dark_markings)
        nodes = self._nodes(camera, car)
        self._tracker = self._make_tracker(nodes, car, dtype)
        self._pair = self._tracker.pair
        ridges = RunRidges(brightness, options.contrast)
        self._search = RowSearch(LineProjection(camera, dtype), ridges, nodes, marking, self._size)
        tried = LaneSearchConfig(
            lane_width_m=unit,
            marking_m=marking,
            reference_x_m=car.vehicle.reference_x_m,
            contrast=options.contrast,
            radius_lanes=options.radius_lanes,
            ahead=min(options.look_ahead_lanes, 2.0),
        )
        self._start = RowHough(camera, tried, brightness)
        self.stages = StageClock()
        self.reset()
        self._warm_up()

    def _make_tracker(self, nodes: Floats, car: CarConfig, dtype: type[np.floating[Any]]) -> ClothoidTracker:
        options, unit, reference = self._options, self._unit, car.vehicle.reference_x_m
        spacing = max(options.piece_lanes * unit, float(nodes[-1]) / self.PIECES)
        away = np.tile(nodes + reference - car.camera.extrinsics.x_m, 2)
        sigma = np.hypot(self.MARKING_SIGMA * car.lane.marking_width_m, self.RANGE_SIGMA * away)
        self._odometry = OdometryMonitor(sigma)
        return ClothoidTracker(
            ClothoidPair(nodes, spacing, reference, dtype),
            TrackerConfig(lane_width_m=unit, law=options.update, radius_lanes=options.radius_lanes),
            np.concatenate((sigma, np.full(len(nodes), self.TURN_SIGMA_RAD))),
        )

    def reset(self) -> None:
        """Forget the lane."""
        self._last_t_ns: int | None = None
        self._odometry.reset()
        self._led = self._misled = False  # by the motion: in this frame, up to this frame
        self._seen_t_ns = self._confirmed_ns = 0
        self._new_m = 0.0  # of way, for which the lane is new
        self._paired = False
        self._forget()

    @property
    def iterations(self) -> int:
        """Iterations of the update law in the last step."""
        return self._tracker.iterations

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        """The lane in this frame (LOST for a picture of another size than the camera's)."""
        self.stages.start()
        self._advance(frame.t_ns, motion)
        self.stages.lap("prediction")
        if frame.image.shape[:2] != self._size:
            return self._lost(frame)
        fitted = False
        if self._tracker.parameters is None:
            begun = self._begin(frame)
            if begun is None:
                self._forget()
                return self._lost(frame)
            followed, fitted = begun
        else:
            followed = self._follow(frame.image, self.ROUNDS, self._led)
            if self._wants_pair(frame.index, self._count(followed)):
                followed = self._recover(frame.image) or followed
        left, right = self._count(followed)
        self._search.learn(followed[1], followed[2])
        # A fitted start has seen both lines, on more rows than there are nodes.
        seen = (fitted or left >= self.LINE_NODES, fitted or right >= self.LINE_NODES)
        estimate = self._estimate(frame, followed, seen)
        self.stages.lap("estimate")
        return estimate

    def _warm_up(self) -> None:
        """Have everything compiled that a step calls, so that none has to wait for it."""
        nothing = np.zeros(self._size, np.uint8)
        self._start.step(nothing)
        straight = ArcLane(offset_m=0.0, heading_rad=0.0, width_m=self._unit, curvature_per_m=0.0, sure_m=self._unit)
        self._tracker.start(straight)
        self._tracker.move(0.0, 0.0, 0.0, True)
        self._tracker.pose()
        followed = self._follow(nothing, 1, True)
        self._count(followed)
        self._search.learn(followed[1], followed[2])
        followed[1].points(followed[0], followed[2], self._unit)
        self.reset()

    def _advance(self, t_ns: int, motion: Motion) -> None:
        """Move the lane by the odometry since the frame before; a gap or time that goes back starts again."""
        last, self._last_t_ns = self._last_t_ns, t_ns
        if last is None or self._tracker.parameters is None:
            return
        dt_ns = t_ns - last
        if self._misled or not 0 < dt_ns <= self.MAX_GAP_NS:
            self._forget()
            return
        dt_s = dt_ns * 1e-9
        distance, turn = motion.speed_mps * dt_s, motion.yaw_rate_radps * dt_s
        possible = motion.known and abs(distance) < self.MOST_WAY * self._unit and abs(turn) < self.MOST_TURN_RAD
        self._led = led = possible and self._odometry.trusted(t_ns)
        self._tracker.move(distance if led else 0.0, turn if led else 0.0, dt_s, led)
        self._new_m -= self._tracker.advance_m

    def _wants_pair(self, index: int, counts: tuple[int, int]) -> bool:
        """Whether to look on whole rows too: no line is seen, or one alone ever was, and any width is possible."""
        if max(counts) < self.LINE_NODES:
            return self._tracker.blind_m > self.BLIND * self._unit
        self._paired = self._paired or self._sure(counts)
        return not self._paired and index % self.EVERY == 0

    def _begin(self, frame: Frame) -> tuple[Followed, bool] | None:
        """A lane from nothing, and whether the start saw enough of it by itself."""
        guess = self._look_for(frame.image)
        if guess is None:
            return None
        self._restart(guess)
        followed = self._follow(frame.image, self.START_ROUNDS)
        counts = self._count(followed)
        if (max(counts) < self.SINGLE_NODES and not guess.fitted) or not self._within():
            return None
        self._confirmed_ns = frame.t_ns + (0 if guess.fitted or self._sure(counts) else self.CONFIRM_NS)
        return followed, guess.fitted

    def _within(self) -> bool:
        """Whether the car stands in the lane, about along it; else it is the neighbour's, or no lane at all."""
        offset, heading, width, _ = self._tracker.pose()
        return math.hypot(offset / (self.START_OFFSET * width), heading / self.START_HEADING_RAD) < 1.0

    def _look_for(self, image: Image) -> InitialLane | None:
        """A lane on whole rows, from nothing."""
        guess = self._start.step(image)
        self.stages.lap("start")
        return guess

    def _restart(self, guess: InitialLane) -> None:
        self._tracker.start(guess.rough(self.FITTED))
        self._new_m = self.NEW * self._unit
        self._search.forget(guess.edge)
        self._paired = guess.pair

    def _recover(self, image: Image) -> Followed | None:
        """Where no line is seen look for both on whole rows; they must lie about where they are expected."""
        guess = self._look_for(image)
        if guess is None or not guess.pair:
            return None
        aside, turned = self._tracker.difference(guess.rough(self.FITTED))
        if abs(aside) > self.ASIDE * self._unit or abs(turned) > self.TURNED_RAD:
            return None
        before = copy.copy(self._tracker), copy.copy(self._search), self._paired, self._new_m
        self._restart(guess)
        followed = self._follow(image, self.START_ROUNDS)
        if self._sure(self._count(followed)):
            return followed
        self._tracker, self._search, self._paired, self._new_m = before
        return None

    def _follow(self, image: Image, rounds: int, led: bool = False) -> Followed:
        """Look around the pair and correct it until it stays where it is; `led`: the motion brought it there."""
        tracker, stages = self._tracker, self.stages
        for k in range(rounds):
            shape = tracker.shape()
            stages.lap("projection")
            seen = self._search.look(image, shape, tracker.width_m)
            if led and k == 0:
                self._misled = self._odometry.rejects(self._last_t_ns or 0, seen.nodes, seen.residual, seen.found)
            stages.lap("search")
            carrying = tracker.update(shape, seen.nodes, seen.residual, seen.found)
            stages.lap("update")
            if tracker.moved_m < self._settled_m:
                break
        return shape, seen, carrying

    def _count(self, followed: Followed) -> tuple[int, int]:
        """How many nodes of each line, left and right, carry the lane."""
        shape, sighting, carrying = followed
        return sighting.count(shape, carrying)

    def _sure(self, counts: tuple[int, int]) -> bool:
        return min(counts) >= self.PAIR_NODES and sum(counts) >= self.SURE_NODES

    def _estimate(self, frame: Frame, followed: Followed, seen: tuple[bool, bool]) -> LaneEstimate:
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
        points = followed[1].points(followed[0], followed[2], half)
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
        """Whether too little was seen for too long."""
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
        """The car's pose in the lane, None where it is none that a car in a lane can have.

        A lane that the car would leave as soon as it was found is a neighbour's.
        """
        offset, theta, width, covariance = self._tracker.pose()
        unit = self._unit
        farthest = (self.FARTHEST_NEW if self._new_m > 0.0 else self.FARTHEST) * unit
        if not (0.65 * unit < width < 1.5 * unit and abs(offset) < farthest and abs(theta) < self.STEEPEST_RAD):
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
        """Arc lengths ahead of the reference point, log-spaced so that they are about even in the picture."""
        options, reference, eye = car.pipeline.contour, car.vehicle.reference_x_m, car.camera.extrinsics
        near = max(camera.first_visible_x_m() - reference, 0.2 * car.lane.width_m)
        back = eye.z_m + reference - eye.x_m
        far = near + options.look_ahead_lanes * car.lane.width_m
        return np.geomspace(0.85 * near + back, far + back, options.nodes) - back

    def _curve(self, aside_m: float) -> DeferredCurve:
        tracker = self._tracker
        behind = self.BEHIND * self._unit
        return DeferredCurve(partial(self._pair.table, tracker.known(), tracker.phase_m, aside_m, behind))

    def _forget(self) -> None:
        self._tracker.forget()
        self._search.forget()
        self._paired = self._misled = False

    def _lost(self, frame: Frame) -> LaneEstimate:
        return LaneEstimate(t_ns=frame.t_ns, status=LaneStatus.LOST, frame_age_ns=max(frame.t_ns - self._seen_t_ns, 0))
