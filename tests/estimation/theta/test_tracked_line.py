"""One line from frame to frame: what is remembered of it, for how long, and how sure it is."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.estimation.road import ANY_BEND, BEHIND
from automodel.estimation.theta.line_spline import MIN_POINTS
from automodel.estimation.theta.tracked_line import SeenLine, TrackedLine
from automodel.geometry import SE2
from tests.support.measured_lanes import REFERENCE_M, RLS, UNIT
from tests.support.world_lanes import WorldLane, arc

STEP_M = 0.03
DT_S = 0.03
NOTHING = SeenLine(points_m=np.empty((0, 2)), sigma_m=np.empty(0))


def seen(lane: WorldLane, car: SE2, s_m: float, side: int = 1, ended: bool = False) -> SeenLine:
    """What a camera sees that looks from 0.35 m to 1.5 m ahead of the reference point."""
    points = lane.seen_from(car, np.arange(s_m + 0.35, s_m + 1.5, 0.05), side)
    return SeenLine(points_m=points, sigma_m=np.full(len(points), 0.004), ended=ended)


class Drive:
    """A car in the middle of a lane, and one of its lines."""

    def __init__(self, lane: WorldLane, side: int = 1, s_m: float = 2.0) -> None:
        self.lane, self.side, self.s_m = lane, side, s_m
        self.tracked = TrackedLine(RLS)
        self.car = lane.car(s_m, 0.0, 0.0, REFERENCE_M)

    def go(self, known: bool = True, distance_m: float = STEP_M) -> None:
        """On along the lane, and the line with it."""
        self.s_m += distance_m
        before, self.car = self.car, self.lane.car(self.s_m, 0.0, 0.0, REFERENCE_M)
        motion = self.car.inverse() @ before
        if known:
            self.tracked.move(motion, distance_m, DT_S, True)
        else:
            self.tracked.move(SE2(), 0.0, DT_S, False)

    def drive(self, frames: int) -> None:
        """Frames that show the line."""
        for _ in range(frames):
            self.go()
            assert self.tracked.update(seen(self.lane, self.car, self.s_m, self.side))

    @property
    def errors(self) -> tuple[float, float, float]:
        """Of the line beside the reference point: distance [m], direction [rad], curvature [1/m]."""
        line = self.tracked.line
        assert line is not None
        bend = float(self.lane.curvature(np.array([self.s_m]))[0])
        kappa = bend / (1.0 - bend * self.side * 0.5 * UNIT)
        return line.lateral_m - self.side * 0.5 * UNIT, line.heading_at(0.0), line.curvature_at(0.0) - kappa


def remembered(tracked: TrackedLine) -> np.ndarray:
    """The remembered points (n, 2) [m]."""
    return tracked._memory[:, :2]


def test_there_is_no_line_before_the_first_update() -> None:
    tracked = TrackedLine(RLS)
    assert tracked.line is None
    tracked.move(SE2(-0.03, 0.0, 0.01), 0.03, DT_S, True)
    tracked.end(True)
    assert tracked.line is None
    assert not tracked.update(NOTHING)
    assert tracked.line is None


@pytest.mark.parametrize("points", [1, 3])
def test_a_few_points_are_no_line(points: int) -> None:
    tracked = TrackedLine(RLS)
    few = seen(arc(0.0), SE2(2.0 - REFERENCE_M, 0.0, 0.0), 2.0)
    assert not tracked.update(SeenLine(points_m=few.points_m[:points], sigma_m=few.sigma_m[:points]))
    assert tracked.line is None


@pytest.mark.parametrize("bend", [0.0, 1.0, -1.25])
@pytest.mark.parametrize("side", [1, -1])
def test_the_line_is_known_beside_the_car_though_it_is_seen_ahead(bend: float, side: int) -> None:
    run = Drive(arc(bend), side)
    run.drive(45)  # far enough that the points remembered lie behind the car
    lateral, heading, kappa = run.errors
    assert abs(lateral) < 0.002
    assert abs(heading) < math.radians(0.8)
    assert abs(kappa) < 0.15
    places = remembered(run.tracked)
    on_lane = run.car.apply(places)
    beside = run.lane.beside(np.linspace(0.0, 8.0, 40_001), side * 0.5 * UNIT)
    away = [np.hypot(*(beside - place).T).min() for place in on_lane]
    assert max(away) < 1e-3  # the odometry was right, so they lie where they were
    assert places[:, 0].min() < 0.0
    assert places[:, 0].max() > REFERENCE_M


def test_the_memory_is_pruned() -> None:
    run = Drive(arc(0.4))
    counts, backs = [], []
    for _ in range(150):
        run.drive(1)
        places = remembered(run.tracked)
        counts.append(len(places))
        backs.append(float(REFERENCE_M - places[:, 0].min()))
    assert max(counts[60:]) <= max(counts[:60]) + MIN_POINTS  # it does not grow
    assert max(counts) < 200
    assert max(backs) < (BEHIND + 0.5) * UNIT


def test_a_car_that_stands_remembers_no_more() -> None:
    run = Drive(arc(0.0))
    run.drive(20)
    before = len(remembered(run.tracked))
    for _ in range(50):
        run.go(distance_m=0.0)
        run.tracked.update(seen(run.lane, run.car, run.s_m))
    assert len(remembered(run.tracked)) <= before + MIN_POINTS
    assert abs(run.errors[0]) < 0.002


def test_the_line_is_kept_over_a_gap() -> None:
    run = Drive(arc(0.5))
    run.drive(45)
    for k in range(1, 21):  # 1.5 lanes
        run.go()
        assert run.tracked.unseen_m == pytest.approx(k * STEP_M)
    assert run.tracked.line is not None
    places = remembered(run.tracked)
    assert 0 < len(places) <= 200
    lateral, heading, _ = run.errors
    assert abs(lateral) < 0.02
    assert abs(heading) < math.radians(4.0)
    run.drive(3)
    assert run.tracked.unseen_m == 0.0
    assert abs(run.errors[0]) < 0.01


def test_motion_that_is_not_known_forgets_the_points() -> None:
    run = Drive(arc(0.6))
    run.drive(45)
    information = run.tracked.rls.information[0, 0]
    variance = run.tracked.rls.lateral_variance_m2
    run.go(known=False)
    assert len(remembered(run.tracked)) == 0
    assert run.tracked.line is not None  # the line itself is a guess for a while
    assert run.tracked.rls.information[0, 0] < 0.9 * information
    assert run.tracked.rls.lateral_variance_m2 > variance
    assert run.tracked.unseen_m > 0.0
    assert run.tracked.update(seen(run.lane, run.car, run.s_m))


def test_doubt_grows_with_the_way_from_the_points() -> None:
    """Half a hidden curvature times the squared distance of the nearest point, and the curvature times it."""
    run = Drive(arc(0.0), s_m=2.0)
    doubts = []
    for from_m in (0.2, 0.4, 0.8):
        points = run.lane.seen_from(run.car, np.arange(run.s_m + from_m, run.s_m + 1.8, 0.05), 1)
        tracked = TrackedLine(RLS)
        assert tracked.update(SeenLine(points_m=points, sigma_m=np.full(len(points), 0.004)))
        again = SeenLine(points_m=points, sigma_m=np.full(len(points), 0.004))
        assert tracked.update(again)  # only now is there a line to measure along
        doubts.append((tracked.lateral_sigma_m, tracked.heading_sigma_rad))
    lateral, heading = np.array(doubts).T
    assert (np.diff(lateral) > 0.0).all()
    assert (np.diff(heading) > 0.0).all()
    assert heading[1] / heading[0] == pytest.approx(2.0, rel=0.2)
    assert lateral[1] / lateral[0] == pytest.approx(4.0, rel=0.4)


@pytest.mark.parametrize("frames", [12, 30, 120])
def test_frames_that_miss_the_same_bend_weigh_as_one(frames: int) -> None:
    """Over 0.6 m, from a line that is seen from 1 m ahead on, however many frames that takes."""
    run = Drive(arc(0.0), s_m=2.0)
    weight = 0.0
    for frame in range(frames + 1):
        if frame:
            run.go(distance_m=0.6 / frames)
        points = run.lane.seen_from(run.car, np.arange(3.0, 4.5, 0.05), 1)
        assert run.tracked.update(SeenLine(points_m=points, sigma_m=np.full(len(points), 0.004)))
        if frame:
            weight += run.tracked.heading_sigma_rad**-2
    kappa = ANY_BEND / UNIT
    near_m = np.linspace(1.0, 0.4, 1001)
    assert weight == pytest.approx(0.6 * np.mean(near_m**-3) / kappa**2, rel=0.35)


def test_there_is_little_doubt_where_points_lie_beside_the_car() -> None:
    run = Drive(arc(0.5))
    run.drive(1)
    first = run.tracked.lateral_sigma_m, run.tracked.heading_sigma_rad
    run.drive(45)
    assert run.tracked.lateral_sigma_m < 0.05 * first[0]
    assert run.tracked.heading_sigma_rad < 0.2 * first[1]


def test_a_line_that_ended_goes_straight_on() -> None:
    lane = arc(1.0)
    run = Drive(lane)
    run.drive(45)
    line = run.tracked.line
    assert line is not None
    assert line.arc_ahead_m == math.inf
    run.go()
    assert run.tracked.update(seen(lane, run.car, run.s_m, ended=True))
    ended = run.tracked.line
    assert ended is not None
    assert ended.arc_ahead_m == 0.0
    far = ended.s_max_m + ended.arc_ahead_m
    assert ended.heading_at(far + 1.0) == pytest.approx(ended.heading_at(far + 0.1), abs=1e-9)
    run.tracked.end(False)
    on = run.tracked.line
    assert on is not None
    assert on.heading_at(far + 0.5) - on.heading_at(far) == pytest.approx(0.5 * 1.25, rel=0.2)  # the inner line


def test_forget_is_a_new_line() -> None:
    run = Drive(arc(0.6))
    run.drive(30)
    run.tracked.forget()
    assert run.tracked.line is None
    assert len(remembered(run.tracked)) == 0
    assert run.tracked.unseen_m == 0.0
    assert (run.tracked.lateral_sigma_m, run.tracked.heading_sigma_rad) == (0.0, 0.0)
    fresh = TrackedLine(RLS)
    for tracked in (run.tracked, fresh):
        assert tracked.update(seen(run.lane, run.car, run.s_m))
    assert run.tracked.line is not None
    assert fresh.line is not None
    assert run.tracked.line.coefficients_rad == fresh.line.coefficients_rad
    assert run.tracked.line.lateral_m == fresh.line.lateral_m


def test_points_that_are_not_finite_are_left_out() -> None:
    run = Drive(arc(0.0))
    run.drive(20)
    run.go()
    good = seen(run.lane, run.car, run.s_m)
    points = good.points_m.copy()
    points[3], points[7] = (np.nan, 0.2), (0.5, np.inf)
    run.tracked.update(SeenLine(points_m=points, sigma_m=good.sigma_m))
    run.drive(5)
    assert np.isfinite(run.errors).all()
    assert abs(run.errors[0]) < 0.01


def test_noise_averages_out() -> None:
    lane, rng = arc(0.0), np.random.default_rng(5)
    run = Drive(lane)
    laterals = []
    for i in range(120):
        run.go()
        clean = seen(lane, run.car, run.s_m)
        noisy = clean.points_m + rng.normal(0.0, 0.004, clean.points_m.shape)
        assert run.tracked.update(SeenLine(points_m=noisy, sigma_m=clean.sigma_m))
        if i >= 45:
            laterals.append(run.errors[0])
    assert np.std(laterals) < 0.002  # of points known to 4 mm each
    assert abs(np.mean(laterals)) < 0.001
