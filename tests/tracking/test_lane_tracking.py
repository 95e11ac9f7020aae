"""The lane between frames: when it is doubted and believed again, what is told of it, and when it is forgotten."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from automodel.config import CarConfig
from automodel.curves import GraphCurve
from automodel.estimation.checked_odometry import DISSENT, CheckedOdometry
from automodel.estimation.road import LOST_TURN_RAD, MAX_GAP_S, TAPER
from automodel.geometry import GroundCamera, lane_path
from automodel.geometry.lane_path import ROAD
from automodel.perception.line_scan import SightedLine
from automodel.signals import EXCEEDED, Frame, LaneEstimate, LaneLine, LanePose, LaneStatus, Motion, MotionSource
from automodel.tracking import evidence, lane_motion, seen_places
from automodel.tracking.belief import Assigned, LaneBelief
from automodel.tracking.hypotheses import Hypotheses
from automodel.tracking.integrity import K
from automodel.tracking.lane_motion import Part
from automodel.tracking.lane_tracking import Followed, LaneTracking, TrackingConfig
from automodel.tracking.stories import LEFT, LEFT_FAR, RIGHT, RIGHT_FAR
from automodel.types import FloatArray
from tests.support.drawn_roads import Road
from tests.support.sighted_lines import DASHED, bending, line_of, sighted

CAR = CarConfig()
LANE_M = CAR.lane.width_m
CONFIG = TrackingConfig(coast_s=1.0, coast_lanes=2.0)
STEP_NS, STEP_S, SPEED_MPS = 50_000_000, 0.05, 1.0
AHEAD = GraphCurve((0.0, 0.0), 0.0, 2.0)
BOTH: tuple[float, ...] = (LEFT, RIGHT)
NONE: tuple[float, ...] = ()


def sights(offset_m: float, roles: Sequence[float] = BOTH, heading_rad: float = 0.0) -> tuple[SightedLine, ...]:
    """Lines of a straight road on which the car is `offset_m` to the left of its lane's centre, in that direction."""
    return tuple(line_of(Road(aside_m=-offset_m, heading_rad=-heading_rad), role, -0.5, 1.5) for role in roles)


def said(offset_m: float, seen: Sequence[float] = BOTH, width_m: float = LANE_M, heading_rad: float = 0.0) -> Followed:
    """What an estimator says that takes the lane to lie there, and these of its lines to be seen there."""
    drawn = heading_rad if math.isfinite(heading_rad) else 0.0
    points = {role: line.points_m for role, line in zip(seen, sights(offset_m, seen, drawn), strict=True)}
    left, right = (
        LaneLine(curve=AHEAD, points_m=points.get(role, np.empty((0, 2))), seen=role in seen) for role in BOTH
    )
    covariance = np.diag(np.square((0.005, 0.01, 0.005)))
    pose = LanePose(
        offset_m=offset_m, heading_rad=heading_rad, width_m=width_m, curvature_per_m=0.0, covariance=covariance
    )
    return Followed(pose=pose, left=left, right=right, centerline=AHEAD)


class Drive:
    """A car that drives straight on, frame by frame, as a pipeline would take them."""

    def __init__(self, config: TrackingConfig = CONFIG, car: CarConfig = CAR) -> None:
        self.tracking, self.t_ns = LaneTracking(car, config, AHEAD.length_m), 0
        self.anew: LaneBelief | None = None  # where the estimator was told to start again in the last frame

    def predict(self, dt_ns: int = STEP_NS, speed_mps: float = SPEED_MPS, known: bool = True) -> None:
        self.t_ns += dt_ns
        source = MotionSource.MEASURED if known else MotionSource.NONE
        motion = Motion(t_ns=self.t_ns, speed_mps=speed_mps, yaw_rate_radps=0.0, source=source)
        self.tracking.predict(self.frame, motion)

    def follow(
        self, followed: Followed, lines: tuple[SightedLine, ...] = (), speed_mps: float = SPEED_MPS, known: bool = True
    ) -> LaneEstimate:
        """One frame in which there is a lane."""
        self.predict(speed_mps=speed_mps, known=known)
        self.anew = self.tracking.judge(lines, followed) if self.tracking.looks_around(followed) else None
        return self.tracking.follow(self.frame, followed)

    @property
    def frame(self) -> Frame:
        return Frame(t_ns=self.t_ns, index=0, image=np.zeros((2, 2), np.uint8))

    @property
    def doubted(self) -> bool:
        return self.tracking.in_doubt


def driving(offset_m: float = 0.0, frames: int = 12, config: TrackingConfig = CONFIG) -> Drive:
    """A car that has followed both its lines for a while."""
    drive = Drive(config)
    drive.predict()
    start = drive.tracking.start(drive.t_ns, sights(offset_m))
    assert start is not None
    assert start.offset_m == pytest.approx(offset_m, abs=0.01)
    for _ in range(frames):
        assert drive.follow(said(offset_m)).status is LaneStatus.TRACKING
    assert not drive.doubted
    return drive


def beginning() -> tuple[Drive, LaneEstimate]:
    """A car that has the left line alone in view, and what is told of the frame with which its lane begins."""
    drive = Drive()
    drive.predict()
    while (start := drive.tracking.start(drive.t_ns, sights(0.0, (LEFT,)))) is None:
        assert drive.t_ns < 3 * STEP_NS
        drive.predict()
    assert start.offset_m == pytest.approx(0.0, abs=0.05)
    followed = said(0.0, (LEFT,))
    assert drive.tracking.judge(sights(0.0, (LEFT,)), followed) is None
    return drive, drive.tracking.follow(drive.frame, followed)


def bound(estimate: LaneEstimate) -> float:
    assert estimate.pose is not None
    return estimate.pose.offset_bound_m


def test_two_lines_in_view_are_a_lane_at_once() -> None:
    drive = Drive()
    drive.predict()
    start = drive.tracking.start(drive.t_ns, sights(0.05))
    assert start is not None
    assert start.offset_m == pytest.approx(0.05, abs=0.01)
    estimate = drive.tracking.follow(drive.frame, said(start.offset_m))
    assert estimate.status is LaneStatus.TRACKING
    assert bound(estimate) < LANE_M


@pytest.mark.parametrize(("lanes", "placed"), [(0.5, True), (1.5, False)])
def test_a_car_that_has_driven_without_a_lane_is_not_where_a_person_put_it(lanes: float, placed: bool) -> None:
    """Two lines that come into view then may be anything, and the bound fills the lane."""
    drive = Drive()
    drive.predict()
    for _ in range(round(lanes * LANE_M / (SPEED_MPS * STEP_S))):
        assert drive.tracking.start(drive.t_ns, ()) is None
        drive.predict()
    start = drive.tracking.start(drive.t_ns, sights(0.0))
    assert start is not None
    assert drive.tracking.paired == placed
    assert (bound(drive.tracking.follow(drive.frame, said(start.offset_m))) < 0.5 * LANE_M) == placed


def test_the_bound_holds_a_lane_that_a_line_inside_it_would_make_with_its_other_line() -> None:
    """Both have been in view since the lane began: which one bounds it cannot be known."""
    inside = -0.3  # 0.2 lane widths from the right line: the lane's middle would be 0.1 of them aside
    for look in (CONFIG.look, math.inf):
        drive = Drive(replace(CONFIG, look=look))
        drive.predict()
        assert drive.tracking.start(drive.t_ns, sights(0.0)) is not None
        bounds = [bound(drive.follow(said(0.0), sights(0.0, (*BOTH, inside)))) for _ in range(60)]
        assert min(bounds[30:]) > 0.1 * LANE_M
        alone = driving(config=replace(CONFIG, look=look))
        for _ in range(60):
            alone.follow(said(0.0), sights(0.0))
        later = [bound(alone.follow(said(0.0), sights(0.0, (*BOTH, inside)))) for _ in range(60)]
        assert max(later) < 0.1 * LANE_M


def test_a_line_inside_the_lane_makes_no_narrower_one_where_its_own_is_out_of_view() -> None:
    inside = -0.3
    drive = driving(frames=0)
    for _ in range(40):
        drive.follow(said(0.0), sights(0.0, (*BOTH, inside)))
    for _ in range(20):
        drive.follow(said(0.0, (LEFT,)), sights(0.0, (LEFT, inside)))
        assert drive.anew is None
    assert not drive.doubted


def test_an_estimator_that_takes_another_thing_for_its_line_is_sent_back_however_well_that_fits() -> None:
    inside, drive, sent = -0.3, driving(frames=0), []
    for _ in range(40):
        drive.follow(said(0.0), sights(0.0, (*BOTH, inside)))
    middle = 0.5 * (0.5 + inside)
    narrow = said(-middle * LANE_M, BOTH, width_m=(0.5 - inside) * LANE_M)
    left, right = (replace(narrow.left, points_m=sights(0.0, (role,))[0].points_m) for role in (LEFT, inside))
    for _ in range(20):
        told = drive.follow(replace(narrow, left=left, right=right), sights(0.0, (LEFT, inside)))
        assert told.pose is not None
        assert abs(told.pose.offset_m) < told.pose.offset_bound_m
        sent += [] if drive.anew is None else [drive.anew]
    assert sent
    for one in sent:
        assert one.width_m == pytest.approx(LANE_M, rel=0.05)
        assert one.offset_m == pytest.approx(0.0, abs=0.02)


def test_another_thing_teaches_nothing_in_place_of_a_line_that_is_out_of_view() -> None:
    """An estimator has come to follow a tape that was in view beside the line before; it lies almost where that ran."""
    inside, drive = -0.36, driving(frames=0)
    for _ in range(40):
        drive.follow(said(0.0), sights(0.0, (*BOTH, inside)))
    middle = 0.5 * (0.5 + inside)
    narrow = said(-middle * LANE_M, BOTH, width_m=(0.5 - inside) * LANE_M)
    left, right = (replace(narrow.left, points_m=sights(0.0, (role,))[0].points_m) for role in (LEFT, inside))
    widths = []
    for _ in range(20):
        drive.follow(replace(narrow, left=left, right=right))
        belief = drive.tracking._belief
        assert belief is not None
        widths.append(belief.width_m)
    assert min(widths) == pytest.approx(LANE_M, abs=0.005)


def test_what_another_thing_was_beside_one_lane_is_any_line_beside_the_next() -> None:
    inside, drive = -0.3, driving(frames=0)
    for _ in range(40):
        drive.follow(said(0.0), sights(0.0, (*BOTH, inside)))
    known, belief = drive.tracking._rivals, drive.tracking._belief
    assert belief is not None
    assert not known.others(belief, sights(0.0, (inside,)))
    drive.tracking.change_lane(+1)
    assert known.others(belief, sights(0.0, (inside,)))


def test_the_lines_of_a_lane_that_is_changed_to_have_not_moved() -> None:
    drive = driving(0.35 * LANE_M, frames=30)
    drive.tracking.change_lane(+1)
    for _ in range(10):
        assert bound(drive.follow(said(-0.65 * LANE_M))) < 0.15 * LANE_M


def test_a_heading_by_one_line_may_be_that_of_a_lane_that_gets_wider() -> None:
    drive = driving(frames=30)
    assert drive.follow(said(0.0), sights(0.0)).pose.heading_bound_rad < K * 0.5 * TAPER  # type: ignore[union-attr]
    for seen in ((LEFT,), (RIGHT,), NONE):
        one = drive.follow(said(0.0, seen), sights(0.0, seen))
        assert one.pose.heading_bound_rad > K * 0.5 * TAPER  # type: ignore[union-attr]


def seen_by(camera: GroundCamera, points_m: FloatArray) -> FloatArray:
    """Where those of the points (n, 2) [m] that a camera sees seem to lie to one that is set as configured."""
    pixels = camera.ground_to_px(points_m)
    return GroundCamera.from_config(CAR.camera).px_to_ground(pixels[camera.camera.inside(pixels)])


def pitched_wrongly(down_deg: float, narrower: float = 0.0, frames: int = 60) -> tuple[Drive, list[LaneBelief]]:
    """A car whose camera looks further down than configured, and how it was turned, while both lines are seen.

    `narrower`: by so many of its widths the lane gets narrower per metre.
    """
    drive, real = Drive(), GroundCamera.from_config(CAR.camera).pitched(math.radians(down_deg))
    turned = []
    for k in range(frames):
        points = [line.points_m for line in sights(0.0)]
        widths = [1.0 - narrower * (1e-9 * STEP_NS * k * SPEED_MPS + one[:, 0]) for one in points]
        lines = tuple(
            replace(line, points_m=seen_by(real, np.column_stack((one[:, 0], one[:, 1] * width))))
            for line, one, width in zip(sights(0.0), points, widths, strict=True)
        )
        told = said(0.0, width_m=LANE_M * float(1.0 - narrower * 1e-9 * STEP_NS * k * SPEED_MPS))
        left, right = (
            replace(line, points_m=seen.points_m) for line, seen in zip((told.left, told.right), lines, strict=True)
        )
        if k == 0:
            drive.predict()
            assert drive.tracking.start(drive.t_ns, lines) is not None
            continue
        drive.follow(replace(told, left=left, right=right), lines)
        believed = drive.tracking.turn_camera()
        if believed is not None:
            turned.append(believed)
            break
    return drive, turned


@pytest.mark.parametrize("down_deg", [1.2, -1.2])
def test_lines_that_are_not_parallel_tell_the_cameras_pitch(down_deg: float) -> None:
    drive, turned = pitched_wrongly(down_deg)
    tracking, configured = drive.tracking, CAR.camera.extrinsics.pitch_rad
    assert len(turned) == 1
    assert turned[0].width_m == pytest.approx(LANE_M, abs=0.02)
    assert math.degrees(tracking.pitch_rad) == pytest.approx(down_deg, abs=0.4)
    assert tracking.camera.extrinsics.pitch_rad == configured + tracking.pitch_rad
    assert f"pitch_rad = {configured:.3f}: the lane's lines are parallel at" in tracking.warning
    assert tracking.turn_camera() is None  # once
    tracking.reset()
    assert (tracking.pitch_rad, tracking.warning) == (0.0, "")


def test_the_pitch_is_told_by_the_way_that_an_odometry_gives_though_the_ground_contradicts_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def contradicted(odometry: CheckedOdometry, frame: Frame, motion: Motion) -> Motion:
        return replace(motion, speed_mps=0.0, source=MotionSource.NONE)

    monkeypatch.setattr(CheckedOdometry, "step", contradicted)
    assert pitched_wrongly(1.2)[1]


def test_the_width_of_another_lane_tells_no_pitch() -> None:
    tracking = driving().tracking
    belief = tracking._belief
    assert belief is not None
    tracking._marked = belief
    tracking._believe(belief.beside_it(+1))
    assert tracking._marked is None


@pytest.mark.parametrize("narrower", [0.06, -0.06])
def test_a_lane_that_gets_narrower_is_no_camera(narrower: float) -> None:
    drive, turned = pitched_wrongly(0.0, narrower, frames=110)
    assert not turned
    belief = drive.tracking._belief
    assert belief is not None
    assert abs(math.degrees(belief.pitch_rad[0])) > 0.5  # though its lines say so


def test_a_camera_is_not_turned_by_little_nor_in_doubt_nor_by_lines_that_no_mount_explains() -> None:
    assert not pitched_wrongly(0.0)[1]
    assert not pitched_wrongly(0.2, frames=400)[1]
    tracking = driving().tracking
    for k in range(20):
        belief = tracking._belief  # what a camera that fell down shows, little by little
        assert belief is not None
        belief.state[lane_path.PITCH], belief.covariance[lane_path.PITCH, lane_path.PITCH] = 2.0, 0.01
        tracking.in_doubt = k < 4
        assert not (tracking.in_doubt and tracking.turn_camera())
        tracking._marked, tracking._marked_m = belief, 10.0
        if not tracking.in_doubt:
            tracking.turn_camera()
    assert math.degrees(tracking.pitch_rad) == pytest.approx(2.4)


@pytest.mark.parametrize("width", [0.7, 1.3])
def test_a_lane_that_got_narrower_or_wider_while_one_line_was_seen_is_found_by_the_other(width: float) -> None:
    drive = driving()
    for _ in range(20):
        drive.follow(said(0.0, (LEFT,)), sights(0.0, (LEFT,)))
    found = None
    for _ in range(6):
        drive.follow(said(0.0, (LEFT,)), sights(0.0, (LEFT, LEFT - width)))
        found = drive.anew or found
    assert found is not None
    assert found.width_m == pytest.approx(width * LANE_M, abs=0.03)
    assert found.offset_m == pytest.approx(0.5 * (width - 1.0) * LANE_M, abs=0.02)


@pytest.mark.parametrize("roles", [(LEFT_FAR, LEFT, RIGHT_FAR), (LEFT_FAR, RIGHT, RIGHT_FAR)])
def test_both_lines_of_the_next_lane_and_the_far_one_are_a_lane_at_once(roles: tuple[float, ...]) -> None:
    """A lamp may hide a line of the lane; a person has put the car there, and the next lane tells the same."""
    drive = Drive()
    drive.predict()
    start = drive.tracking.start(drive.t_ns, sights(0.05, roles))
    assert start is not None
    assert start.offset_m == pytest.approx(0.05, abs=0.01)
    assert bound(drive.tracking.follow(drive.frame, said(start.offset_m))) < LANE_M


@pytest.mark.parametrize(("offset", "sure"), [(0.0, True), (0.44, True), (0.49, False)])
def test_of_two_lanes_side_by_side_the_one_that_the_car_is_in_is_the_lane(offset: float, sure: bool) -> None:
    """Astride the line between them, to what the lines tell, it may be either."""
    drive = Drive()
    drive.predict()
    start = drive.tracking.start(drive.t_ns, sights(offset * LANE_M, (*BOTH, LEFT_FAR)))
    assert (start is not None) == sure
    if start is not None:
        assert start.offset_m == pytest.approx(offset * LANE_M, abs=0.01)


@pytest.mark.parametrize(("certainty", "starts", "doubted"), [(0.98, 0, 0), (0.995, 1, 1), (0.9995, 1, 0)])
def test_a_lane_that_is_only_likely_is_in_doubt(
    certainty: float, starts: bool, doubted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another one is likelier than a bound may be exceeded."""
    monkeypatch.setattr(Hypotheses, "certainty", property(lambda _: certainty))
    drive = Drive()
    drive.predict()
    start = drive.tracking.start(drive.t_ns, sights(0.0))
    assert (start is not None, drive.doubted) == (starts, doubted)
    if start is not None:
        assert (bound(drive.tracking.follow(drive.frame, said(0.0))) > 0.5 * LANE_M) == doubted


@pytest.mark.parametrize("roles", [(LEFT, RIGHT_FAR), (LEFT_FAR, RIGHT)])
def test_lines_two_lanes_apart_may_be_those_of_one_wide_lane_or_two_kerbs(roles: tuple[float, ...]) -> None:
    drive = Drive()
    for _ in range(10):
        drive.predict()
        start = drive.tracking.start(drive.t_ns, sights(0.05, roles))
        assert start is not None
        assert start.offset_m == pytest.approx(0.05, abs=0.01)
        assert bound(drive.tracking.follow(drive.frame, said(start.offset_m))) > LANE_M
        assert not drive.tracking.paired


@pytest.mark.parametrize("roles", [(), (RIGHT_FAR,), (LEFT_FAR,)])
def test_no_line_and_the_neighbours_line_are_no_start(roles: tuple[float, ...]) -> None:
    drive = Drive()
    for _ in range(5):
        drive.predict(speed_mps=0.0)
        assert drive.tracking.start(drive.t_ns, sights(0.0, roles)) is None


def test_a_lane_too_narrow_to_be_one_is_no_start() -> None:
    drive = Drive()
    for _ in range(5):
        drive.predict()
        assert drive.tracking.start(drive.t_ns, sights(0.0, (0.6 * LEFT, 0.6 * RIGHT))) is None


def measured(sigma_m: float) -> CarConfig:
    """The car of somebody who has measured the lanes so well."""
    return replace(CAR, lane=replace(CAR.lane, width_sigma_m=sigma_m))


@pytest.mark.parametrize(("sigma_m", "error_m"), [(0.0, 0.039), (0.004, 0.0)])
def test_a_thing_beside_a_line_makes_no_lane_narrower_than_lanes_were_measured(sigma_m: float, error_m: float) -> None:
    drive = Drive(car=measured(sigma_m))
    drive.predict(speed_mps=0.0)
    start = drive.tracking.start(drive.t_ns, (line_of(Road(), 0.6 * LEFT, 0.3, 0.55), *sights(0.0, (RIGHT,))))
    assert start is not None
    assert start.offset_m == pytest.approx(error_m, abs=0.005)
    assert drive.doubted == (sigma_m > 0.0)  # a lone line


def test_an_estimator_may_say_another_width_where_it_does_not_know_it() -> None:
    for sigma_m, status in ((0.02, LaneStatus.TRACKING), (0.005, LaneStatus.LOST)):
        drive = Drive(car=measured(0.004))
        drive.predict()
        assert drive.tracking.start(drive.t_ns, sights(0.0)) is not None
        followed = said(0.0, width_m=1.2 * LANE_M)
        covariance = np.diag(np.square((0.005, 0.01, sigma_m)))
        followed = replace(followed, pose=replace(followed.pose, covariance=covariance))
        drive.tracking._odometry.suspect()  # dead reckoning does not know better
        assert drive.tracking.follow(drive.frame, followed).status is status


def test_a_lane_is_found_once_lines_come_into_view_that_contradict_an_earlier_story() -> None:
    """A lone line a lane width away may be the lane's, of a car that stands outside; the lane's own lines decide."""
    drive = Drive()
    for _ in range(40):
        drive.predict()
        drive.tracking.start(drive.t_ns, sights(0.0, (1.2 * LEFT_FAR / 1.5,)))
    assert drive.tracking.lost
    drive.predict()
    for _ in range(15):
        drive.predict()
        start = drive.tracking.start(drive.t_ns, sights(0.0))
        if start is not None:
            break
    assert start is not None
    assert start.offset_m == pytest.approx(0.0, abs=0.02)


def test_a_lane_of_one_line_is_told_with_a_bound_that_fills_the_lane() -> None:
    drive, first = beginning()
    estimates = [first] + [drive.follow(said(0.0, (LEFT,)), sights(0.0, (LEFT,))) for _ in range(4)]
    assert all(estimate.status is LaneStatus.ONE_LINE for estimate in estimates)
    assert all(bound(estimate) > LANE_M + 0.01 for estimate in estimates)  # the next lane's is not exactly seen either


def test_a_lane_that_seems_narrow_may_be_the_next_one_all_the_same() -> None:
    drive, _ = beginning()
    assert bound(drive.follow(said(0.0, (LEFT,), width_m=0.8 * LANE_M), sights(0.0, (LEFT,)))) > LANE_M


def test_a_lane_that_the_estimator_does_not_see_in_its_first_frame_was_none() -> None:
    drive = Drive()
    drive.predict()
    assert drive.tracking.start(drive.t_ns, sights(0.0)) is not None
    assert drive.tracking.follow(drive.frame, said(0.0, NONE)).status is LaneStatus.LOST
    assert drive.tracking.lost


def test_of_an_unpaired_lane_the_bound_is_at_least_half_the_lane() -> None:
    drive, _ = beginning()
    alone = [drive.follow(said(0.0, (LEFT,)), sights(0.0, (LEFT,))) for _ in range(20)]
    assert all(bound(estimate) >= 0.5 * LANE_M for estimate in alone if estimate.valid)
    headings = [estimate.pose.heading_bound_rad for estimate in alone if estimate.pose is not None]
    assert min(headings) > math.radians(60.0)  # it may be a road that crosses the car's
    paired = [drive.follow(said(0.0), sights(0.0)) for _ in range(20)]
    assert bound(paired[-1]) < 0.25 * LANE_M
    assert paired[-1].pose is not None
    assert paired[-1].pose.heading_bound_rad < math.radians(15.0)


def test_a_lane_that_is_followed_is_not_doubted_and_its_bound_stays_small() -> None:
    drive = driving(frames=1)
    bounds = []
    for _ in range(10):
        bounds.append(bound(drive.follow(said(0.0))))
        assert not drive.doubted
    assert max(bounds) < 0.065 * LANE_M
    assert 0.0 < bounds[-1] < 0.2 * LANE_M


def test_the_bound_holds_what_the_camera_may_be_off() -> None:
    drive = driving(frames=40)
    estimate = drive.follow(said(0.0))
    assert bound(estimate) > drive.tracking._errors.offset_m
    assert estimate.pose is not None
    assert estimate.pose.heading_bound_rad > drive.tracking._errors.heading_rad


@pytest.mark.parametrize("jump", [0.6, -0.6, 1.0])
def test_an_estimator_that_jumps_is_doubted_and_the_bound_reaches_where_the_lane_was(jump: float) -> None:
    drive = driving()
    estimate = drive.follow(said(jump * 0.8 * LANE_M))
    assert drive.doubted
    assert bound(estimate) > 0.8 * abs(jump) * 0.8 * LANE_M


def test_an_estimator_one_of_whose_two_lines_is_another_thing_is_doubted() -> None:
    drive = driving()
    drive.follow(replace(said(0.0), right=said(-0.3 * LANE_M).right))
    assert drive.doubted


@pytest.mark.parametrize(("says", "seen"), [(0.2, NONE), (0.0, NONE), (0.0, BOTH)])
def test_a_lane_that_only_the_lines_in_view_tell_from_the_next_one_is_told_with_a_bound_that_fills_it(
    says: float, seen: tuple[float, ...]
) -> None:
    """It may be the neighbour's until it has been followed for a lane width: that has two lines, too."""
    drive = driving()
    while bound(drive.follow(said(0.0, NONE), known=False)) < LANE_M:  # dead reckoning no longer tells which lane it is
        assert drive.t_ns < 3e9
    while drive.doubted:
        assert drive.follow(said(says * LANE_M, seen), sights(0.0)).valid
        assert drive.t_ns < 3e9
    assert (drive.anew is not None) == (says != 0.0)  # sent to where the lines are
    assert bound(drive.follow(said(0.0), sights(0.0))) >= LANE_M
    told = [bound(drive.follow(said(0.0), sights(0.0))) for _ in range(10)]
    assert told[-1] < 0.3 * LANE_M


def test_a_lane_that_is_found_after_one_was_lost_is_told_with_a_bound_that_fills_it() -> None:
    """Two pieces of paint may lie like a lane's lines, or be the next lane's, until the car has followed them."""
    drive = driving()
    while drive.follow(said(0.0, NONE)).valid:
        assert drive.t_ns < 5e9
    drive.predict()
    assert drive.tracking.start(drive.t_ns, sights(0.0)) is not None
    assert bound(drive.tracking.follow(drive.frame, said(0.0))) >= LANE_M
    told = [bound(drive.follow(said(0.0))) for _ in range(math.ceil(LANE_M / (SPEED_MPS * STEP_S)) + 1)]
    assert min(told[:3]) >= LANE_M
    assert told[-1] < 0.5 * LANE_M


def test_a_lane_that_dead_reckoning_tells_from_the_next_one_is_known_when_its_lines_are_seen_again() -> None:
    drive = driving()
    while not drive.doubted:
        assert drive.follow(said(0.0, NONE), known=False).valid
    while drive.doubted:
        assert drive.follow(said(0.0), sights(0.0)).valid
        assert drive.t_ns < 3e9
    assert bound(drive.follow(said(0.0), sights(0.0))) < 0.5 * LANE_M


@pytest.mark.parametrize(("gap", "sure"), [(5.0, True), (7.0, False)])
def test_over_a_crossing_dead_reckoning_tells_the_lane_from_the_next_one(gap: float, sure: bool) -> None:
    """A road that bends unseen by a lane width also turns; over seven lane widths it may turn back."""
    drive = driving(config=replace(CONFIG, coast_s=10.0, coast_lanes=20.0))
    for _ in range(round(gap * LANE_M / (SPEED_MPS * STEP_S))):
        assert drive.follow(said(0.0, NONE)).valid
    assert drive.doubted
    while drive.doubted:
        told = bound(drive.follow(said(0.0), sights(0.0)))
        assert drive.t_ns < 10e9
    assert (told < 0.5 * LANE_M) == sure


def test_a_lane_far_from_where_the_odometry_puts_it_and_the_next_one_may_be_any() -> None:
    drive = driving()
    belief = drive.tracking._belief
    assert belief is not None
    assert max(drive.tracking._beside_reckoned(belief, belief)) < EXCEEDED
    assert drive.tracking._beside_reckoned(belief.moved(0.0, math.radians(50.0), STEP_S, True), belief) == (1.0, 1.0)


@pytest.mark.parametrize("side", [+1, -1])
def test_a_lane_to_the_left_of_dead_reckonings_is_likelier_the_left_one(side: int) -> None:
    drive = driving()
    assert drive.tracking._belief is not None
    reckoned = drive.tracking._belief.without_road().moved(6.0 * LANE_M, 0.0, 1.2, True)
    aside = reckoned.displaced(0.5 * side * LANE_M, 0.0, np.zeros((2, 2)))
    left, right = drive.tracking._beside_reckoned(aside, reckoned)
    assert (left > 1e3 * right) if side > 0 else (right > 1e3 * left)


class TwoStories(Hypotheses):
    """Besides the likeliest story another one lives on, of a lane aside: of the same lines, or of other ones."""

    def __init__(self, other_lines: bool) -> None:
        super().__init__()
        self._other = -1.0 if other_lines else 0.0

    def update(self, *args: Any, **options: Any) -> float:
        news = super().update(*args, **options)
        best = self.all[0]
        other = best.belief.displaced(0.2 * LANE_M, 0.0, np.zeros((2, 2)))
        roles = tuple(Assigned(line, role + self._other) for line, role in best.assigned)
        self.all = (best, replace(best, belief=other, log_odds=best.log_odds - 2.0, assigned=roles))
        return news


def with_two_stories(other_lines: bool) -> tuple[Drive, float]:
    """A car beyond a gap, whose lane may be two; and the bound of dead reckoning."""
    drive = driving(config=replace(CONFIG, coast_s=10.0, coast_lanes=20.0))
    for _ in range(round(5.0 * LANE_M / (SPEED_MPS * STEP_S))):
        blind = bound(drive.follow(said(0.0, NONE)))
    two = TwoStories(other_lines)
    two.start([(one.belief, one.log_odds) for one in drive.tracking._hypotheses.all], learnt=True)
    drive.tracking._hypotheses = two
    return drive, blind


@pytest.mark.parametrize(
    ("roles", "other_lines", "tell"), [(BOTH, False, True), (BOTH, True, False), ((RIGHT,), False, False)]
)
def test_in_doubt_both_lines_tell_the_lane_where_all_stories_take_them_for_its_own(
    roles: Sequence[float], other_lines: bool, tell: bool
) -> None:
    """How far aside the car stands in it is not known yet, but better than dead reckoning knows."""
    drive, blind = with_two_stories(other_lines)
    told = drive.follow(said(0.0, NONE), sights(0.0, roles))
    assert drive.doubted
    assert (bound(told) < 0.5 * blind) is tell


def test_what_tells_the_lane_in_one_frame_does_not_in_the_next_without_lines() -> None:
    drive, blind = with_two_stories(other_lines=False)
    drive.follow(said(0.0, NONE), sights(0.0))
    assert bound(drive.follow(said(0.0, NONE))) > blind


def test_in_doubt_what_the_estimator_takes_for_its_lines_contradicts_no_odometry() -> None:
    """It follows the line, and then the end of a zebra's bar; the likeliest story has lines that stand still."""
    drive, _ = with_two_stories(other_lines=False)
    for frame in range(24):
        aside_m = 0.3 * LANE_M if frame // 8 % 2 else 0.0
        drive.follow(said(aside_m, (LEFT,)), sights(0.0, (RIGHT,)))
        assert drive.doubted
        assert drive.tracking._unmoved is None


@pytest.mark.parametrize(("aside", "contradicts"), [(1.0, False), (0.35, True)])
def test_the_right_line_that_is_taken_for_the_left_one_is_no_slip(aside: float, contradicts: bool) -> None:
    """Nor is the left one that is seen after it; a line that has moved by less than half a lane width is."""
    drive, contradicted = driving(), False
    for lanes in (aside, 0.0):
        for _ in range(8):
            drive.predict()
            drive.tracking._see_paint(said(lanes * LANE_M, (LEFT,)))
            contradicted |= drive.tracking._unmoved is not None
    assert contradicted is contradicts


def test_in_doubt_lines_of_the_likeliest_story_that_move_contradict_the_odometry() -> None:
    drive, _ = with_two_stories(other_lines=False)
    contradicted = False
    for frame in range(24):
        drive.follow(said(0.0, NONE), sights(0.01 * LANE_M * frame))
        contradicted |= drive.doubted and drive.tracking._unmoved is not None
    assert contradicted


def test_behind_a_gap_a_worn_line_is_that_of_the_lane_where_dead_reckoning_has_it() -> None:
    """It looks dashed, as that of the oncoming lane."""
    drive = driving(config=replace(CONFIG, coast_s=10.0, coast_lanes=20.0))
    for _ in range(100):
        drive.follow(said(0.0), country_road(0.0))
    for _ in range(round(4.0 * LANE_M / (SPEED_MPS * STEP_S))):
        drive.follow(said(0.0, NONE))
    assert drive.doubted
    (line,) = sights(0.0, (RIGHT,))
    for _ in range(20):
        told = drive.follow(said(0.0, (RIGHT,)), (replace(line, painted_m=DASHED * line.span_m),))
    assert not drive.doubted
    assert bound(told) < 0.5 * LANE_M


def test_an_estimator_is_no_surer_than_the_lines_that_it_follows() -> None:
    """However sure it says it is: the points of a line have an error in common."""
    tracking = LaneTracking(CAR, CONFIG, AHEAD.length_m)
    sure = replace(said(0.0).pose, covariance=1e-8 * np.eye(3))
    line_m = tracking.road.line_sigma * LANE_M
    assert tracking._measured(sure).sigma(Part.OFFSET) == pytest.approx(line_m / math.sqrt(2.0), rel=0.01)
    assert tracking._measured(sure).sigma(Part.WIDTH) == pytest.approx(line_m * math.sqrt(2.0), rel=0.01)


@pytest.mark.parametrize("jump", [0.6, -0.6])
def test_after_a_jump_to_another_line_the_estimator_is_sent_back(jump: float) -> None:
    drive = driving()
    drive.follow(said(jump * LANE_M), sights(0.0))
    anew = []
    for _ in range(10):
        drive.follow(said(jump * LANE_M, (LEFT if jump > 0.0 else RIGHT,)), sights(0.0))
        if drive.anew is not None:
            anew.append(drive.anew)
            break
    assert anew
    assert anew[0].offset_m == pytest.approx(0.0, abs=0.03)
    assert not drive.doubted
    for _ in range(5):  # it does as it is told
        assert drive.follow(said(0.0), sights(0.0)).status is LaneStatus.TRACKING
    assert not drive.doubted


@pytest.mark.parametrize("way", [0.3, -0.3])
def test_an_estimator_that_no_line_bears_out_is_sent_back_to_where_the_odometry_puts_the_lane(way: float) -> None:
    drive = driving()
    drive.follow(said(way * LANE_M, NONE))
    drive.tracking._contradict(drive.tracking._measured(said(0.0).pose))
    drive.follow(said(way * LANE_M, NONE))
    assert drive.anew is not None
    assert drive.anew.offset_m == pytest.approx(0.0, abs=0.02)


def test_what_takes_over_must_be_seen_at_once_and_not_be_drawn_there_step_by_step() -> None:
    drive = driving()
    tracking, here = drive.tracking, drive.tracking._measured(said(0.0).pose)
    tracking._contradict(here)
    assert tracking._at_once(here, sights(0.0))
    turned = tracking._measured(said(0.0, heading_rad=-0.2).pose)
    lines = tuple(line_of(Road(heading_rad=0.2), role, 0.3, 0.6) for role in BOTH)
    assert not tracking._at_once(turned, lines)  # dead reckoning knows the heading better
    assert not tracking._at_once(here, sights(0.0, NONE))


def test_no_paint_is_a_witness_twice() -> None:
    tracking, lines = LaneTracking(CAR, CONFIG, AHEAD.length_m), sights(0.0)
    beside = lines[0].points_m + np.array((0.0, 2.0 * CAR.lane.marking_width_m))
    assert tracking._together(lines, [line.points_m for line in lines]) == lines
    both = tracking._together(lines, [np.concatenate((lines[0].points_m, beside))])
    assert len(both) == len(lines) + 1
    assert {tuple(point) for point in both[-1].points_m} <= {tuple(point) for point in beside}


def test_points_that_no_scan_finds_are_specks_however_far_apart() -> None:
    """Ends of a zebra's bars, which an estimator takes for a line: a long one would be likelier a line's."""
    tracking, line = LaneTracking(CAR, CONFIG, AHEAD.length_m), sights(0.0, (LEFT,))[0]
    (specks,) = tracking._together((), [line.points_m[::4]])
    assert specks.painted_m < 0.3 * line.painted_m
    (dense,) = tracking._together((), [np.linspace(line.points_m[0], line.points_m[-1], 100)])
    assert dense.painted_m == pytest.approx(line.painted_m)


def test_a_look_at_lines_that_agree_ends_the_doubt() -> None:
    drive = driving()
    drive.follow(said(0.6 * LANE_M))
    assert drive.doubted
    for _ in range(10):
        estimate = drive.follow(said(0.0), sights(0.0, (LEFT, RIGHT, LEFT_FAR)))
        assert drive.anew is None
    assert not drive.doubted
    assert bound(estimate) < 0.3 * LANE_M


@pytest.mark.parametrize(("log_odds", "counts"), [(-6.0, True), (-6.9072, False)])
def test_a_story_that_is_less_likely_than_a_bound_may_be_exceeded_does_not_widen_it(
    log_odds: float, counts: bool
) -> None:
    drive = driving()
    belief = drive.tracking._belief
    assert belief is not None
    drive.tracking._doubt(belief)
    drive.tracking._hypotheses.start(((belief, 0.0), (belief.beside_it(+1), log_odds)))
    estimate = drive.follow(said(0.0, NONE))
    assert len(drive.tracking._hypotheses.all) == 2
    assert (bound(estimate) > LANE_M) == counts


@pytest.mark.parametrize("seen", [(RIGHT,), NONE])
def test_a_line_that_was_in_view_before_dead_reckoning_lost_the_lane_ends_a_doubt_alone(
    seen: tuple[float, ...],
) -> None:
    drive = driving(config=replace(CONFIG, coast_s=10.0, coast_lanes=20.0))
    belief = drive.tracking._belief
    assert belief is not None
    drive.tracking._doubt(belief.without_road())
    while drive.tracking._reckoned is not None and not drive.tracking._confusable(drive.tracking._reckoned, 1.0):
        drive.follow(said(0.0, NONE), sights(0.0, seen))
        assert drive.doubted  # by a line that the estimator does not see
    drive.follow(said(0.0, (RIGHT,)), sights(0.0, (RIGHT,)))
    assert drive.doubted == (not seen)  # a line that is seen only now may be the next lane's


@pytest.mark.parametrize(("sigma", "least", "most"), [(0.2, 1, 3), (0.3, 30, 30)])
def test_a_line_that_is_seen_only_now_ends_a_doubt_where_it_can_hardly_be_the_next_lanes(
    sigma: float, least: int, most: int
) -> None:
    """`sigma`: of the lane's place beside the car, in lane widths; the next lane's line is one of these away."""
    drive = driving()
    belief = drive.tracking._belief
    assert belief is not None
    covariance = belief.covariance.copy()
    covariance[Part.OFFSET, Part.OFFSET] += (sigma * LANE_M) ** 2
    drive.tracking._doubt(replace(belief, covariance=covariance))
    frames = 0
    while drive.doubted and frames < 30:
        drive.follow(said(0.0, (RIGHT,)), sights(0.0, (RIGHT,)))
        frames += 1
    assert least <= frames <= most


@pytest.mark.parametrize(("log_odds", "ends"), [(-3.0, False), (-9.0, True)])
@pytest.mark.parametrize("seen", [BOTH, NONE])
def test_a_doubt_lasts_as_long_as_another_story_is_likelier_than_a_bound_may_be_exceeded(
    seen: tuple[float, ...], log_odds: float, ends: bool
) -> None:
    drive = driving()
    belief = drive.tracking._belief
    assert belief is not None
    drive.tracking._doubt(belief)
    drive.tracking._hypotheses.start(((belief, 0.0), (belief.beside_it(+1), log_odds)), learnt=True)
    drive.follow(said(0.0, seen), sights(0.0))
    assert drive.doubted != ends


def far(followed: Followed, from_m: float) -> Followed:
    """Its lines are those of a car on the centerline, and begin so far ahead of the reference point."""
    from_x_m = CAR.vehicle.reference_x_m + from_m
    left, right = (
        replace(line, points_m=points[points[:, 0] > from_x_m] if line.seen else line.points_m)
        for line, points in zip((followed.left, followed.right), (each.points_m for each in sights(0.0)), strict=True)
    )
    return replace(followed, left=left, right=right)


def unsure(followed: Followed) -> Followed:
    """The same from an estimator that has not seen a line for long."""
    covariance = np.diag(np.square((0.06, 0.3, 0.02)))
    return replace(followed, pose=replace(followed.pose, covariance=covariance))


@pytest.mark.parametrize(("seen", "looks"), [(BOTH, 1), ((LEFT,), 4), (NONE, 4)])
def test_all_lines_in_view_are_wanted_every_lane_width_where_both_are_followed_and_else_four_times_as_often(
    seen: Sequence[float], looks: int
) -> None:
    drive, wanted = driving(), 0
    for _ in range(12):  # of 5 cm each: one and a half lane widths
        drive.predict()
        wanted += drive.tracking.looks_around(said(0.0, seen))
        if drive.tracking.looks_around(said(0.0, seen)):
            drive.tracking.judge(sights(0.0), said(0.0, seen))
    assert wanted == looks


def test_a_blind_and_unsure_estimator_is_sent_to_the_line_that_is_in_view() -> None:
    drive = driving()
    sent = []
    for _ in range(6):
        drive.follow(unsure(said(0.0, NONE, heading_rad=0.1)), sights(0.0, (LEFT,)))
        sent.append(drive.anew)
    found = [one for one in sent if one is not None]
    assert found
    assert found[0].offset_m == pytest.approx(0.0, abs=0.015)
    assert found[0].heading_rad == pytest.approx(0.0, abs=0.03)


@pytest.mark.parametrize(
    ("said_rad", "reckoned_rad", "line_rad", "sent_rad"),
    [(0.3, 0.0, 0.05, 0.05), (0.3, 0.0, -0.05, -0.05), (0.02, 0.0, 0.0, None), (0.3, 0.4, 0.0, 0.4)],
)
def test_in_doubt_an_estimator_that_sees_nothing_is_put_where_one_line_and_dead_reckoning_have_the_lane(
    said_rad: float, reckoned_rad: float, line_rad: float, sent_rad: float | None
) -> None:
    """The doubt goes on until it sees the lane, too. Where these contradict, dead reckoning has it."""
    drive = driving()
    drive.tracking._contradict(drive.tracking._measured(said(0.0, heading_rad=reckoned_rad).pose))
    for _ in range(3):
        drive.follow(said(0.0, NONE, heading_rad=said_rad), sights(0.0, (LEFT,), line_rad))
        assert drive.doubted
        assert (drive.anew is None) == (sent_rad is None)
    if drive.anew is not None:
        assert drive.anew.heading_rad == pytest.approx(sent_rad, abs=0.02)


@pytest.mark.parametrize(("sigma", "sent"), [(0.1, True), (0.01, False)])
def test_in_doubt_an_estimator_that_sees_nothing_and_knows_little_is_told_what_one_line_tells(
    sigma: float, sent: bool
) -> None:
    """A line that passes where it looks for one, but for the error of a bend that it draws on, is never found."""
    drive, blind = driving(), said(0.005, NONE)
    blind = replace(blind, pose=replace(blind.pose, covariance=np.diag(np.square((sigma * LANE_M, sigma, 0.005)))))
    drive.tracking._contradict(drive.tracking._measured(said(0.0).pose))
    for _ in range(3):
        drive.follow(blind, sights(0.0, (LEFT,)))
    assert (drive.anew is not None) == sent
    assert drive.doubted


@pytest.mark.parametrize(("seen", "off_m"), [(NONE, 0.012), (BOTH, 0.03)])
def test_an_estimator_that_only_extrapolates_is_put_where_the_lane_is_believed(
    seen: Sequence[float], off_m: float
) -> None:
    """However sure it is: its lines, if it sees any, are so far ahead that they fit the belief as well."""
    drive, sent = driving(), []
    for _ in range(6):
        told = drive.follow(far(said(off_m, seen), 2.0 * LANE_M), sights(0.0, (LEFT,)))
        assert not drive.doubted
        assert told.pose is not None
        assert told.pose.offset_m == pytest.approx(0.0, abs=0.01)
        assert told.centerline is not None
        _, aside_m = told.centerline.project((CAR.vehicle.reference_x_m, 0.0))
        assert aside_m == pytest.approx(told.pose.offset_m, abs=1e-4)
        sent.append(drive.anew)
    assert any(one is not None and abs(one.offset_m) < 0.01 for one in sent)


def test_an_estimator_whose_lines_reach_to_the_car_is_told_as_it_is() -> None:
    drive = driving()
    for seen in (BOTH, (LEFT,), BOTH):
        followed = said(0.005, seen)
        told = drive.follow(followed)
        assert told.pose is not None
        assert told.pose.offset_m == followed.pose.offset_m
        assert told.centerline is followed.centerline


def test_what_explains_nothing_in_view_is_not_told_however_likely_it_was() -> None:
    drive = driving()
    assert drive.tracking._belief is not None
    drive.tracking._doubt(drive.tracking._belief)
    drive.tracking._hypotheses.start(((drive.tracking._belief.moved(0.0, 0.7, STEP_S, True), 30.0),))
    told = drive.follow(far(said(0.02, (LEFT,)), 2.0 * LANE_M), sights(0.02, (LEFT,)))
    assert drive.doubted
    assert told.pose is not None
    assert told.pose.offset_m == 0.02


def test_dead_reckoning_where_no_car_can_be_is_not_told() -> None:
    drive = driving()
    assert drive.tracking._belief is not None
    drive.tracking._doubt(drive.tracking._belief.beside_it(+1))
    told = drive.follow(said(0.02, NONE))
    assert drive.doubted
    assert told.pose is not None
    assert told.pose.offset_m == 0.02


def test_without_odometry_the_estimator_is_told_even_where_it_extrapolates() -> None:
    drive = driving()
    told = drive.follow(far(said(0.005), 2.0 * LANE_M), known=False)
    assert told.pose is not None
    assert told.pose.offset_m == 0.005


def test_an_estimator_of_one_line_is_sent_to_the_lane_where_the_other_is_in_view_too() -> None:
    """Both lines in view say that the lane is narrower than the estimator holds, and so where it is."""
    drive, sent = driving(), []
    wrong = said(0.05, (LEFT,), width_m=LANE_M + 0.1)
    wrong = replace(wrong, left=said(0.0, (LEFT,)).left)  # it follows the real left line
    for _ in range(6):
        drive.follow(wrong, sights(0.0))
        sent.append(drive.anew)
    found = [one for one in sent if one is not None]
    assert found
    assert found[0].offset_m == pytest.approx(0.0, abs=0.01)
    assert found[0].width_m == pytest.approx(LANE_M, abs=0.02)


def test_a_speck_where_the_other_line_may_be_starts_nothing_anew() -> None:
    drive = driving()
    for aside in (0.03, 0.05, 0.03, 0.05, 0.03, 0.05):  # ever again farther out than the right line is
        speck = line_of(Road(aside_m=-aside), RIGHT, 1.2, 1.21, count=1)
        drive.follow(unsure(said(0.0, (LEFT,))), (*sights(0.0, (LEFT,)), speck))
        assert drive.anew is None


def test_a_speck_in_place_of_a_line_teaches_nothing_and_keeps_no_lane_alive() -> None:
    speck = line_of(Road(aside_m=-0.04), RIGHT, 1.2, 1.21, count=1)
    states, ends_ns = [], []
    for lines in ((), (speck,)):
        drive = driving()
        for _ in range(6):
            drive.follow(said(0.0, NONE), lines)
        assert drive.tracking._belief is not None
        states.append(drive.tracking._belief.state)
        while not drive.tracking.lost and drive.t_ns < 5_000_000_000:
            drive.follow(said(0.0, NONE), lines)
        ends_ns.append(drive.t_ns)
    assert states[1] == pytest.approx(states[0], abs=1e-12)
    assert ends_ns[1] == ends_ns[0] < 5_000_000_000


def test_a_line_that_is_followed_and_bears_nothing_out_begins_a_doubt() -> None:
    drive = driving(config=replace(CONFIG, coast_s=20.0, coast_lanes=50.0))
    piece = line_of(Road(), LEFT, painted=0.1, count=2)  # two points, little paint: hardly a line
    plain = said(0.0, (LEFT,))
    followed, way = replace(plain, left=replace(plain.left, points_m=piece.points_m)), 0.0
    while not drive.doubted and way < 10.0:
        drive.follow(followed, (piece,))
        way += SPEED_MPS * STEP_NS * 1e-9 / LANE_M
    news = drive.tracking.road.news
    assert news < way < news + CONFIG.glance


def test_a_lone_line_teaches_nothing_until_it_is_weighed_with_all_in_view() -> None:
    drive = driving()
    drive.follow(said(0.0, (LEFT,)), sights(0.0))  # a look at all of them
    before = drive.tracking._belief
    drive.predict()
    followed = replace(said(0.0, (LEFT,)), left=said(0.015, (LEFT,)).left)  # it follows something beside its line
    assert not drive.tracking.looks_around(followed)
    drive.tracking.follow(drive.frame, followed)
    after = drive.tracking._belief
    assert before is not None
    assert after is not None
    assert after.state[:ROAD] == pytest.approx(before.state[:ROAD], abs=1e-3)
    assert not drive.doubted


def test_a_doubt_keeps_the_road_that_was_seen_and_knows_that_it_may_be_another() -> None:
    drive = driving(config=replace(CONFIG, coast_s=10.0, coast_lanes=20.0))
    belief, ahead = drive.tracking._belief, ROAD + 4  # two lane widths
    assert belief is not None
    known = belief.covariance[ahead, ahead]
    drive.follow(said(0.15))
    assert drive.doubted
    likely, other, _ = drive.tracking._hypotheses.all  # the third gets wider
    assert likely.belief.covariance[ahead, ahead] < 1.2 * known
    assert other.belief.covariance[ahead, ahead] > 2.0 * known
    assert likely.log_odds - other.log_odds == pytest.approx(-math.log(EXCEEDED))
    blind = driving(config=drive.tracking.config)
    for _ in range(16):  # two lane widths
        doubtful = drive.follow(said(0.0, NONE))
        plain = blind.follow(said(0.0, NONE))
    assert drive.doubted
    assert bound(doubtful) < 1.5 * bound(plain)


@pytest.mark.parametrize("width", [1.2, 1.25])
def test_a_doubt_ends_where_both_lines_show_a_lane_that_got_wider(width: float) -> None:
    drive = driving()
    belief, right = drive.tracking._belief, LEFT - width
    assert belief is not None
    drive.tracking._doubt(belief)
    lines, middle = sights(0.0, (LEFT, right)), 0.5 * (LEFT + right)
    wide = said(-middle * LANE_M, BOTH, width_m=width * LANE_M)
    left, right_line = (replace(wide.left, points_m=line.points_m) for line in lines)
    for _ in range(12):
        told = drive.follow(replace(wide, left=left, right=right_line), lines)
    assert not drive.doubted
    assert told.pose is not None
    assert told.pose.width_m == pytest.approx(width * LANE_M, rel=0.02)


def test_in_doubt_the_odometry_is_as_sure_as_it_was_right_while_the_lane_was_followed() -> None:
    config = replace(CONFIG, coast_s=10.0, coast_lanes=20.0)
    fresh, driven = driving(config=config), driving(frames=1000, config=config)
    assumed = fresh.tracking.road.turn_rad
    for drive, least, most in ((fresh, 0.9, 1.0), (driven, 0.0, 0.6)):
        while not drive.doubted:
            assert drive.follow(said(0.0, NONE)).valid
        reckoned, on_any_road = drive.tracking._reckoned, drive.tracking._on_any_road
        assert reckoned is not None
        assert on_any_road is not None
        assert reckoned.road == on_any_road.road == drive.tracking._hypotheses.all[0].belief.road
        assert least * assumed < reckoned.road.turn_rad < most * assumed + 1e-9
        assert drive.tracking._learnt_road._heading_rad is None  # what is turned now is not learnt from
        while drive.doubted:
            drive.follow(said(0.0), sights(0.0))
        assert drive.tracking._belief is not None
        assert drive.tracking._belief.road.turn_rad == assumed
        assert drive.tracking._learnt_road._heading_rad is not None
        drive.tracking.forget()
        assert drive.tracking._learnt_road._heading_rad is None


def test_an_estimator_that_sees_a_bend_begin_is_not_sent_back_by_the_road_that_was_seen() -> None:
    drive = driving(config=replace(CONFIG, coast_s=10.0, coast_lanes=20.0))
    belief = drive.tracking._belief
    assert belief is not None
    drive.tracking._doubt(belief)
    while not drive.tracking._confusable(drive.tracking._on_any_road or belief):
        drive.follow(said(0.0, NONE))
    assert drive.tracking._reckoned is not None
    assert not drive.tracking._confusable(drive.tracking._reckoned)
    drive.follow(said(0.0, (LEFT,), heading_rad=0.5))
    assert drive.anew is None


def test_an_odometry_that_was_wrong_leaves_the_lane_in_doubt_until_its_lines_are_seen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drive = driving()
    monkeypatch.setattr(drive.tracking._odometry._images, "agrees", lambda frame, motion: False)
    drive.tracking._odometry.suspect()
    for _ in range(DISSENT - 1):
        assert drive.follow(said(0.0)).valid
    drive.predict()
    assert drive.doubted
    assert not drive.tracking.lost
    assert bound(drive.tracking.follow(drive.frame, said(0.0))) > 0.1 * LANE_M
    for _ in range(8):
        estimate = drive.follow(said(0.0), sights(0.0))
    assert not drive.doubted
    assert bound(estimate) < 0.15 * LANE_M


@pytest.mark.parametrize(("blind", "lost"), [(0, False), (12, True)])
def test_a_wrong_odometry_was_right_as_long_as_the_lines_bore_it_out(
    blind: int, lost: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After that the lane may be anywhere: it is looked for anew, where the car stands."""
    drive = driving(config=replace(CONFIG, coast_s=10.0, coast_lanes=20.0))
    for _ in range(blind):
        assert drive.follow(said(0.0, NONE), speed_mps=0.2).valid
    odometry = drive.tracking._odometry
    monkeypatch.setattr(odometry, "step", lambda frame, motion: motion)
    odometry.wrong = True
    drive.predict(speed_mps=0.2)
    assert drive.tracking.lost == lost
    if lost:
        assert drive.tracking.start(drive.t_ns, sights(0.02)) is not None
    else:
        assert drive.doubted
        assert bound(drive.tracking.follow(drive.frame, said(0.0))) < 0.5 * LANE_M


def test_a_lane_whose_lines_are_both_in_view_is_paired_however_often_it_is_doubted() -> None:
    drive = driving()
    drive.tracking._pair_m = 0.0
    for frames in range(1, 20):
        assert drive.tracking._belief is not None
        drive.tracking._doubt(drive.tracking._belief)
        drive.follow(said(0.0), sights(0.0))
        assert not drive.doubted
        assert drive.tracking.paired == (frames > 8)  # a lane width


def compiled_late() -> dict[str, int]:
    """Names of compiled functions that are first called with some types of arguments while a car drives; how many."""
    functions = {
        name: one
        for module in (evidence, lane_motion, lane_path, seen_places)
        for name, one in vars(module).items()
        if hasattr(one, "signatures")
    }
    assert len(functions) > 10
    Drive()
    before = {name: len(one.signatures) for name, one in functions.items()}
    drive = driving(0.02)
    for _ in range(6):
        drive.follow(said(0.0, NONE), sights(0.0, (LEFT,)))
    belief = drive.tracking._belief
    assert belief is not None
    drive.tracking._contradict(belief)
    for _ in range(6):
        drive.follow(said(0.0), sights(0.0, (LEFT, RIGHT, LEFT_FAR)), known=False)
    late = {name: len(one.signatures) - before[name] for name, one in functions.items()}
    return {name: count for name, count in late.items() if count}


def test_nothing_is_compiled_while_a_car_drives() -> None:
    """In a process of its own: what another test has compiled stays."""
    late = "from tests.tracking.test_lane_tracking import compiled_late; print(compiled_late())"
    root = Path(__file__).parents[2]
    told = subprocess.run([sys.executable, "-c", late], cwd=root, capture_output=True, text=True, check=True)
    assert told.stdout == "{}\n"


def test_without_a_lane_a_wrong_odometry_is_no_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = Drive()
    drive.predict()
    odometry = drive.tracking._odometry
    monkeypatch.setattr(odometry, "step", lambda frame, motion: motion)
    odometry.wrong = True
    drive.predict()
    assert not drive.doubted


@pytest.mark.parametrize("doubted", [False, True])
@pytest.mark.parametrize("uncertain", [False, True])
def test_an_estimator_that_sees_no_line_is_sent_back_to_the_road_that_is_remembered(
    uncertain: bool, doubted: bool
) -> None:
    drive, astray = driving(), said(0.1 * LANE_M, NONE)
    assert drive.follow(said(0.0, NONE), sights(0.0)).status is LaneStatus.COASTING
    if doubted:
        assert drive.tracking._belief is not None
        drive.tracking._contradict(drive.tracking._belief)
    for _ in range(6):
        drive.follow(unsure(astray) if uncertain else astray, ())
        if drive.anew is not None:
            break
    assert drive.anew is not None
    assert drive.anew.offset_m == pytest.approx(0.0, abs=0.02 * LANE_M)


def test_an_estimator_that_sees_no_line_in_the_first_frame_of_its_lane_is_sent_nowhere() -> None:
    drive = Drive()
    for _ in range(2):
        drive.predict()
    assert drive.tracking.reckons
    drive.tracking.begin(drive.t_ns, said(0.0).pose)
    assert drive.tracking.judge((), said(0.0, NONE)) is None


def test_an_estimator_that_sees_no_line_lives_on_lines_that_are_in_view() -> None:
    drive = driving()
    for _ in range(round(2.0 * CONFIG.coast_s / (1e-9 * STEP_NS))):
        estimate = drive.follow(said(0.0, NONE), sights(0.0))
    assert estimate.pose is not None
    assert bound(estimate) < 0.2 * LANE_M


def test_a_car_that_stands_looks_around_by_time() -> None:
    drive, lone = driving(), said(0.0, (LEFT,))
    drive.follow(lone, sights(0.0))
    assert not drive.tracking.looks_around(lone)
    for _ in range(12):
        drive.predict(speed_mps=0.0)
    assert drive.tracking.looks_around(lone)


def test_lines_in_view_correct_a_bend_that_was_remembered_wrongly() -> None:
    drive = driving()
    believed = drive.tracking._belief
    assert believed is not None
    state, covariance = believed.state.copy(), believed.covariance.copy()
    state[ROAD + 2 :] = 1.5  # a bend from one lane width on, and sure of it
    covariance[ROAD + 2 :, :] = covariance[:, ROAD + 2 :] = 0.0
    covariance[range(ROAD + 2, len(state)), range(ROAD + 2, len(state))] = 0.05**2
    drive.tracking._belief = replace(believed, state=state, covariance=covariance)
    drive.follow(said(0.0, NONE), sights(0.0))
    assert not drive.doubted
    assert drive.tracking._belief is not None
    assert abs(drive.tracking._belief.state[ROAD + 4]) < 0.5


def test_a_tight_bend_that_begins_at_once_is_believed_in_the_frame_that_shows_it() -> None:
    """To the left, of one and a half lane widths' radius."""
    drive, begins_m, radius_m = driving(), 1.2 * LANE_M, 1.5 * LANE_M
    ahead = np.array((CAR.vehicle.reference_x_m, 0.0))
    lines = (bending(role, begins_m, radius_m) for role in BOTH)
    drive.follow(said(0.0, NONE), tuple(sighted(line.points_m + ahead) for line in lines))
    assert not drive.doubted
    assert drive.tracking._belief is not None
    (a_metre_on,), _, _ = drive.tracking._belief.beside(np.array([1.0]), 0.0)
    assert a_metre_on[1] == pytest.approx(radius_m * (1.0 - math.cos((1.0 - begins_m) / radius_m)), abs=0.03)


def test_an_estimator_that_drifts_after_a_wrong_line_is_noticed_by_the_lines_in_view() -> None:
    drive, off = driving(), 0.0
    while off < 0.5 * LANE_M:
        off += 0.004  # so slowly that no step is an odd one
        estimate = drive.follow(said(off, (LEFT,)), sights(0.0))
        if drive.anew is not None:
            break
        assert bound(estimate) > off
    assert drive.anew is not None
    assert abs(drive.anew.offset_m) < 0.5 * off  # what it drifted before was believed in part


def test_blind_for_a_while_the_lane_is_doubted_and_found_again() -> None:
    drive = driving(config=replace(CONFIG, coast_s=10.0, coast_lanes=20.0))
    while not drive.tracking.lost and not drive.doubted:
        drive.follow(said(0.0, NONE))
    assert drive.doubted  # long before it is given up
    drive.follow(said(0.0), sights(0.0))
    assert not drive.doubted


def test_while_coasting_the_bound_grows() -> None:
    drive = driving()
    coasting = [drive.follow(said(0.0, NONE), speed_mps=0.5) for _ in range(15)]
    assert {estimate.status for estimate in coasting} == {LaneStatus.COASTING}
    bounds = [bound(estimate) for estimate in coasting]
    assert bounds == sorted(bounds)
    assert bounds[-1] > 1.3 * bounds[0]
    assert [estimate.frame_age_ns for estimate in coasting] == [k * STEP_NS for k in range(1, 16)]


@pytest.mark.parametrize(
    ("speed_mps", "known", "most_s"),
    [(0.0, True, 1.0), (2.0, True, 0.4), (-2.0, True, 0.4), (0.0, False, 2.0 / 3.0)],
)
def test_coasting_ends_by_time_and_by_way(speed_mps: float, known: bool, most_s: float) -> None:
    """Two lane widths, or a second; a car whose speed is unknown may drive three lane widths a second."""
    drive, statuses = driving(), []
    while not drive.tracking.lost:
        statuses.append(drive.follow(said(0.0, NONE), speed_mps=speed_mps, known=known).status)
    assert statuses[:-1] == [LaneStatus.COASTING] * (len(statuses) - 1)
    assert statuses[-1] is LaneStatus.LOST
    assert (len(statuses) - 1) * STEP_NS * 1e-9 == pytest.approx(most_s, abs=0.051)


@pytest.mark.parametrize("dt_ns", [round(MAX_GAP_S * 1e9) + 1, 0, -STEP_NS])
def test_a_gap_forgets_the_lane(dt_ns: int) -> None:
    drive = driving()
    drive.predict(dt_ns)
    assert drive.tracking.lost
    assert not drive.doubted
    drive.predict()
    assert drive.tracking.start(drive.t_ns, sights(0.1)) is not None


IMPOSSIBLE = [
    said(0.95 * LANE_M),
    said(0.0, width_m=1.6 * LANE_M),
    said(0.0, width_m=0.4 * LANE_M),
    said(0.0, heading_rad=math.radians(65.0)),
]
NOT_FINITE = [said(0.0, width_m=math.nan), said(0.0, heading_rad=math.inf)]


@pytest.mark.parametrize("followed", IMPOSSIBLE)
def test_a_pose_that_no_car_can_have_is_no_lane_but_that_of_dead_reckoning(followed: Followed) -> None:
    drive, blind = driving(), 0
    while drive.follow(followed).status is LaneStatus.COASTING:
        blind += 1
    assert 0 < blind < CONFIG.coast_s / STEP_S
    assert drive.tracking.lost


@pytest.mark.parametrize("followed", [*IMPOSSIBLE, *NOT_FINITE])
def test_a_pose_that_no_car_can_have_is_no_lane_where_no_odometry_is_given(followed: Followed) -> None:
    drive = driving()
    assert drive.follow(followed, known=False).status is LaneStatus.LOST
    assert drive.tracking.lost


@pytest.mark.parametrize("followed", NOT_FINITE)
def test_an_estimator_that_fails_has_no_lane(followed: Followed) -> None:
    drive = driving()
    assert drive.follow(followed).status is LaneStatus.LOST
    assert drive.tracking.lost


def test_a_lane_that_is_lost_has_the_age_of_its_last_line() -> None:
    drive = driving()
    drive.tracking.forget()
    drive.predict()
    drive.predict()
    assert drive.tracking.lost_estimate(drive.frame).frame_age_ns == 2 * STEP_NS


def test_after_a_reset_everything_is_as_at_the_beginning() -> None:
    used = driving(0.05)
    used.follow(said(0.6 * LANE_M))
    used.tracking.reset()
    assert used.tracking.lost
    used.t_ns, fresh = 0, Drive()
    told = []
    for drive in (used, fresh):
        drive.predict()
        start = drive.tracking.start(drive.t_ns, sights(0.02))
        assert start is not None
        told.append((start.mean.tolist(), bound(drive.tracking.follow(drive.frame, said(0.02)))))
    assert told[0] == told[1]


@pytest.mark.parametrize(("speed_mps", "gathers"), [(0.0, False), (SPEED_MPS, True)])
def test_a_car_that_stands_gathers_no_evidence_from_the_same_view(speed_mps: float, gathers: bool) -> None:
    drive, line = Drive(), sights(0.5 * LANE_M, (LEFT,))  # below the car: the left line, or the right one
    for _ in range(10):
        drive.predict(speed_mps=speed_mps)
        assert drive.tracking.start(drive.t_ns, line) is None
    best = drive.tracking._hypotheses.all[0]
    assert (best.log_odds > 2.0 * best.news) is gathers


def country_road(offset_m: float, mirrored: bool = False) -> tuple[SightedLine, ...]:
    """Two lanes: a dashed line to the left of the car's own, the oncoming lane's far line, the right edge."""
    side = -1.0 if mirrored else 1.0
    road, dashed, solid = Road(aside_m=-offset_m), side * LEFT, (side * LEFT_FAR, side * RIGHT)
    lines = [line_of(road, role, -0.5, 1.5) for role in solid]
    return (*lines, line_of(road, dashed, -0.5, 1.5, painted=DASHED))


@pytest.mark.parametrize("mirrored", [False, True])
def test_who_follows_the_oncoming_lane_is_told_by_the_kinds_of_its_lines(mirrored: bool) -> None:
    side = -1.0 if mirrored else 1.0
    drive = driving()
    for _ in range(100):
        drive.follow(said(0.0), country_road(0.0, mirrored))
    assert bound(drive.follow(said(0.0))) < 0.3 * LANE_M
    for _ in range(14):  # an intersection
        drive.follow(said(0.0, NONE))
    oncoming, tracking = country_road(side * LANE_M, mirrored), drive.tracking
    anew, wide = None, 0
    for _ in range(160):  # the estimator takes the oncoming lane's lines for its own
        drive.predict()
        anew = tracking.judge(oncoming, said(0.0)) if tracking.looks_around(said(0.0)) else None
        if anew is not None:
            break
        wide += bound(tracking.follow(drive.frame, said(0.0))) > LANE_M
    assert anew is not None
    assert wide > 0  # before it was sure
    assert anew.offset_m == pytest.approx(side * LANE_M, abs=0.1 * LANE_M)
    back = said(anew.offset_m, (LEFT,) if side > 0 else (RIGHT,))
    for _ in range(3):  # it starts anew from there, beside its lane
        assert tracking.follow(drive.frame, back).status is LaneStatus.ONE_LINE
        drive.predict()
    assert not drive.doubted


@pytest.mark.parametrize("own", [True, False])
def test_in_doubt_the_kinds_of_the_lines_tell_the_lane_from_the_next_one(own: bool) -> None:
    """Behind a gap the car is on the left one of two lines: its own lane's, or its right line and one beyond."""
    drive = driving(config=replace(CONFIG, coast_s=10.0, coast_lanes=20.0))
    for _ in range(100):
        drive.follow(said(0.0), country_road(0.0))
    for _ in range(round(6.0 * LANE_M / (SPEED_MPS * STEP_S))):
        drive.follow(said(0.0, NONE))
    assert drive.doubted
    painted = (DASHED, 1.0) if own else (1.0, DASHED)
    pair = zip(sights(0.5 * LANE_M), painted, strict=True)
    told = drive.follow(said(0.0, NONE), tuple(replace(line, painted_m=share * line.span_m) for line, share in pair))
    assert told.pose is not None
    assert told.pose.offset_m == pytest.approx(math.copysign(0.5 * LANE_M, 1.0 if own else -1.0), abs=0.05 * LANE_M)


def test_a_line_that_becomes_solid_leaves_the_lane_as_it_is() -> None:
    drive = driving()
    for _ in range(100):
        drive.follow(said(0.0), country_road(0.0))
    for _ in range(100):
        estimate = drive.follow(said(0.0), sights(0.0, (LEFT_FAR, *BOTH)))
        assert drive.anew is None
        assert bound(estimate) < 0.3 * LANE_M


def test_in_doubt_the_likeliest_story_is_told_and_the_estimator_sent_there_once_its_own_is_dead() -> None:
    """It follows something beside the left line, which reaches to the car; in view is the right one."""
    drive, off, sent = driving(), 0.3 * LANE_M, []
    told = drive.follow(said(off, (LEFT,)), sights(0.0, (RIGHT,)))
    assert drive.doubted
    assert not drive.tracking._odometry.borne_out  # the odometry may be what is wrong: the estimator is told
    assert told.pose is not None
    assert told.pose.offset_m == off
    drive.tracking._odometry.reset()
    for _ in range(10):
        told = drive.follow(said(off, (LEFT,)), sights(0.0, (RIGHT,)))
        assert told.pose is not None
        assert told.pose.offset_m == pytest.approx(0.0, abs=0.02)
        sent += [] if drive.anew is None else [drive.anew]
    assert sent
    assert sent[0].offset_m == pytest.approx(0.0, abs=0.02)
    assert drive.doubted


def test_in_doubt_what_was_likely_is_told_where_nothing_is_in_view() -> None:
    drive, off = driving(), 0.3 * LANE_M
    for _ in range(3):
        drive.follow(said(off, (LEFT,)), sights(0.0, (RIGHT,)))
        drive.tracking._odometry.reset()
    reckoned = drive.tracking._reckoned
    assert reckoned is not None
    drive.tracking._reckoned = reckoned.moved(0.0, 0.0, 10.0, False)  # that knows nothing any more
    told = drive.follow(said(off, NONE))
    assert drive.doubted
    assert told.pose is not None
    assert told.pose.offset_m == pytest.approx(0.0, abs=0.02)


def test_the_lines_that_were_followed_do_not_teach_anew_because_there_is_a_doubt() -> None:
    drive = driving()
    before = drive.tracking._belief
    assert before is not None
    drive.tracking._doubt(before)
    drive.follow(said(0.0), sights(0.0))
    after = drive.tracking._belief
    assert after is not None
    assert not drive.doubted
    assert after.sigma(Part.OFFSET) > 0.95 * before.sigma(Part.OFFSET)


def test_an_estimator_that_says_what_cannot_be_is_sent_back_where_dead_reckoning_knows_the_lane() -> None:
    drive = driving()
    for impossible in IMPOSSIBLE:
        assert drive.tracking.looks_around(impossible)
        sent = drive.tracking.judge(sights(0.0), impossible)
        assert sent is not None
        assert sent.offset_m == pytest.approx(0.0, abs=0.01)
        told = drive.follow(impossible, sights(0.0))  # it says so again
        assert told.status is LaneStatus.COASTING
        assert told.pose is not None
        assert told.pose.offset_m == pytest.approx(0.0, abs=0.01)
    told = drive.follow(said(0.0), sights(0.0))
    assert told.status is LaneStatus.TRACKING


def test_a_lane_that_dead_reckoning_has_left_is_lost() -> None:
    drive = driving()
    belief = drive.tracking._belief
    assert belief is not None
    belief.state[lane_path.OFFSET] = 1.2 * LANE_M
    assert drive.follow(said(1.2 * LANE_M, NONE)).status is LaneStatus.LOST


def test_an_estimator_that_goes_on_with_another_thing_as_its_line_is_sent_back_as_the_doubt_ends() -> None:
    """A lamp beside the line, which no scan of the view takes for a line: a narrower lane where the lane may be."""
    aside, right = 0.2 * LANE_M, sights(0.0, (RIGHT,))
    misled = replace(said(0.5 * aside, width_m=LANE_M - aside), left=said(-aside).left, right=said(0.0).right)
    drive = driving()
    drive.follow(misled, right)
    assert drive.doubted
    drive.follow(misled, right)
    assert not drive.doubted
    assert drive.anew is not None
    assert drive.anew.offset_m == pytest.approx(0.0, abs=0.01)
    assert drive.anew.width_m == pytest.approx(LANE_M, abs=0.02)


def test_lines_in_view_tell_the_lane_where_an_estimator_says_what_cannot_be_and_the_odometry_is_suspected() -> None:
    drive, impossible = driving(), said(0.0, width_m=0.4 * LANE_M)
    drive.tracking._odometry.suspect()
    for _ in range(3):
        told = drive.follow(impossible, sights(0.0, (RIGHT,)))
        assert drive.anew is not None
        assert drive.anew.offset_m == pytest.approx(0.0, abs=0.01)
        assert told.valid
        assert told.pose is not None
        assert told.pose.offset_m == pytest.approx(0.0, abs=0.01)
    unseen = [drive.follow(impossible)]
    assert drive.doubted
    assert drive.anew is not None
    assert unseen[0].pose is not None
    assert told.pose is not None
    turned_rad = LOST_TURN_RAD * 1e-9 * STEP_NS  # since then, by whatever motion
    assert unseen[0].pose.heading_bound_rad > math.hypot(turned_rad, told.pose.heading_bound_rad)
    unseen += [drive.follow(impossible) for _ in range(10)]
    bounds = [one.pose.offset_bound_m for one in unseen if one.pose is not None]
    assert len(bounds) > 1  # a lane that was seen a moment ago is not forgotten
    assert bounds == sorted(bounds)
    assert bounds[0] < bounds[-1] < LANE_M
    assert unseen[-1].status is LaneStatus.LOST  # the car may have left it
