"""The tracker on drives along lanes of which only points ahead are shown."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.estimation.polynomial.lane_fit import LaneFitConfig
from automodel.estimation.polynomial.lane_tracker import LaneTracker
from automodel.geometry import SE2
from automodel.signals import Observation
from automodel.types import FloatArray
from tests.support.world_lanes import WorldLane, arc

REFERENCE_M = 0.13
NEAR_M, FAR_M = 0.4, 1.2  # body x between which points are shown
CONFIG = LaneFitConfig(lane_width_m=0.4, reference_x_m=REFERENCE_M, ahead_lanes=3.2)
STEP_M = 1.0 / 60.0
NONE = np.empty((0, 2))


def s_bend(length_m: float = 12.0) -> WorldLane:
    return WorldLane(lambda s: 0.7 * np.sin(1.5 * s), length_m, 0.4)


def observation(left: np.ndarray, right: np.ndarray, sigma_m: float = 0.004) -> Observation:
    return Observation(
        left_m=left,
        right_m=right,
        left_sigma_m=np.full(len(left), sigma_m),
        right_sigma_m=np.full(len(right), sigma_m),
    )


def ahead_of(lane: WorldLane, car: SE2, s_m: float, sides: tuple[int, ...] = (+1, -1)) -> Observation:
    """Twelve points a line that lie in front, near to far."""
    found = {+1: NONE, -1: NONE}
    for side in sides:
        points = lane.seen_from(car, np.linspace(s_m, s_m + 1.15, 200), side)
        points = points[(points[:, 0] > NEAR_M) & (points[:, 0] < FAR_M)]
        found[side] = points[np.linspace(0, len(points) - 1, 12).astype(int)]
    return observation(found[+1], found[-1])


def begin(tracker: LaneTracker, seen: Observation, arc: FloatArray) -> None:
    """Start near an arc (m,)."""
    tracker.place(arc)
    tracker.restart(seen, arc, np.array((0.1, 0.2, 0.5, 0.04)))


class Driven:
    """A car that follows its lane with the given offset and heading over s, and its tracker."""

    def __init__(self, lane: WorldLane, s_m: float = 0.5) -> None:
        self.lane, self.s_m = lane, s_m
        self.tracker = LaneTracker(CONFIG, NEAR_M)
        self.car = self._at(s_m)
        seen = ahead_of(lane, self.car, s_m)
        _, offset, heading = lane.pose_of(self.car, REFERENCE_M)
        bend = float(np.mean(lane.curvature(np.linspace(s_m, s_m + 1.0, 9))))
        begin(self.tracker, seen, self.tracker.fit.start(offset, -heading, bend, 0.4))

    def _at(self, s_m: float) -> SE2:
        return self.lane.car(s_m, 0.05 * math.sin(1.7 * s_m), 0.1 * math.cos(1.7 * s_m), REFERENCE_M)

    def go(self, known: bool = True) -> None:
        before, self.s_m = self.car, self.s_m + STEP_M
        self.car = self._at(self.s_m)
        self.tracker.move(self.car.inverse() @ before, STEP_M, known)

    def look(self, sides: tuple[int, ...] = (+1, -1)) -> tuple[int, int]:
        seen = ahead_of(self.lane, self.car, self.s_m, sides) if sides else observation(NONE, NONE)
        support = self.tracker.update(seen)[1]
        return support.left, support.right

    def errors(self) -> tuple[float, float]:
        """Offset [m] and heading [rad] estimated, less the true ones."""
        assert self.tracker.parameters is not None
        _, offset, heading = self.lane.pose_of(self.car, REFERENCE_M)
        return float(self.tracker.parameters[0] - offset), float(-self.tracker.parameters[1] - heading)


LANES = {"straight": arc(0.0), "left": arc(0.8, 6.0), "right": arc(-0.8, 6.0), "s-bend": s_bend()}  # no full circles


@pytest.mark.parametrize("name", LANES)
def test_the_lane_is_known_under_the_car(name: str) -> None:
    drive = Driven(LANES[name])
    errors = []
    for frame in range(180):
        drive.go()
        left, right = drive.look()
        assert min(left, right) >= 6
        if frame >= 60:  # the lane under the car was seen by then
            errors.append(drive.errors())
    worst = np.abs(errors).max(axis=0)
    assert worst[0] < 0.004
    assert worst[1] < math.radians(0.7)
    assert np.abs(np.mean(errors, axis=0))[0] < 0.002


@pytest.mark.parametrize("side", [+1, -1])
def test_one_line_is_enough_to_go_on(side: int) -> None:
    drive = Driven(s_bend())
    for frame in range(150):
        drive.go()
        left, right = drive.look((+1, -1) if frame < 50 else (side,))
        if frame >= 50:
            assert (left if side < 0 else right) == 0
    offset, heading = drive.errors()
    assert abs(offset) < 0.01
    assert abs(heading) < math.radians(1.0)


@pytest.mark.parametrize("name", LANES)
def test_a_gap_is_coasted_along_the_lane(name: str) -> None:
    drive = Driven(LANES[name])
    for _ in range(75):
        drive.go()
        drive.look()
    for _ in range(30):  # half a metre
        drive.go()
        assert drive.look(()) == (0, 0)
    offset, heading = drive.errors()
    assert abs(offset) < 0.012
    assert abs(heading) < math.radians(2.0)


def test_a_turn_in_place_turns_the_lane() -> None:
    drive = Driven(arc(0.5))
    for _ in range(60):
        drive.go()
        drive.look()
    parameters = drive.tracker.parameters
    assert parameters is not None
    theta = float(parameters[1])
    drive.tracker.move(SE2(0.0, 0.0, 0.2).inverse(), 0.0, True)
    turned = drive.tracker.parameters
    assert turned is not None
    assert turned[1] == pytest.approx(theta - 0.2, abs=0.08)  # the reference point swings along the lane, too
    assert turned[1] < theta - 0.1


def test_unknown_motion_forgets_the_remembered_points() -> None:
    sideways = SE2(0.0, 0.02, 0.0)  # carried off unnoticed
    errors = {}
    for known in (True, False):
        drive = Driven(arc(0.0))
        for _ in range(60):
            drive.go()
            drive.look()
        drive.tracker.move(SE2(), 0.0, known)
        drive.car = drive.car @ sideways
        _, offset, _ = drive.lane.pose_of(drive.car, REFERENCE_M)
        seen = ahead_of(drive.lane, drive.car, drive.s_m)
        solution = drive.tracker.update(seen)[0]
        errors[known] = abs(solution.offset_m - offset)
    assert errors[False] < 0.006
    assert errors[False] < 0.5 * errors[True]


def test_points_far_from_the_lane_do_not_support_it() -> None:
    drive = Driven(arc(0.0))
    for _ in range(30):
        drive.go()
        drive.look()
    seen = ahead_of(drive.lane, drive.car, drive.s_m)
    off = observation(seen.left_m + np.array([0.0, 0.12]), seen.right_m)
    solution, support = drive.tracker.update(off)
    assert support.left < 4
    assert support.right >= 10
    assert abs(drive.errors()[0]) < 0.006
    assert solution.width_m == pytest.approx(0.4, abs=0.01)


def test_update_without_a_lane_is_a_mistake() -> None:
    tracker = LaneTracker(CONFIG, NEAR_M)
    assert tracker.parameters is None
    with pytest.raises(ValueError, match="call start first"):
        tracker.update(observation(NONE, NONE))


def test_forgotten_is_as_new() -> None:
    drive = Driven(s_bend())
    for _ in range(40):
        drive.go()
        drive.look()
    drive.tracker.forget()
    assert drive.tracker.parameters is None
    lane = arc(-0.4)
    results = []
    for tracker in (drive.tracker, LaneTracker(CONFIG, NEAR_M)):
        other = Driven(lane)
        seen = ahead_of(lane, other.car, other.s_m)
        begin(tracker, seen, tracker.fit.start(0.0, 0.0, -0.4, 0.4))
        tracker.move(SE2.arc(STEP_M, 0.0).inverse(), STEP_M, True)
        results.append(tracker.update(seen)[0].parameters)
    np.testing.assert_array_equal(results[0], results[1])
