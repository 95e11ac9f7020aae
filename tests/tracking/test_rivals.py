"""Lines beside a lane's own ones: which of them may be one of its own, and for how long."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from automodel.perception.line_scan import SightedLine
from automodel.tracking.hypotheses import HypothesesConfig
from automodel.tracking.rivals import Rivals
from automodel.tracking.stories import LEFT, LEFT_FAR, RIGHT, RIGHT_FAR
from automodel.types import FloatArray
from tests.support.drawn_roads import LANE_M, Road
from tests.support.sighted_lines import belief, line_of

ROAD = Road(aside_m=0.01, heading_rad=0.05, curvature_per_m=0.3)
LANE = belief(ROAD)
INSIDE, OUTSIDE = -0.3, -0.75  # of lanes that are a fifth narrower, and a quarter wider


def line(role: float, to_m: float = 1.2, painted: float = 1.0) -> SightedLine:
    return line_of(ROAD, role, to_m=to_m, painted=painted)


def wide(roles: Sequence[float]) -> FloatArray:
    """All lines would be in view over a meter."""
    return np.ones(len(roles))


def looked(*views: tuple[float, ...]) -> Rivals:
    """After looks at views of lines that lie so many lane widths to the left."""
    rivals = Rivals(HypothesesConfig(), LANE.road.width_sigma)
    for roles in views:
        rivals.look(LANE, [line(role) for role in roles], 1.0, wide)
    return rivals


@pytest.mark.parametrize("role", [INSIDE, OUTSIDE, -INSIDE, -OUTSIDE])
def test_a_line_that_runs_along_from_the_start_may_be_the_lanes_own(role: float) -> None:
    """The lane is then the one between it and the line on the other side."""
    (lane,) = looked(*10 * [(LEFT, RIGHT, role)]).lanes(LANE)
    other = math.copysign(0.5, -role)
    assert lane.width_m == pytest.approx(abs(role - other) * LANE_M, rel=0.05)
    assert lane.offset_m == pytest.approx(LANE.offset_m - 0.5 * (role + other) * LANE_M, abs=0.05 * LANE_M)


@pytest.mark.parametrize("role", [LEFT_FAR, RIGHT_FAR, -1.2, 0.0])
def test_a_line_at_no_lanes_distance_is_none_of_its_own(role: float) -> None:
    rivals = looked(*4 * [(LEFT, RIGHT, role)])
    assert not rivals.lanes(LANE)
    assert rivals.settled


def test_one_that_comes_into_view_later_is_none() -> None:
    """The lane was there without it."""
    rivals = looked(*4 * [(LEFT, RIGHT)], *10 * [(LEFT, RIGHT, INSIDE)])
    assert not rivals.lanes(LANE)
    assert looked((LEFT, RIGHT), *4 * [(LEFT, RIGHT, INSIDE)]).lanes(LANE)  # after a single look it may be


def test_one_that_ends_is_none_and_one_that_is_hidden_for_a_while_is_one_again() -> None:
    gone = (*2 * [(LEFT, RIGHT, INSIDE)], *3 * [(LEFT, RIGHT)])
    assert looked(*gone[:-1]).lanes(LANE)
    assert not looked(*gone).lanes(LANE)
    assert not looked(*gone).settled
    assert looked(*gone, (LEFT, RIGHT, INSIDE)).lanes(LANE)
    ended = looked(*gone, *3 * [(LEFT, RIGHT)])
    assert ended.settled
    ended.look(LANE, [line(LEFT), line(RIGHT), line(INSIDE)], 1.0, wide)
    assert not ended.lanes(LANE)


def test_one_that_is_out_of_view_may_still_be_there() -> None:
    rivals = looked((LEFT, RIGHT, INSIDE))
    for _ in range(10):
        rivals.look(LANE, [line(LEFT), line(RIGHT)], 1.0, lambda roles: 0.5 * LANE_M * np.ones(len(roles)))
    assert rivals.lanes(LANE)


def test_one_may_come_into_view_whose_place_was_not_in_view() -> None:
    rivals = Rivals(HypothesesConfig(), LANE.road.width_sigma)
    for _ in range(10):
        rivals.look(
            LANE, [line(LEFT), line(RIGHT)], 1.0, lambda roles: np.where(np.asarray(roles) > RIGHT - 0.1, LANE_M, 0.0)
        )
    assert not rivals.settled
    rivals.look(LANE, [line(LEFT), line(RIGHT), line(INSIDE)], 1.0, wide)
    assert not rivals.lanes(LANE)
    rivals.look(LANE, [line(LEFT), line(RIGHT), line(OUTSIDE)], 1.0, wide)
    assert rivals.lanes(LANE)


def test_looks_at_what_was_in_view_before_count_as_little_as_they_tell() -> None:
    rivals = Rivals(HypothesesConfig(), LANE.road.width_sigma)
    for _ in range(29):
        rivals.look(LANE, [line(LEFT), line(RIGHT)], 0.1, wide)
    assert not rivals.settled
    rivals.look(LANE, [line(LEFT), line(RIGHT)], 1.0, wide)
    assert rivals.settled


def test_a_view_without_the_lanes_own_lines_tells_of_no_others() -> None:
    rivals = looked(*10 * [()], *10 * [(INSIDE,)])
    assert not rivals.settled
    assert not rivals.lanes(LANE)
    rivals.look(LANE, [line(LEFT), line(INSIDE)], 1.0, wide)
    assert rivals.lanes(LANE)


def test_what_is_short_or_runs_aslant_is_no_line() -> None:
    aslant = line_of(Road(aside_m=0.1, heading_rad=0.4), INSIDE)
    for other in (line(INSIDE, to_m=0.4), line(INSIDE, painted=0.2), aslant):
        rivals = Rivals(HypothesesConfig(), LANE.road.width_sigma)
        rivals.look(LANE, [line(LEFT), line(RIGHT), other], 1.0, wide)
        assert not rivals.lanes(LANE)


def test_what_was_in_view_with_both_of_the_lanes_own_lines_is_another_one() -> None:
    """What was in view with one of them may be the other: the lane may be taken for a wider one."""
    lines = [line(LEFT), line(INSIDE)]
    alone, beside = looked(*2 * [(LEFT, INSIDE)]), looked((LEFT, INSIDE), (LEFT, RIGHT, INSIDE))
    assert alone.others(LANE, lines) == tuple(lines)
    assert beside.others(LANE, lines) == (lines[0],)


def test_a_line_is_another_thing_where_that_ran_not_where_the_lanes_own_runs() -> None:
    near = RIGHT + 0.14
    rivals = looked(*2 * [(LEFT, RIGHT, near)])
    kept = [line(RIGHT), line(RIGHT + 0.05), line(near + 0.15)]
    assert rivals.others(LANE, [*kept, line(near), line(near - 0.05)]) == tuple(kept)


def test_a_short_piece_of_the_lanes_own_line_is_one() -> None:
    rivals = Rivals(HypothesesConfig(), LANE.road.width_sigma)
    rivals.look(LANE, [line(LEFT), line(RIGHT, to_m=0.4), line(INSIDE)], 1.0, wide)
    assert rivals.others(LANE, [line(INSIDE)]) == ()


def test_another_thing_is_one_though_it_came_late_and_the_lane_begins_anew() -> None:
    rivals = looked(*4 * [(LEFT, RIGHT)], (LEFT, RIGHT, INSIDE))
    rivals.begin_anew()
    assert rivals.others(LANE, [line(INSIDE)]) == ()
    assert not rivals.lanes(LANE)
    for _ in range(7):
        rivals.look(LANE, [line(LEFT), line(RIGHT)], 1.0, wide)
    assert len(rivals.others(LANE, [line(INSIDE)])) == 1  # it has ended
    assert rivals.settled


def test_what_may_be_the_lanes_own_is_any_when_the_lane_begins_anew() -> None:
    rivals = looked((LEFT, INSIDE))
    rivals.begin_anew()
    assert not rivals.lanes(LANE)
    assert not rivals.settled


def test_a_double_line_is_one() -> None:
    rivals = Rivals(HypothesesConfig(), LANE.road.width_sigma)
    rivals.look(LANE, [line(LEFT), line(RIGHT), line(RIGHT + 0.05)], 1.0, wide)
    assert not rivals.lanes(LANE)


def test_a_new_lane_begins_without_any() -> None:
    rivals = looked((LEFT, RIGHT, INSIDE))
    rivals.reset()
    assert not rivals.lanes(LANE)
    assert not rivals.settled
