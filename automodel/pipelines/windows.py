"""`windows`: lane lines for the AutoModelCar category (seed 003), in metres and over time.

Bird's-eye view -> binarisation -> white-areas filter -> histogram start / prediction -> sliding windows ->
regression -> lane fit (width, offset, heading, curvature) -> crossing. Where the paper treats every frame alone, the
lane is carried from frame to frame by odometry (estimation/lane_tracker.py), because the nearest ground the camera sees
lies ahead of the car, and because at a crossing there is nothing to see.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from automodel.config import CarConfig
from automodel.curves import Curve, GraphCurve
from automodel.estimation.polynomial.lane_fit import LaneFitConfig, LaneSolution
from automodel.estimation.polynomial.lane_tracker import LaneTracker, Observation, Support
from automodel.estimation.polynomial.regression import fit_polynomial
from automodel.geometry import SE2, BirdsEye, GroundCamera, View
from automodel.perception.markings.binary_views import TemporalPaintCheck, WhiteAreas
from automodel.perception.markings.crossings import CrossingScan, CrossingSearch
from automodel.perception.windows.lane_initialiser import LaneCandidate, LaneInitialiser
from automodel.perception.windows.sliding_windows import LaneWindows
from automodel.pipelines.stages import StageClock
from automodel.signals import Crossing, Frame, LaneEstimate, LaneLine, LanePose, LaneStatus, Motion
from automodel.types import FloatArray, Image

NO_POINTS: FloatArray = np.empty((0, 2))


class Windows:
    """Seed 003 as a pipeline: `step` one frame, `reset`."""

    name = "windows"
    CROSSING_TURN = 0.5  # how much a line's slope may differ from the lane's near a crossing
    MAX_SKEW_RAD = math.radians(15.0)  # of a crossing that is told (the paper's tolerance)
    CONFIRM_NS = 250_000_000  # a lane started from one line is not told before it was seen for so long
    MAX_ROWS = 240  # of the bird's-eye view; a long view is coarser along the road than across
    MAX_GAP_NS = 500_000_000  # a longer gap between frames: start again

    def __init__(self, car: CarConfig) -> None:
        options, lane = car.pipeline.windows, car.lane
        camera = GroundCamera.from_config(car.camera)
        near = camera.first_visible_x_m()
        across = lane.marking_width_m / options.marking_px
        self.view = View(
            x_near_m=near,
            x_far_m=near + options.view_ahead_lanes * lane.width_m,
            half_width_m=options.view_half_lanes * lane.width_m,
            m_per_px=across,
            m_per_row=max(across, options.view_ahead_lanes * lane.width_m / self.MAX_ROWS),
        )
        self._options, self._lane, self._reference_x_m = options, lane, car.vehicle.reference_x_m
        self._size = (car.camera.height_px, car.camera.width_px)
        self._birdseye = BirdsEye(camera, self.view)
        self._white = WhiteAreas(self._birdseye, lane.marking_width_m, options.contrast, lane.dark_markings)
        self._lines = LaneWindows(self.view, lane.marking_width_m)
        self._crossings = CrossingSearch(self.view, lane.width_m, lane.marking_width_m)
        self._ground = TemporalPaintCheck(self.view, self._white.mask, lane.width_m, lane.marking_width_m)
        self._tracker = LaneTracker(
            LaneFitConfig(
                lane_width_m=lane.width_m,
                reference_x_m=self._reference_x_m,
                ahead_lanes=(self.view.x_far_m - self._reference_x_m) / lane.width_m + 0.3,
            ),
            near,
        )
        self._fresh = LaneInitialiser(self._lines, self._tracker)
        self.stages = StageClock()
        self.reset()

    def reset(self) -> None:
        """Forget the lane."""
        self._tracker.forget()
        self._ground.forget()
        self._last_t_ns: int | None = None
        self._seen_t_ns = self._confirmed_ns = 0

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        """The lane in this frame (LOST for a picture of another size than the camera's)."""
        self.stages.begin()
        self._advance(frame.t_ns, motion)
        self.stages.lap("prediction")
        if frame.image.shape[:2] != self._size:
            return self._lost(frame)
        grey = frame.image if frame.image.ndim == 2 else cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
        view = self._birdseye.warp(np.asarray(grey, dtype=np.uint8))
        self.stages.lap("birdseye")
        bright, lines = self._white.step(view)
        painted = self._ground.step(lines)
        self._ground.remember(bright)
        self.stages.lap("white_areas")
        crossing = None
        if self._tracker.parameters is None:
            fresh = self._fresh.find(painted)
            if fresh is None or not self._plausible(fresh.solution):
                return self._lost(frame)
            seen, solution, support = self._take(fresh)
            self._confirmed_ns = frame.t_ns + (0 if fresh.pair else self.CONFIRM_NS)
        else:
            crossed = self._cross(bright)
            crossing = crossed.crossing
            self.stages.lap("crossing")
            seen = self._observe(painted, crossed)
            self.stages.lap("windows")
            solution, support = self._tracker.update(seen)
            self.stages.lap("lane_fit")
            rival = self._fresh.replacement(painted, crossed, support)
            if rival is not None and self._plausible(rival.solution):
                seen, solution, support = self._take(rival)
        estimate = self._estimate(frame, crossing, seen, solution, support)
        self.stages.lap("estimate")
        return estimate

    def _advance(self, t_ns: int, motion: Motion) -> None:
        """Move the lane by the odometry since the frame before; a gap or time that goes back starts again."""
        last, self._last_t_ns = self._last_t_ns, t_ns
        if last is None:
            return
        dt_ns = t_ns - last
        if not 0 < dt_ns <= self.MAX_GAP_NS:
            self._tracker.forget()
            self._ground.forget()
            return
        distance = motion.speed_mps * dt_ns * 1e-9 if motion.known else 0.0
        turn = motion.yaw_rate_radps * dt_ns * 1e-9 if motion.known else 0.0
        before_from_after = SE2.arc(distance, turn)
        self._tracker.move(before_from_after.inverse(), distance, motion.known)
        if motion.known:
            self._ground.move(before_from_after, distance)
        else:
            self._ground.forget()

    def _take(self, fresh: LaneCandidate) -> tuple[Observation, LaneSolution, Support]:
        self._tracker.start(fresh.seen, fresh.solution)
        return fresh.seen, fresh.solution, fresh.support

    def _observe(self, lines: Image, crossed: CrossingScan) -> Observation:
        """Both lines' points from where the lane is predicted, without those where paint covers the lane."""
        lane = self._tracker.shape
        breadth = min(1.0 + self._tracker.blind_m / self._lane.width_m, 2.0)
        left, right = self._lines.expected(lane, +1), self._lines.expected(lane, -1)
        turn = self.CROSSING_TURN if self._tracker.near_crossing else math.inf  # other roads' lines lie there
        seen = self._lines.observe(lines, left, right, breadth, turn)
        if not crossed.covered.any():
            return seen
        keep = [crossed.free(lane.nearest_s(points)) for points in (seen.left_m, seen.right_m)]
        return Observation(
            left_m=seen.left_m[keep[0]],
            right_m=seen.right_m[keep[1]],
            left_sigma_m=seen.left_sigma_m[keep[0]],
            right_sigma_m=seen.right_sigma_m[keep[1]],
        )

    def _estimate(
        self, frame: Frame, crossing: Crossing | None, seen: Observation, solution: LaneSolution, support: Support
    ) -> LaneEstimate:
        left_seen, right_seen = (
            support.left >= self._fresh.LINE_WINDOWS,
            support.right >= self._fresh.LINE_WINDOWS,
        )
        if left_seen or right_seen:
            self._seen_t_ns = frame.t_ns
        blind_ns = frame.t_ns - self._seen_t_ns
        unconfirmed = frame.t_ns < self._confirmed_ns
        too_long = (
            (unconfirmed and blind_ns > 0)
            or blind_ns * 1e-9 > self._options.coast_s
            or self._tracker.blind_m > self._options.coast_m
        )
        if too_long or not self._plausible(solution):
            self._tracker.forget()
            return self._lost(frame)
        if unconfirmed:
            return self._lost(frame)
        status = (LaneStatus.COASTING, LaneStatus.ONE_LINE, LaneStatus.TRACKING)[int(left_seen) + int(right_seen)]
        fit, p = self._tracker.fit, solution.parameters
        shape = self._tracker.shape
        pose = LanePose(
            offset_m=solution.offset_m,
            heading_rad=solution.heading_rad,
            width_m=solution.width_m,
            curvature_per_m=fit.curvature(p),
            covariance=fit.covariance(solution),
        )
        return LaneEstimate(
            t_ns=frame.t_ns,
            status=status,
            left=self._line(seen.left_m, left_seen, +1),
            right=self._line(seen.right_m, right_seen, -1),
            centerline=shape.curve(),
            pose=pose,
            crossing=self._told(crossing, p),
            frame_age_ns=blind_ns,
        )

    def _line(self, points_m: FloatArray, seen: bool, side: int) -> LaneLine:
        """The paper's regression x(row) of degree 2 through a line that is seen, else the lane's edge."""
        curve: Curve
        if seen and float(points_m[-1, 0] - points_m[0, 0]) > 2 * self.view.m_per_row:
            x = points_m[:, 0]
            curve = GraphCurve(fit_polynomial(x, points_m[:, 1], 2), float(x.min()), float(x.max()))
        else:
            shape = self._tracker.shape
            curve = shape.curve(side * 0.5 * shape.width_m)
        return LaneLine(curve=curve, points_m=points_m if seen else NO_POINTS, seen=seen)

    def _cross(self, bright: Image) -> CrossingScan:
        """Look for a crossing; one that is found tells the tracker the lane's direction there."""
        crossed = self._crossings.step(bright, self._tracker.shape, self.view.x_far_m - self._reference_x_m)
        if crossed.crossing is not None:
            self._tracker.add_crossing(crossed.crossing.distance_m, crossed.crossing.angle_rad - 0.5 * math.pi)
        return crossed

    def _told(self, crossing: Crossing | None, parameters: FloatArray) -> Crossing | None:
        if crossing is None:
            return None
        skew = crossing.angle_rad - 0.5 * math.pi - self._tracker.fit.direction(parameters, crossing.distance_m)
        return crossing if abs(skew) <= self.MAX_SKEW_RAD else None

    def _plausible(self, solution: LaneSolution) -> bool:
        unit = self._lane.width_m
        return bool(
            np.isfinite(solution.parameters).all()
            and 0.65 * unit < solution.width_m < 1.35 * unit
            and abs(solution.offset_m) < 0.9 * unit
            and abs(solution.heading_rad) < math.radians(60.0)
        )

    def _lost(self, frame: Frame) -> LaneEstimate:
        return LaneEstimate(t_ns=frame.t_ns, status=LaneStatus.LOST, frame_age_ns=max(frame.t_ns - self._seen_t_ns, 0))
