"""The lane's belief against roads whose place is known: what its lines, its motion and its covariance say."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from automodel.geometry import SE2
from automodel.perception.line_scan import SightedLine
from automodel.tracking.belief import (
    BEND_CALM,
    BEND_SHARE,
    BEND_SUDDEN,
    Assigned,
    Bends,
    LaneBelief,
    Part,
    RoadModel,
)
from automodel.tracking.hypotheses import LEFT, RIGHT
from automodel.types import FloatArray
from tests.support.drawn_roads import LANE_M, MARKING_M, STRAIGHT, Road
from tests.support.sighted_lines import ROAD_MODEL, belief, line_of, sighted

NOWHERE = belief(STRAIGHT)
ARCS = [
    Road(),
    Road(curvature_per_m=0.8, heading_rad=0.15, aside_m=0.05),
    Road(curvature_per_m=-0.8, heading_rad=0.2, aside_m=-0.08),
    Road(curvature_per_m=0.3, heading_rad=-0.25, aside_m=0.1),
]


def pair(road: Road, from_m: float = 0.2, to_m: float = 1.2) -> tuple[Assigned, Assigned]:
    """Both lines of a road's lane."""
    return Assigned(line_of(road, LEFT, from_m, to_m), LEFT), Assigned(line_of(road, RIGHT, from_m, to_m), RIGHT)


def normalised_error(believed: LaneBelief, truth: FloatArray) -> float:
    """Squared error over its covariance: chi-square with four degrees of freedom."""
    error = believed.mean - truth
    return float(error @ np.linalg.solve(believed.covariance, error))


@pytest.mark.parametrize("reference_x_m", [0.0, 0.1])
@pytest.mark.parametrize("road", ARCS)
def test_a_lane_is_recovered_from_the_points_of_its_lines(road: Road, reference_x_m: float) -> None:
    start = replace(belief(STRAIGHT, (0.2, 0.5, 2.0, 0.05)), reference_x_m=reference_x_m)
    found, _ = start.update(pair(road))
    truth = belief(road, reference_x_m=reference_x_m).mean
    assert normalised_error(found, truth) < 2.0  # 4 on average where the points have errors; these have none
    assert found.offset_m == pytest.approx(truth[Part.OFFSET], abs=0.01)
    assert -found.heading_rad == pytest.approx(truth[Part.THETA], abs=0.03)
    assert found.width_m == pytest.approx(LANE_M, abs=0.01)


def winding_road(random: np.random.Generator, truth: FloatArray, model: RoadModel) -> tuple[Assigned, ...]:
    """Both lines of a road whose curvature walks, with the errors that the model says they have."""
    d, theta, kappa, width = truth
    unit, step = model.lane_width_m, 0.005
    s = np.arange(0.0, 1.4, step)
    walk = random.normal(0.0, math.sqrt(model.bend_walk / unit**3 * step), len(s)).cumsum()
    heading = theta + ((kappa + walk) * step).cumsum()
    x = d * math.sin(theta) + (np.cos(heading) * step).cumsum()
    y = -d * math.cos(theta) + (np.sin(heading) * step).cumsum()
    lines = []
    for role in (LEFT, RIGHT):
        left = role * width + random.normal(0.0, model.line_sigma * unit)
        points = np.column_stack((x - left * np.sin(heading), y + left * np.cos(heading)))[60::20]
        noise = random.normal(0.0, model.point_markings * model.marking_width_m, points.shape)
        lines.append(Assigned(sighted(points + noise * np.array((0.0, 1.0))), role))
    return tuple(lines)


def test_the_covariance_is_as_large_as_the_errors_over_random_roads() -> None:
    random = np.random.default_rng(1)
    model = replace(ROAD_MODEL, bend_walk=0.25 * ROAD_MODEL.bend_walk)  # half as winding: what lies ahead is not linear
    kinds = [replace(model, bend_walk=factor * model.bend_walk) for factor in (BEND_CALM, BEND_SUDDEN)]
    start = belief(STRAIGHT, (0.04, 0.08, 0.15, 0.03), model=model)
    errors = []
    for _ in range(300):
        truth = start.mean + random.normal(0.0, 1.0, 4) * np.sqrt(np.diag(start.covariance))
        found, _ = start.update(winding_road(random, truth, kinds[int(random.uniform() < BEND_SHARE)]))
        errors.append(normalised_error(found, truth))
    assert 3.5 < np.mean(errors) < 5.5  # 4 is right: it is a quarter too sure, because two roads are joined to one


MOTIONS = [(0.0, 0.0), (0.3, 0.0), (0.25, 0.3), (-0.1, -0.1), (0.0, 0.4)]


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("road", ARCS)
def test_a_known_motion_keeps_the_lane_where_it_is(road: Road, motion: tuple[float, float]) -> None:
    before = belief(road, reference_x_m=0.12)
    after = before.moved(*motion, 0.05, True)
    x, y = SE2.arc(*motion).apply(np.array((0.12, 0.0)))
    theta = road.heading_rad + road.curvature_per_m * float(road.along(x, y)) - motion[1]
    expected = (float(road.beside(x, y)), theta, road.curvature_per_m, LANE_M)
    assert after.mean == pytest.approx(np.array(expected), abs=1e-9)


def test_a_known_motion_carries_the_covariance_as_numeric_derivatives_say() -> None:
    sure = RoadModel(
        lane_width_m=LANE_M, marking_width_m=MARKING_M, bend_walk=0.0, step=0.0, turn_rad=0.0, width_walk=0.0
    )
    before = belief(Road(heading_rad=0.02, aside_m=0.01), model=sure)
    step = 1e-5
    columns = []
    for part in Part:
        ends = [
            replace(before, mean=before.mean + sign * step * np.eye(4)[part]).moved(0.3, 0.02, 0.05, True).mean
            for sign in (1.0, -1.0)
        ]
        columns.append((ends[0] - ends[1]) / (2.0 * step))
    jacobian = np.column_stack(columns)
    expected = jacobian @ before.covariance @ jacobian.T
    assert before.moved(0.3, 0.02, 0.05, True).covariance == pytest.approx(expected, rel=0.03, abs=1e-5)


def test_an_unknown_motion_leaves_the_lane_and_makes_it_uncertain() -> None:
    before = belief(ARCS[1], (0.01, 0.02, 0.1, 0.02))
    after = before.moved(0.0, 0.0, 0.1, False)
    assert after.mean == pytest.approx(before.mean, abs=1e-12)
    assert after.sigma(Part.OFFSET) > 5.0 * before.sigma(Part.OFFSET)
    assert after.sigma(Part.THETA) > 5.0 * before.sigma(Part.THETA)
    assert after.sigma(Part.WIDTH) == pytest.approx(before.sigma(Part.WIDTH))


def test_two_lines_far_ahead_measure_the_width_and_not_the_place() -> None:
    wide = replace(NOWHERE, mean=NOWHERE.mean + np.array((0.0, 0.0, 0.0, 0.04)))  # expected 10 % too wide
    far, _ = wide.update(pair(STRAIGHT, 2.2, 2.8))
    assert far.width_m == pytest.approx(LANE_M, abs=0.012)
    assert far.sigma(Part.WIDTH) < 0.3 * wide.sigma(Part.WIDTH)
    assert far.sigma(Part.OFFSET) > 0.8 * wide.sigma(Part.OFFSET)


def test_one_line_leaves_the_width_unknown() -> None:
    found, _ = NOWHERE.update((Assigned(line_of(STRAIGHT, LEFT), LEFT),))
    assert found.sigma(Part.WIDTH) > 0.9 * NOWHERE.sigma(Part.WIDTH)


def scaled(believed: LaneBelief, factor: float) -> LaneBelief:
    unit = np.array((factor, 1.0, 1.0 / factor, factor))
    model = believed.road
    return LaneBelief(
        unit * believed.mean,
        np.outer(unit, unit) * believed.covariance,
        replace(model, lane_width_m=factor * model.lane_width_m, marking_width_m=factor * model.marking_width_m),
        factor * believed.reference_x_m,
    )


def scaled_line(line: SightedLine, factor: FloatArray) -> SightedLine:
    return replace(line, points_m=line.points_m * factor)


def test_all_lengths_ten_times_as_large_change_nothing_but_the_unit() -> None:
    small, lines = replace(NOWHERE, reference_x_m=0.1), pair(ARCS[1])
    big, ten = scaled(small, 10.0), np.array((10.0, 10.0))
    big_lines = [Assigned(scaled_line(line, ten), role) for line, role in lines]
    one, odds = small.update(lines)
    other, big_odds = big.update(big_lines)
    assert other.mean == pytest.approx(scaled(one, 10.0).mean, rel=1e-6)
    assert other.covariance == pytest.approx(scaled(one, 10.0).covariance, rel=1e-6)
    clutter = sum(small.clutter(line) for line, _ in lines)
    assert big_odds - sum(big.clutter(line) for line, _ in big_lines) == pytest.approx(odds - clutter, abs=1e-6)
    moved, big_moved = one.moved(0.2, 0.1, 0.05, True), other.moved(2.0, 0.1, 0.05, True)
    assert big_moved.mean == pytest.approx(scaled(moved, 10.0).mean, rel=1e-6)
    assert big_moved.covariance == pytest.approx(scaled(moved, 10.0).covariance, rel=1e-6)


@given(
    curvature=st.integers(-80, 80).map(lambda percent: 0.01 * percent),
    heading=st.floats(-0.3, 0.3),
    aside=st.floats(-0.1, 0.1),
    turn=st.floats(-0.3, 0.3),
)
def test_a_mirrored_road_gives_the_mirrored_lane(curvature: float, heading: float, aside: float, turn: float) -> None:
    one = Road(curvature_per_m=curvature, heading_rad=heading, aside_m=aside)
    sign = np.array((-1.0, -1.0, -1.0, 1.0))
    lines = pair(one)
    flipped = [Assigned(scaled_line(line, np.array((1.0, -1.0))), -role) for line, role in lines]
    found, odds = NOWHERE.moved(0.2, turn, 0.05, True).update(lines)
    mirrored, mirrored_odds = NOWHERE.moved(0.2, -turn, 0.05, True).update(flipped)
    assert mirrored.mean == pytest.approx(sign * found.mean, abs=1e-9)
    assert mirrored.covariance == pytest.approx(np.outer(sign, sign) * found.covariance, abs=1e-9)
    assert mirrored_odds == pytest.approx(odds, abs=1e-6)


def test_a_line_in_its_place_is_explained_and_another_is_not() -> None:
    sure = belief(STRAIGHT, (0.02, 0.03, 0.1, 0.02))
    assert sure.explains(Assigned(line_of(STRAIGHT, LEFT), LEFT))
    assert not sure.explains(Assigned(line_of(STRAIGHT, 0.0), LEFT))
    assert not sure.explains(Assigned(line_of(STRAIGHT, RIGHT), LEFT))


def test_what_is_no_news_teaches_little() -> None:
    lines = pair(ARCS[1])
    sigmas = [NOWHERE.update(lines, way)[0].sigma(Part.OFFSET) for way in (1.0, 0.1, 1e-6)]
    assert sigmas[0] < sigmas[1] < sigmas[2]
    assert sigmas[2] == pytest.approx(NOWHERE.sigma(Part.OFFSET), rel=0.05)


def test_what_lies_far_ahead_is_news_only_after_the_way_to_it() -> None:
    for from_m, to_m, lost in ((0.0, 0.1, 1.0), (1.0, 1.4, 2.0)):
        lines = pair(STRAIGHT, from_m, to_m)
        known, at_first, soon = (
            NOWHERE.sigma(Part.WIDTH),
            *(NOWHERE.update(lines, way)[0].sigma(Part.WIDTH) for way in (math.inf, 0.25)),
        )
        information = [sigma**-2.0 - known**-2.0 for sigma in (at_first, soon)]
        assert information[0] >= 0.99 * lost * information[1]
        assert (information[0] < 1.01 * information[1]) == (lost == 1.0)


@pytest.mark.parametrize("pitch_rad", [0.01, -0.01])
def test_lines_that_a_wrong_pitch_lets_converge_are_the_lanes_where_the_pitch_is_uncertain(pitch_rad: float) -> None:
    eye_m = (0.0, 0.2)
    lines = []
    for line, role in pair(STRAIGHT, 0.2, 1.5):
        x, y = line.points_m.T
        lines.append(Assigned(sighted(np.column_stack((x, y * (1.0 + pitch_rad * x / eye_m[1])))), role))
    sure, unsure = (
        belief(STRAIGHT, (0.02, 0.05, 0.1, 0.005), model=replace(ROAD_MODEL, eye_m=eye_m, pitch_rad=sigma))
        for sigma in (0.0, 0.01)
    )
    assert unsure.update(lines)[1] > sure.update(lines)[1] + 3.0
    assert unsure.update(lines)[0].width_m == pytest.approx(LANE_M, abs=0.01)


def test_a_line_beyond_the_end_of_a_bend_is_explained_by_a_road_that_may_change_at_once() -> None:
    bend = belief(Road(curvature_per_m=-1.0), (0.003, 0.016, 0.19, 0.01))
    x = np.linspace(0.7, 1.2, 4)
    straight_on = sighted(
        np.column_stack((x, 0.2 - 0.5 * 0.5**2 - 0.5 * (x - 0.5)))
    )  # the bend ends half a metre ahead
    assert bend.explains(Assigned(straight_on, LEFT))
    assert not bend.explains(Assigned(straight_on, RIGHT))


def test_no_line_changes_nothing() -> None:
    found, odds = NOWHERE.update(())
    assert found is NOWHERE
    assert odds == 0.0


@pytest.mark.parametrize("road", ARCS)
@pytest.mark.parametrize("role", [LEFT, RIGHT])
def test_a_line_runs_beside_the_lane_where_the_road_says(road: Road, role: float) -> None:
    points, heading, sigma = belief(road, reference_x_m=0.1).beside(np.linspace(0.0, 1.0, 9), role)
    assert road.beside(points[:, 0], points[:, 1]) == pytest.approx(np.full(9, role * LANE_M), abs=1e-9)
    along = road.along(points[:, 0], points[:, 1])
    assert heading == pytest.approx(road.heading_rad + road.curvature_per_m * along, abs=1e-9)
    assert (np.diff(sigma) > 0.0).all()  # the farther, the less is known


def test_a_winding_road_is_learnt_and_a_straight_one_as_well() -> None:
    winding, straight = Bends(ROAD_MODEL), Bends(ROAD_MODEL)
    for i in range(400):
        for bends, curvature in ((winding, 0.8 * (-1) ** (i // 4)), (straight, 0.0)):
            bends.move(0.6 * LANE_M)
            bends.see(curvature)
    assert winding.road.bend_walk > 2.0 * ROAD_MODEL.bend_walk
    assert straight.road.bend_walk < 0.3 * ROAD_MODEL.bend_walk
    winding.reset()
    assert winding.road == ROAD_MODEL


def test_a_standing_car_learns_nothing_of_the_road() -> None:
    bends = Bends(ROAD_MODEL)
    for i in range(100):
        bends.see(0.5 * (-1) ** i)
    assert bends.road == ROAD_MODEL
