"""`windows`: the lane lines of Balbuena Palma et al. 2020, for the AutoModelCar, in metres and over time.

Bird's-eye view -> binarisation, white-areas filter -> crossing search -> prediction, or histogram start -> sliding
windows -> regression -> lane fit (width, offset, heading, curvature). The paper treats every frame alone. Here the lane
is carried from frame to frame by odometry, because the nearest ground that the camera sees lies ahead of the car, and
because no line is visible at a crossing.
"""

from __future__ import annotations

import math
from functools import partial

import cv2
import numpy as np

from automodel.config import CarConfig
from automodel.curves import Curve, DeferredGraphCurve
from automodel.curves.regression import fit_polynomial
from automodel.estimation.polynomial.lane_fit import LaneFitConfig, LaneSolution
from automodel.estimation.polynomial.lane_tracker import LaneTracker, Support
from automodel.geometry import BirdsEye, GroundCamera
from automodel.perception.line_scan import LineScan
from automodel.perception.markings.binary_views import MarkingViews, WhiteAreas, road_view
from automodel.perception.markings.crossings import CrossingScan, CrossingSearch
from automodel.perception.markings.faint_lines import FaintLines
from automodel.perception.markings.marking_width import MarkingWidth
from automodel.perception.markings.reflections import Reflections
from automodel.perception.windows.sliding_windows import HistogramStart, SlidingWindows
from automodel.pipelines.stages import SEEN, StageClock
from automodel.signals import Crossing, Frame, LaneEstimate, LaneLine, LanePose, Motion, Observation
from automodel.tracking.belief import LaneBelief
from automodel.tracking.gentle_start import GentleLane, GentleStart
from automodel.tracking.lane_tracking import Followed, LaneTracking, TrackingConfig
from automodel.types import FloatArray, Image

NO_POINTS: FloatArray = np.empty((0, 2))
Fitted = tuple[Observation, LaneSolution, Support]  # a frame's points, the lane fitted to them, and how many agree


class Windows:
    """The pipeline of Balbuena Palma et al. 2020."""

    name = "windows"
    MAX_SKEW_RAD = math.radians(15.0)  # of a crossing that is reported (the paper's tolerance)

    def __init__(self, car: CarConfig) -> None:
        options, lane = car.pipeline.windows, car.lane
        camera = GroundCamera.from_config(car.camera)
        self._car, self._options, self._lane = car, options, lane
        self._reference_x_m = car.vehicle.reference_x_m
        self._size = (car.camera.height_px, car.camera.width_px)
        self._width = MarkingWidth(camera, lane, self._reference_x_m)
        near_x_m = camera.first_visible_x_m()
        ahead_m = near_x_m + options.view_ahead_lanes * lane.width_m - self._reference_x_m
        self._tracker = LaneTracker(
            LaneFitConfig(
                lane_width_m=lane.width_m,
                reference_x_m=self._reference_x_m,
                ahead_lanes=ahead_m / lane.width_m + 0.3,
            ),
            near_x_m,
        )
        coasting = TrackingConfig(coast_s=options.coast_s, coast_lanes=options.coast_lanes)
        self._tracking = LaneTracking(car, coasting, ahead_m)
        self._marking_m = lane.marking_width_m
        self._see_with(camera)
        self.stages = StageClock()
        self.reset()

    def _see_with(self, camera: GroundCamera) -> None:
        """From now on the camera is set so."""
        self._camera = camera
        self._width.see_with(camera)
        self._gentle = GentleStart(self._car, camera, self._options.view_ahead_lanes)
        self._look_for(self._marking_m)

    def _look_for(self, marking_m: float) -> None:
        """Look for markings of this width from now on."""
        options, lane, self._marking_m = self._options, self._lane, marking_m
        self.view = road_view(
            self._camera,
            options.view_ahead_lanes * lane.width_m,
            options.view_half_lanes * lane.width_m,
            marking_m / options.marking_px,
        )
        self._birdseye = BirdsEye(self._camera, self.view)
        self._white_areas = WhiteAreas(self._birdseye, marking_m, options.contrast, lane.markings)
        self._faint_lines = FaintLines(
            self._birdseye,
            self._white_areas,
            marking_m,
            self._car.pipeline.contour.radius_lanes * lane.width_m,
            LineScan.SLOPE,
        )
        self._reflections = Reflections(
            self._camera, self.view, self._white_areas.mask, marking_m, lane.markings, SlidingWindows.COUNT
        )
        self._crossings = CrossingSearch(self.view, lane.width_m, marking_m)
        self._windows = SlidingWindows(self.view, marking_m)
        self._histogram = HistogramStart(self.view, marking_m)
        self._scan = LineScan(self.view, lane.width_m, marking_m)
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
        self._forget()

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        """The lane in this frame, body frame; LOST for an image of another size than the camera's."""
        self.stages.start()
        self._predict(frame, motion)  # odometry, or the ground's own motion
        self.stages.lap("prediction")
        if frame.image.shape[:2] != self._size:
            return self._tracking.lost_estimate(frame)
        turned = self._tracking.turn_camera()
        if turned is not None:
            self._see_with(self._tracking.camera)
        if self._width.step(frame.image):
            self._look_for(self._width.width_m)
        view = self._birdseye_view(frame.image)
        self.stages.lap("birdseye")
        areas = self._white_areas.step(view)  # binarisation, white-areas filter
        lines = areas.lines
        self.stages.lap("white_areas")
        if self._tracking.lost:
            areas = self._faint_lines.step(view, areas)
            lines = self._reflections.step(view, areas.lines, areas.paint)  # without reflections
            # Lines in view, of which those that point to the camera may be reflections, too.
            sighted = self._reflections.told(self._scan.step(lines, areas.bright, self._reflections.doubtful))
            start = self._tracking.start(frame.t_ns, sighted)  # the lane's pair
            self.stages.lap("start")
            gentle = self._gentle.step(frame.image)  # line integrals, where all bends are wide
            if gentle is not None:
                followed = self._followed(None, *self._begin(gentle))
                self._tracking.begin(frame.t_ns, followed.pose)
            elif start is not None:
                followed = self._followed(None, *self._restart(start, view, areas, lines))
            else:
                return self._tracking.lost_estimate(frame)
        elif turned is not None:
            followed = self._followed(None, *self._restart(turned, view, areas, lines))
        else:
            scan = self._scan_crossing(areas.bright)
            self.stages.lap("crossing")
            seen = self._observe(view, areas, lines, scan)  # sliding windows
            self.stages.lap("windows")
            followed = self._followed(scan.crossing, seen, *self._tracker.update(seen))  # lane fit
            self.stages.lap("lane_fit")
        if self._tracking.looks_around(followed):  # which of all lines in view are the lane's?
            areas = self._faint_lines.step(view, areas)
            lines = self._reflections.step(view, areas.lines, areas.paint)
            anew = self._tracking.judge(
                self._reflections.told(self._scan.step(lines, areas.bright, self._reflections.doubtful)), followed
            )
            if anew is not None:
                followed = self._followed(None, *self._restart(anew, view, areas, lines))
            self.stages.lap("doubt")
        estimate = self._tracking.follow(frame, followed)
        if self._tracking.lost:
            self._tracker.forget()
        self.stages.lap("estimate")
        return estimate

    def _predict(self, frame: Frame, motion: Motion) -> None:
        """Move the lane by the odometry since the last frame; a gap, or time that goes back, drops it."""
        moved = self._tracking.predict(frame, motion)
        self._reflections.turned(moved.turn_rad if moved is not None and moved.known else None)
        if self._tracking.lost or moved is None:
            self._forget()
            return
        self._tracker.move(moved.after_from_before, moved.distance_m, moved.known)

    def _birdseye_view(self, image: Image) -> Image:
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        return self._birdseye.warp(np.asarray(grey, dtype=np.uint8))

    def _begin(self, lane: GentleLane) -> Fitted:
        """The lane fitted to the lines of a start from the whole image."""
        arc = self._tracker.fit.start(*lane.belief.mean.tolist())
        self._tracker.place(arc)
        _, left, right, left_sigma, right_sigma = lane
        seen = Observation(left_m=left, right_m=right, left_sigma_m=left_sigma, right_sigma_m=right_sigma)
        return seen, *self._tracker.restart(seen, arc, np.sqrt(np.diag(lane.belief.spread)))

    def _restart(self, belief: LaneBelief, view: Image, areas: MarkingViews, lines: Image) -> Fitted:
        """The lane fitted anew about a belief."""
        arc = self._tracker.fit.start(*belief.mean.tolist())
        self._tracker.place(arc)
        beside_m = self._lines_beside(belief, lines)
        seen = self._observe(view, areas, lines, self._scan_crossing(areas.bright), beside_m)
        return seen, *self._tracker.restart(seen, arc, np.sqrt(np.diag(belief.spread)))

    def _scan_crossing(self, bright: Image) -> CrossingScan:
        """Search for a crossing."""
        return self._crossings.step(bright, self._tracker.shape, self.view.x_far_m - self._reference_x_m)

    def _lines_beside(self, belief: LaneBelief, lines: Image) -> tuple[float, float]:
        """How far [m] the left and the right line lie to the left of a belief, up to its uncertainty: the histogram."""
        x = self._windows.centre_x_m
        left, right = (
            self._histogram.step(
                lines,
                x,
                self._windows.expected(self._tracker.shape, side),
                2.0 * float(belief.beside(x[:1] - self._reference_x_m, 0.5 * side)[2][0]),
            )
            for side in (+1, -1)
        )
        return left, right

    def _observe(
        self,
        view: Image,
        areas: MarkingViews,
        lines: Image,
        scan: CrossingScan,
        beside_m: tuple[float, float] = (0.0, 0.0),
    ) -> Observation:
        """Both lines' points about the predicted lane, without reflections and where no paint covers the lane.

        `beside_m`: how far the left and the right line start to the left of that.
        """
        lane = self._tracker.shape
        widening = min(1.0 + self._tracker.blind_m / self._lane.width_m, 2.0)
        left, right = self._windows.expected(lane, +1) + beside_m[0], self._windows.expected(lane, -1) + beside_m[1]
        seen = self._windows.observe(lines, left, right, widening)
        if self._reflections.any_points_to_camera(seen.left_m, seen.right_m):
            lines = self._reflections.step(view, areas.lines, areas.paint)
            seen = self._windows.observe(lines, left, right, widening)
        if not scan.covered.any():
            return seen
        keep = [scan.free(lane.nearest_s(points)) for points in (seen.left_m, seen.right_m)]
        return Observation(
            left_m=seen.left_m[keep[0]],
            right_m=seen.right_m[keep[1]],
            left_sigma_m=seen.left_sigma_m[keep[0]],
            right_sigma_m=seen.right_sigma_m[keep[1]],
        )

    def _followed(
        self, crossing: Crossing | None, seen: Observation, solution: LaneSolution, support: Support
    ) -> Followed:
        left_seen, right_seen = (n >= SEEN for n in (support.left, support.right))
        fit, p = self._tracker.fit, solution.parameters
        count = len(seen.left_m)
        left_m = seen.left_m[solution.inliers[:count]]
        right_m = seen.right_m[solution.inliers[count : count + len(seen.right_m)]]
        return Followed(
            pose=LanePose(
                offset_m=solution.offset_m,
                heading_rad=solution.heading_rad,
                width_m=solution.width_m,
                curvature_per_m=fit.curvature(p),
                covariance=fit.covariance(solution),
            ),
            left=self._line(left_m, left_seen, +1),
            right=self._line(right_m, right_seen, -1),
            centerline=self._tracker.shape.curve(),
            crossing=self._reported(crossing, p),
        )

    def _line(self, points_m: FloatArray, seen: bool, side: int) -> LaneLine:
        """The paper's regression of degree 2 through a line that is seen, else the lane's edge."""
        curve: Curve
        if seen and float(points_m[-1, 0] - points_m[0, 0]) > 2 * self.view.m_per_row:
            curve = DeferredGraphCurve(partial(_regression, points_m))
        else:
            shape = self._tracker.shape
            curve = shape.curve(side * 0.5 * shape.width_m)
        return LaneLine(curve=curve, points_m=points_m if seen else NO_POINTS, seen=seen)

    def _reported(self, crossing: Crossing | None, parameters: FloatArray) -> Crossing | None:
        """The crossing, unless it is too far from square to the lane."""
        if crossing is None:
            return None
        skew = crossing.angle_rad - 0.5 * math.pi - self._tracker.fit.direction(parameters, crossing.distance_m)
        return crossing if abs(skew) <= self.MAX_SKEW_RAD else None

    def _forget(self) -> None:
        self._tracker.forget()


def _regression(points_m: FloatArray) -> tuple[FloatArray, float, float]:
    """The regression of degree 2 through points (n, 2) [m], and the x [m] of its ends."""
    x = points_m[:, 0]
    return fit_polynomial(x, points_m[:, 1], 2), float(x.min()), float(x.max())
