"""Both lines and the pose between them: start, move, update, and the prediction of lines that are not seen."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.estimation.theta.tracked_lane import TrackedLane
from automodel.estimation.theta.tracked_line import SeenLine
from automodel.geometry import SE2
from tests.support.measured_lanes import REFERENCE_M, UNIT
from tests.support.world_lanes import WorldLane, arc

NOTHING = SeenLine(points_m=np.empty((0, 2)), sigma_m=np.empty(0))
STEP_M, DT_S = 0.03, 0.03
START = np.diag(np.square((0.05, 0.1, 0.5, 0.04)))
SEES = {"both": (1, -1), "left": (1,), "right": (-1,), "none": ()}


class Drive:
    """A car at a constant offset and heading in a lane, and what is tracked of the lane."""

    def __init__(self, lane: WorldLane, offset_m: float = 0.03, s_m: float = 2.0, sees: str = "both") -> None:
        self.lane, self.offset_m, self.s_m = lane, offset_m, s_m
        self.tracked = TrackedLane(UNIT, REFERENCE_M)
        self.car = lane.car(s_m, offset_m, 0.0, REFERENCE_M)
        kappa = float(lane.curvature(np.array((s_m,)))[0])
        assert self.tracked.start(*self.seen(sees), np.array((offset_m, 0.0, kappa, UNIT)), START)

    def seen(self, sees: str, least_m: float = 0.35) -> tuple[SeenLine, SeenLine]:
        """Both lines, from `least_m` to 1.5 m ahead of the reference point."""
        lines = []
        for side in (1, -1):
            if side not in SEES[sees]:
                lines.append(NOTHING)
                continue
            points = self.lane.seen_from(self.car, np.arange(self.s_m + least_m, self.s_m + 1.5, 0.05), side)
            lines.append(SeenLine(points_m=points, sigma_m=np.full(len(points), 0.004)))
        return lines[0], lines[1]

    def go(self, frames: int, sees: str = "both", known: bool = True) -> tuple[bool, bool]:
        """On along the lane; what was seen in the last frame."""
        taken = (False, False)
        for _ in range(frames):
            self.s_m += STEP_M
            before, self.car = self.car, self.lane.car(self.s_m, self.offset_m, 0.0, REFERENCE_M)
            motion = self.car.inverse() @ before
            if known:
                self.tracked.move(motion, math.hypot(motion.x_m, motion.y_m), DT_S, True)
            else:
                self.tracked.move(SE2(), 0.0, DT_S, False)
            taken = self.tracked.update(*self.seen(sees))
        return taken

    def check(self, offset_m: float = 0.002, heading_deg: float = 0.8) -> None:
        pose = self.tracked.pose
        assert pose.offset_m == pytest.approx(self.offset_m, abs=offset_m)
        assert pose.heading_rad == pytest.approx(0.0, abs=math.radians(heading_deg))


def test_there_is_no_centerline_before_start() -> None:
    tracked = TrackedLane(UNIT, REFERENCE_M)
    with pytest.raises(ValueError, match="no lane; call start first"):
        _ = tracked.centerline
    straight = np.array((0.0, 0.0, 0.0, UNIT))
    assert not tracked.start(NOTHING, NOTHING, straight, START)
    few = SeenLine(points_m=np.array([(0.5, 0.2), (0.6, 0.2), (0.7, 0.2)]), sigma_m=np.full(3, 0.004))
    assert not tracked.start(few, few, straight, START)


@pytest.mark.parametrize("bend", [0.0, 0.8, -1.0])
def test_start_with_both_lines(bend: float) -> None:
    drive = Drive(arc(bend))
    assert drive.tracked.left.line is not None
    assert drive.tracked.right.line is not None
    drive.check(0.02, 5.0)
    drive.go(60)
    drive.check()
    assert drive.tracked.pose.width_m == pytest.approx(UNIT, abs=0.002)
    assert drive.tracked.centerline.curvature_at(0.0) == pytest.approx(bend, abs=0.08)
    assert drive.tracked.blind_m == 0.0


@pytest.mark.parametrize("sees", ["left", "right"])
@pytest.mark.parametrize("bend", [0.0, 0.8])
def test_start_with_one_line(sees: str, bend: float) -> None:
    """The other one is taken to be a lane's width beside it."""
    drive = Drive(arc(bend), sees=sees)
    tracked = drive.tracked
    assert (tracked.left.line is None) == (sees == "right")
    assert (tracked.right.line is None) == (sees == "left")
    assert drive.go(60, sees) == (sees == "left", sees == "right")
    drive.check(0.004)
    assert tracked.pose.width_m == pytest.approx(UNIT, abs=0.01 * UNIT)  # one line says nothing of it
    sigma = math.sqrt(tracked.pose.covariance[0, 0])
    both = Drive(arc(bend))
    both.go(60)
    assert sigma > 5.0 * math.sqrt(both.tracked.pose.covariance[0, 0])


@pytest.mark.parametrize("sees", ["left", "right"])
def test_one_line_starts_beside_the_other_one(sees: str) -> None:
    drive = Drive(arc(0.5), sees=sees)
    drive.go(30, sees)
    assert drive.go(1) == (True, True)
    drive.go(60)
    drive.check()
    assert drive.tracked.left.line is not None
    assert drive.tracked.right.line is not None


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("bend", [0.0, 0.8, -0.8])
@pytest.mark.parametrize("sees", ["both", "left", "right"])
def test_lines_are_expected_where_they_are(side: float, bend: float, sees: str) -> None:
    drive = Drive(arc(bend), sees=sees)
    drive.go(60, sees)
    points, heading, known_m = drive.tracked.expected(side, 1.0)
    assert len(points) == len(heading)
    beside = drive.lane.beside(np.linspace(0.0, 9.0, 45_001), side * 0.5 * UNIT)
    away = [np.hypot(*(beside - place).T).min() for place in drive.car.apply(points)]
    assert max(away) < 0.012
    tangents = np.gradient(points, axis=0)
    assert np.arctan2(tangents[1:-1, 1], tangents[1:-1, 0]) == pytest.approx(heading[1:-1], abs=0.02)
    assert points[0, 0] < REFERENCE_M  # it begins behind the reference point
    driven_m = float(np.hypot(*np.diff(points, axis=0).T).sum())
    length = 1.0 + 0.5 * UNIT
    bent = 1.0 if sees == "both" or (side > 0) == (sees == "left") else 1.0 - bend * side * 0.5 * UNIT
    assert driven_m == pytest.approx(length * bent, rel=0.03)
    assert 0.5 * UNIT + 1.2 < known_m < 0.5 * UNIT + 2.2


def test_a_line_that_is_not_seen_is_kept_for_a_while() -> None:
    drive = Drive(arc(0.0))
    drive.go(60)
    kept = round(TrackedLane.KEPT_LANES * UNIT / STEP_M)
    drive.go(kept - 1, "left")
    assert drive.tracked.right.line is not None
    assert drive.tracked.right.unseen_m == pytest.approx((kept - 1) * STEP_M)
    drive.go(kept, "left")
    assert drive.tracked.right.line is None
    drive.check()
    drive.go(60, "left")
    drive.check(0.004)


def test_a_line_whose_direction_is_forgotten_is_expected_beside_the_centerline() -> None:
    """In a bend that began while it was out of sight."""
    bend = 0.8
    lane = WorldLane(lambda s: np.where(s < 4.0, 0.0, bend), 10.0, UNIT)
    drive = Drive(lane, s_m=2.0)
    drive.go(round(1.6 / STEP_M))
    sees = round(0.8 * TrackedLane.KEPT_LANES * UNIT / STEP_M)
    drive.go(sees, "left")
    right = drive.tracked.right
    assert right.line is not None
    assert right.rls.heading_variance_here() > TrackedLane.KNOWN_RAD**2
    points, _, _ = drive.tracked.expected(-1.0, 1.0)
    beside = lane.beside(np.linspace(0.0, 9.0, 45_001), -0.5 * UNIT)
    away = [np.hypot(*(beside - place).T).min() for place in drive.car.apply(points)]
    assert max(away) < 0.02


def glimpse(drive: Drive, sees: str, frames: int) -> None:
    """Frames that show the line that was not seen from 0.9 m ahead on."""
    for _ in range(frames):
        drive.go(1, "none")
        left, right = drive.seen("both")
        far = drive.seen("both", least_m=0.9)
        drive.tracked.update(*((left, far[1]) if sees == "left" else (far[0], right)))


@pytest.mark.parametrize("sees", ["left", "right"])
def test_the_width_is_measured_where_a_line_comes_into_view(sees: str) -> None:
    """By both lines there; beside the car only one of them has been seen."""
    width_m = 1.2 * UNIT
    drive = Drive(arc(0.0, width_m=width_m), sees=sees)
    drive.go(30, sees)
    known = drive.tracked.pose.width_m
    glimpse(drive, sees, 1)
    assert abs(drive.tracked.pose.width_m - width_m) > 0.8 * abs(known - width_m), "a glimpse is none"
    glimpse(drive, sees, 2)
    assert abs(drive.tracked.pose.width_m - width_m) < 0.5 * abs(known - width_m)


def test_frames_that_measure_the_same_width_ahead_weigh_as_one() -> None:
    """Its taper up to there is the same for all of them."""
    drive = Drive(arc(0.0), sees="left")
    drive.go(30, "left")
    glimpse(drive, "left", 3)
    first = math.sqrt(drive.tracked.pose.covariance[2, 2])
    glimpse(drive, "left", 3)
    assert math.sqrt(drive.tracked.pose.covariance[2, 2]) > 0.9 * first


def test_blind_way_and_what_is_coasted() -> None:
    drive = Drive(arc(0.6))
    drive.go(60)
    before = drive.tracked.pose.covariance
    assert drive.go(17, "none") == (False, False)  # half a metre
    assert drive.tracked.blind_m == pytest.approx(17 * STEP_M * (1.0 - 0.6 * 0.03), rel=0.01)
    drive.check(0.01, 3.0)
    after = drive.tracked.pose.covariance
    assert (np.diag(after) > np.diag(before)).all()
    assert drive.go(1) == (True, True)
    assert drive.tracked.blind_m == 0.0
    drive.check(0.01, 3.0)


def test_blind_way_grows_with_time_where_the_motion_is_not_known() -> None:
    drive = Drive(arc(0.0))
    drive.go(20)
    assert drive.tracked.motion_known
    drive.go(10, "none", known=False)
    assert not drive.tracked.motion_known
    assert drive.tracked.blind_m > 0.1 * UNIT
    drive.go(1, known=True)
    assert drive.tracked.motion_known


def test_end_is_straight_on() -> None:
    drive = Drive(arc(1.0))
    drive.go(60)
    middle = drive.tracked.centerline
    on = middle.heading_at(middle.s_max_m + 0.8)
    drive.tracked.end()
    ended = drive.tracked.centerline
    assert ended.arc_ahead_m == 0.0
    straight = ended.heading_at(ended.s_max_m)
    assert ended.heading_at(ended.s_max_m + 0.8) == pytest.approx(straight, abs=1e-9)
    assert on - straight == pytest.approx(0.8, rel=0.15)
    for tracked in (drive.tracked.left, drive.tracked.right):
        assert tracked.line is not None
        assert tracked.line.arc_ahead_m == 0.0
    drive.check()
    drive.go(1)  # seen again, and not to end
    assert drive.tracked.centerline.arc_ahead_m == math.inf


@pytest.mark.parametrize("bend", [0.0, 0.6])
@pytest.mark.parametrize("change", [0.3, -0.3])
def test_a_lane_that_widens(bend: float, change: float) -> None:
    """By 30 % over three lane widths; its lines are not parallel there."""
    lane = arc(bend)
    drive = Drive(lane, offset_m=0.0)
    drive.go(30)
    begin_m, over_m = drive.s_m + 1.0, 3.0 * UNIT

    def width(s: np.ndarray) -> np.ndarray:
        return UNIT * (1.0 + change * np.clip((s - begin_m) / over_m, 0.0, 1.0))

    worst = 0.0
    for _ in range(110):
        drive.s_m += STEP_M
        before, drive.car = drive.car, lane.car(drive.s_m, 0.0, 0.0, REFERENCE_M)
        drive.tracked.move(drive.car.inverse() @ before, STEP_M, DT_S, True)
        s = np.arange(drive.s_m + 0.35, drive.s_m + 1.5, 0.05)
        x, y = lane.beside(s, 0.0).T
        lines = []
        for side in (1, -1):
            d = side * 0.5 * width(s)
            theta = lane.theta(s)
            edge = drive.car.inverse().apply(np.stack((x - d * np.sin(theta), y + d * np.cos(theta)), axis=-1))
            lines.append(SeenLine(points_m=edge, sigma_m=np.full(len(edge), 0.004)))
        assert drive.tracked.update(*lines) == (True, True)
        true = float(width(np.array([drive.s_m]))[0])
        worst = max(worst, abs(drive.tracked.pose.width_m / true - 1.0))
        assert abs(drive.tracked.pose.offset_m) < 0.03 * true
    assert worst < 0.04
    assert true == pytest.approx(UNIT * (1.0 + change), abs=1e-9)
