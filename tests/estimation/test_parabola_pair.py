"""The parabola pair: its geometry against circles, its derivatives against differences, its filter against truth."""

from __future__ import annotations

import numpy as np
import pytest

from automodel.estimation.parabola.parabola_pair import SECTIONS, SIZE, STATIONS, ParabolaPair, Part, residual
from automodel.geometry import SE2
from automodel.geometry.lane_path import lane_path

LANE, REFERENCE, FAR = 3.6, 1.4, 30.0
BENDS = 1e-4  # [1 / lane width^2] per lane width: a motorway
SECTION = FAR / SECTIONS


def state_of(offset: float, theta: float, width: float, taper: float, *kappa: float) -> np.ndarray:
    """A state whose curvature runs linearly through values that are evenly spaced over the view."""
    ends = np.arange(STATIONS) / SECTIONS
    return np.array((offset, theta, width, taper, *np.interp(ends, np.linspace(0.0, 1.0, len(kappa)), kappa)))


STATES = [
    state_of(0.3, 0.1, 3.5, 0.01, 0.0),
    state_of(-0.4, -0.05, 3.6, 0.0, 0.02),
    state_of(0.2, 0.3, 3.4, -0.02, -0.05),
    state_of(0.0, 0.0, 3.6, 0.0, 1e-5),
    state_of(0.1, -0.1, 3.5, 0.0, 0.04, -0.04),
]


def lane(state: np.ndarray, bends: float = BENDS) -> ParabolaPair:
    pair = ParabolaPair(LANE, 0.12 * LANE, REFERENCE, FAR, bends)
    pair.start(state[[Part.OFFSET, Part.THETA, Part.ROAD, Part.WIDTH]], np.diag((0.2, 0.02, 1e-2, 0.1)))
    return pair


def off_line(state: np.ndarray, point: np.ndarray, side: float, slope: np.ndarray | None = None) -> float:
    path = lane_path(state, 0.0, SECTION, REFERENCE)
    return residual(path, state, 0.0, SECTION, REFERENCE, point, side, np.empty(SIZE) if slope is None else slope)[0]


def line_points(state: np.ndarray, side: int, near: float = 5.0, far: float = 25.0) -> np.ndarray:
    """Points of a line by the definition: the centerline's points, moved along their normals."""
    s = np.linspace(near, far, 25)
    pair = lane(state)
    pair.state = state
    place = pair.ahead(s)
    along = (pair.ahead(s + 1e-4) - pair.ahead(s - 1e-4)) / 2e-4
    points = place + 1j * along * 0.5 * side * (state[Part.WIDTH] + state[Part.TAPER] * s)
    return np.column_stack((points.real, points.imag))


def both_lines(state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    points = np.concatenate([line_points(state, side) for side in (1, -1)])
    return points, np.repeat((1.0, -1.0), len(points) // 2)


def test_a_width_that_nothing_tells_is_known_as_any_lanes_is() -> None:
    pair = lane(STATES[0])
    for _ in range(200):
        pair.move(1.0, 0.0, 0.05, True)
    assert pair.covariance[Part.WIDTH, Part.WIDTH] == pytest.approx((0.12 * LANE) ** 2)
    assert np.linalg.eigvalsh(pair.covariance).min() > 0.0


@pytest.mark.parametrize("state", STATES)
def test_the_lines_have_no_residual(state: np.ndarray) -> None:
    for point, side in zip(*both_lines(state), strict=True):
        assert off_line(state, point, side) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("part", range(SIZE))
def test_derivatives_are_the_differences(state: np.ndarray, part: int) -> None:
    slope, step = np.empty(SIZE), 1e-6
    for x, y, side in ((8.0, 1.5, 1.0), (16.0, -3.0, -1.0), (3.0, 0.5, 1.0)):
        point = np.array((x, y))
        off_line(state, point, side, slope)
        high, low = state.copy(), state.copy()
        high[part], low[part] = state[part] + step, state[part] - step
        difference = off_line(high, point, side) - off_line(low, point, side)
        taper = abs(state[Part.TAPER])  # by which the foot's own way along the line is neglected
        assert slope[part] == pytest.approx(difference / (2 * step), rel=1e-2 + 3.0 * taper, abs=1e-2 + 30.0 * taper)


def test_the_path_is_the_integral_of_its_curvature() -> None:
    """Against a fine numerical integration of a curvature that is linear along the road."""
    state = state_of(0.2, 0.1, 3.6, 0.0, 0.03, -0.03)
    pair = lane(state)
    pair.state = state
    s = np.linspace(0.0, 20.0, 20001)
    kappa = 0.03 - 0.06 * s / FAR
    turn = 0.1 + np.concatenate(([0.0], np.cumsum(0.5 * (kappa[1:] + kappa[:-1]) * np.diff(s))))
    way = np.concatenate(([0.0], np.cumsum(np.diff(s) * np.exp(0.5j * (turn[1:] + turn[:-1])))))
    place = REFERENCE - 0.2j * np.exp(0.1j) + way
    np.testing.assert_allclose(pair.ahead(s[::5000]), place[::5000], atol=0.03)


@pytest.mark.parametrize("state", STATES[:4])
def test_a_lane_is_recovered_from_its_points(state: np.ndarray) -> None:
    pair = lane(state_of(state[Part.OFFSET] + 0.15, state[Part.THETA] - 0.02, LANE, 0.0, state[Part.ROAD]))
    points, side = both_lines(state)
    good = pair.update(points, side, np.full(len(points), 0.01))
    assert good.all()
    assert pair.state[Part.OFFSET] == pytest.approx(state[Part.OFFSET], abs=0.03)
    assert pair.state[Part.THETA] == pytest.approx(state[Part.THETA], abs=0.01)
    assert pair.state[Part.WIDTH] == pytest.approx(state[Part.WIDTH], abs=0.03)


def test_points_off_the_lines_are_outliers() -> None:
    pair = lane(STATES[0])
    points, side = both_lines(STATES[0])
    points[3] += (0.0, 0.8)
    good = pair.update(points, side, np.full(len(points), 0.02))
    assert not good[3]
    assert good.sum() == len(points) - 1


def test_a_lone_line_keeps_the_width() -> None:
    truth = state_of(0.4, 0.0, 3.0, 0.0, 0.0)
    pair = lane(state_of(0.0, 0.0, LANE, 0.0, 0.0))
    right = line_points(truth, -1)
    pair.update(right, np.full(len(right), -1.0), np.full(len(right), 0.02))
    assert pair.state[Part.WIDTH] == LANE
    near = pair.ahead(np.array((8.0,)))[0] - 1j * 0.5 * LANE
    assert near.imag == pytest.approx(right[0, 1], abs=0.05)  # the lane lies along the line that is seen


@pytest.mark.parametrize("state", STATES)
def test_a_motion_moves_the_lane_as_its_points(state: np.ndarray) -> None:
    pair, motion = lane(state), SE2.arc(2.0, 0.05)
    pair.state[Part.TAPER] = 0.0
    points = np.concatenate([line_points(pair.state.copy(), side) for side in (1, -1)])
    pair.move(2.0, 0.05, 0.05, True)
    side = np.repeat((1.0, -1.0), 25)
    path = lane_path(pair.state, pair.start_m, SECTION, REFERENCE)
    for point, on in zip(motion.inverse().apply(points), side, strict=True):
        rest = residual(path, pair.state, pair.start_m, SECTION, REFERENCE, point, on, np.empty(SIZE))[0]
        assert rest == pytest.approx(0.0, abs=0.01)


def test_an_unknown_motion_costs_certainty() -> None:
    known, unknown = lane(STATES[0]), lane(STATES[0])
    known.move(0.5, 0.0, 0.05, True)
    unknown.move(0.0, 0.0, 0.05, False)
    for part in (Part.OFFSET, Part.THETA):
        assert unknown.covariance[part, part] > known.covariance[part, part]


def test_stripes_are_told_apart() -> None:
    pair = lane(STATES[1])
    far_left = line_points(STATES[1], 3)  # of the lane to the left
    assert pair.sides_of([line_points(STATES[1], 1), line_points(STATES[1], -1), far_left]).tolist() == [1.0, -1.0, 0.0]


def test_of_stripes_beside_each_other_the_longest_is_the_line() -> None:
    """A shorter one may lie nearer to where the line is expected: by chance one of many does."""
    expected = line_points(STATES[1], 1)
    beside = expected[6:12]
    line = expected + np.array((0.0, 0.5))
    pair = lane(STATES[1])
    assert pair.sides_of([beside]).tolist() == [1.0]
    assert pair.sides_of([beside, line]).tolist() == [0.0, 1.0]
    assert pair.sides_of([line, beside]).tolist() == [1.0, 0.0]


def test_dashes_one_behind_the_other_are_one_line_and_so_is_one_that_both_eyes_see() -> None:
    expected = line_points(STATES[1], 1)
    dashes = [expected[:9], expected[10:16], expected[18:], expected[1:8] + np.array((0.0, 0.1))]
    assert lane(STATES[1]).sides_of(dashes).tolist() == [1.0] * 4


@pytest.mark.parametrize("state", STATES)
def test_the_curves_are_the_lines(state: np.ndarray) -> None:
    pair = lane(state)
    pair.state[Part.TAPER] = 0.0
    for side in (1, -1):
        curve = pair.curve(0.5 * side)
        for point in line_points(pair.state.copy(), side):
            assert abs(curve.project(point)[1]) < 0.01


def test_a_bend_ahead_is_in_the_curve_and_not_in_the_arc_beside_the_car() -> None:
    """Straight for 12 m, then an arc: the points beyond do not turn the lane beside the car."""
    straight = state_of(0.0, 0.0, LANE, 0.0, 0.0)
    pair = lane(straight, 2e-3)
    points, side = both_lines(straight)
    beyond = np.maximum(points[:, 0] - REFERENCE - 12.0, 0.0)
    points[:, 1] += 0.5 * 0.02 * beyond**2
    pair.update(points, side, np.full(len(points), 0.02))
    assert abs(pair.state[Part.THETA]) < 0.01
    assert abs(pair.state[Part.OFFSET]) < 0.05
    end = points[24] - np.array((0.0, 0.5 * LANE))
    assert abs(pair.curve(0.0).project(end)[1]) < 0.1


def test_a_bend_that_was_seen_is_known_when_the_car_gets_there() -> None:
    """Both lines of a bend ahead are seen once; then the car drives there blind."""
    bend = state_of(0.0, 0.0, LANE, 0.0, 0.0, 0.0, 0.04, 0.04)
    pair = lane(state_of(0.0, 0.0, LANE, 0.0, 0.0), 2e-3)
    points, side = both_lines(bend)
    for _ in range(3):
        pair.update(points, side, np.full(len(points), 0.005))
    for _ in range(40):
        pair.move(0.5, 0.0, 0.02, True)
    assert pair.curvature_per_m == pytest.approx(0.04, abs=0.005)


def test_a_line_that_leads_across_is_neither() -> None:
    """A chevron's bar ends at the line, at half a right angle."""
    pair = lane(STATES[3])
    points, side = both_lines(STATES[3])
    pair.update(points, side, np.full(len(points), 0.01))
    bar = np.column_stack((np.linspace(8.0, 10.0, 9), 1.8 - np.linspace(0.0, 2.0, 9)))
    assert pair.sides_of([line_points(STATES[3], 1), bar]).tolist() == [1.0, 0.0]
    assert pair.sides_of([bar]).tolist() == [0.0]
