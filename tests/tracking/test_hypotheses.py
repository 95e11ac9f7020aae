"""Which line is which: what may be told at once, what stays open, and what decides it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from automodel.geometry.lane_path import OFFSET
from automodel.perception.line_scan import SightedLine
from automodel.tracking.belief import Assigned
from automodel.tracking.hypotheses import STILL_LANES, Hypotheses, HypothesesConfig, Hypothesis, LineKinds
from automodel.tracking.lane_motion import Part
from automodel.tracking.stories import LEFT, LEFT_FAR, RIGHT, RIGHT_FAR
from tests.support.drawn_roads import LANE_M, MARKING_M, STRAIGHT, Road
from tests.support.sighted_lines import DASHED, ROAD_MODEL, belief, bending, line_of, sighted

START = belief(STRAIGHT, (0.25 * LANE_M, 0.25, 0.2 / LANE_M, 0.12 * LANE_M))  # a car somewhere in a lane
COUNTRY = LineKinds(left=4.0, right=-4.0)  # dashed middle line, solid edge: traffic on the right


def started(*lines: SightedLine, kinds: LineKinds | None = None) -> Hypotheses:
    """The hypotheses after one frame's lines."""
    hypotheses = Hypotheses()
    hypotheses.start(((START, 0.0),))
    hypotheses.update(lines, kinds or LineKinds())
    return hypotheses


def road_at(offset_lanes: float, heading_rad: float = 0.0) -> Road:
    """A straight road on which the car stands `offset_lanes` to the left of its lane's centre."""
    return Road(aside_m=-offset_lanes * LANE_M, heading_rad=heading_rad)


def country_road(offset_lanes: float, heading_rad: float = 0.0) -> list[SightedLine]:
    """Two lanes: the right edge, the dashed middle, and the far edge of the oncoming lane."""
    road = road_at(offset_lanes, heading_rad)
    return [line_of(road, RIGHT), line_of(road, LEFT, painted=DASHED), line_of(road, LEFT_FAR)]


def roles(one: Hypothesis) -> set[float]:
    return {role for _, role in one.assigned}


@pytest.mark.parametrize("offset", [-0.3, -0.1, 0.0, 0.2, 0.3])
@pytest.mark.parametrize("heading", [-0.2, 0.0, 0.2])
def test_the_lane_that_the_car_stands_in_is_the_likeliest_of_two(offset: float, heading: float) -> None:
    hypotheses = started(*country_road(offset, heading), kinds=COUNTRY)
    best = hypotheses.all[0]
    assert best.belief.offset_m == pytest.approx(offset * LANE_M, abs=0.02)
    assert best.belief.heading_rad == pytest.approx(-heading, abs=0.03)
    assert best.belief.width_m == pytest.approx(LANE_M, abs=0.02)
    assert roles(best) == {LEFT, RIGHT, LEFT_FAR}
    assert hypotheses.posterior()[0] > 0.99


def test_the_oncoming_lane_is_no_lane_of_the_cars_though_its_two_lines_are_a_lane_apart() -> None:
    _, middle, outer = country_road(0.0)
    best = started(middle, outer, kinds=COUNTRY).all[0]  # the own right line is covered
    assert best.belief.offset_m == pytest.approx(0.0, abs=0.03)
    assert roles(best) == {LEFT, LEFT_FAR}


def test_the_lanes_width_tells_its_lines_from_another_pair() -> None:
    road = road_at(0.0)
    lines = [line_of(road, RIGHT), line_of(road, 0.15), line_of(road, LEFT)]  # the middle one is a crack
    best = started(*lines).all[0]
    assert best.line(LEFT) == (lines[2],)
    assert best.line(RIGHT) == (lines[0],)
    assert best.belief.width_m == pytest.approx(LANE_M, abs=0.02)


@pytest.mark.parametrize("astride", [0.4, 0.5, 0.6])
def test_astride_the_middle_line_the_kinds_of_the_lines_decide(astride: float) -> None:
    lines = country_road(astride)
    right_hand = started(*lines, kinds=COUNTRY)
    assert right_hand.all[0].belief.offset_m == pytest.approx(astride * LANE_M, abs=0.03)
    left_hand = started(*lines, kinds=LineKinds(left=-4.0, right=4.0))
    assert left_hand.all[0].belief.offset_m == pytest.approx((astride - 1.0) * LANE_M, abs=0.03)


def test_astride_the_middle_line_without_kinds_both_lanes_stay_possible() -> None:
    hypotheses = started(*country_road(0.5))
    offsets = [one.belief.offset_m / LANE_M for one in hypotheses.all]
    assert min(abs(offset - 0.5) for offset in offsets) < 0.1
    assert min(abs(offset + 0.5) for offset in offsets) < 0.1
    assert max(hypotheses.posterior()) < 0.9


def test_one_line_before_the_car_may_be_the_left_or_the_right() -> None:
    hypotheses = started(line_of(STRAIGHT, 0.0))
    single = [one for one in hypotheses.all if one.assigned]
    assert {role for one in single for role in roles(one)} >= {LEFT, RIGHT}
    left, right = (next(one for one in single if roles(one) == {role}) for role in (LEFT, RIGHT))
    assert left.log_odds == pytest.approx(right.log_odds, abs=1e-6)
    assert left.belief.offset_m == pytest.approx(-right.belief.offset_m, abs=1e-9)
    assert max(hypotheses.posterior()) < 0.6


@pytest.mark.parametrize(("other", "role"), [(1.0, RIGHT), (-1.0, LEFT)])
def test_a_second_line_later_on_decides_what_the_first_was(other: float, role: float) -> None:
    first, second = line_of(STRAIGHT, 0.0), line_of(STRAIGHT, other)
    hypotheses = started(first)
    for _ in range(3):
        hypotheses.move(ROAD_MODEL, 0.25 * LANE_M, 0.0, 0.05, True)
        hypotheses.update((first, second), LineKinds())
    best = hypotheses.all[0]
    assert best.line(role) == (first,)
    assert best.line(-role) == (second,)
    assert best.belief.offset_m == pytest.approx(role * LANE_M, abs=0.03)


@pytest.mark.parametrize(("painted", "role"), [(1.0, RIGHT), (DASHED, LEFT)])
def test_one_line_is_the_one_of_its_kind(painted: float, role: float) -> None:
    assert roles(started(line_of(STRAIGHT, 0.0, painted=painted), kinds=COUNTRY).all[0]) == {role}


def test_the_same_frame_again_is_no_news() -> None:
    lines = country_road(0.1)
    hypotheses = started(*lines)
    odds = hypotheses.all[0].log_odds
    assert hypotheses.update(lines, LineKinds()) == 0.0
    assert hypotheses.all[0].log_odds == pytest.approx(odds)
    hypotheses.move(ROAD_MODEL, 0.0, 0.0, 0.5 * ROAD_MODEL.news / STILL_LANES, True)
    assert hypotheses.update(lines, LineKinds()) == pytest.approx(0.5)
    assert hypotheses.all[0].log_odds > odds


def test_a_frame_without_lines_changes_no_odds() -> None:
    hypotheses = started(*country_road(0.5))
    before = hypotheses.posterior()
    hypotheses.move(ROAD_MODEL, LANE_M, 0.0, 0.05, True)
    hypotheses.update((), LineKinds())
    assert hypotheses.posterior() == pytest.approx(before)


def test_lines_that_are_no_lanes_are_clutter() -> None:
    across = line_of(Road(heading_rad=1.2, aside_m=0.6), 0.0, 0.0, 0.6)
    assert started(across).all[0].assigned == ()


def test_the_road_ahead_takes_part_of_one_line_twice_where_it_is_broken() -> None:
    near, far = line_of(STRAIGHT, LEFT, 0.2, 0.6), line_of(STRAIGHT, LEFT, 0.8, 1.4)
    best = started(near, far, line_of(STRAIGHT, RIGHT)).all[0]
    assert set(best.line(LEFT)) == {near, far}


def test_a_mirrored_road_has_the_mirrored_hypotheses() -> None:
    road, mirrored = Road(aside_m=0.06, heading_rad=0.1), Road(aside_m=-0.06, heading_rad=-0.1)
    one = started(line_of(road, RIGHT), line_of(road, LEFT_FAR))
    other = started(line_of(mirrored, LEFT), line_of(mirrored, RIGHT_FAR))
    assert [each.log_odds for each in other.all] == pytest.approx([each.log_odds for each in one.all], abs=1e-6)
    offsets = [[each.belief.offset_m for each in side.all] for side in (one, other)]
    assert offsets[1] == pytest.approx([-offset for offset in offsets[0]], abs=1e-9)


def followed(lines: Sequence[SightedLine]) -> Hypotheses:
    """The hypotheses of a car that knows its place on a road that was straight so far, after one frame's lines."""
    hypotheses, straight = Hypotheses(), replace(ROAD_MODEL, bend_walk=1e-4)
    hypotheses.start(((belief(STRAIGHT, (0.01, 0.02, 0.01, 0.01), model=straight), 0.0),))
    hypotheses.update(lines, LineKinds())
    return hypotheses


def a_metre_on(one: Hypothesis) -> float:
    """Where the lane lies so far ahead, to the left [m]."""
    return float(one.belief.beside(np.array((1.0,)), 0.0)[0][0, 1])


@pytest.mark.parametrize("seen", [(LEFT, RIGHT), (LEFT,), (RIGHT,)])
def test_where_lines_leave_the_road_smoothly_a_bend_begins_however_straight_it_was(seen: Sequence[float]) -> None:
    begins_m, radius_m = 1.2 * LANE_M, 1.5 * LANE_M
    best = followed([bending(role, begins_m, radius_m) for role in seen]).best
    assert a_metre_on(best) == pytest.approx(radius_m * (1.0 - math.cos((1.0 - begins_m) / radius_m)), abs=0.05)


def test_a_line_that_goes_on_as_another_thing_bends_no_road_in_one_frame() -> None:
    """The line's end and a zebra's bar, joined by the scan, beside a line that goes straight on."""
    points = line_of(STRAIGHT, LEFT).points_m.copy()
    points[5:, 1] += 0.2 * LANE_M + 0.3 * (points[5:, 0] - points[5, 0])
    hypotheses = followed([sighted(points), line_of(STRAIGHT, RIGHT)])
    assert hypotheses.certainty > 0.99
    assert a_metre_on(hypotheses.best) == pytest.approx(0.0, abs=0.02)
    assert [len(part.points_m) for part in hypotheses.best.line(LEFT)] == [5]


@pytest.mark.parametrize(("learnt", "least", "most"), [(True, 0.99, 1.01), (False, 0.3, 0.9)])
def test_what_has_taught_a_belief_is_no_news_to_it_when_it_is_doubted(learnt: bool, least: float, most: float) -> None:
    """However much it speaks for it."""
    lines = [line_of(STRAIGHT, role) for role in (LEFT, RIGHT)]
    known, _ = belief(STRAIGHT).update([Assigned(line, role) for line, role in zip(lines, (LEFT, RIGHT), strict=True)])
    hypotheses = Hypotheses()
    hypotheses.note(lines, ROAD_MODEL)
    hypotheses.start(((known, 0.0),), learnt=learnt)
    hypotheses.update(lines, LineKinds())
    assert least < hypotheses.best.belief.sigma(Part.OFFSET) / known.sigma(Part.OFFSET) < most
    assert hypotheses.best.log_odds > 10.0


def as_likely(count: int, config: HypothesesConfig | None = None) -> Hypotheses:
    """So many hypotheses that are as likely, half a lane width apart, after a frame without lines."""
    hypotheses, first = Hypotheses(config), belief(STRAIGHT)
    places = [first.state.copy() for _ in range(count)]
    for k, state in enumerate(places):
        state[OFFSET] += 0.5 * k * LANE_M
    hypotheses.start([(replace(first, state=state), 0.0) for state in places])
    hypotheses.update((), LineKinds())
    return hypotheses


def test_what_a_bound_may_not_leave_out_lives_on() -> None:
    assert len(as_likely(10).all) == 10


def test_hypotheses_for_which_there_is_no_room_are_no_certainty_of_the_others() -> None:
    hypotheses = as_likely(4, HypothesesConfig(most=2))
    assert hypotheses.posterior() == pytest.approx([0.25, 0.25])
    assert hypotheses.certainty == pytest.approx(0.25)
    hypotheses.update([line_of(STRAIGHT, role) for role in (LEFT, RIGHT)], LineKinds())
    assert hypotheses.certainty > 0.9  # what was dropped explained nothing
    hypotheses.start([(belief(STRAIGHT), 0.0)])
    assert hypotheses.certainty == 1.0


def test_no_more_hypotheses_live_than_the_limit_and_their_probabilities_sum_to_one() -> None:
    lines = [line_of(STRAIGHT, lanes) for lanes in np.linspace(-1.5, 1.5, 9)]
    hypotheses = started(*lines)
    for _ in range(3):
        hypotheses.move(ROAD_MODEL, 0.3 * LANE_M, 0.0, 0.05, True)
        hypotheses.update(lines, LineKinds())
        assert 1 <= len(hypotheses.all) <= hypotheses.config.most
        assert math.fsum(hypotheses.posterior()) == pytest.approx(1.0)
        odds = [one.log_odds for one in hypotheses.all]
        assert odds == sorted(odds, reverse=True)


@pytest.mark.parametrize(("odds", "other", "agree"), [(-2.0, LEFT, True), (-2.0, RIGHT, False), (-8.0, RIGHT, True)])
def test_hypotheses_agree_that_take_the_same_lines_for_the_lanes_own(odds: float, other: float, agree: bool) -> None:
    """Those that a bound may leave out do not matter, nor do the lines of other lanes."""
    line, far = line_of(STRAIGHT, LEFT), line_of(STRAIGHT, LEFT_FAR)
    hypotheses = Hypotheses()
    hypotheses.all = (
        Hypothesis(START, 0.0, (Assigned(line, LEFT), Assigned(far, LEFT_FAR))),
        Hypothesis(START, odds, (Assigned(line, other),)),
    )
    assert hypotheses.agree is agree


def test_hypotheses_for_which_there_was_no_room_may_say_otherwise() -> None:
    hypotheses = as_likely(3, HypothesesConfig(most=2))
    assert not hypotheses.agree


def test_without_a_start_there_are_no_hypotheses() -> None:
    hypotheses = Hypotheses()
    hypotheses.move(ROAD_MODEL, 0.1, 0.0, 0.05, True)
    assert hypotheses.update(country_road(0.0), LineKinds()) == 0.0
    assert hypotheses.all == ()
    assert hypotheses.posterior() == []


@pytest.mark.parametrize(("ahead", "others"), [(0.0, 0.5), (2.0, 1.0 / (1.0 + math.exp(2.0))), (40.0, 0.0)])
def test_of_two_that_say_about_the_same_the_moments_remain(ahead: float, others: float) -> None:
    first = Hypothesis(belief(STRAIGHT, (0.01, 0.02, 0.1, 0.01)), ahead)
    state = first.belief.state.copy()
    state[OFFSET] += 0.02
    second = Hypothesis(replace(first.belief, state=state, covariance=4.0 * first.belief.covariance), 0.0)
    merged = first.merged(second)
    assert merged.log_odds == ahead
    assert merged.belief.offset_m - first.belief.offset_m == pytest.approx(0.02 * others)
    variance = 0.01**2 * (1.0 + 3.0 * others) + others * (1.0 - others) * 0.02**2
    assert merged.belief.sigma(Part.OFFSET) == pytest.approx(math.sqrt(variance))


def test_an_assignment_that_is_hardly_likelier_than_none_leaves_the_doubt() -> None:
    line = line_of(road_at(-0.18), LEFT, 0.6, 0.8)
    sure = belief(STRAIGHT, (0.02, 0.05, 0.1, 0.02))
    hypotheses = Hypotheses()
    hypotheses.start(((sure, 0.0),))
    hypotheses.update((line,), LineKinds())
    best = hypotheses.best
    assert abs(best.news) < 4.0
    alone, _ = sure.update(best.assigned)
    assert best.belief.sigma(Part.OFFSET) > 1.02 * min(alone.sigma(Part.OFFSET), sure.sigma(Part.OFFSET))


def speck(random: np.random.Generator) -> SightedLine:
    """A short piece of anything, anywhere in view, with the errors of its points."""
    road = Road(aside_m=random.normal(0.0, ROAD_MODEL.anywhere) * LANE_M, heading_rad=random.normal(0.0, 0.4))
    start_m = random.uniform(0.2, 1.0)
    points = line_of(road, 0.0, start_m, start_m + random.uniform(0.08, 0.3), count=3).points_m.copy()
    points[:, 1] += random.normal(0.0, ROAD_MODEL.point_markings * MARKING_M, len(points))
    return sighted(points)


def test_of_many_specks_two_lie_where_lines_would_and_are_no_lane() -> None:
    """Odds of five nats may come by chance once in 148 frames; without a price of the picking they do in one of 20."""
    random = np.random.default_rng(8)
    claimed = {True: 0, False: 0}
    for _ in range(300):
        seen = [speck(random) for _ in range(8)]
        for picked in claimed:
            hypotheses = Hypotheses()
            hypotheses.start(((START, 0.0),))
            hypotheses.update(seen, LineKinds(), picked=picked)
            claimed[picked] += hypotheses.all[0].log_odds > 5.0
    assert claimed[True] <= 2
    assert claimed[False] >= 8


def test_a_short_piece_is_less_of_a_line_than_a_long_one() -> None:
    """By the lengths of lines and of other things, and nothing else."""
    road, things = road_at(0.0), HypothesesConfig().things(START.anything(), LANE_M)
    pair = [line_of(road, RIGHT), line_of(road, LEFT)]
    worn = replace(pair[1], painted_m=0.1 * LANE_M)
    lost = things.length_per_lane * (pair[1].painted_m / LANE_M - 0.1)
    assert lost > 3.0
    assert started(*pair).all[0].log_odds - started(pair[0], worn).all[0].log_odds == pytest.approx(lost)


def test_what_is_picked_out_of_more_things_counts_for_less() -> None:
    """The ratio of Gamma(m + 1/2) for the things that are clutter."""
    road, across = road_at(0.0), line_of(Road(heading_rad=1.2, aside_m=0.6), 0.0, 0.0, 0.6)
    pair = [line_of(road, RIGHT), line_of(road, LEFT)]
    plain, cluttered = started(*pair).all[0], started(*pair, across, across).all[0]
    assert roles(plain) == roles(cluttered) == {LEFT, RIGHT}
    assert plain.log_odds - cluttered.log_odds == pytest.approx(math.log(3.5 * 2.5 / (1.5 * 0.5)))
