"""The lane between frames: followed, in doubt or lost; what is told of it, and how far it may be wrong.

A pipeline's own estimator follows the lane. Where it may take another line for the lane's (nothing was seen for a
while, or what it says contradicts the odometry) its word is one story among others: the whole view is searched for
lines, and hypotheses compete until one is left. If that is what the estimator says, the doubt is over; if not, the
estimator starts anew from it. The kinds of the lines beside the lane tell whether it is still the same one.

What is told of the lane is what the estimator says, as long as it sees lines that reach to the car. Where it only
extrapolates, what is believed is told, which has learnt from the same lines and forgets nothing, and the estimator is
put there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from automodel.config import CarConfig
from automodel.curves import Curve
from automodel.estimation.checked_odometry import CheckedOdometry
from automodel.estimation.road import TAPER
from automodel.geometry import GroundCamera
from automodel.perception.line_scan import LineScan, ScanConfig, SightedLine
from automodel.signals import (
    EXCEEDED,
    Crossing,
    Frame,
    LaneEstimate,
    LaneLine,
    LanePose,
    LaneStatus,
    Motion,
    MotionSource,
)
from automodel.tracking.belief import Assigned, Evidence, LaneBelief, LearntRoad, RoadModel, warm_up
from automodel.tracking.evidence import most_misfit
from automodel.tracking.frame_motion import FrameMotion, FrameMotions
from automodel.tracking.hypotheses import STILL_LANES, Hypotheses, HypothesesConfig, Hypothesis, LineKinds
from automodel.tracking.integrity import ANGLE_RAD, CameraErrors, Innovations, K, bound, chi_square, sigmas
from automodel.tracking.lane_motion import Part
from automodel.tracking.rivals import Rivals
from automodel.tracking.road_profile import LEFT_LANE, RIGHT_LANE, SAME, SLOTS, RoadProfile
from automodel.tracking.still_paint import StillPaint
from automodel.tracking.stories import LEFT, LEFT_FAR, RIGHT, RIGHT_FAR
from automodel.types import Bools, FloatArray

STATUS = (LaneStatus.COASTING, LaneStatus.ONE_LINE, LaneStatus.TRACKING)  # by the number of lines seen
LEARNT_POINTS = 5  # of a line that the belief learns from; up to twice as many, because every n-th is taken
RIDGE_PX = 0.33  # to which the middle of a line is measured: assumed
TOLD = 4.0  # [nats] of what car.toml says of a line: it is wrong once in 50 times
SLIGHT = 0.5  # of the sigma of a camera's pitch: less is not worth measuring anew
MOST_HEADING_RAD = math.atan(LineScan.SLOPE)  # of a car that drives in its lane: more is across
FAR_OFF = sigmas(EXCEEDED * EXCEEDED)  # of it, which happen to one camera in a million: such lines are not parallel
DASH_ODDS = {"any": 0.0, "dashed": TOLD, "solid": -TOLD}


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingConfig:
    """`coast_s`, `coast_lanes`: time, and distance in lane widths, for which a lane lives without any line.

    `bend`: sigma of the curvature [1 / lane width] beside the car.
    `gate`: squared innovation of offset and heading that happens once in a million frames (chi-square, two degrees of
    freedom); `contradicts`: as seldom as a bound may be exceeded, what lines move by against the odometry; `differs`:
    once in a hundred, with the width too once in forty. `fits`: misfit of a line's points that happens once in a
    thousand true lines of nine points, the most (as of Student's errors). `unsure`: what all others may have together
    beside the hypothesis that a lane starts with, in doubt, or that lines teach; a doubt ends with all but what a bound
    may leave out.
    `exists`: log-odds [nats] that it, or what a look at all lines finds, must have against clutter: those of a bound.
    `start`: sigma of a car's offset [lane widths], heading [rad] and bend [1 / lane width] where nothing is known.
    `look`: lane widths from one look at the whole view to the next where both lines are followed; infinite for a
    pipeline that reads few pixels, which learns the lines' kinds where it looks anyway. `glance`: where they are not.
    `another`: probability by the lines' kinds from which on a lane is another one than it was, and below which it may
    be. `next_lane`: probability that a lane that is found after one was lost is another. `hypotheses`: how lines in
    view are weighed.
    """

    coast_s: float
    coast_lanes: float
    bend: float = 0.1
    fits: float = most_misfit(2 * LEARNT_POINTS - 1, EXCEEDED)
    unsure: float = 0.01
    gate: float = chi_square(EXCEEDED * EXCEEDED)
    contradicts: float = chi_square(EXCEEDED)
    differs: float = chi_square(unsure)
    exists: float = -math.log(EXCEEDED)
    start: float = 0.25
    look: float = 1.0
    glance: float = 0.25
    another: float = 0.9
    next_lane: float = 0.3
    hypotheses: HypothesesConfig = field(default_factory=HypothesesConfig)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Followed:
    """What a pipeline's estimator says of the lane in a frame; `pose` states no bounds yet."""

    pose: LanePose
    left: LaneLine
    right: LaneLine
    centerline: Curve
    crossing: Crossing | None = None


class LaneTracking:
    """One lane from frame to frame, for one pipeline.

    In each frame: `predict`; while `lost`, `start` with the lines of the whole view, or `begin` with what another
    search found; while `in_doubt`, `judge`, which may say where the estimator must start anew; then
    `follow`. `ahead_m`: how far ahead of the reference point the curves reach that the belief gives.
    """

    def __init__(self, car: CarConfig, config: TrackingConfig, ahead_m: float) -> None:
        self.config, self._unit, self._reference_x_m = config, car.lane.width_m, car.vehicle.reference_x_m
        self._ahead_m = ahead_m
        camera = self._as_configured = GroundCamera.from_config(car.camera)
        self._errors = CameraErrors(car.camera, car.lane.width_m, self._reference_x_m)
        road = RoadModel(
            lane_width_m=car.lane.width_m,
            marking_width_m=car.lane.marking_width_m,
            eye_m=(float(camera.centre_m[0]), float(camera.centre_m[2])),
            pitch_rad=ANGLE_RAD,
            pixel_rad=RIDGE_PX / car.camera.intrinsics.fx_px,
            radius_lanes=car.pipeline.contour.radius_lanes,
        )
        if car.lane.width_sigma_m > 0.0:  # a lane that was measured; the camera may still see it larger or smaller
            measured = math.hypot(car.lane.width_sigma_m / car.lane.width_m, self._errors.scale)
            road = replace(road, width_sigma=min(measured, road.width_sigma))
        self._learnt_road = LearntRoad(road)
        self._kinds = LineKinds(DASH_ODDS[car.lane.left], DASH_ODDS[car.lane.right])
        self._profile = RoadProfile()
        self._odometry = CheckedOdometry(camera, self._unit)
        self._see_with(camera)
        self._motions, self._given = FrameMotions(self._unit), FrameMotions(self._unit)
        self._innovations = Innovations()
        self._paint = StillPaint(self._unit)
        self._unmoved: LaneBelief | None = None  # the lane by odometry, since its lines began to contradict that
        self._hypotheses = Hypotheses(self.config.hypotheses)
        self._rivals = Rivals(self.config.hypotheses, road.width_sigma)
        warm_up()
        self.reset()

    def reset(self) -> None:
        """Forget everything but the configuration."""
        if self.pitch_rad:
            self._see_with(self._as_configured)
        self._odometry.reset()
        self._motions.reset()
        self._given.reset()
        self._learnt_road.reset()
        self._profile.reset()
        self._lines_seen = 0  # of the lane's, in the last frame
        self._t_ns = self._started_ns = self._learnt_ns = 0
        self._seen_ns = self._borne_out_ns = 0  # a line, last, by the estimator; by what is believed
        self._belief: LaneBelief | None = None
        self._without_lane_m = 0.0  # driven without a lane, since a person has put the car into its own
        self.forget()

    def forget(self) -> None:
        """Forget the lane."""
        if self._belief is not None:
            self._profile.fade(self.config.next_lane)
            self._without_lane_m = math.inf
        self._belief = None
        self._reckoned: LaneBelief | None = None  # by odometry alone, since the doubt began
        self._on_any_road: LaneBelief | None = None  # the same where the road may have become another one
        self._said = 0.0  # log-odds [nats] of what the estimator says, since the doubt began
        self._hypotheses.start(())
        self._innovations.reset()
        self._forget_paint()
        self._learnt_road.lose()
        self.in_doubt = False
        self.reckons = False  # whether the last frame's motion is the odometry's
        self._marked: LaneBelief | None = None  # where its lines began to look as if they were not parallel
        self._marked_m = 0.0  # driven since then
        self._story: LaneBelief | None = None  # in doubt, what is likelier than what the estimator says
        self._told_ns = -1  # when both lines told the lane last, in doubt
        self._outvoted = False  # whether the estimator's pose differs from what is believed
        self._blind_m = 0.0
        self._news_m = math.inf  # driven since the last frame that was a witness
        self._around_m = 0.0  # driven since the last look at all lines in view
        self._rivals_m = 0.0  # the same, for what runs beside the lane's own
        self._pair_m = 0.0  # driven with both lines seen
        self._rivals.reset()
        self._beside = False  # whether the car is in the next lane, which it has taken for its own

    @property
    def paired(self) -> bool:
        """Whether both lines were seen for a lane width of way: a lone line, or a chance pair, may be anything.

        Not that of the first lane, if its lines are both in view before the car has driven so far: a person has put
        the car there.
        """
        return self._pair_m >= self._unit

    @property
    def road(self) -> RoadModel:
        """What the road is like, with what was learnt of its bends."""
        return self._learnt_road.road

    @property
    def lost(self) -> bool:
        """Whether there is no lane."""
        return self._belief is None

    def predict(self, frame: Frame, motion: Motion) -> FrameMotion | None:
        """The motion since the last frame; None for the first frame and after a gap, when the lane is forgotten.

        It is that of the ground in the images where no odometry gives it, or where that is wrong.
        """
        self._t_ns = frame.t_ns
        given = self._given.step(frame.t_ns, motion)
        motion = self._odometry.step(frame, motion)
        moved = self._motions.step(frame.t_ns, motion)
        if moved is None or given is None:
            self.forget()
            return None
        before, driven = self._belief, abs(moved.distance_m)
        if not moved.known:
            driven = self.road.lost_pace * self._unit * moved.dt_s
        if before is None:
            self._without_lane_m += driven
        self._paint.move(given)
        if self._unmoved is not None:
            self._unmoved = self._unmoved.moved(given.distance_m, given.turn_rad, given.dt_s, given.known)
        if self._hypotheses.all or before is not None:  # a lane, or what may become one
            step = moved.distance_m, moved.turn_rad, moved.dt_s, moved.known
            self._hypotheses.move(self.road, *step)
            if before is not None:
                self._belief = before.moved(*step)
            if self._reckoned is not None and self._on_any_road is not None:
                self._reckoned, self._on_any_road = self._reckoned.moved(*step), self._on_any_road.moved(*step)
            self._blind_m += driven
            # By a wrong pitch the ground contradicts an odometry that is right; an unknown motion tells nothing.
            self._marked_m += (moved if moved.known else given).distance_m
            passed = max(driven, STILL_LANES * self._unit * moved.dt_s)  # also where the odometry stands still
            self._news_m += passed
            self._around_m += passed
            self._rivals_m += passed
            self._learnt_road.move(math.copysign(driven, moved.distance_m), moved.turn_rad, motion.source)
            if not moved.known:
                self._learnt_road.lose()
            self._profile.move(driven / self._unit, self._lines_seen)
        self.reckons = moved.known and motion.source is not MotionSource.IMAGES
        if before is not None and self._odometry.wrong:  # it has moved the lane away from its lines
            known = self._on_any_way(before)  # its lines bore out the motion until then
            if self._confusable(known):  # it may be another one: the car's is looked for anew
                self.forget()
            else:
                self._doubt(known)
        return moved

    def turn_camera(self) -> LaneBelief | None:
        """What is believed by the camera as it is, where the lane has shown that it is not as it was taken to be.

        Its lines are not parallel ahead of the car, nor has the lane got as much wider or narrower as they say by the
        time that the car is there: then it would be the road. `camera` is that from then on, and a pipeline must
        measure by it anew.
        """
        belief, marked = self._belief, self._marked
        if belief is None or self.in_doubt:
            self._marked = None
            return None
        pitch, sigma = belief.pitch_rad
        if abs(pitch) < max(K * sigma, SLIGHT * ANGLE_RAD) or abs(self.pitch_rad + pitch) > FAR_OFF * ANGLE_RAD:
            self._marked = None
            return None
        if marked is None:
            self._marked, self._marked_m = belief, 0.0
            return None
        told_m = belief.width_m * pitch / belief.road.eye_m[1] * self._marked_m
        variance = belief.sigma(Part.WIDTH) ** 2 + marked.sigma(Part.WIDTH) ** 2
        odds = told_m * (0.5 * told_m - (belief.width_m - marked.width_m)) / variance  # that it is not the road
        if abs(odds) < self.config.exists:
            return None
        self._marked = None
        if odds < 0.0:
            return None
        try:
            self._see_with(self.camera.pitched(pitch))
        except ValueError:  # it would see no ground
            return None
        self._belief = belief.pitched()
        self._paint.reset()  # it was seen by the camera as it was taken to be
        return self._belief

    def _see_with(self, camera: GroundCamera) -> None:
        self._near_m = max(camera.first_visible_x_m() - self._reference_x_m, 0.5 * self._unit)
        self.camera = camera
        self.pitch_rad = camera.extrinsics.pitch_rad - self._as_configured.extrinsics.pitch_rad
        self._odometry.see_with(camera)

    @property
    def warning(self) -> str:
        """One line where the camera's pitch is not what is configured, else empty."""
        if not self.pitch_rad:
            return ""
        configured, used = (one.extrinsics.pitch_rad for one in (self._as_configured, self.camera))
        return (
            f"[camera.extrinsics] pitch_rad = {configured:.3f}: the lane's lines are parallel at {used:.3f}, which is"
            " used; correct car.toml"
        )

    def change_lane(self, side: int) -> None:
        """The neighbour lane on a side, +1 left or -1 right, becomes the lane; not while this one is in doubt."""
        if self._belief is None or self.in_doubt:
            raise ValueError("a lane that is lost or in doubt has no neighbour")
        self._belief = self._belief.beside_it(side)
        self._forget_paint()
        self._profile.change_lane(side)
        self._innovations.reset()
        self._rivals.reset()

    def start(self, t_ns: int, lines: tuple[SightedLine, ...]) -> LaneBelief | None:
        """A lane to start with, from the lines of this frame and of those since it was lost; None while none is sure.

        The lane is the one that the car is in: it may stand anywhere there, in any direction that is not across. Where
        one of its lines is all that is in view, or it is only likely, it is in doubt. After a lane was lost, it may be
        the next one.
        """
        if not self._hypotheses.all:
            self._hypotheses.start(((self._anywhere(), 0.0),))
        self._hypotheses.update(lines, self._learnt_kinds)
        self._hypotheses.condition(_inside)
        best = self._hypotheses.best
        if abs(best.belief.offset_m) > 0.5 * best.belief.width_m:
            self._hypotheses.start(())
            return None
        roles = {role for _, role in best.assigned}
        if self._sure(best):
            self._believe(best.belief)
        elif self._likely(best) and (self._is_lane(best) or (roles & {LEFT, RIGHT} and not best.bounds_a_lane)):
            self._reckon(self._anywhere())
        else:
            return None
        self._started_ns = self._seen_ns = t_ns
        both = min(roles, default=0.0) < 0.0 < max(roles, default=0.0)
        placed = self._without_lane_m < self._unit
        self._pair_m = self._unit if placed and both and best.bounds_a_lane else 0.0
        return best.belief

    def begin(self, t_ns: int, pose: LanePose) -> None:
        """Begin with a lane that another search found.

        It is in doubt, unless its `pose` may be that of the lane that `start` returned for the same frame.
        """
        self._started_ns, self._seen_ns, known = t_ns, t_ns, self._belief
        if known is not None and self._apart(self._measured(pose), known) < self.config.gate:
            return
        self._pair_m, self._belief = 0.0, None
        self._reckon(self._anywhere())
        self._hypotheses.start(((self._anywhere(), 0.0),))

    @property
    def _learnt_kinds(self) -> LineKinds:
        """The kinds of the lane's lines by car.toml, and by what was seen of them before the doubt."""
        (left, right), told = self._profile.dashed, self._kinds
        return LineKinds(left + told.left, right + told.right)

    def _anywhere(self) -> LaneBelief:
        config, unit = self.config, self._unit
        sigma = (
            config.start * unit,
            config.start,
            config.start / unit,
            self.road.width_sigma * unit,
        )
        mean = np.array((0.0, 0.0, 0.0, unit))
        return LaneBelief.arc(mean, np.diag(np.square(sigma)), self.road, self._reference_x_m)

    def judge(self, lines: tuple[SightedLine, ...], followed: Followed) -> LaneBelief | None:
        """Weigh all lines in view, and where the estimator must start anew; None where it may go on or nothing is sure.

        One that says what cannot be must, where the odometry or the lines still tell the lane. What it says is a
        hypothesis, too: unlikely by as much as it differs from dead reckoning, likely by what it explains.
        """
        if not self._possible(followed.pose):
            self._said = 0.0
            known = self._known()
            return known or self._by_lines(lines) or self._lately_known()
        if self._reckoned is None or self._on_any_road is None:
            outvoted, self._outvoted = self._outvoted, False
            if outvoted and self._strays(followed):
                return self._belief
            plain, due = followed.left.seen and followed.right.seen, outvoted or self._looks_again(followed)
            belief, others = self._belief, lines
            if belief is not None:
                others = self._rivals.others(belief, lines)
                news, self._rivals_m = float(self.road.news_of(1, self._rivals_m / self._unit)[0]), 0.0
                self._rivals.look(belief, lines, news, partial(self._in_view_m, belief))
            if not due:
                return None
            return self._recognise(others) if plain else self._watch(others, followed)
        own = [line.points_m for line, _ in _sides(followed) if line.seen]
        seen = self._together(lines, own)
        lane = self._hypotheses.best.belief if self._certain else self._reckoned
        if not self._confusable(lane):  # what was another thing before the doubt is none of its lines now
            seen, lines = self._rivals.others(lane, seen), self._rivals.others(lane, lines)
        self._hypotheses.displace(lambda belief: self._confusable(belief, 1.0))
        kinds = self._learnt_kinds
        share = self._hypotheses.update(seen, kinds)
        best, measured = self._hypotheses.best, self._measured(followed.pose)
        alone = Hypotheses(self.config.hypotheses)
        alone.start(((measured, 0.0),))
        alone.update(seen, kinds, picked=False)
        self._said += share * alone.all[0].log_odds
        said = self._said - 0.5 * min(self._apart(measured, self._on_any_road), self.config.gate)
        explains = best.assigned or not alone.all[0].assigned
        likelier = bool(explains) and best.log_odds > max(said, 0.0)
        blind = not own and not self._confusable(self._reckoned, 1.0)
        story = best.belief if likelier else self._reckoned if blind else None
        self._story = story if story is not None and self._possible(story.pose) else None
        lane_in_view = best.news > self.config.exists and self._is_lane(best)
        if lane_in_view and self._hypotheses.agree and self._at_once(best.belief, seen):
            self._told_ns = self._t_ns
        apart = self._apart(measured, best.belief)
        agreed = apart < self.config.gate and self._certain
        clear = not self._confusable(self._reckoned)
        told = agreed and self._tells(best)
        better = self._place_variance(best.belief) < self._place_variance(measured) and apart > self.config.differs
        better = better and len(own) < 2 and best.news > alone.all[0].news  # who sees both lines knows the width
        if told and not better and (own or self._sure(best)):
            self._believe(best.belief, best.assigned)
            if best.log_odds > said and self._is_misled(followed, lines, best):
                return best.belief
        elif own and not told and said > self._least(best, agreed, clear or len(own) > 1):
            self._believe(alone.all[0].belief, alone.all[0].assigned)
        elif (
            self._sure(best)
            and self._certain
            and (not own or self._beats(best, said, alone.all[0].news))
            and self._at_once(best.belief, seen)
        ):
            self._believe(best.belief, best.assigned)
            if apart <= self.config.differs and not self._vaguer(measured, best.belief):
                return None
            return best.belief
        elif not own and self._is_elsewhere(measured, best):
            return best.belief
        elif likelier and self._is_dead(followed, apart, said, best):
            self._said = 0.0
            return self._story
        elif self._refuted(followed, measured) if own else self._strays(followed):
            self._said = 0.0
            return self._reckoned
        return None

    def _known(self) -> LaneBelief | None:
        """Where dead reckoning or this frame's lines have the lane; None where neither does or the car has left it."""
        known = self._reckoned if self.in_doubt else self._belief
        told = self._trusts or (not self.in_doubt and self._learnt_ns == self._t_ns)
        if known is None or not told or self._confusable(known) or not self._possible(known.pose):
            return None
        return known

    def _lately_known(self) -> LaneBelief | None:
        """Where the lane is, in doubt, whatever the motion since its lines were last seen; None if it may be anywhere.

        A motion that is suspected is no reason to forget a lane that was seen a moment ago.
        """
        if self._belief is None:
            return None
        known = self._on_any_way(self._belief)
        if self._confusable(known) or not self._possible(known.pose):
            return None
        self._doubt(known)
        return known

    def _on_any_way(self, belief: LaneBelief) -> LaneBelief:
        """A belief whose motion since it last learnt may have been any, but the same all the time.

        Its sigma grows with the time t, while that of a walk, which `LaneBelief.moved` takes, grows with its root.
        """
        since_s = (self._t_ns - self._learnt_ns) * 1e-9
        return belief.without_road().moved(0.0, 0.0, since_s * since_s, False)

    def _by_lines(self, lines: tuple[SightedLine, ...]) -> LaneBelief | None:
        """The lane by the lines in view alone, if they tell it, whatever an estimator or dead reckoning says."""
        if not self.in_doubt:
            if self._belief is None:
                return None
            self._doubt(self._belief)
        self._hypotheses.update(lines, self._learnt_kinds)
        best = self._hypotheses.best
        if not (self._certain and self._tells(best) and self._possible(best.belief.pose)):
            return None
        self._believe(best.belief, best.assigned)
        self._borne_out_ns, self._blind_m = self._t_ns, 0.0
        return best.belief

    @property
    def _certain(self) -> bool:
        """Whether one hypothesis is left, so that a bound that drops the others holds."""
        return self._hypotheses.certainty > 1.0 - EXCEEDED

    def _tells(self, best: Hypothesis) -> bool:
        """Whether lines bear out a hypothesis, and it tells its lane from the next one."""
        exists = best.log_odds > self.config.exists and not self._confusable(best.belief)
        return exists and (best.placed or best.bounds_a_lane)

    @property
    def _trusts(self) -> bool:
        """Whether the motion is an odometry's that nothing seen has contradicted since the ground bore it out."""
        return self.reckons and self._odometry.borne_out

    def _at_once(self, belief: LaneBelief, seen: tuple[SightedLine, ...]) -> bool:
        """Whether one frame's lines say the same against dead reckoning alone, as surely as a bound must hold.

        What is seen again and again, a zebra's bar beside a reflection, draws a belief away step by step. Dead
        reckoning may be wrong, too.
        """
        assert self._reckoned is not None
        assert self._on_any_road is not None
        look = Hypotheses(self.config.hypotheses)
        others = self._on_any_road, self._anywhere()
        look.start(((self._reckoned, 0.0), *((other, -self.config.exists) for other in others)))
        look.update(seen, self._learnt_kinds)
        best = look.best
        return best.log_odds > -math.log(EXCEEDED) and self._apart(belief, best.belief) < self.config.gate

    def _is_elsewhere(self, measured: LaneBelief, best: Hypothesis) -> bool:
        """Whether an estimator that sees nothing knows less of the lane than lines and dead reckoning do, or otherwise.

        It is put there, and the doubt goes on: what it sees then ends it.
        """
        differs, reckoned = self.config.differs, self._on_any_road
        if reckoned is None or not (self._certain and self._tells(best) and self._possible(best.belief.pose)):
            return False
        elsewhere = self._apart(measured, best.belief) > differs or self._vaguer(measured, best.belief)
        return elsewhere and self._apart(best.belief, reckoned) < differs

    def _is_dead(self, followed: Followed, apart: float, said: float, best: Hypothesis) -> bool:
        """Whether what the estimator says, by these odds, is another story than the best, and so unlikely that it dies.

        Who sees both lines from the car on knows better than that.
        """
        exists = self.config.exists
        dead = best.log_odds > max(said + 2.0 * exists, exists) and apart > self.config.gate
        return dead and self._trusts and not self._is_plain(followed)

    def _refuted(self, followed: Followed, measured: LaneBelief) -> bool:
        """Whether dead reckoning knows the lane, and the estimator says otherwise without a line that bears it out.

        It may see a bend that begins or ends, which dead reckoning on the road as it was seen does not know. Who sees
        both lines from the car on knows better than dead reckoning.
        """
        reckoned = self._on_any_road
        if reckoned is None or not self.reckons or self._confusable(reckoned) or self._is_plain(followed):
            return False
        return self._said < self.config.exists and self._apart(measured, reckoned) > self.config.gate

    def _is_misled(self, followed: Followed, lines: tuple[SightedLine, ...], best: Hypothesis) -> bool:
        """Whether an estimator takes for a line of the lane what neither the best story nor the scan takes for one."""
        other = [line.points_m for line, role in _sides(followed) if line.seen and not best.line(role)]
        return any(self._on_none(points, lines).all() for points in other)

    def _least(self, best: Hypothesis, agreed: bool, clear: bool) -> float:
        """Log-odds [nats] from which on the estimator's word ends the doubt: of one line four times as many."""
        return (1.0 if clear else 4.0) * self.config.exists + (0.0 if agreed else max(best.log_odds, 0.0))

    def _sure(self, best: Hypothesis) -> bool:
        """Whether one hypothesis is left, and the last frame bears it out by both lines of a lane."""
        return self._certain and self._likely(best) and self._is_lane(best)

    def _is_lane(self, best: Hypothesis) -> bool:
        """Whether two lines of the last frame bear out a lane, too certain to be taken for another.

        A single piece of a line can be anything; two at the distance of a lane's lines seldom are. At twice that
        distance they may be the lines of one wide lane, or a street's kerbs.
        """
        own = bool(best.line(LEFT) or best.line(RIGHT)) and best.bounds_a_lane
        width = best.belief.width_m / self._unit
        lane = max(width, 1.0 / width) < math.exp(3.0 * self.road.width_sigma) if width > 0.0 else False
        return own and lane and not self._confusable(best.belief)

    def _likely(self, best: Hypothesis) -> bool:
        """Whether a hypothesis is far likelier than all others, and the last frame speaks for it."""
        return self._hypotheses.certainty > 1.0 - self.config.unsure and best.news > self.config.exists

    def _beats(self, best: Hypothesis, said: float, news: float) -> bool:
        """Whether a hypothesis is far likelier than the estimator's, by all frames and by this one."""
        exists = self.config.exists
        return best.log_odds > max(said, 0.0) + 2.0 * exists and best.news > max(news, 0.0) + exists

    def looks_around(self, followed: Followed) -> bool:
        """Whether `judge` wants the lines of the whole view: where one line is followed, or none, it may be any.

        Where both are, now and then: the lines beside them tell whether it is still the same lane; and when it has
        begun, whether they may be its own.
        """
        if self.lost or self.in_doubt or not self._possible(followed.pose):
            return not self.lost
        beside = not self._rivals.settled and self._rivals_m > self.road.news * self._unit
        return beside or self._looks_again(followed)

    def _looks_again(self, followed: Followed) -> bool:
        plain = followed.left.seen and followed.right.seen and not self._may_be_another
        return self._outvoted or self._around_m > (self.config.look if plain else self.config.glance) * self._unit

    @property
    def _may_be_another(self) -> bool:
        """Whether the lines beside the lane are rather those of the next one."""
        return bool(self._profile.lanes[SAME] < self.config.another)

    def follow(self, frame: Frame, followed: Followed) -> LaneEstimate:
        """The estimate by what the pipeline's estimator says, or by dead reckoning where that cannot be true.

        LOST, and forgotten, where neither knows the lane.
        """
        if not self._possible(followed.pose):
            known = self._known() or self._lately_known()
            if known is None or not _is_finite(followed.pose):
                self.forget()
                return self.lost_estimate(frame)
            left, right = (replace(line, points_m=line.points_m[:0], seen=False) for line, _ in _sides(followed))
            followed = self._by(known, replace(followed, left=left, right=right))
        pose, count = followed.pose, followed.left.seen + followed.right.seen
        self._lines_seen = count
        self._beside = self._beside and abs(pose.offset_m) > 0.5 * pose.width_m
        if self._news_m > self.config.glance * self._unit / 3.0:
            self._see_paint(followed)
        if self._belief is None:
            self._belief, self._learnt_ns = self._measured(pose), frame.t_ns
        elif not self.in_doubt:
            self._check(followed)
        if count:
            knows = not self.in_doubt and self._is_plain(followed)
            self._learnt_road.see(pose.curvature_per_m, pose.heading_rad if knows else None)
            self._seen_ns, self._blind_m = frame.t_ns, 0.0
        if self._too_long(frame.t_ns, count):
            self.forget()
            return self.lost_estimate(frame)
        return self._estimate(frame, STATUS[count], followed)

    def _check(self, followed: Followed) -> None:
        """Learn from the estimator's lines, and doubt it where it contradicts them or they are too few."""
        belief = self._belief
        assert belief is not None
        if self._news_m > self.config.glance * self._unit / 3.0:  # not after `_watch`, which learnt or doubts
            own = [Assigned(_sighted(line.points_m), role) for line, role in _sides(followed) if line.seen]
            evidence, assigned = self._explained(own)
            lines = [line for line, _ in own]
            if len(assigned) < len(own) or len(self._rivals.others(belief, lines)) < len(own):
                self._contradict(belief)
            elif len(assigned) == len((LEFT, RIGHT)):  # a lone line may be anything: `_watch` weighs it with all others
                self._hypotheses.note(lines, self.road)
                belief = evidence.update(assigned, belief.road.news_of(len(assigned), self._news_m / self._unit))
                self._learn(belief, followed, True)
        if not self.in_doubt and self._confusable(belief):
            self._doubt(belief)

    def _see_paint(self, followed: Followed) -> None:
        """Where the lines have moved otherwise than the odometry says, the lane may still be where that has it.

        Either may be wrong. That is so until the lines are back there, or the odometry cannot tell the lane any more.
        In doubt they are the likeliest story's: what the estimator takes for its lines may be anything then. What it
        takes for one where the lane is believed to have the other is none either.
        """
        contradicts, lane = self.config.contradicts, self._measured(followed.pose)
        believed = None if self._belief is None else Evidence(self._belief)
        lines = [
            line.points_m
            if line.seen and (believed is None or believed.nearest_role(_sighted(line.points_m)) == role)
            else line.points_m[:0]
            for line, role in _sides(followed)
        ]
        if self.in_doubt and self._hypotheses.all:
            best = self._hypotheses.best
            lane, none = best.belief, np.empty((0, 2))
            lines = [np.concatenate((none, *(line.points_m for line in best.line(role)))) for role in (LEFT, RIGHT)]
        slip = self._paint.look(lines, self.road, contradicts)
        if slip is not None and slip.square > contradicts:
            self._unmoved = lane.displaced(-slip.left_m, -slip.turn_rad, slip.covariance)
        elif slip is not None and slip.square < self.config.differs:
            self._unmoved = None
        if self._unmoved is not None and self._confusable(self._unmoved):
            self._unmoved = None

    def _forget_paint(self) -> None:
        self._paint.reset()
        self._unmoved = None

    def _explained(self, own: list[Assigned]) -> tuple[Evidence, list[Assigned]]:
        """What speaks best for an estimator's lines, and which of them are explained: by the road, or by a new bend."""
        assert self._belief is not None
        known = Evidence(self._belief.on(self.road))
        best, (explained, odds) = known, known.explained(own, self.config.fits)
        for line, role in own:
            ahead_m = known.departs_m(line, role)
            if ahead_m is not None:
                bending = Evidence(known.belief.of_new_bend(ahead_m))
                by_bend, bend_odds = bending.explained(own, self.config.fits)
                if bend_odds - self.config.exists > odds:
                    best, explained, odds = bending, by_bend, bend_odds - self.config.exists
        return best, explained

    def _watch(self, lines: tuple[SightedLine, ...], followed: Followed) -> LaneBelief | None:
        """Learn from all lines in view, which may fit in more than one way; specks, which lie anywhere, teach nothing.

        Lines that may be the lane's and teach nothing for as long as it takes to see other places begin a doubt, in
        which what they say adds up: the less is known, the less a single frame of a lone line can tell.

        Returns a belief to start anew from where the estimator misses a line.
        """
        belief, measured = self._belief, self._measured(followed.pose)
        assert belief is not None
        self._around_m = 0.0
        own = [line.points_m for line, _ in _sides(followed) if line.seen]
        around, known = Hypotheses(self.config.hypotheses), replace(belief, road=self.road)
        # Its bends may be another thing's, and roads get narrower.
        others = known.without_road(), known.of_any_width()
        around.start(((known, 0.0), *((other, -self.config.exists) for other in others)))
        seen = self._together(lines, own)
        around.update(seen, self._kinds, self._news_m / self._unit)
        best = around.best
        if around.certainty < 1.0 - self.config.unsure or (own and not best.assigned):
            self._contradict(belief)
        elif best.assigned and best.news > self.config.exists:
            self._hypotheses.note(seen, self.road)
            self._learn(best.belief, followed, self._is_pair(belief, best))
            if self._misses(followed, belief, measured, best):
                self._believe(best.belief)
                return best.belief
            if best.line(LEFT) or best.line(RIGHT):
                self._borne_out_ns, self._blind_m = self._t_ns, 0.0
                anew = self._which_lane(best, plain=False)
                if anew is not None:
                    return anew
        elif (own or best.assigned) and self._news_m > self.road.news * self._unit:  # none of them has borne it out
            self._doubt(belief)
        if not self.in_doubt and self._strays(followed):
            return self._belief
        return None

    def _recognise(self, lines: tuple[SightedLine, ...]) -> LaneBelief | None:
        """A belief to start anew from where the lane, whose lines are both seen, is another one than it was."""
        belief = self._belief
        assert belief is not None
        self._around_m = 0.0
        around = Hypotheses(self.config.hypotheses)
        around.start(((replace(belief, road=self.road), 0.0),))
        around.update(lines, LineKinds(), math.inf)
        best = around.best
        return self._which_lane(best, plain=True) if best.line(LEFT) and best.line(RIGHT) else None

    def _which_lane(self, best: Hypothesis, *, plain: bool) -> LaneBelief | None:
        """Learn the road's cross-section by a frame's lines; the lane that was followed, where this is another one."""
        belief = self._belief
        assert belief is not None
        beside = (LEFT_FAR, RIGHT_FAR)
        far = dict(zip(beside, self._in_view_m(belief, beside).tolist(), strict=True)) if plain else {}
        self._profile.see({role: best.line(role) for role in SLOTS}, far, self._unit)
        for lane, side in ((LEFT_LANE, -1), (RIGHT_LANE, +1)):
            if self._profile.lanes[lane] > self.config.another:
                self._profile.keep(self._profile.known)
                self._believe(belief.beside_it(side))
                self._forget_paint()
                self._beside = True
                return self._belief
        return None

    def _in_view_m(self, belief: LaneBelief, roles: Sequence[float]) -> FloatArray:
        """The lengths (n,) [m] of the road's lines of these roles that are in view, as far ahead as lines are found."""
        s_m = self._near_m + np.arange(0.0, 4.0, 0.2) * self._unit
        places, headings, _ = belief.beside(s_m, 0.0)
        left = belief.width_m * np.stack((-np.sin(headings), np.cos(headings)), axis=1)
        points = places + np.asarray(roles, np.float64)[:, None, None] * left
        seen = self.camera.camera.inside(self.camera.ground_to_px(points))
        seen &= np.abs(points[..., 1]) < 1.5 * self._unit
        return 0.2 * self._unit * np.count_nonzero(seen, axis=1)

    def _together(self, lines: tuple[SightedLine, ...], own: list[FloatArray]) -> tuple[SightedLine, ...]:
        """All lines in view, and what the estimator alone sees: no paint is a witness twice, in two roles perhaps.

        What the scan does not find are specks, on average half as long as the shortest line that it does.
        """
        scanned, speck_m = lines, 0.5 * ScanConfig().least_lanes * self._unit
        for points in own:
            alone = self._on_none(points, scanned)
            if np.count_nonzero(alone) > 1:
                line = _sighted(points[alone])
                painted_m = min(line.painted_m, speck_m * float(np.count_nonzero(alone)))
                lines = (*lines, replace(line, painted_m=painted_m))
        return lines

    def _on_none(self, points_m: FloatArray, lines: tuple[SightedLine, ...]) -> Bools:
        """Which of the points (n, 2) [m] of a line lie on none of the scanned lines."""
        alone = np.ones(len(points_m), np.bool_)
        for line in lines:
            alone &= _distances(points_m, line.points_m) > self.road.marking_width_m
        return alone

    def _strays(self, followed: Followed) -> bool:
        """Whether an estimator has left the road that is believed, which explains the lines that it sees.

        How uncertain it is does not excuse it: all that it knows was learnt. One that only extrapolates knows nothing.
        """
        belief, measured = self._belief, self._measured(followed.pose)
        if belief is None or not self.reckons or self._confusable(belief):  # in doubt since its first frame: no belief
            return False
        own = [Assigned(_sighted(line.points_m), role) for line, role in _sides(followed) if line.seen]
        explained = Evidence(belief.on(self.road)).explained(own, self.config.fits)[0] if own else own
        if len(explained) < len(own):
            return False
        if not self.in_doubt and not any(self._reaching(followed)):
            return True
        return self._is_outside(followed, measured, belief)

    def _is_outside(self, followed: Followed, measured: LaneBelief, belief: LaneBelief) -> bool:
        """Whether an estimator's offset, heading or width is beyond what is believed.

        Who sees both lines from the car on knows better than that.
        """
        if self._is_plain(followed):
            return False
        away = (measured.state - belief.state)[:3]
        return float(away @ np.linalg.solve(belief.covariance[:3, :3], away)) > self.config.differs

    def _reaching(self, followed: Followed) -> list[bool]:
        """Of each line that is seen, whether it is longer than it is from the car to its first point.

        The error of a line that is drawn on beyond its points grows by how much farther that is than they reach.
        """
        near_m = self._near_m + self._reference_x_m
        seen = [line.points_m for line, _ in _sides(followed) if line.seen]
        return [_length_m(points) > float(points[0, 0]) - near_m for points in seen]

    def _is_plain(self, followed: Followed) -> bool:
        """Whether both lines are seen, and reach to the car."""
        return self._reaching(followed) == [True, True]

    def _misses(self, followed: Followed, belief: LaneBelief, measured: LaneBelief, best: Hypothesis) -> bool:
        """Whether the estimator misses a line of its lane that is in view.

        It does where it knows far less than that line says, or where both lines are in view and say otherwise; without
        odometry the belief has no more of a past than the estimator, and does not know better.
        """
        missed = [role for line, role in _sides(followed) if best.line(role) and not line.seen]
        if not missed or self._confusable(best.belief) or not self._stands_out(belief, best, missed):
            return False
        pair = self.reckons and best.line(LEFT) and best.line(RIGHT)
        otherwise = bool(pair) and self._apart(measured, best.belief) > self.config.differs
        return otherwise or self._vaguer(measured, best.belief)

    def _is_pair(self, belief: LaneBelief, best: Hypothesis) -> bool:
        """Whether both lines are in view; as long as that has not been so for a while, not by specks."""
        roles = (LEFT, RIGHT)
        if not all(best.line(role) for role in roles):
            return False
        return self.paired or all(self._stands_out(belief, best, [role]) for role in roles)

    def _stands_out(self, belief: LaneBelief, best: Hypothesis, roles: list[float]) -> bool:
        """Whether the lines of these roles are more than specks that lie where a line would, as was believed."""
        evidence, anything = Evidence(belief), belief.anything()
        looks = [evidence.look(line, role) for line, role in best.assigned]
        others = [look for look in looks if look.role not in roles]
        alone = sum(anything.of_line(look.line) for look in looks if look.role in roles)
        odds = evidence.log_likelihood(looks) - alone - (evidence.log_likelihood(others) if others else 0.0)
        return odds > self.config.exists

    def _vaguer(self, one: LaneBelief, other: LaneBelief) -> bool:
        """Whether one is so much less certain than the other that it says nothing against it."""
        return self._place_variance(one) > self.config.differs * self._place_variance(other)

    def _place_variance(self, belief: LaneBelief) -> float:
        """Of where the lane comes into view by the car's place in it alone [m^2]: a pose says no more."""
        row = np.array((-1.0, self._near_m))
        return float(row @ belief.covariance[:2, :2] @ row)

    def _learn(self, belief: LaneBelief, followed: Followed, pair: bool) -> None:
        """Take a belief that has learnt from a frame, and doubt the estimator where it contradicts that."""
        if pair:
            self._pair_m += min(self._news_m, self.config.glance * self._unit)
        self._news_m, self._learnt_ns, self._belief = 0.0, self._t_ns, belief
        measured = self._measured(followed.pose)
        normalised = self._apart(measured, belief)
        self._innovations.add(0.5 * normalised)
        self._outvoted = self._is_outside(followed, measured, belief)
        if normalised > self.config.gate:
            self._contradict(belief)

    def _contradict(self, belief: LaneBelief) -> None:
        """What is seen contradicts a belief: the estimator may be wrong, or the motion."""
        self._doubt(belief)
        self._odometry.suspect()

    def _doubt(self, belief: LaneBelief) -> None:
        """From now on the estimator is not believed without a look at everything else.

        The road ahead stays what it was seen to be: in twelve drives, after each of 138 contradictions, the squared
        error of dead reckoning over its covariance was 0.1 to 0.7 for the next four lane widths, and without that road
        it was off by up to five times as much. That the road is another one is a story, too, and that it gets wider.
        """
        self._story, on_any_road = self._reckon(belief)
        others = on_any_road, self._story.of_any_width()
        self._hypotheses.start(((self._story, 0.0), *((other, -self.config.exists) for other in others)), learnt=True)

    def _reckon(self, belief: LaneBelief) -> tuple[LaneBelief, LaneBelief]:
        """The lane is in doubt from now on: dead reckoning alone moves it, on the road as it was seen and on any."""
        belief = belief.on(self._learnt_road.reckoning)
        self._reckoned, self._on_any_road = belief, belief.without_road()
        self._said, self.in_doubt = 0.0, True
        self._learnt_road.lose()
        return self._reckoned, self._on_any_road

    def _believe(self, belief: LaneBelief, assigned: Sequence[Assigned] = ()) -> None:
        """The doubt is over, by these lines; it may be the next lane where dead reckoning cannot tell the two."""
        beside = (0.0, 0.0) if self._reckoned is None else self._beside_reckoned(belief, self._reckoned)
        if self._reckoned is not None:
            self._profile.land(*beside)
        if max(beside) > EXCEEDED:
            self._pair_m = 0.0
        elif {role for _, role in assigned} >= {LEFT, RIGHT}:
            self._pair_m += min(self._news_m, self.config.glance * self._unit)
        was = self._reckoned or self._belief
        if was is not None and self._apart(belief, was) < self.config.differs:
            self._rivals.begin_anew()
        else:
            self._rivals.reset()
        self._belief, self._reckoned, self._on_any_road, self.in_doubt = belief.on(self.road), None, None, False
        self._marked = None  # it may be another lane's width
        self._news_m, self._learnt_ns = 0.0, self._t_ns
        self._hypotheses.start((), learnt=True)
        self._innovations.reset()

    def _beside_reckoned(self, belief: LaneBelief, reckoned: LaneBelief) -> tuple[float, float]:
        """By how much likelier dead reckoning has a lane as the one to the left, and to the right, of its own.

        A road that bends unseen moves the lane aside and turns it: one that lies as it did is hardly the next. Where
        it fits none of them, dead reckoning is wrong, and tells nothing.
        """
        here = self._apart(belief, reckoned)
        if here > self.config.gate:
            return 1.0, 1.0
        left, right = (math.exp(0.5 * (here - self._apart(belief.beside_it(side), reckoned))) for side in (-1, +1))
        return left, right

    def _apart(self, one: LaneBelief, other: LaneBelief) -> float:
        """Squared difference of offset and heading over its covariance: chi-square with two degrees of freedom."""
        d, theta = (one.state[:2] - other.state[:2]).tolist()
        (offset, both), (_, heading) = (one.covariance[:2, :2] + other.covariance[:2, :2]).tolist()
        offset, heading = offset + self._errors.offset_m**2, heading + self._errors.heading_rad**2
        return float((d * d * heading - 2.0 * d * theta * both + theta * theta * offset) / (offset * heading - both**2))

    def lost_estimate(self, frame: Frame) -> LaneEstimate:
        """An estimate that says that there is none."""
        age_ns = max(frame.t_ns - self._seen_ns, 0)
        return LaneEstimate(
            t_ns=frame.t_ns, status=LaneStatus.LOST, frame_age_ns=age_ns, camera_pitch_rad=self.pitch_rad
        )

    def _measured(self, pose: LanePose) -> LaneBelief:
        """A pose as a belief, which knows no line better than the error that its points have in common."""
        (d, d_turn, d_width), (_, turn, turn_width), (_, _, width) = pose.covariance.tolist()
        line = (self.road.line_sigma * self._unit) ** 2
        d, width = d + 0.5 * line, width + 2.0 * line
        covariance = np.diag((d, turn, (self.config.bend / self._unit) ** 2, width))  # in the order of `Part`
        covariance[Part.OFFSET, Part.THETA] = covariance[Part.THETA, Part.OFFSET] = -d_turn
        covariance[Part.OFFSET, Part.WIDTH] = covariance[Part.WIDTH, Part.OFFSET] = d_width
        covariance[Part.THETA, Part.WIDTH] = covariance[Part.WIDTH, Part.THETA] = -turn_width
        mean = np.array((pose.offset_m, -pose.heading_rad, pose.curvature_per_m, pose.width_m))
        return LaneBelief.arc(mean, covariance, self.road, self._reference_x_m)

    def _confusable(self, belief: LaneBelief, away: float = 0.5) -> bool:
        """Whether the lane may be so many lane widths off, as a bound must hold: by a half, and the nearest line to a
        place is no longer sure to be the lane's; by a whole one, and the next lane may be taken for this one.
        """
        return K * math.sqrt(self._lateral_variance(belief)) > away * belief.width_m

    def _lateral_variance(self, belief: LaneBelief) -> float:
        """Of the lane's place at the nearest ground that is seen [m^2]."""
        return belief.lateral_variance(self._near_m)

    def _possible(self, pose: LanePose) -> bool:
        """Whether a car may stand so in a lane, and the lane be so wide."""
        unit = self._unit
        return bool(
            _is_finite(pose)
            and abs(pose.width_m - unit)
            < 4.0 * math.hypot(self.road.width_sigma * unit, math.sqrt(pose.covariance[2, 2]))
            and abs(pose.offset_m) < (1.4 if self._beside else 0.9) * unit
            and abs(pose.heading_rad) < MOST_HEADING_RAD
        )

    def _too_long(self, t_ns: int, count: int) -> bool:
        blind_s = (t_ns - max(self._seen_ns, self._borne_out_ns)) * 1e-9
        if t_ns == self._started_ns and count == 0:  # the estimator does not see what the lane was to start with
            return True
        return blind_s > self.config.coast_s or self._blind_m > self.config.coast_lanes * self._unit

    def _estimate(self, frame: Frame, status: LaneStatus, followed: Followed) -> LaneEstimate:
        followed = self._told(followed)
        offset_bound, heading_bound = self._bounds(followed)
        return LaneEstimate(
            t_ns=frame.t_ns,
            status=status,
            left=followed.left,
            right=followed.right,
            centerline=followed.centerline,
            pose=replace(followed.pose, offset_bound_m=offset_bound, heading_bound_rad=heading_bound),
            crossing=followed.crossing,
            camera_pitch_rad=self.pitch_rad,
            frame_age_ns=max(frame.t_ns - self._seen_ns, 0),
        )

    def _told(self, followed: Followed) -> Followed:
        """What is told of the lane: by the estimator, where its lines reach to the car, else what is believed.

        In doubt it is the best hypothesis, if that explains a line in view and is likelier than the estimator's, or
        dead reckoning, if that sees no line. Without odometry nothing is known that the estimator does not see.
        """
        belief, reaching = self._belief, self._reaching(followed)
        if belief is None or not self.reckons or reaching == [True, True]:
            return followed
        if reaching == [True] and not (self.in_doubt and self._trusts):
            return followed
        if self.in_doubt:
            if self._story is None:
                return followed
            belief = self._story
        return self._by(belief, followed)

    def _by(self, belief: LaneBelief, followed: Followed) -> Followed:
        """What is believed in place of what an estimator says, but for the lines that it sees."""
        left, right = (
            line if line.seen else replace(line, curve=belief.curve(role, self._ahead_m))
            for line, role in _sides(followed)
        )
        centerline = belief.curve(0.0, self._ahead_m)
        return replace(followed, pose=belief.pose, left=left, right=right, centerline=centerline)

    def _bounds(self, followed: Followed) -> tuple[float, float]:
        """Bounds of offset [m] and heading [rad]: those of every hypothesis that may be true, seen from the pose.

        One that is less likely than a bound may be exceeded is none of them. Where a lane gets wider or narrower, one
        of its lines is turned from its middle by half of that.
        """
        pose, errors, inflation = followed.pose, self._errors, self._innovations.inflation
        taper_rad = 0.0 if followed.left.seen and followed.right.seen else 0.5 * TAPER
        assert self._belief is not None
        may_be = [self._belief]
        if self.in_doubt:  # and dead reckoning, which no line can mislead, unless this frame's tell the lane
            told = self._told_ns == self._t_ns
            reckoned = [] if self._reckoned is None or told else [self._reckoned]
            stories = zip(self._hypotheses.all, self._hypotheses.posterior(), strict=True)
            may_be = [*(one.belief for one, share in stories if share > EXCEEDED), *reckoned]
        else:
            may_be += self._rivals.lanes(self._belief)
            may_be += [self._belief.beside_it(side) for side in (+1, -1) if self._may_be_another]
        may_be += [] if self._unmoved is None else [self._unmoved]
        offset = heading = 0.0
        for one in may_be:
            aside = abs(one.offset_m) + abs(one.heading_rad) * self._near_m
            side, turn = errors.sigmas(aside + 0.5 * abs(one.curvature_per_m) * self._near_m**2)
            if not self.paired:
                side = math.hypot(side, 0.5 * self.road.width_sigma * self._unit)
            turn = math.hypot(turn, taper_rad)
            away, turned = abs(one.offset_m - pose.offset_m), abs(one.heading_rad - pose.heading_rad)
            offset = max(offset, away + bound(inflation * float(one.covariance[0, 0]), side))
            heading = max(heading, turned + bound(inflation * float(one.covariance[1, 1]), turn))
        if not self.paired:  # what is seen may be the next lane's, a lane width away, whatever its own width seems
            offset += max(pose.width_m, self._unit)
            heading += MOST_HEADING_RAD  # or that of a road that crosses the car's
        return offset, heading


def _inside(lane: LaneBelief) -> float:
    """The probability that the car is in a lane."""
    away = (0.5 * lane.width_m - abs(lane.offset_m)) / lane.sigma(Part.OFFSET)
    return 0.5 * math.erfc(-away / math.sqrt(2.0))


def _is_finite(pose: LanePose) -> bool:
    values = pose.offset_m + pose.heading_rad + pose.width_m + pose.curvature_per_m
    return bool(math.isfinite(values) and np.isfinite(pose.covariance).all())


def _sides(followed: Followed) -> tuple[tuple[LaneLine, float], tuple[LaneLine, float]]:
    """The lane's lines with their roles."""
    return (followed.left, LEFT), (followed.right, RIGHT)


def _distances(points_m: FloatArray, line_m: FloatArray) -> FloatArray:
    """How far points (n, 2) [m] lie from a line through points (k, 2) [m]: (n,) [m]."""
    start, along = line_m[:-1], np.diff(line_m, axis=0)
    if not len(along):
        return np.asarray(np.hypot(*(points_m - line_m[0]).T))
    away = points_m[:, None] - start
    share = np.clip(np.einsum("nki,ki->nk", away, along) / np.einsum("ki,ki->k", along, along), 0.0, 1.0)
    rest = away - share[:, :, None] * along
    return np.asarray(np.hypot(rest[..., 0], rest[..., 1]).min(axis=1))


def _sighted(points_m: FloatArray) -> SightedLine:
    """An estimator's points of a line, thinned: neighbours are no more witnesses than one."""
    stride = max(len(points_m) // LEARNT_POINTS, 1)
    points = points_m[::stride]
    return SightedLine(points_m=points, painted_m=_length_m(points_m), span_m=0.0)


def _length_m(points_m: FloatArray) -> float:
    return math.dist(points_m[0].tolist(), points_m[-1].tolist())
