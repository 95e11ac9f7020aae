"""The parabola pair: its geometry against circles, its derivatives against differences, its filter against truth."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.estimation.parabola.parabola_pair import ParabolaPair, Part, foot_on_arc, residual
from automodel.geometry import SE2

LANE, REFERENCE, FAR = 3.6, 1.4, 30.0
BENDS = 1e-4  # [1 / lane width^2] per lane width: a motorway
STATES = [
    np.array((0.3, 0.1, 0.0, 3.5, 0.01)),
    np.array((-0.4, -0.05, 0.02, 3.6, 0.0)),
    np.array((0.2, 0.3, -0.05, 3.4, -0.02)),
    np.array((0.0, 0.0, 1e-5, 3.6, 0.0)),
]


def lane(state: np.ndarray) -> ParabolaPair:
    pair = ParabolaPair(LANE, REFERENCE, FAR)
    pair.start(state[[Part.OFFSET, Part.THETA, Part.KAPPA, Part.WIDTH]], np.diag((0.2, 0.02, 1e-2, 0.1)))
    return pair


def line_points(state: np.ndarray, side: int, near: float = 5.0, far: float = 25.0) -> np.ndarray:
    """Points of a line by the definition: the centerline's points, moved along their normals."""
    s = np.linspace(near, far, 25)
    place, along = lane(state).ahead(s)
    points = place + 1j * along * 0.5 * side * (state[Part.WIDTH] + state[Part.TAPER] * s)
    return np.column_stack((points.real, points.imag))


def both_lines(state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    points = np.concatenate([line_points(state, side) for side in (1, -1)])
    return points, np.repeat((1.0, -1.0), len(points) // 2)


@pytest.mark.parametrize("state", STATES)
def test_the_lines_have_no_residual(state: np.ndarray) -> None:
    slope = np.empty(5)
    for (x, y), side in zip(*both_lines(state), strict=True):
        assert residual(state, REFERENCE, x, y, side, slope)[0] == pytest.approx(0.0, abs=1e-9)


def test_the_foot_on_an_arc_is_that_on_its_circle() -> None:
    state = np.array((0.5, 0.2, 0.04, 3.6, 0.0))
    normal = np.array((-math.sin(0.2), math.cos(0.2)))
    centre = np.array((REFERENCE, 0.0)) + (1.0 / 0.04 - 0.5) * normal
    for point in ((10.0, 3.0), (15.0, 0.0), (4.0, -2.0)):
        foot = foot_on_arc(state, REFERENCE, *point)
        assert foot.left_m == pytest.approx(1 / 0.04 - math.dist(point, centre))


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("part", list(Part))
def test_derivatives_are_the_differences(state: np.ndarray, part: Part) -> None:
    slope, nothing, step = np.empty(5), np.empty(5), 1e-6
    for x, y, side in ((8.0, 1.5, 1.0), (16.0, -3.0, -1.0), (2.0, 0.5, 1.0)):
        residual(state, REFERENCE, x, y, side, slope)
        high, low = state.copy(), state.copy()
        high[part], low[part] = state[part] + step, state[part] - step
        difference = (
            residual(high, REFERENCE, x, y, side, nothing)[0] - residual(low, REFERENCE, x, y, side, nothing)[0]
        )
        taper = abs(state[Part.TAPER])  # by which the foot's own way along the line is neglected
        assert slope[part] == pytest.approx(difference / (2 * step), rel=1e-3 + 3.0 * taper, abs=1e-3 + 30.0 * taper)


@pytest.mark.parametrize("state", STATES)
def test_a_lane_is_recovered_from_its_points(state: np.ndarray) -> None:
    pair = lane(np.array((state[0] + 0.15, state[1] - 0.02, 0.0, LANE, 0.0)))
    points, side = both_lines(state)
    good = pair.update(points, side, np.full(len(points), 0.01), BENDS)
    assert good.all()
    assert pair.state[Part.OFFSET] == pytest.approx(state[Part.OFFSET], abs=0.03)
    assert pair.state[Part.THETA] == pytest.approx(state[Part.THETA], abs=0.01)
    assert pair.state[Part.WIDTH] == pytest.approx(state[Part.WIDTH], abs=0.03)


def test_points_off_the_lines_are_outliers() -> None:
    pair = lane(STATES[0])
    points, side = both_lines(STATES[0])
    points[3] += (0.0, 0.8)
    good = pair.update(points, side, np.full(len(points), 0.02), BENDS)
    assert not good[3]
    assert good.sum() == len(points) - 1


def test_a_lone_line_keeps_the_width() -> None:
    truth = np.array((0.4, 0.0, 0.0, 3.0, 0.0))
    pair = lane(np.array((0.0, 0.0, 0.0, LANE, 0.0)))
    right = line_points(truth, -1)
    pair.update(right, np.full(len(right), -1.0), np.full(len(right), 0.02), BENDS)
    assert pair.state[Part.WIDTH] == LANE
    near = pair.ahead(np.array((8.0,)))[0][0] - 1j * 0.5 * LANE
    assert near.imag == pytest.approx(right[0, 1], abs=0.05)  # the lane lies along the line that is seen


@pytest.mark.parametrize("state", STATES)
def test_a_motion_moves_the_lane_as_its_points(state: np.ndarray) -> None:
    pair, motion = lane(state), SE2.arc(2.0, 0.05)
    pair.state[Part.TAPER] = 0.0
    points = np.concatenate([line_points(pair.state.copy(), side) for side in (1, -1)])
    pair.move(2.0, 0.05, 0.05, True, BENDS)
    slope = np.empty(5)
    side = np.repeat((1.0, -1.0), 25)
    for (x, y), on in zip(motion.inverse().apply(points), side, strict=True):
        assert residual(pair.state, REFERENCE, x, y, on, slope)[0] == pytest.approx(0.0, abs=1e-9)


def test_an_unknown_motion_costs_certainty() -> None:
    known, unknown = lane(STATES[0]), lane(STATES[0])
    known.move(0.5, 0.0, 0.05, True, BENDS)
    unknown.move(0.0, 0.0, 0.05, False, BENDS)
    for part in (Part.OFFSET, Part.THETA):
        assert unknown.covariance[part, part] > known.covariance[part, part]


def test_stripes_are_told_apart() -> None:
    pair = lane(STATES[1])
    assert pair.side_of(line_points(STATES[1], 1), BENDS) == 1.0
    assert pair.side_of(line_points(STATES[1], -1), BENDS) == -1.0
    assert pair.side_of(line_points(STATES[1], 3), BENDS) == 0.0  # the far line of the lane to the left


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
    straight = np.array((0.0, 0.0, 0.0, LANE, 0.0))
    pair = lane(straight)
    points, side = both_lines(straight)
    beyond = np.maximum(points[:, 0] - REFERENCE - 12.0, 0.0)
    points[:, 1] += 0.5 * 0.02 * beyond**2
    pair.update(points, side, np.full(len(points), 0.02), 2e-3)
    assert abs(pair.state[Part.THETA]) < 0.01
    assert abs(pair.state[Part.OFFSET]) < 0.05
    end = points[24] - np.array((0.0, 0.5 * LANE))
    assert abs(pair.curve(0.0).project(end)[1]) < 0.1
