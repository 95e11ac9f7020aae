"""The lane's belief against roads whose place is known: what its lines, its motion and its covariance say."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from automodel.geometry import SE2
from automodel.geometry.lane_path import ROAD, WIDTH
from automodel.perception.line_scan import SightedLine
from automodel.signals import MotionSource
from automodel.tracking.belief import STATION, STATIONS, Assigned, Evidence, LaneBelief, LearntRoad, RoadModel
from automodel.tracking.evidence import most_misfit
from automodel.tracking.lane_motion import Part
from automodel.tracking.lane_tracking import TrackingConfig
from automodel.tracking.stories import LEFT, RIGHT
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
    return float(error @ np.linalg.solve(believed.spread, error))


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


STEP_M = 0.01  # between the points of a drawn road


def winding_road(random: np.random.Generator, length_m: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Curvatures (n,) [1/m], headings (n,) [rad] and points (n, 2) [m] of a road of arcs that begin and end at once."""
    curvatures = np.empty(0)
    while len(curvatures) * STEP_M < length_m:
        arc = round(random.uniform(0.3, 2.0) / STEP_M)
        bend = random.choice((0.0, 0.0, 1.0, -1.0)) / (LANE_M * random.uniform(2.5, 8.0))
        curvatures = np.append(curvatures, np.full(arc, bend))
    headings = np.append(0.0, np.cumsum(curvatures * STEP_M))[:-1]
    steps = STEP_M * np.column_stack((np.cos(headings), np.sin(headings)))
    return curvatures, headings, np.vstack((np.zeros(2), np.cumsum(steps, axis=0)[:-1]))


def seen(random: np.random.Generator, headings: FloatArray, points: FloatArray, model: RoadModel) -> list[Assigned]:
    """Both lines of a road with these headings and points in the body frame, with the errors that the model states."""
    lines = []
    for role in (LEFT, RIGHT):
        left = role * model.lane_width_m + random.normal(0.0, model.line_sigma * model.lane_width_m)
        line = points + left * np.column_stack((-np.sin(headings), np.cos(headings)))
        noise = random.normal(0.0, model.point_markings * model.marking_width_m, line.shape)
        lines.append(Assigned(sighted((line + noise)[30:140:8]), role))
    return lines


def test_the_covariance_is_as_large_as_the_errors_along_winding_roads() -> None:
    errors = []
    for seed in range(4):
        random = np.random.default_rng(seed)
        curvatures, headings, points = winding_road(random, 30.0)
        model = replace(ROAD_MODEL, pace=0.02)  # the odometry of this drive is right
        believed, bends = belief(STRAIGHT, (0.1, 0.25, 0.5, 0.05), model=model), LearntRoad(model)
        for i in range(0, 2500, 10):
            turn = np.array(
                ((math.cos(headings[i]), -math.sin(headings[i])), (math.sin(headings[i]), math.cos(headings[i])))
            )
            ahead = slice(i, i + 220)
            errors_of = np.random.default_rng((seed, int(i * STEP_M / LANE_M / model.news)))  # the same for that way
            lines = seen(errors_of, headings[ahead] - headings[i], (points[ahead] - points[i]) @ turn, model)
            believed, _ = replace(believed, road=bends.road).update(lines, 10 * STEP_M / LANE_M)
            bends.see(curvatures[i], None)
            error, order = believed.mean[:2], np.ix_((0, 1), (0, 1))  # the car drives on the centre
            if i > 200:
                errors.append(float(error @ np.linalg.solve(believed.spread[order], error)))
            believed = believed.moved(10 * STEP_M, headings[i + 10] - headings[i], 0.1, True)
            bends.move(10 * STEP_M, headings[i + 10] - headings[i], MotionSource.MEASURED)
    assert 0.6 < np.mean(errors) < 2.4  # 2 is right
    assert np.quantile(errors, 0.999) < 27.6  # once in a million of them


def sharp_bend(random: np.random.Generator) -> tuple[LaneBelief, list[Assigned]]:
    """A belief near the truth of a lane whose bend begins or ends at once, and one or both of its lines far ahead."""
    before, after = (random.choice((-0.4, 0.0, 0.0, 0.4)) / LANE_M for _ in range(2))
    changes_m = random.uniform(0.3, 3.5) * LANE_M
    sigmas = np.array((0.03 * LANE_M, 0.03, 0.03 / LANE_M, 0.03 * LANE_M))
    mean = np.array((0.0, 0.0, before, LANE_M)) + random.normal(size=4) * sigmas
    from_lanes = random.uniform(0.5, 2.2)
    s = np.arange(from_lanes, from_lanes + random.uniform(1.0, 2.5), 0.3) * LANE_M
    step_m = 0.005 * LANE_M
    way = np.arange(0.0, s[-1] + step_m, step_m)
    heading = np.concatenate(((0.0,), np.cumsum(np.where(way[:-1] < changes_m, before, after) * step_m)))
    x, y = (np.concatenate(((0.0,), np.cumsum(step_m * part[:-1]))) for part in (np.cos(heading), np.sin(heading)))
    x, y, heading = (np.interp(s, way, part) for part in (x, y, heading))
    normal, lines = np.column_stack((-np.sin(heading), np.cos(heading))), []
    for role in ((LEFT, RIGHT), (RIGHT,))[random.integers(2)]:
        noise = 0.1 * MARKING_M * random.normal(size=(len(s), 1)) + 0.02 * LANE_M * random.normal()
        lines.append(Assigned(sighted(np.column_stack((x, y)) + (role * LANE_M + noise) * normal), role))
    return LaneBelief.arc(mean, np.diag(np.square(sigmas)), ROAD_MODEL, 0.0), lines


@pytest.mark.parametrize("seed", [11, 12, 15])
def test_the_covariance_is_about_as_large_as_the_errors_where_bends_begin_and_end_at_once(seed: int) -> None:
    """A normal belief smooths such bends, and is a little too sure; a linearisation gone astray would be far off.

    Lines that are likelier as clutter are not followed: a bend of twice the usual change, for example.
    """
    random, errors = np.random.default_rng(seed), []
    for _ in range(400):
        believed, lines = sharp_bend(random)
        found, log_likelihood = believed.update(lines)
        if log_likelihood < sum(believed.anything().of_line(line) for line, _ in lines):
            continue
        error, order = found.mean[:2], np.ix_((0, 1), (0, 1))
        errors.append(float(error @ np.linalg.solve(found.spread[order], error)))
    assert len(errors) > 350
    assert 1.6 < np.mean(errors) < 2.6  # 2 is right; 0.1 is a standard deviation of the mean
    assert np.max(errors) < 40.0


@pytest.mark.parametrize("pixel_rad", [0.0, 0.01])
def test_the_points_of_a_line_are_as_likely_as_students_errors(pixel_rad: float) -> None:
    """Of a lane that is known for certain, without an error that its points have in common; of pixels, the larger the
    farther away.
    """
    model = replace(ROAD_MODEL, line_sigma=0.0, pixel_rad=pixel_rad)
    scale_m = model.point_markings * model.marking_width_m
    away_m = scale_m * np.array((0.0, 0.5, -1.0, 2.0, -8.0, 30.0))
    points = np.column_stack((np.linspace(0.5, 1.5, len(away_m)) * LANE_M, 0.5 * LANE_M + away_m))
    certain = LaneBelief.arc(np.array((0.0, 0.0, 0.0, LANE_M)), 1e-14 * np.eye(4), replace(model, bend_walk=1e-9), 0.0)
    _, log_likelihood = certain.update((Assigned(sighted(points), LEFT),))
    scales_m = np.hypot(scale_m, pixel_rad * np.hypot(*(points - np.array((model.eye_m[0], 0.0))).T))
    density = (1.0 + 0.5 * (away_m / scales_m) ** 2) ** -1.5 / (math.sqrt(8.0) * scales_m)
    assert log_likelihood == pytest.approx(float(np.log(density).sum()), abs=0.05)


@pytest.mark.parametrize("away_m", [0.05, 0.1, 0.2])
def test_a_point_of_another_thing_hardly_moves_the_lane(away_m: float) -> None:
    """A lamp's edge that touches a line, a zebra's bar that is joined to it."""
    random, errors = np.random.default_rng(7), []
    for _ in range(300):
        believed, ((line, role), *others) = sharp_bend(random)
        points = line.points_m.copy()
        points[random.integers(len(points)), 1] += away_m * random.choice((-1.0, 1.0))
        lines = [Assigned(sighted(points), role), *others]
        found, log_likelihood = believed.update(lines)
        if log_likelihood < sum(believed.anything().of_line(line) for line, _ in lines):
            continue
        error, order = found.mean[:2], np.ix_((0, 1), (0, 1))
        errors.append(float(error @ np.linalg.solve(found.spread[order], error)))
    assert len(errors) > 0.85 * 300
    assert 1.6 < np.mean(errors) < 2.6
    assert np.quantile(errors, 0.99) < 27.6


def test_a_point_of_another_thing_at_a_lines_end_seldom_bends_the_road() -> None:
    """Where nothing is known of a road's bends it might go through that point, and the others would lie beside it."""
    unknown = belief(STRAIGHT, (0.25 * LANE_M, 0.25, 0.25 / LANE_M, 0.12 * LANE_M))
    random, bent = np.random.default_rng(5), []
    for _ in range(60):
        points = np.column_stack((np.linspace(0.5, 1.6, 15), 0.5 * LANE_M + 0.002 * random.normal(size=15)))
        without, _ = unknown.update((Assigned(sighted(points[1:]), LEFT),))
        points[0, 1] -= 0.04
        found, _ = unknown.update((Assigned(sighted(points), LEFT),))
        off = (found.mean - without.mean)[:2] / np.sqrt(np.diag(without.spread)[:2])
        bent.append(np.abs(off).max() > 0.5)
    assert np.mean(bent) < 0.1


MOTIONS = [(0.0, 0.0), (0.3, 0.0), (0.25, 0.3), (-0.1, -0.1), (0.0, 0.4)]


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("road", ARCS)
def test_a_known_motion_keeps_the_lane_where_it_is(road: Road, motion: tuple[float, float]) -> None:
    before = belief(road, reference_x_m=0.12, model=replace(ROAD_MODEL, bend_walk=0.0))  # which never turns straight
    after = before.moved(*motion, 0.05, True)
    x, y = SE2.arc(*motion).apply(np.array((0.12, 0.0)))
    theta = road.heading_rad + road.curvature_per_m * float(road.along(x, y)) - motion[1]
    expected = (float(road.beside(x, y)), theta, road.curvature_per_m, LANE_M)
    assert after.mean == pytest.approx(np.array(expected), abs=1e-9)


def test_a_known_motion_carries_the_covariance_as_numeric_derivatives_say() -> None:
    sure = RoadModel(
        lane_width_m=LANE_M, marking_width_m=MARKING_M, bend_walk=0.0, step=0.0, turn_rad=0.0, width_walk=0.0, pace=0.0
    )
    before = belief(Road(heading_rad=0.02, aside_m=0.01), model=sure)
    step = 1e-5
    columns = []
    for part in Part:
        ends = [
            LaneBelief.arc(before.mean + sign * step * np.eye(4)[part], before.spread, sure, 0.0)
            .moved(0.3, 0.02, 0.05, True)
            .mean
            for sign in (1.0, -1.0)
        ]
        columns.append((ends[0] - ends[1]) / (2.0 * step))
    jacobian = np.column_stack(columns)
    expected = jacobian @ before.spread @ jacobian.T
    assert before.moved(0.3, 0.02, 0.05, True).spread == pytest.approx(expected, rel=0.03, abs=1e-5)


def test_an_unknown_motion_leaves_the_lane_and_makes_it_uncertain() -> None:
    before = belief(ARCS[1], (0.01, 0.02, 0.1, 0.02))
    after = before.moved(0.0, 0.0, 0.1, False)
    assert after.state[:ROAD] == pytest.approx(before.state[:ROAD], abs=1e-12)
    assert after.sigma(Part.OFFSET) > 5.0 * before.sigma(Part.OFFSET)
    assert after.sigma(Part.THETA) > 5.0 * before.sigma(Part.THETA)
    assert after.sigma(Part.WIDTH) == pytest.approx(before.sigma(Part.WIDTH))


def test_two_lines_far_ahead_measure_the_width_and_not_the_place() -> None:
    mean = NOWHERE.mean + np.array((0.0, 0.0, 0.0, 0.04))  # expected 10 % too wide
    wide = LaneBelief.arc(mean, NOWHERE.spread, NOWHERE.road, NOWHERE.reference_x_m)
    far, _ = wide.update(pair(STRAIGHT, 2.2, 2.8))
    assert far.width_m == pytest.approx(LANE_M, abs=0.012)
    assert far.sigma(Part.WIDTH) < 0.3 * wide.sigma(Part.WIDTH)
    assert far.sigma(Part.OFFSET) > 0.8 * wide.sigma(Part.OFFSET)


def test_one_line_leaves_the_width_unknown() -> None:
    found, _ = NOWHERE.update((Assigned(line_of(STRAIGHT, LEFT), LEFT),))
    assert found.sigma(Part.WIDTH) > 0.9 * NOWHERE.sigma(Part.WIDTH)


def scaled(believed: LaneBelief, factor: float) -> LaneBelief:
    unit = np.array((factor, 1.0, factor, 1.0, *(STATIONS * (1.0 / factor,))))
    model = believed.road
    return LaneBelief(
        unit * believed.state,
        np.outer(unit, unit) * believed.covariance,
        factor * believed.start_m,
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
    assert other.mean == pytest.approx(scaled(one, 10.0).mean, rel=1e-5, abs=1e-7)
    assert other.covariance == pytest.approx(scaled(one, 10.0).covariance, rel=1e-5, abs=1e-7)
    clutter = sum(small.anything().of_line(line) for line, _ in lines)
    assert big_odds - sum(big.anything().of_line(line) for line, _ in big_lines) == pytest.approx(
        odds - clutter, abs=1e-6
    )
    moved, big_moved = one.moved(0.2, 0.1, 0.05, True), other.moved(2.0, 0.1, 0.05, True)
    assert big_moved.mean == pytest.approx(scaled(moved, 10.0).mean, rel=1e-5, abs=1e-7)
    assert big_moved.covariance == pytest.approx(scaled(moved, 10.0).covariance, rel=1e-5, abs=1e-7)


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
    assert mirrored.spread == pytest.approx(np.outer(sign, sign) * found.spread, abs=1e-9)
    assert mirrored_odds == pytest.approx(odds, abs=1e-6)


def likelihood(believed: LaneBelief, line: SightedLine, role: float = LEFT) -> float:
    return believed.update((Assigned(line, role),))[1]


def explained(believed: LaneBelief, line: Assigned) -> bool:
    return bool(Evidence(believed).explained((line,), TrackingConfig(coast_s=1.0, coast_lanes=1.0).gate)[0])


def test_a_line_in_its_place_is_explained_and_another_is_not() -> None:
    sure = belief(STRAIGHT, (0.02, 0.03, 0.1, 0.02))
    assert explained(sure, Assigned(line_of(STRAIGHT, LEFT), LEFT))
    assert not explained(sure, Assigned(line_of(STRAIGHT, 0.0), LEFT))
    assert not explained(sure, Assigned(line_of(STRAIGHT, RIGHT), LEFT))


def test_a_line_that_goes_on_as_another_is_not_explained_though_no_clutter_is_likelier() -> None:
    sure = belief(STRAIGHT, (0.02, 0.03, 0.1, 0.02))
    points = line_of(STRAIGHT, LEFT).points_m.copy()
    points[: len(points) // 2, 1] += 0.1 * LANE_M  # the near half is something beside it
    mixed = sighted(points)
    assert likelihood(sure, mixed) > sure.anything().of_line(mixed)
    assert not explained(sure, Assigned(mixed, LEFT))


def test_a_new_bend_begins_where_a_line_departs_or_anywhere_before_it() -> None:
    sure, points = belief(STRAIGHT, (0.01, 0.02, 0.05, 0.01)), line_of(STRAIGHT, LEFT, count=10).points_m.copy()
    assert Evidence(sure).departs_m(sighted(points), LEFT) is None
    far, near = points.copy(), points.copy()
    far[6:, 1] += 0.3 * LANE_M
    departs_m = Evidence(sure).departs_m(sighted(far), LEFT)
    assert departs_m is not None
    assert np.hypot(*far[5]) <= departs_m <= np.hypot(*far[6])
    near[:3, 1] += 0.3 * LANE_M
    assert Evidence(sure).departs_m(sighted(near), LEFT) == pytest.approx(0.5 * float(np.hypot(*near[0])))


def test_what_is_no_news_teaches_little() -> None:
    lines = pair(ARCS[1])
    sigmas = [NOWHERE.update(lines, way)[0].sigma(Part.OFFSET) for way in (1.0, 0.1, 1e-6)]
    assert sigmas[0] < sigmas[1] < sigmas[2]
    assert sigmas[2] == pytest.approx(NOWHERE.sigma(Part.OFFSET), rel=0.05)


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


def test_a_line_that_was_seen_stays_where_it_is_in_a_lane_of_any_width() -> None:
    known, _ = belief(STRAIGHT, (0.1, 0.25, 0.5, 0.03)).update(pair(STRAIGHT)[:1])  # the left one
    any_width, s = known.of_any_width(), np.array((0.3, 0.6))
    assert any_width.sigma(Part.WIDTH) == pytest.approx(ROAD_MODEL.width_sigma * LANE_M, rel=1e-3)
    assert any_width.sigma(Part.OFFSET) > 1.3 * known.sigma(Part.OFFSET)
    (left, _, sigma), (was, _, was_sigma) = any_width.beside(s, LEFT), known.beside(s, LEFT)
    assert left == pytest.approx(was, abs=1e-3)
    assert sigma == pytest.approx(was_sigma, rel=0.05)


def test_a_line_beyond_the_end_of_a_bend_is_explained_by_a_road_that_may_change_at_once() -> None:
    bend = belief(Road(curvature_per_m=-1.0), (0.003, 0.016, 0.19, 0.01))
    x = np.linspace(0.7, 1.2, 4)
    straight_on = sighted(
        np.column_stack((x, 0.2 - 0.5 * 0.5**2 - 0.5 * (x - 0.5)))
    )  # the bend ends half a metre ahead
    assert explained(bend, Assigned(straight_on, LEFT))
    assert not explained(bend, Assigned(straight_on, RIGHT))


@pytest.mark.parametrize("side", [+1.0, -1.0])
def test_a_tight_bend_that_begins_at_once_is_explained_by_a_road_with_a_new_bend(side: float) -> None:
    """Of one and a half lane widths' radius, from a lane width ahead on; the Carolo-Cup's tightest has 2.5."""
    known, turned = belief(STRAIGHT, (0.003, 0.016, 0.1, 0.01)), np.linspace(0.0, 0.9, 8)
    outer_m = 1.5 * LANE_M + 0.5 * LANE_M
    y = 0.5 * LANE_M - outer_m * (1.0 - np.cos(turned))
    outer = sighted(np.column_stack((LANE_M + outer_m * np.sin(turned), side * y)))
    role = LEFT if side > 0.0 else RIGHT
    assert not explained(known.without_road(), Assigned(outer, role))
    assert explained(known.of_new_bend(LANE_M), Assigned(outer, role))
    assert not explained(known.of_new_bend(LANE_M), Assigned(outer, -role))
    beside = known.of_new_bend(1.5 * LANE_M)
    assert beside.mean == pytest.approx(known.mean)
    assert beside.spread == pytest.approx(known.spread)


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


def drive_on(road: LearntRoad, curvature: float, turn_rad: float = 0.0, heading_rad: float | None = None) -> None:
    """0.6 lane widths on, with a look at the lane then."""
    road.move(0.6 * LANE_M, turn_rad, MotionSource.MEASURED)
    road.see(curvature, heading_rad)


def test_a_winding_road_is_learnt_and_a_straight_one_as_well() -> None:
    winding, straight = LearntRoad(ROAD_MODEL), LearntRoad(ROAD_MODEL)
    for i in range(400):
        drive_on(winding, 0.8 * (-1) ** (i // 4))
        drive_on(straight, 0.0)
    assert winding.road.bend_walk > 2.0 * ROAD_MODEL.bend_walk
    assert straight.road.bend_walk < 0.3 * ROAD_MODEL.bend_walk
    winding.reset()
    assert winding.road == winding.reckoning == ROAD_MODEL


@pytest.mark.parametrize("turn_rad", [0.0, 0.01, 0.05])
def test_how_well_the_odometry_tells_turns_is_learnt(turn_rad: float) -> None:
    """A car that weaves in a lane of one bend: its odometry's error is a random walk."""
    road, random, step, bend = LearntRoad(ROAD_MODEL), np.random.default_rng(0), 0.6, 0.5
    headings = 0.1 * np.sin(np.arange(4001))
    for before, heading in itertools.pairwise(headings):
        turned = heading - before + bend * step * LANE_M
        drive_on(road, bend, turned + turn_rad * math.sqrt(step) * random.normal(), heading)
    assert road.reckoning.turn_rad == pytest.approx(turn_rad, rel=0.15, abs=0.001)
    assert road.road.turn_rad == ROAD_MODEL.turn_rad
    assert road.road.bend_walk < 0.01 * ROAD_MODEL.bend_walk


def test_a_car_that_reverses_through_a_bend_turns_the_other_way() -> None:
    road, bend, step_m = LearntRoad(ROAD_MODEL), 0.5, 0.6 * LANE_M
    for _ in range(400):
        road.move(-step_m, -bend * step_m, MotionSource.MEASURED)
        road.see(bend, 0.0)
    assert road.reckoning.turn_rad < 0.5 * ROAD_MODEL.turn_rad


def test_what_is_learnt_of_an_odometry_says_nothing_of_another_one() -> None:
    road = LearntRoad(ROAD_MODEL)
    for _ in range(400):
        drive_on(road, 0.0, 0.0, 0.0)
    learnt = road.reckoning.turn_rad
    assert learnt < 0.5 * ROAD_MODEL.turn_rad
    road.move(0.0, 0.0, MotionSource.MODEL)
    assert road.reckoning.turn_rad == pytest.approx(ROAD_MODEL.turn_rad)
    road.move(0.0, 0.0, MotionSource.MEASURED)
    assert road.reckoning.turn_rad == learnt


def test_nothing_is_learnt_of_turns_where_the_lane_is_not_known() -> None:
    unseen, doubted, seldom = (LearntRoad(ROAD_MODEL) for _ in range(3))
    for i in range(100):
        drive_on(unseen, 0.0, 0.1)
        drive_on(doubted, 0.0, 0.1, 0.0)
        doubted.lose()
        drive_on(seldom, 0.0, 0.1, None if i % 20 else 0.0)
    for road in (unseen, doubted, seldom):
        assert road.reckoning.turn_rad == pytest.approx(ROAD_MODEL.turn_rad)


def test_a_standing_car_learns_nothing_of_the_road() -> None:
    road = LearntRoad(ROAD_MODEL)
    for i in range(100):
        road.see(0.5 * (-1) ** i, 0.2 * (-1) ** i)
    assert road.road == road.reckoning == ROAD_MODEL


def test_a_bend_that_was_seen_ahead_is_known_when_the_car_comes_to_it_blind() -> None:
    """A straight of 0.8 m, then an arc; both lines are seen from the straight alone."""
    bend, straight_m = 1.0 / 1.2, 0.8
    along = np.arange(0.2, 1.6, 0.05)
    turns = np.maximum(along - straight_m, 0.0) * bend
    middle = np.column_stack((np.minimum(along, straight_m) + np.sin(turns) / bend, (1.0 - np.cos(turns)) / bend))
    normal = np.column_stack((-np.sin(turns), np.cos(turns)))
    lines = [Assigned(sighted(middle + role * LANE_M * normal), role) for role in (LEFT, RIGHT)]
    believed, _ = belief(STRAIGHT, (0.02, 0.05, 0.2, 0.02)).update(lines)
    arc = LaneBelief.arc(believed.mean, believed.spread, believed.road, believed.reference_x_m)
    for _ in range(20):  # straight on, to where the bend begins, and half a metre along it
        believed, arc = (one.moved(straight_m / 20.0, 0.0, 0.05, True) for one in (believed, arc))
    for _ in range(10):
        believed, arc = (one.moved(0.05, 0.05 * bend, 0.05, True) for one in (believed, arc))
    assert believed.curvature_per_m == pytest.approx(bend, abs=0.25)
    assert believed.heading_rad == pytest.approx(0.0, abs=0.08)
    assert believed.offset_m == pytest.approx(0.0, abs=0.03)
    assert abs(arc.heading_rad) > 0.25  # who forgot the bend
    assert believed.sigma(Part.THETA) < 0.7 * arc.sigma(Part.THETA)


def test_without_motion_the_road_ahead_gets_uncertain_and_turns_straight() -> None:
    before = belief(Road(curvature_per_m=0.8), (0.01, 0.02, 0.02, 0.01))
    after = before
    for _ in range(60):
        after = after.moved(0.0, 0.0, 0.05, False)
    assert after.sigma(Part.KAPPA) > 5.0 * before.sigma(Part.KAPPA)
    assert abs(after.curvature_per_m) < 0.8
    assert after.sigma(Part.KAPPA) <= ROAD_MODEL.any_bend / LANE_M * 1.01


def test_a_width_that_is_not_seen_is_again_the_one_that_is_configured() -> None:
    wide = belief(STRAIGHT, (0.01, 0.02, 0.02, 0.001))
    wide = replace(wide, state=wide.state + 0.1 * np.eye(len(wide.state))[WIDTH])
    for _ in range(200):
        wide = wide.moved(0.4, 0.0, 0.1, True)
    assert wide.width_m == pytest.approx(LANE_M, abs=0.01)
    assert wide.sigma(Part.WIDTH) == pytest.approx(ROAD_MODEL.width_sigma * LANE_M, rel=0.02)


def test_a_car_that_drives_there_and_back_has_its_road_again() -> None:
    start = belief(Road(curvature_per_m=0.5), (0.01, 0.02, 0.02, 0.01), model=replace(ROAD_MODEL, bend_walk=0.0))
    there = start
    for step in (*[0.05] * 20, *[-0.05] * 20):
        there = there.moved(step, step * 0.5, 0.05, True)
    assert 0.0 <= there.start_m < STATION * LANE_M
    assert there.mean == pytest.approx(start.mean, abs=1e-6)


def test_lines_far_from_where_a_straight_road_has_them_are_found_by_a_bend() -> None:
    """A linearisation about the straight road alone would take them for clutter."""
    road = Road(curvature_per_m=0.92)
    wide = belief(STRAIGHT, (0.1, 0.25, 0.5, 0.05))
    lines = [Assigned(line_of(road, role, 0.3, 1.4), role) for role in (LEFT, RIGHT)]
    found, likely = wide.update(lines)
    assert abs(found.curvature_per_m - 0.92) < 3.0 * found.sigma(Part.KAPPA)
    assert found.offset_m == pytest.approx(0.0, abs=0.02)
    anything = wide.anything()
    assert likely > sum(anything.of_line(line) for line, _ in lines) + 5.0


def test_a_thing_with_corners_is_clutter_even_where_the_road_may_bend() -> None:
    """The road ahead may turn there and back; a thing that is smooth could not."""
    wide = belief(STRAIGHT, (0.02, 0.1, 1.0, 0.05))
    x = np.linspace(0.5, 1.4, 7)
    corners = SightedLine(points_m=np.stack((x, 0.2 + 0.15 * (np.arange(7) % 2)), axis=1), painted_m=1.0, span_m=1.0)
    assert likelihood(wide, corners) < wide.anything().of_line(corners)
    smooth = line_of(STRAIGHT, LEFT, 0.5, 1.4)
    assert likelihood(wide, smooth) > wide.anything().of_line(smooth)


def on_a_ray(bearing_rad: float, turn_rad: float = 0.0) -> SightedLine:
    """A straight thing 0.7 m from below the camera, which points there, or is turned from that direction."""
    along = np.linspace(-0.2, 0.2, 6)[:, None]
    eye_m, there, direction = np.array((ROAD_MODEL.eye_m[0], 0.0)), bearing_rad, bearing_rad + turn_rad
    middle = eye_m + 0.7 * np.array((math.cos(there), math.sin(there)))
    return sighted(middle + along * np.array((math.cos(direction), math.sin(direction))))


@pytest.mark.parametrize("bearing_rad", [-0.3, 0.0, 0.25])
def test_what_points_to_the_camera_may_be_a_reflection(bearing_rad: float) -> None:
    """A line of the lane must be likelier than that. What is turned from there is none."""
    anything = belief(STRAIGHT, (0.1, 0.25, 0.5, 0.05)).anything()

    def gain(line: SightedLine, reflection: float) -> float:
        return anything.of_line(replace(line, reflection=reflection)) - anything.of_line(line)

    assert gain(on_a_ray(bearing_rad), 1.0) > 2.0
    assert 0.0 < gain(on_a_ray(bearing_rad), 0.01) < gain(on_a_ray(bearing_rad), 1.0)
    assert gain(on_a_ray(bearing_rad, 0.3), 1.0) == pytest.approx(0.0, abs=0.5)


def anything_smooth(believed: LaneBelief) -> LaneBelief:
    """A thing of its own that is as smooth as a road."""
    model, unit = believed.road, believed.road.lane_width_m
    somewhere = np.diag(np.square((model.anywhere * unit, model.any_turn_rad, model.any_bend / unit, 0.0)))
    return LaneBelief.arc(np.zeros(4), somewhere, model, believed.reference_x_m)


def test_clutter_is_the_sum_of_a_smooth_thing_of_one_with_corners_and_of_a_reflection() -> None:
    wide = belief(STRAIGHT, (0.02, 0.1, 1.0, 0.05))
    anything, model = wide.anything(), wide.road
    unit, smooth = model.lane_width_m, anything_smooth(wide)
    for line in (line_of(STRAIGHT, LEFT, 0.5, 1.4), line_of(ARCS[2], RIGHT, 0.3, 1.2)):
        sigma_m, y = model.anywhere * unit, line.points_m[:, 1]
        corners = float((-0.5 * (y / sigma_m) ** 2 - np.log(sigma_m * np.sqrt(2.0 * np.pi))).sum())
        thing = np.logaddexp(likelihood(smooth, line, 0.0), corners - anything.CORNERS)
        away_m = math.dist(line.points_m.mean(axis=0).tolist(), (model.eye_m[0], 0.0))
        spread = np.diag(np.square((anything.streak.pointing_rad * away_m, model.any_turn_rad, 0.0, 0.0)))
        ray = LaneBelief.arc(np.zeros(4), spread, replace(model, bend_walk=0.0), model.eye_m[0])
        assert anything.of_line(line) == pytest.approx(float(thing), rel=1e-12)
        expected = np.logaddexp(thing, likelihood(ray, line, 0.0) + math.log(0.3))
        assert anything.of_line(replace(line, reflection=0.3)) == pytest.approx(float(expected), rel=1e-9)


def test_few_true_lines_cost_more_than_the_most_that_a_line_costs() -> None:
    t = np.random.default_rng(1).standard_t(2.0, (200_000, 9))
    costs = 3.0 * np.log1p(0.5 * t * t).sum(axis=1)
    assert np.mean(costs > most_misfit(9, 1e-3)) == pytest.approx(1e-3, abs=3.0 * math.sqrt(1e-3 / len(t)))
