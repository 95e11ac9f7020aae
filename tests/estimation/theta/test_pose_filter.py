"""The lane-pose filter: both lines, one line or none, a changing lane, gates, and bad numbers."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from automodel.estimation.theta.pose_filter import LanePoseFilter, LinePoint, predicted_measurement, predicted_state
from automodel.geometry import SE2
from tests.support.measured_lanes import FILTER, REFERENCE_M, UNIT, point, pose_state
from tests.support.world_lanes import WorldLane, arc

START = (0.15, 0.15, 0.15)  # sigmas of heading [rad], offset and width [lane widths]


@pytest.mark.parametrize(
    ("offset_m", "heading_rad", "width_m"), [(0.0, 0.0, 0.4), (0.1, -0.6, 0.45), (-0.12, 0.5, 0.33)]
)
def test_both_lines_give_the_pose(offset_m: float, heading_rad: float, width_m: float) -> None:
    tracker = LanePoseFilter(FILTER)
    tracker.start(offset_m + 0.02, heading_rad + 0.1, width_m - 0.02, START)
    truth = pose_state(offset_m, heading_rad, width_m)
    for _ in range(30):
        done = tracker.update(point(truth, 1), point(truth, -1))
        assert done.left
        assert done.right
        assert not done.heading
        assert done.dimensions == 4
    assert tracker.offset_m == pytest.approx(offset_m, abs=5e-4)
    assert tracker.heading_rad == pytest.approx(heading_rad, abs=0.003)
    assert tracker.width_m == pytest.approx(width_m, abs=1e-3)
    np.testing.assert_allclose(tracker.state, truth, atol=0.005)


@pytest.mark.parametrize("side", [1, -1])
def test_one_line_tells_its_own_distance(side: int) -> None:
    """The lane is wider than the filter believes: the line's distance is right, and the offset's variance says so."""
    tracker = LanePoseFilter(FILTER)
    tracker.start(0.0, 0.1, 0.38, sigma=(0.05, 0.1, 0.045))
    truth = pose_state(0.03, 0.05, 0.40)
    rng = np.random.default_rng(1)
    for _ in range(30):
        tracker.predict(SE2(), 0.0, 0.01)
        measured = point(truth, side, rng)
        tracker.update(*((measured, None) if side > 0 else (None, measured)))
    beside = 0.5 * tracker.width_m - side * tracker.offset_m
    assert beside == pytest.approx(0.5 * 0.40 - side * 0.03, abs=0.002)
    assert tracker.heading_rad == pytest.approx(0.05, abs=0.012)
    # what is not known of the width is not known of the offset
    offset, _, width = np.sqrt(np.diag(tracker.covariance))
    assert offset == pytest.approx(0.5 * width, rel=0.1)
    assert abs(tracker.offset_m - 0.03) < 2.0 * offset


def test_one_line_after_the_other_teaches_a_width_that_is_hardly_known() -> None:
    """Neither says anything of it alone; a car that stands still sees first the left one and then the right one."""
    tracker = LanePoseFilter(FILTER)
    tracker.start(0.05, 0.0, 0.40, sigma=(0.05, 0.2, 0.15))
    truth = pose_state(0.03, 0.0, 0.34)
    rng = np.random.default_rng(2)
    for side in (+1, -1):
        for _ in range(20):
            tracker.predict(SE2(), 0.0, 0.005)
            measured = point(truth, side, rng)
            tracker.update(*((measured, None) if side > 0 else (None, measured)))
        if side > 0:
            assert abs(tracker.width_m - 0.34) > 0.02
    assert tracker.width_m == pytest.approx(0.34, abs=0.01)
    assert tracker.offset_m == pytest.approx(0.03, abs=0.01)


def driven(
    tracker: LanePoseFilter,
    lane: WorldLane,
    frames: int,
    lines: str = "LR",
    noise: np.random.Generator | None = None,
    start: int = 0,
) -> list[tuple[float, float]]:
    """A weaving car; errors of (offset, heading) after each frame. The filter knows the true curvature."""
    errors, before = [], None
    for i in range(start, start + frames):
        s, offset, heading = 1.0 + 0.03 * i, 0.06 * math.sin(0.1 * i), 0.2 * math.cos(0.1 * i)
        car = lane.car(s, offset, heading, REFERENCE_M)
        if before is not None:
            tracker.predict(car.inverse() @ before, float(lane.curvature(np.array(s - 0.015))), 0.03)
        truth = pose_state(offset, heading, lane.width_m)
        left = point(truth, 1, noise) if "L" in lines else None
        right = point(truth, -1, noise) if "R" in lines else None
        tracker.update(left, right)
        errors.append((tracker.offset_m - offset, tracker.heading_rad - heading))
        before = car
    return errors


@pytest.mark.parametrize("bend", [0.0, 0.9, -0.9])
def test_the_motion_keeps_it_from_lagging(bend: float) -> None:
    rng = np.random.default_rng(2)
    tracker = LanePoseFilter(FILTER)
    tracker.start(0.0, 0.2, UNIT, START)
    errors = np.array(driven(tracker, arc(bend), 150, noise=rng))[20:]
    assert np.abs(errors[:, 0]).mean() < 0.002
    assert np.abs(errors[:, 1]).mean() < 0.012
    assert np.abs(errors.mean(axis=0)).max() < 0.004
    # the paper's random walk, without the motion
    blind = LanePoseFilter(FILTER)
    blind.start(0.0, 0.2, UNIT, START)
    blind.predict = lambda *_: LanePoseFilter.predict(blind, SE2(), 0.0, 0.03)  # type: ignore[method-assign]
    lagging = np.array(driven(blind, arc(bend), 150, noise=np.random.default_rng(2)))[20:]
    assert np.abs(lagging[:, 1]).mean() > 3.0 * np.abs(errors[:, 1]).mean()


def test_without_lines_it_coasts_on_the_motion() -> None:
    tracker, lane = LanePoseFilter(FILTER), arc(0.8)
    tracker.start(0.0, 0.2, UNIT, sigma=(0.01, 0.01, 0.01))
    driven(tracker, lane, 20, noise=np.random.default_rng(3))
    spread = np.sqrt(np.diag(tracker.covariance))
    s, offset, heading = 1.0 + 0.03 * 19, 0.06 * math.sin(1.9), 0.2 * math.cos(1.9)
    car = lane.car(s, offset, heading, REFERENCE_M)
    for i in range(17):  # half a metre
        after = lane.car(s + 0.03 * (i + 1), offset, heading, REFERENCE_M)
        tracker.predict(after.inverse() @ car, 0.8, 0.03)
        assert tracker.update(None, None).dimensions == 0
        car = after
    assert tracker.offset_m == pytest.approx(offset, abs=0.01)
    assert tracker.heading_rad == pytest.approx(heading, abs=0.02)
    assert (np.sqrt(np.diag(tracker.covariance))[:2] > 1.3 * spread[:2]).all()


@pytest.mark.parametrize("ratio", [0.7, 1.3])
def test_it_follows_a_lane_that_changes_its_width(ratio: float) -> None:
    """30 % within two metres; the wedge turns the lines by 3.4 deg, which the points do not show."""
    rng = np.random.default_rng(4)
    tracker = LanePoseFilter(FILTER)
    errors = []
    for i in range(120):
        width = UNIT * (1.0 + (ratio - 1.0) * min(max((i - 20) / 66.0, 0.0), 1.0))
        truth = pose_state(0.05, 0.0, width)
        tracker.predict(SE2.arc(0.03, 0.0).inverse(), 0.0, 0.03)
        done = tracker.update(point(truth, 1, rng), point(truth, -1, rng))
        assert done.left
        assert done.right
        errors.append((tracker.width_m - width, tracker.offset_m - 0.05))
    width_error, offset_error = np.abs(errors[10:]).max(axis=0)
    assert width_error < 0.02
    assert offset_error < 0.01
    assert tracker.width_m == pytest.approx(UNIT * ratio, abs=0.008)


def test_what_fails_the_gate_changes_nothing() -> None:
    tracker = LanePoseFilter(FILTER)
    truth = pose_state(0.02, 0.1)
    tracker.start(0.02, 0.1, UNIT, sigma=(0.02, 0.01, 0.01))
    for _ in range(5):
        tracker.update(point(truth, 1), point(truth, -1))
    before = tracker.state
    far = LinePoint(point_m=np.array((REFERENCE_M, 0.35)), covariance_m2=np.eye(2) * 0.004**2)
    done = tracker.update(far, None)
    assert (done.left, done.right, done.dimensions, tracker.rejected) == (False, False, 0, 1)
    np.testing.assert_array_equal(tracker.state, before)
    done = tracker.update(far, point(truth, -1), (2.0, 0.01**2))
    assert (done.left, done.right, done.heading, tracker.rejected) == (False, True, False, 3)
    assert tracker.offset_m == pytest.approx(0.02, abs=1e-3)
    tracker.start(0.0, 0.0, UNIT, START)
    assert tracker.rejected == 0


def test_a_direction_helps_where_the_points_say_little() -> None:
    """Right above the left line: its point shows no direction; the centerline's own heading does."""
    truth = pose_state(0.19, 0.3)
    spread = []
    for theta in (None, (truth[0], 0.01**2)):
        tracker = LanePoseFilter(FILTER)
        tracker.start(0.19, 0.2, UNIT, START)
        for _ in range(5):
            done = tracker.update(point(truth, 1), None, theta)
            assert done.heading == (theta is not None)
        spread.append(math.sqrt(tracker.covariance[1, 1]))
    assert spread[0] > 0.1
    assert spread[1] < 0.006
    assert tracker.heading_rad == pytest.approx(0.3, abs=0.002)


def test_a_width_that_was_measured_ahead_is_weighed_by_its_variance() -> None:
    tracker = LanePoseFilter(FILTER)
    tracker.start(0.02, 0.0, UNIT, (0.1, 0.1, 0.1))
    before = tracker.covariance[2, 2]
    assert tracker.update(None, None, None, (1.1 * UNIT, before)).dimensions == 1
    assert tracker.width_m == pytest.approx(1.05 * UNIT)
    assert tracker.covariance[2, 2] == pytest.approx(0.5 * before)
    assert tracker.update(None, None, None, (math.nan, before)).dimensions == 0


def test_directions_wrap() -> None:
    tracker = LanePoseFilter(FILTER)
    tracker.start(0.0, 3.1, UNIT, START)
    for _ in range(20):
        tracker.update(None, None, (3.15, 0.05**2))  # a car that faces the wrong way
    assert math.remainder(tracker.heading_rad + 3.15, math.tau) == pytest.approx(0.0, abs=0.01)
    assert abs(tracker.heading_rad) <= math.pi


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_left_out(bad: float) -> None:
    tracker = LanePoseFilter(FILTER)
    truth = pose_state(0.02, 0.1)
    tracker.update(point(truth, 1), point(truth, -1))
    before, covariance = tracker.state, np.eye(2) * 1e-5
    spoilt = covariance.copy()
    spoilt[0, 0] = bad
    for left in (
        LinePoint(point_m=np.array((bad, 0.2)), covariance_m2=covariance),
        LinePoint(point_m=np.array((0.13, 0.2)), covariance_m2=spoilt),
    ):
        assert tracker.update(left, None).dimensions == 0
    assert tracker.update(None, None, (bad, 0.01)).dimensions == 0
    assert tracker.update(None, None, (0.1, bad)).dimensions == 0
    np.testing.assert_array_equal(tracker.state, before)
    tracker.predict(SE2(bad, 0.0, 0.0), 0.0, 0.03)
    tracker.predict(SE2(), bad, 0.03)
    tracker.predict(SE2(), 0.0, bad)
    np.testing.assert_allclose(tracker.state, before)
    assert np.isfinite(tracker.covariance).all()


@pytest.mark.parametrize("covariance", [-np.eye(2), np.array(((1.0, 5.0), (5.0, 1.0))) * 1e-3])
def test_impossible_covariances_are_left_out(covariance: np.ndarray) -> None:
    tracker = LanePoseFilter(FILTER)
    assert tracker.update(LinePoint(point_m=np.array((0.13, 0.2)), covariance_m2=covariance), None).dimensions == 0


def test_unknown_motion_opens_the_filter() -> None:
    tracker = LanePoseFilter(FILTER)
    tracker.start(0.0, 0.0, UNIT, sigma=(0.01, 0.01, 0.01))
    before = tracker.state
    tracker.predict(SE2.arc(0.3, 0.4).inverse(), 0.0, 0.1, motion_known=False)
    np.testing.assert_allclose(tracker.state, before)
    offset, heading, width = np.sqrt(np.diag(tracker.covariance))
    assert heading > 0.2
    assert offset > 0.04
    assert width < 0.01


@pytest.mark.parametrize("change", [{"lane_width_m": 0.0}, {"rejected": 1.0}, {"rejected": 0.0}])
def test_the_scales_are_checked(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="PoseFilterConfig"):
        replace(FILTER, **change)


STATES = [(0.0, 0.0, 0.4), (0.3, -0.5, 0.35), (-0.7, 0.8, 0.5), (0.5, 1.2, 0.4)]


@pytest.mark.parametrize("bend", [0.0, 0.8, -1.25])
@pytest.mark.parametrize(("speed", "yaw_rate"), [(1.0, 0.0), (1.0, 1.5), (2.0, -2.0), (0.0, 1.0), (-0.5, 0.3)])
def test_the_motion_on_an_arc_is_exact(bend: float, speed: float, yaw_rate: float) -> None:
    """A car on a circle, beside a lane on a circle: pose by search against the pose carried along."""
    lane, dt = arc(bend), 0.25
    car = lane.car(4.0, 0.07, -0.3, REFERENCE_M)
    motion = SE2.arc(speed * dt, yaw_rate * dt)
    reference = np.array((REFERENCE_M, 0.0))
    shift = motion.apply(reference) - reference
    after, _ = predicted_state(pose_state(0.07, -0.3), (shift[0], shift[1]), motion.yaw_rad, bend)
    _, offset, heading = lane.pose_of(car @ motion, REFERENCE_M)
    assert 0.5 * after[1] * after[2] == pytest.approx(offset, abs=1e-6)
    # the search is on a grid of half a millimetre
    assert math.remainder(-after[0] - heading, math.tau) == pytest.approx(0.0, abs=1e-3)
    assert after[2] == UNIT


def test_the_motion_agrees_with_the_lanes_kinematics() -> None:
    """d' = v sin psi + w l cos psi and psi' = w - kappa s', added up in small steps, signs and all."""
    kappa, speed, yaw_rate, steps = 0.9, 1.2, -0.8, 20_000
    d, psi, dt = 0.05, 0.25, 0.3 / 20_000
    state = pose_state(d, psi)
    for _ in range(steps):
        along = speed * math.cos(psi) - yaw_rate * REFERENCE_M * math.sin(psi)
        across = speed * math.sin(psi) + yaw_rate * REFERENCE_M * math.cos(psi)
        d, psi = d + dt * across, psi + dt * (yaw_rate - kappa * along / (1.0 - kappa * d))
    motion = SE2.arc(0.3 * speed, 0.3 * yaw_rate)
    reference = np.array((REFERENCE_M, 0.0))
    shift = motion.apply(reference) - reference
    after, _ = predicted_state(state, (shift[0], shift[1]), motion.yaw_rad, kappa)
    assert 0.5 * after[1] * after[2] == pytest.approx(d, abs=2e-5)
    assert -after[0] == pytest.approx(psi, abs=5e-5)


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("kappa", [0.0, 1e-9, 0.8, -1.5])
def test_the_motions_jacobian(state: tuple[float, ...], kappa: float) -> None:
    x = np.array(state)
    _, jacobian = predicted_state(x, (0.12, 0.03), 0.15, kappa)
    for i in range(3):
        step = np.zeros(3)
        step[i] = 1e-6
        ahead, behind = (predicted_state(x + sign * step, (0.12, 0.03), 0.15, kappa)[0] for sign in (1, -1))
        np.testing.assert_allclose(jacobian[:, i], (ahead - behind) / 2e-6, atol=1e-7)


@pytest.mark.parametrize("state", STATES)
def test_the_measurement_and_its_jacobian(state: tuple[float, ...]) -> None:
    x = np.array(state)
    theta, rho, width = state
    h, jacobian = predicted_measurement(x, REFERENCE_M)
    # eq. (25) as printed, x_CM = reference, y_CM = 0
    printed = (
        REFERENCE_M - 0.5 * width * (1 - rho) * math.sin(theta),
        0.5 * width * (1 - rho) * math.cos(theta),
        REFERENCE_M + 0.5 * width * (1 + rho) * math.sin(theta),
        -0.5 * width * (1 + rho) * math.cos(theta),
    )
    np.testing.assert_allclose(h[:4], printed, atol=1e-15)
    # and as geometry: the lines' points beside a car with this pose
    lane = arc(0.0, width_m=width)
    car = lane.car(3.0, 0.5 * rho * width, -theta, REFERENCE_M)
    for rows, side in ((h[:2], 1), (h[2:4], -1)):
        np.testing.assert_allclose(rows, lane.seen_from(car, 3.0, side), atol=1e-12)
    assert h[4] == theta
    for i in range(3):
        step = np.zeros(3)
        step[i] = 1e-6
        ahead, behind = (predicted_measurement(x + sign * step, REFERENCE_M)[0] for sign in (1, -1))
        np.testing.assert_allclose(jacobian[:, i], (ahead - behind) / 2e-6, atol=1e-9)


def test_a_line_points_covariance_is_that_of_draws() -> None:
    rng = np.random.default_rng(0)
    distance, theta = rng.normal(-0.23, 0.004, 40_000), rng.normal(0.4, 0.03, 40_000)
    points = np.column_stack((REFERENCE_M - distance * np.sin(theta), distance * np.cos(theta)))
    claimed = LinePoint.beside((REFERENCE_M, 0.0), 0.4, -0.23, 0.004**2, 0.03**2)
    np.testing.assert_allclose(claimed.point_m, points.mean(axis=0), atol=3e-4)
    np.testing.assert_allclose(claimed.covariance_m2, np.cov(points.T), atol=1.5e-6)
