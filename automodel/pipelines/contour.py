"""`contour`: a clothoid pair tracked on a few image rows, after the active contour of Smith 2024.

Prediction by speed and yaw rate -> projection of the pair's nodes into the image -> ridges on short runs of rows about
them -> robust least squares -> pose. While a lane is followed, nothing of the image is projected onto the ground, and
under 2 % of the pixels are read, as many again where a line is missing or the markings' width is measured. Where none
is followed, one has just begun, or another one may be, the whole view is searched for lines.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np

from automodel.config import CarConfig
from automodel.curves import DeferredCurve
from automodel.estimation.clothoid.clothoid_pair import ClothoidPair, PairShape
from automodel.estimation.clothoid.clothoid_tracker import ClothoidTracker, TrackerConfig
from automodel.estimation.road import BEHIND
from automodel.geometry import BirdsEye, GroundCamera
from automodel.geometry.line_projection import LineProjection
from automodel.perception.line_scan import LineScan, SightedLine
from automodel.perception.markings.binary_views import WhiteAreas, road_view
from automodel.perception.markings.faint_lines import FaintLines
from automodel.perception.markings.marking_width import MarkingWidth
from automodel.perception.markings.reflections import Reflections
from automodel.perception.rows.brightness import CHANNELS, Brightness
from automodel.perception.rows.row_search import NodeMeasurements, RowSearch
from automodel.pipelines.stages import SEEN, StageClock
from automodel.signals import Frame, LaneEstimate, LaneLine, LanePose, Motion
from automodel.tracking.belief import LaneBelief
from automodel.tracking.gentle_start import GentleStart
from automodel.tracking.integrity import K
from automodel.tracking.lane_tracking import Followed, LaneTracking, TrackingConfig
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
    ROUNDS = 3  # iterations of measurement and correction, at most
    SETTLED = 0.5  # markings: a correction that moves no node further ends the iteration
    MARKING_SIGMA, RANGE_SIGMA, TURN_SIGMA_RAD = 0.06, 0.006, 0.3  # of a ridge: markings, per metre away, direction
    VIEW_HALF, MARKING_PX = 1.6, 4.0  # of the view that is scanned for lines: lane widths, pixels per marking
    # Odds [nats] from which nodes that point to the camera are paint, 19 in 20: a streak that is followed bends the
    # lane, and without these nodes others are left. Of 26 such runs of nodes on paint 2 had less, of 82 on streaks 72.
    PAINT = 3.0
    PIECES = 7  # maximum number of the pair's stations ahead

    def __init__(self, car: CarConfig) -> None:
        options, unit, marking = car.pipeline.contour, car.lane.width_m, car.lane.marking_width_m
        self._options, self._unit, self._settled_m = options, unit, self.SETTLED * marking
        camera = GroundCamera.from_config(car.camera)
        self._car = car
        self._size = (car.camera.height_px, car.camera.width_px)
        dtype = PRECISIONS[options.precision]
        self._nodes_m = self._nodes(camera, car)
        self._tracker = self._make_tracker(self._nodes_m, car, dtype)
        self._pair = self._tracker.pair
        self._dtype, self._marking_m = dtype, marking
        self._width = MarkingWidth(camera, car.lane, car.vehicle.reference_x_m, options.colour)
        self._see_with(camera, car.lane.markings == "dark")
        self._tracking = LaneTracking(
            car,
            TrackingConfig(coast_s=options.coast_s, coast_lanes=options.coast_lanes, look=math.inf),
            float(self._nodes_m[-1]),
        )
        self.stages = StageClock()
        self.reset()
        self._warm_up()

    def _see_with(self, camera: GroundCamera, dark: bool) -> None:
        """From now on the camera is set so, and markings are looked for first of this polarity."""
        self._camera = camera
        self._projection = LineProjection(camera, self._dtype)
        self._gentle = GentleStart(self._car, camera, self._options.look_ahead_lanes)
        self._width.see_with(camera)
        self._look_for(self._marking_m, dark)

    def _look_for(self, marking_m: float, dark: bool) -> None:
        """Look for markings of this width from now on, and first of this polarity."""
        options, unit, self._marking_m = self._options, self._unit, marking_m
        brightness = Brightness(options.colour, dark)
        self._search = RowSearch(
            self._projection, brightness, options.contrast, self._nodes_m, marking_m, unit, self._size
        )
        self._gentle.look_for(marking_m)
        ahead_m, half_m = options.look_ahead_lanes * unit, self.VIEW_HALF * unit
        view = road_view(self._camera, ahead_m, half_m, marking_m / self.MARKING_PX)
        self._birdseye = BirdsEye(self._camera, view)
        self._white_areas = WhiteAreas(self._birdseye, marking_m, options.contrast, self._car.lane.markings)
        self._faint_lines = FaintLines(
            self._birdseye, self._white_areas, marking_m, options.radius_lanes * unit, LineScan.SLOPE
        )
        self._reflections = Reflections(self._camera, view, self._white_areas.mask, marking_m, self._car.lane.markings)
        self._scan = LineScan(view, unit, marking_m)

    @property
    def warning(self) -> str:
        """A line for the user after a run, which may be empty."""
        return "; ".join(filter(None, (self._width.warning, self._tracking.warning)))

    def _make_tracker(self, nodes: Floats, car: CarConfig, dtype: type[np.floating[Any]]) -> ClothoidTracker:
        options, unit, reference = self._options, self._unit, car.vehicle.reference_x_m
        spacing = max(options.piece_lanes * unit, float(nodes[-1]) / self.PIECES)
        away = np.tile(nodes + reference - car.camera.extrinsics.x_m, 2)
        sigma = np.hypot(self.MARKING_SIGMA * car.lane.marking_width_m, self.RANGE_SIGMA * away)
        return ClothoidTracker(
            ClothoidPair(nodes, spacing, reference, dtype),
            TrackerConfig(lane_width_m=unit, radius_lanes=options.radius_lanes, gate=K, solver=options.update),
            np.concatenate((sigma, np.full(len(nodes), self.TURN_SIGMA_RAD))),
        )

    def reset(self) -> None:
        """Forget the lane and the markings' measured width."""
        self._width.reset()
        self._tracking.reset()
        dark = self._car.lane.markings == "dark"
        if self._marking_m != self._width.width_m:
            self._look_for(self._width.width_m, dark)
        if self._camera is not self._tracking.camera:
            self._see_with(self._tracking.camera, dark)
        self._forget()

    @property
    def iterations(self) -> int:
        """Iterations of the update law in the last step."""
        return self._tracker.iterations

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        """The lane in this frame, body frame; LOST for an image of another size than the camera's."""
        self.stages.start()
        self._predict(frame, motion)  # speed and yaw rate
        self.stages.lap("prediction")
        if frame.image.shape[:2] != self._size:
            return self._tracking.lost_estimate(frame)
        turned = self._tracking.turn_camera()
        if turned is not None:
            self._see_with(self._tracking.camera, self._search.dark)
        if self._width.step(frame.image):
            self._look_for(self._width.width_m, self._search.dark)
        self.stages.lap("width")
        gentle, both = None, False
        if self._tracking.lost:
            start = self._tracking.start(frame.t_ns, self._lines_in_view(frame.image))
            gentle = self._gentle.step(frame.image)  # line integrals, where all bends are wide
            self.stages.lap("start")
            if gentle is not None:
                tracked, both = self._restart(frame.image, gentle.belief), True
                self._tracking.begin(frame.t_ns, self._followed(tracked, self._seen(tracked)).pose)
            elif start is not None:
                tracked, both = self._restart(frame.image, start), self._tracking.paired
            else:
                self._tracker.forget()
                return self._tracking.lost_estimate(frame)
        elif turned is not None:
            tracked = self._restart(frame.image, turned)
        else:
            # Projection of the nodes, ridges about them, robust least squares; repeated until the pair is settled.
            tracked = self._track(frame.image, self.ROUNDS)
        followed = self._followed(tracked, self._seen(tracked))
        if gentle is not None:  # which looks at more rows than there are nodes
            left = replace(followed.left, points_m=gentle.left_m, seen=True)
            right = replace(followed.right, points_m=gentle.right_m, seen=True)
            followed = replace(followed, left=left, right=right)
        if not both and self._tracking.looks_around(followed):  # which of all lines in view are the lane's?
            anew = self._tracking.judge(self._lines_in_view(frame.image), followed)
            self.stages.lap("doubt")
            if anew is not None:
                tracked = self._restart(frame.image, anew)
                followed = self._followed(tracked, self._seen(tracked))
        self._search.learn(tracked.measured, tracked.inliers)
        estimate = self._tracking.follow(frame, followed)
        if self._tracking.lost:
            self._forget()
        self.stages.lap("estimate")
        return estimate

    def _warm_up(self) -> None:
        """Compile everything that a step calls, so that no step waits for it."""
        nothing = np.zeros(self._size, np.uint8)
        self._gentle.step(nothing)
        self._tracker.start(np.array((0.0, 0.0, 0.0, self._unit)), np.diag(np.full(4, self._settled_m**2)))
        self._tracker.move(0.0, 0.0, True)
        self._tracker.pose()
        tracked = self._track(nothing, 1)
        tracked.counts()
        self._search.learn(tracked.measured, tracked.inliers)
        tracked.measured.points(tracked.shape, tracked.inliers, self._tracker.half_m())
        self.reset()

    def _predict(self, frame: Frame, motion: Motion) -> None:
        """Move the lane by the odometry since the last frame; a gap, or time that goes back, drops it."""
        moved = self._tracking.predict(frame, motion)
        self._reflections.turned(moved.turn_rad if moved is not None and moved.known else None)
        if self._tracking.lost or moved is None:
            self._tracker.forget()
            return
        self._tracker.move(moved.distance_m, moved.turn_rad, moved.known)

    def _restart(self, image: Image, belief: LaneBelief) -> Tracked:
        """The pair measured anew about a belief; of either polarity, if it may be both, that which shows more of it."""
        dark = self._search.dark
        if self._car.lane.markings == "both":
            counts = {each: sum(self._measured_anew(image, belief, each).counts()) for each in (dark, not dark)}
            dark = max(counts, key=lambda each: counts[each])
        return self._measured_anew(image, belief, dark)

    def _measured_anew(self, image: Image, belief: LaneBelief, dark: bool) -> Tracked:
        self._tracker.start(belief.mean, belief.spread)
        self._search.forget(dark=dark)
        return self._track(image, self.ROUNDS)

    def _seen(self, tracked: Tracked) -> tuple[bool, bool]:
        left, right = tracked.counts()
        return left >= SEEN, right >= SEEN

    def _lines_in_view(self, image: Image) -> tuple[SightedLine, ...]:
        """The lines of the whole view, without reflections; those that point to the camera may be some, too."""
        pixels, colour = np.asarray(image), self._options.colour
        if pixels.ndim == 2:
            grey = pixels
        elif colour in CHANNELS:
            grey = np.ascontiguousarray(pixels[..., CHANNELS[colour]])
        else:
            grey = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        view = self._birdseye.warp(np.asarray(grey, dtype=np.uint8))
        areas = self._faint_lines.step(view, self._white_areas.step(view))
        lines = self._reflections.step(view, areas.lines, areas.paint)
        return self._reflections.told(self._scan.step(lines, areas.bright, self._reflections.doubtful))

    def _track(self, image: Image, rounds: int) -> Tracked:
        """Measure the pair and correct it, up to `rounds` times."""
        tracker, stages = self._tracker, self.stages
        for _ in range(rounds):
            shape = tracker.shape()
            stages.lap("projection")
            sigma_m, half_m = tracker.sigma_m(shape), tracker.half_m()
            seen = self._search.look(image, shape, half_m, tracker.config.gate * sigma_m)
            self._without_reflections(image, shape, seen, half_m)
            stages.lap("search")
            inliers = tracker.update(shape, seen.nodes, seen.residual, seen.found)
            stages.lap("update")
            if tracker.moved_m < self._settled_m:
                break
        return Tracked(shape, seen, inliers)

    def _without_reflections(self, image: Image, shape: PairShape, seen: NodeMeasurements, half_m: Floats) -> None:
        """Nodes that lie on a reflection were not found."""
        count = len(seen.nodes)
        found = seen.found[:count] > 0.0
        sides = seen.points(shape, found, half_m)
        if self._reflections.any_points_to_camera(*sides):
            away = np.concatenate([self._reflections.on_streaks(image, points, self.PAINT) for points in sides])
            lost = np.flatnonzero(found)[away]
            seen.found[lost] = seen.found[count + lost] = 0.0

    def _followed(self, tracked: Tracked, seen: tuple[bool, bool]) -> Followed:
        offset, theta, width, covariance = self._tracker.pose()
        points = tracked.measured.points(tracked.shape, tracked.inliers, self._tracker.half_m())
        return Followed(
            pose=LanePose(
                offset_m=offset,
                heading_rad=-theta,
                width_m=width,
                curvature_per_m=self._tracker.curvature(),
                covariance=covariance,
            ),
            left=LaneLine(curve=self._curve(+0.5), points_m=points[0][: len(points[0]) * seen[0]], seen=seen[0]),
            right=LaneLine(curve=self._curve(-0.5), points_m=points[1][: len(points[1]) * seen[1]], seen=seen[1]),
            centerline=self._curve(0.0),
        )

    @staticmethod
    def _nodes(camera: GroundCamera, car: CarConfig) -> FloatArray:
        """Arc lengths (n,) [m] ahead of the reference point, log-spaced so that they are about even in the image."""
        options, reference, eye = car.pipeline.contour, car.vehicle.reference_x_m, car.camera.extrinsics
        near = max(camera.first_visible_x_m() - reference, 0.2 * car.lane.width_m)
        back = eye.z_m + reference - eye.x_m
        far = near + options.look_ahead_lanes * car.lane.width_m
        return np.geomspace(0.85 * near + back, far + back, options.nodes) - back

    def _curve(self, side: float) -> DeferredCurve:
        """The curve that many lane widths to the left of the centerline."""
        tracker, behind = self._tracker, BEHIND * self._unit
        left_m, taper = side * tracker.width_m, side * tracker.taper
        return DeferredCurve(partial(self._pair.table, tracker.known(), tracker.phase_m, left_m, behind, taper))

    def _forget(self) -> None:
        self._tracker.forget()
        self._search.forget()
        self._tracking.forget()
