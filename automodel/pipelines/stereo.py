"""`stereo`: lanes of two cameras far apart, on a ground plane of their own, after the wide-baseline stereo paper.

Prediction by speed and yaw rate -> marking extraction in both images, stripe models -> epipolar matching and
triangulation -> ground plane, filtered -> re-projection of all stripes onto it -> parabola pair -> pose.
Nothing is rectified or warped. Where one camera shows nothing the plane is held, and the other one's stripes go on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from automodel.config import CarConfig
from automodel.estimation.parabola.parabola_pair import ParabolaPair, Part
from automodel.estimation.parabola.plane_filter import PlaneFilter
from automodel.geometry import GroundCamera, View
from automodel.geometry.stereo_rig import Eye, Plane, StereoRig, bearings, images_of_ground, on_ground
from automodel.perception.line_scan import LineScan, ScanConfig, SightedLine
from automodel.perception.markings.marking_width import MarkingWidth
from automodel.perception.markings.reflections import Reflections
from automodel.perception.stereo.ground_plane import fit_plane
from automodel.perception.stereo.matching import match, mirrored, witnesses
from automodel.perception.stereo.reconstruction import log_odds, radial, reconstruct
from automodel.perception.stereo.stage_views import PairStages, stage_views
from automodel.perception.stereo.stripes import Stripes, StripeSearch
from automodel.pipelines.stages import SEEN, StageClock
from automodel.signals import SIDES, Frame, LaneEstimate, LaneLine, LanePose, Motion, StageView, StereoFrame
from automodel.tracking.belief import LaneBelief, RoadModel
from automodel.tracking.gentle_start import GentleStart
from automodel.tracking.hypotheses import HypothesesConfig
from automodel.tracking.lane_change import LaneChanges
from automodel.tracking.lane_tracking import FAR_OFF, Followed, LaneTracking, TrackingConfig
from automodel.types import Bools, Complexes, FloatArray, Image, Ints

NOISE_PX = 0.5  # of a match: two ridges, each measured to a third of a pixel
SURE = 6.0  # [nats] for or against a stripe: three ridges' that the other image shows, of which one is news
BLIND = 0.2  # share of pairs in which one camera alone shows markings, from which on the user is told
ALIKE = 0.7  # mean correlation of what both images show about a stripe that they see as infinitely far: a lamp's


class Stereo:
    """The pipeline of wide-baseline stereo lane detection and tracking."""

    name = "stereo"
    cameras = 2

    def __init__(self, car: CarConfig) -> None:
        options, unit = car.pipeline.stereo, car.lane.width_m
        self._options, self._lane, self._unit = options, car.lane, unit
        self._reference_x_m, self._radius_lanes = car.vehicle.reference_x_m, car.pipeline.contour.radius_lanes
        self._size = (car.camera.height_px, car.camera.width_px)
        self._rig = self.rig(car)
        self._plane = PlaneFilter(float(self._rig.middle_m[2]))
        near = min(eye.first_visible_x_m() for eye in (self._rig.left, self._rig.right))
        near_m = max(near - self._reference_x_m, 0.2 * unit)
        self._far_m = near_m + options.look_ahead_lanes * unit
        self._rows_m = self._stations(near_m)
        self._width = MarkingWidth(self._rig.left, car.lane, self._reference_x_m)
        self._gentle = GentleStart(car, self._rig.left, options.look_ahead_lanes)
        self._look_for(car.lane.marking_width_m)
        anyhow = HypothesesConfig(line=1.0, other=1.0)  # what both eyes match are pieces of any length
        self._tracking = LaneTracking(
            car,
            TrackingConfig(coast_s=options.coast_s, coast_lanes=options.coast_lanes, hypotheses=anyhow),
            self._far_m,
        )
        road, usual = self._tracking.road, RoadModel(lane_width_m=unit, marking_width_m=car.lane.marking_width_m)
        width_sigma_m = road.width_sigma * unit
        # Variance that the curvature gains per lane width of road: arcs begin at once, which nothing learns before.
        bend_walk = usual.bend_walk * (usual.radius_lanes / road.radius_lanes) ** 2
        self._pair = ParabolaPair(unit, width_sigma_m, self._reference_x_m, self._far_m, bend_walk)
        self._changes = LaneChanges()
        if options.lane_changes and not car.lane.left == car.lane.right == "any":
            raise ValueError('lane_changes: needs [lane] left and right "any": each lane has lines of its own')
        self.stages = StageClock()
        self.reset()
        self._warm_up()

    def _look_for(self, marking_m: float) -> None:
        """Look for markings of this width from now on."""
        options, unit, markings = self._options, self._unit, self._lane.markings
        self._marking_m = marking_m
        half_lanes, turn_rad = options.view_half_lanes, options.look_ahead_lanes / self._radius_lanes
        self._searches = [
            StripeSearch(marking_m, unit, half_lanes, options.contrast, self._size, options.rows, dark, turn_rad)
            for dark in (False, True)
            if markings in ("both", "dark" if dark else "light")
        ]
        self._spacing_m = 0.25 * ScanConfig().spacing_lanes * unit
        view = View(
            x_near_m=0.0,
            x_far_m=self._far_m + self._reference_x_m,
            half_width_m=half_lanes * unit,
            m_per_px=0.25 * marking_m,
            m_per_row=self._spacing_m,
        )
        self._scan = LineScan(view, unit, marking_m)
        nothing = np.zeros((0, 0), np.uint8)
        self._reflections = [
            Reflections(eye, view, nothing, marking_m, markings) for eye in (self._rig.left, self._rig.right)
        ]
        self._gentle.look_for(marking_m)

    @property
    def warning(self) -> str:
        """A line for the user after a run, which may be empty."""
        blind = [
            f"the {eye} camera gave no image in {count} frames"
            for eye, count in zip(SIDES, self._missing, strict=True)
            if count
        ]
        blind += [
            f"the {eye} camera showed no marking in {count} of the {self._pairs} pairs in which the other one did"
            for eye, count in zip(SIDES, self._blind, strict=True)
            if count > BLIND * self._pairs
        ]
        if blind:
            blind[-1] += ": the ground plane of the last good pair was used"
        off = f"the ground plane did not fit the cameras' calibration in {self._off} pairs: calibrate both again"
        return "; ".join(text for text in (self._width.warning, *blind, off * (self._off > 0)) if text)

    @property
    def trouble(self) -> str:
        """Why there is no lane, where the cameras are wrong; "" where nothing speaks against them.

        An eye that is turned against its calibration puts the ground plane where no body of a car brings it.
        """
        if self._plane.chance >= math.erfc(FAR_OFF / math.sqrt(2.0)):  # sigmas
            return ""
        return (
            "the ground as both cameras see it does not fit their calibration: a camera was turned, or car.toml is that"
            " of another pair; calibrate both again"
        )

    @property
    def plane(self) -> Plane:
        """The cameras' height, pitch and roll over the ground, beyond the calibrated ones."""
        return self._plane.plane

    @property
    def stage_views(self) -> tuple[StageView, ...]:
        """What the stages found in the last frame, to be drawn; nothing of one that they were not given."""
        if self._found is None:
            return ()
        lane = () if self._tracking.lost else tuple(map(self._pair.curve, (0.5, 0.0, -0.5)))
        return stage_views(self._found, self._rig, self.plane, lane)

    def reset(self) -> None:
        """Forget the lane, the plane and the markings' measured width."""
        self._width.reset()
        if self._marking_m != self._width.width_m:
            self._look_for(self._width.width_m)
        self._plane.reset()
        self._blind, self._pairs = [0, 0], 0  # pairs in which the left eye, the right eye, and not both saw nothing
        self.plane_reach_m = 0.0  # how far ahead this pair measured the ground; 0 where it did not
        self._missing = [0, 0]  # frames without an image of the left camera, of the right one
        self._off = 0  # pairs with a plane that does not fit the calibration
        self._found: PairStages | None = None  # what the stages made of the last frame
        self._lasts = 1.0  # frames for which an error of the plane lasts: they are one witness of it
        self._one_eyed = False  # whether the last pair was none: nothing measured the plane
        self._tracking.reset()
        self._changes.reset()
        self._pair.forget()

    def step(self, frame: Frame | StereoFrame, motion: Motion) -> LaneEstimate:
        """The lane in this pair, body frame; LOST for images of another size than the cameras'.

        A single image is that of the camera that its `eye` says; the other one is missing.
        """
        self.stages.start()
        self._found = None
        single, images = _images(frame)
        self._missing = [count + (image is None) for count, image in zip(self._missing, images, strict=True)]
        self._predict(single, motion)  # speed and yaw rate
        self.stages.lap("prediction")
        if any(image is not None and image.shape[:2] != self._size for image in images):
            return self._tracking.lost_estimate(single)
        if images[0] is not None and self._width.step(images[0]):
            self._look_for(self._width.width_m)
        self.stages.lap("width")
        grey = [None if image is None else _grey(image) for image in images]
        place = self._pair.ahead(self._rows_m)
        stripes = self._stripes(grey, place)  # marking extraction, stripe models
        self.stages.lap("stripes")
        lines = self._on_ground(grey, stripes, place)  # epipolar matching, ground plane, re-projection onto it
        if self.trouble:
            self._off += 1
            return self._tracking.lost_estimate(single)
        if self._tracking.lost:
            self._changes.reset()
            belief = self._start(frame.t_ns, images[0], lines)
            if belief is None:
                self._pair.forget()
                return self._tracking.lost_estimate(single)
            self._pair.start(belief.mean, belief.spread)
        followed = self._fit(lines)  # parabola pair
        self.stages.lap("lane")
        if self._tracking.looks_around(followed):  # which of all lines in view are the lane's?
            anew = self._tracking.judge(self._sighted(lines), followed)
            if anew is not None:
                self._pair.start(anew.mean, anew.spread)
                followed = self._fit(lines)
            self.stages.lap("doubt")
        estimate = self._tracking.follow(single, followed)
        if self._options.lane_changes:  # has the car driven into the next lane?
            estimate = self._change_lane(single, estimate, lines)
        if self._tracking.lost:
            self._pair.forget()
        self.stages.lap("estimate")
        return estimate

    def _warm_up(self) -> None:
        """Compile everything that a step calls, so that no step waits for it: a lane is seen, and forgotten."""
        left, right = (self._drawn_lane(eye) for eye in (self._rig.left, self._rig.right))
        for index in range(2):
            pair = StereoFrame(t_ns=33_000_000 * index, index=index, left=left, right=right)
            self.step(pair, Motion(t_ns=pair.t_ns, speed_mps=0.0, yaw_rate_radps=0.0))
        found = self._found
        if found is not None:
            one, other = found.stripes
            mirrored(one, np.arange(len(one.stripe)) < 1, pair.left, other.eye, pair.right)
        self.reset()

    def _drawn_lane(self, eye: GroundCamera) -> Image:
        """What an eye sees of both lines of a straight lane in whose middle the car is."""
        rows, columns = np.indices(self._size).reshape(2, -1)
        left_m = eye.px_to_ground(np.stack((columns, rows), axis=-1).astype(np.float64))[:, 1]
        paint = np.abs(np.abs(left_m) - 0.5 * self._unit) < 0.5 * self._marking_m
        return np.where(paint, 200, 50).astype(np.uint8).reshape(self._size)

    def _predict(self, frame: Frame, motion: Motion) -> None:
        """Move the lane by the odometry since the last frame; a gap, or time that goes back, drops it."""
        moved = self._tracking.predict(frame, motion)
        if moved is None or self._tracking.lost:
            self._pair.forget()
        else:
            self._pair.move(moved.distance_m, moved.turn_rad, moved.dt_s, moved.known)
        for eye in self._reflections:
            eye.turned(moved.turn_rad if moved is not None and moved.known else None)
        settles_s = self._plane.config.settles_s
        dt_s = settles_s if moved is None else moved.dt_s
        self._plane.predict(dt_s, self._one_eyed)
        self._lasts = max(settles_s / max(dt_s, 1e-3), 1.0)

    def _stripes(self, images: Sequence[Image | None], place: Complexes) -> tuple[Stripes, Stripes]:
        """The stripes of both images about the predicted centerline, of that polarity that shows more of them."""
        eyes = self._rig.over(self._plane.plane)
        pairs = [
            tuple(
                Stripes.none(eye) if image is None else search.look(image, eye, place)
                for image, eye in zip(images, eyes, strict=True)
            )
            for search in self._searches
        ]
        left, right = max(pairs, key=lambda pair: sum(len(stripes.stripe) for stripes in pair))
        if left.count or right.count:
            self._pairs += 1
            both = zip(self._blind, (left, right), images, strict=True)
            self._blind = [n + (image is not None and not one.count) for n, one, image in both]
        return left, right

    def _on_ground(
        self, images: Sequence[Image | None], stripes: tuple[Stripes, Stripes], place: Complexes
    ) -> list[FloatArray]:
        """The lines on the ground (k, 2) [m], on the plane that the matches of this pair and of those before tell."""
        (left, right), middle, predicted = stripes, self._rig.middle_m, self._plane.plane
        known_m = self._plane.height_sigma_m(on_ground(left.eye, left.directions) - middle[:2])
        matches = match(left, right, known_m, NOISE_PX)
        self.stages.lap("matching")
        row_m = np.diff(self._rows_m).mean()
        fit = fit_plane(
            matches,
            np.stack((left.eye.centre_m, right.eye.centre_m)),
            middle,
            self._plane.covariance,
            NOISE_PX,
            min(row_m / self._spacing_m, 1.0),
        )
        self._one_eyed = not fit.inliers.any()
        self.plane_reach_m = float(matches.points_m[fit.inliers, 0].max(initial=0.0))
        self._plane.update(fit.step, fit.covariance)
        turn = self._plane.plane.level_from_body @ predicted.level_from_body.T
        for one, camera in zip(stripes, self._rig.over(self._plane.plane), strict=True):
            one.directions, one.eye = one.directions @ turn.T, Eye.of(camera)
        self.stages.lap("plane")
        odds = np.concatenate([self._odds(eye, stripes, images) for eye in (0, 1)])
        lines = reconstruct(left, right, matches, fit.inliers, odds, self._spacing_m)
        self._found = PairStages(
            seen=(images[0] is not None, images[1] is not None),
            stripes=stripes,
            predicted=predicted,
            place=place,
            matches=matches,
            inliers=fit.inliers,
            odds=odds,
            lines=lines,
        )
        self.stages.lap("lines")
        return lines

    def _odds(self, eye: int, stripes: tuple[Stripes, Stripes], images: Sequence[Image | None]) -> FloatArray:
        """Log-odds (k,) [nats] that the stripes of one eye (0: left, 1: right) are paint on the ground.

        The other image tells; where that says little, whether a stripe is the reflection of a lamp.
        """
        (one, other), (image, other_image) = (stripes[eye], stripes[1 - eye]), (images[eye], images[1 - eye])
        odds = np.zeros(one.count)
        if image is None:
            return odds
        if other.count and other_image is not None:  # else it may be blind
            known_m = self._plane.height_sigma_m(on_ground(one.eye, one.directions) - self._rig.middle_m[:2])
            odds = log_odds(one, witnesses(one, other, (image, other_image), known_m, NOISE_PX))
        camera, reflections = (self._rig.left, self._rig.right)[eye], self._reflections[eye]
        at_rest = Eye.of(camera)
        ground = on_ground(at_rest, bearings(at_rest, one.pixels))
        pointing = radial(ground, one.stripe, camera.centre_m[:2], reflections.config.pointing_rad)
        for k in np.flatnonzero((odds >= 0.0) & (odds < SURE) & (pointing >= 0.5)).tolist():
            its = one.stripe == k
            if other_image is not None and mirrored(one, its, image, other.eye, other_image) > ALIKE:
                odds[k] = -math.inf
            else:
                profiles = ground[its][self._in_view(at_rest, ground[its])][::2]
                if len(profiles) and reflections.on_streaks(image, profiles).mean() > 0.5:
                    odds[k] = -math.inf
        return odds

    def _in_view(self, eye: Eye, ground_m: FloatArray) -> Bools:
        """Whether all of a profile across the ground (n, 2) [m] is in view (n,)."""
        aside = np.array((0.0, (self._reflections[0].config.reach + 0.5) * self._marking_m))
        ends = np.stack((images_of_ground(eye, ground_m + aside), images_of_ground(eye, ground_m - aside)))
        last = np.array((self._size[1] - 1.0, self._size[0] - 1.0))
        return np.asarray(((ends >= 0.0) & (ends <= last)).all(axis=(0, 2)), dtype=np.bool_)

    def _sighted(self, lines: list[FloatArray]) -> tuple[SightedLine, ...]:
        """The lines of the whole view among which the lane's are looked for: none that leads across."""
        ends = [points[-1] - points[0] for points in lines]
        ahead = [points for points, (x, y) in zip(lines, ends, strict=True) if abs(y) < LineScan.SLOPE * abs(x)]
        return self._scan.of_stripes(ahead)

    def _start(self, t_ns: int, image: Image | None, lines: list[FloatArray]) -> LaneBelief | None:
        """A lane to start with: the pair that the lines in view make, or line integrals where all bends are wide.

        The integrals are those of the left camera's `image`.
        """
        start = self._tracking.start(t_ns, self._sighted(lines))
        gentle = None if image is None else self._gentle.step(image)
        self.stages.lap("start")
        if gentle is None:
            return start
        self._pair.start(gentle.belief.mean, gentle.belief.spread)
        self._tracking.begin(t_ns, self._fit(lines).pose)
        return gentle.belief

    def _fit(self, lines: list[FloatArray]) -> Followed:
        """The parabola pair fitted to the lines on it, and what is seen of it."""
        sides = self._pair.sides_of(lines)
        mine = np.flatnonzero(sides)
        points = np.concatenate((*(lines[k] for k in mine.tolist()), np.empty((0, 2))))
        counts = np.array([len(lines[k]) for k in mine.tolist()], dtype=np.intp)
        side = np.repeat(sides[mine], counts)
        good = self._pair.update(points, side, self._sigma_m(points, np.repeat(counts, counts)))
        left, right = points[good & (side > 0.0)], points[good & (side < 0.0)]
        state, covariance = self._pair.state, self._pair.covariance
        sign = np.array((1.0, -1.0, 1.0))
        order = np.ix_((Part.OFFSET, Part.THETA, Part.WIDTH), (Part.OFFSET, Part.THETA, Part.WIDTH))
        return Followed(
            pose=LanePose(
                offset_m=float(state[Part.OFFSET]),
                heading_rad=-float(state[Part.THETA]),
                width_m=float(state[Part.WIDTH]),
                curvature_per_m=self._pair.curvature_per_m,
                covariance=covariance[order] * np.outer(sign, sign),
            ),
            left=self._line(left, +0.5),
            right=self._line(right, -0.5),
            centerline=self._pair.curve(0.0),
        )

    def _change_lane(self, frame: Frame, estimate: LaneEstimate, lines: list[FloatArray]) -> LaneEstimate:
        """The estimate of the next lane, where the car is on its way there and both of its lines are seen."""
        side = 0 if estimate.pose is None else self._changes.due(estimate.pose)
        if not side or self._tracking.in_doubt:
            return estimate
        before = self._pair.state, self._pair.covariance
        self._pair.change_lane(side)
        followed = self._fit(lines)
        if not (followed.left.seen and followed.right.seen):  # there may be no lane
            self._pair.state, self._pair.covariance = before
            return estimate
        self._tracking.change_lane(side)
        self._changes.changed(side)
        return replace(self._tracking.follow(frame, followed), lane_change=side)

    def _sigma_m(self, points_m: FloatArray, together: Ints) -> FloatArray:
        """Lateral standard deviations (n,) [m] of knots: of paint and pixels, and by the plane's uncertainty.

        `together` (n,): the knots of each one's line, which share errors: a whole line can be one wrong thing, and lies
        on one plane; as many knots are no more witnesses than one.
        """
        middle, road = self._rig.middle_m, self._tracking.road
        away = points_m - middle[:2]
        pixel = NOISE_PX * np.hypot(*away.T) / self._rig.left.camera.matrix[0, 0]
        tilted = away[:, 1] / middle[2] * self._plane.height_sigma_m(away)
        shared = together * ((road.line_sigma * self._unit) ** 2 + self._lasts * tilted**2)
        return np.sqrt((road.point_markings * road.marking_width_m) ** 2 + pixel**2 + shared)

    def _line(self, points_m: FloatArray, lanes: float) -> LaneLine:
        seen = len(points_m) >= SEEN
        return LaneLine(curve=self._pair.curve(lanes), points_m=points_m[: len(points_m) * seen], seen=seen)

    @staticmethod
    def rig(car: CarConfig) -> StereoRig:
        """Both cameras of a car; raises ValueError without a second one, and for two at the same place."""
        if car.camera.right is None:
            raise ValueError(
                "needs two cameras: car.toml has no [camera.right.intrinsics] and [camera.right.extrinsics]"
            )
        if car.camera.right.device is not None and car.camera.source != "sim" and not car.camera.right.measured():
            raise ValueError(
                "[camera.right] has a device, and its lens or its place is not given: calibrate the right camera "
                "(automodel calibrate stereo)"
            )
        rig = StereoRig(*map(GroundCamera.from_config, car.camera.eyes))
        if rig.baseline_m < 1e-3:
            raise ValueError("[camera.right.extrinsics]: both cameras are at the same place; nothing can be measured")
        return rig

    def _stations(self, near_m: float) -> FloatArray:
        """Arc lengths (n,) [m] ahead of the reference point, so that their rows are about even in the image."""
        back = float(self._rig.middle_m[2]) + self._reference_x_m - float(self._rig.middle_m[0])
        return np.geomspace(near_m + back, self._far_m + back, self._options.rows) - back


def _images(frame: Frame | StereoFrame) -> tuple[Frame, tuple[Image | None, Image | None]]:
    """One camera's frame, the left one's where it is there, and the images of both; None for one that is missing."""
    if isinstance(frame, Frame):
        return frame, (None, frame.image) if frame.eye else (frame.image, None)
    return Frame(t_ns=frame.t_ns, index=frame.index, image=frame.left), (frame.left, frame.right)


def _grey(image: Image) -> Image:
    if image.ndim == 2:
        return image
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    grey.flags.writeable = False  # as a frame's images are: of the one kind that is compiled
    return grey
