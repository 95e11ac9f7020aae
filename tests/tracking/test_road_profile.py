"""Which lane of its road is followed, by the kinds of the lines beside it."""

from __future__ import annotations

import numpy as np
import pytest

from automodel.perception.line_scan import SightedLine
from automodel.tracking.road_profile import DASHED, LEFT_LANE, NONE, RIGHT_LANE, SAME, SLOTS, SOLID, RoadProfile
from tests.support.sighted_lines import DASHED as DASHED_SHARE

UNIT_M = 0.4
VIEW_LANES = 2.5  # of a line that is in view
Kinds = tuple[int, int, int, int]
COUNTRY: Kinds = (SOLID, DASHED, SOLID, NONE)  # two lanes, the right one; from left to right
ONCOMING: Kinds = (NONE, SOLID, DASHED, SOLID)  # the left one of them
MIRRORED: Kinds = COUNTRY[::-1]
MOTORWAY: Kinds = (DASHED, DASHED, DASHED, DASHED)  # in the middle of many lanes


def line(kind: int) -> SightedLine:
    span_m = VIEW_LANES * UNIT_M
    points = np.column_stack((np.linspace(0.0, span_m, 6), np.zeros(6)))
    return SightedLine(points_m=points, painted_m=span_m * (DASHED_SHARE if kind == DASHED else 1.0), span_m=span_m)


def look(profile: RoadProfile, kinds: Kinds, hidden: tuple[int, ...] = ()) -> None:
    """Look at the lines of these kinds; `hidden` slots have none in view, and are not in view if they are far ones."""
    lines = {
        role: (line(kind),) if kind != NONE and slot not in hidden else ()
        for slot, (role, kind) in enumerate(zip(SLOTS, kinds, strict=True))
    }
    profile.see(lines, {SLOTS[slot]: VIEW_LANES * UNIT_M for slot in (0, 3) if slot not in hidden}, UNIT_M)


def drive(profile: RoadProfile, kinds: Kinds, lanes: int, seen: int = 2, hidden: tuple[int, ...] = ()) -> None:
    """Drive so many lane widths with a look at each."""
    for _ in range(lanes):
        profile.move(1.0, seen)
        look(profile, kinds, hidden)


def known(kinds: Kinds = COUNTRY) -> RoadProfile:
    profile = RoadProfile()
    drive(profile, kinds, 15)
    return profile


@pytest.mark.parametrize("kinds", [COUNTRY, ONCOMING, MIRRORED, MOTORWAY])
def test_the_kinds_of_the_lines_are_learnt_while_the_lane_is_followed(kinds: Kinds) -> None:
    profile = known(kinds)
    assert tuple(profile.known.argmax(axis=1)) == kinds
    assert (profile.known.max(axis=1) > 0.95).all()
    assert profile.lanes[SAME] > 0.98
    np.testing.assert_allclose(profile.known.sum(axis=1), 1.0)


def test_the_log_odds_of_the_own_lines_are_those_of_dashes() -> None:
    left, right = known().dashed
    assert left > 3.0
    assert right < -3.0


def test_nothing_is_known_before_a_line_was_seen_and_after_a_reset() -> None:
    assert RoadProfile().dashed == pytest.approx((0.0, 0.0))
    profile = known()
    profile.reset()
    assert profile.dashed == pytest.approx((0.0, 0.0))
    assert profile.lanes[SAME] == 1.0


@pytest.mark.parametrize(("before", "after", "lane"), [(COUNTRY, ONCOMING, LEFT_LANE), (ONCOMING, COUNTRY, RIGHT_LANE)])
@pytest.mark.parametrize("hidden_lanes", [0, 4])
def test_another_lane_is_told_within_a_few_lane_widths(
    before: Kinds, after: Kinds, lane: int, hidden_lanes: int
) -> None:
    profile = known(before)
    profile.move(float(hidden_lanes), 0)
    drive(profile, after, 6)
    assert profile.lanes[lane] > 0.9
    assert tuple(profile.known.argmax(axis=1)) == before  # the lane to go back to


def test_both_sides_are_treated_alike() -> None:
    one, other = known(COUNTRY), known(MIRRORED)
    drive(one, ONCOMING, 2)
    drive(other, ONCOMING[::-1], 2)
    np.testing.assert_allclose(one.lanes, other.lanes[[SAME, RIGHT_LANE, LEFT_LANE]], rtol=1e-9)
    np.testing.assert_allclose(one.known, other.known[::-1], rtol=1e-9)


@pytest.mark.parametrize("slot", [0, 1, 2, 3])
def test_one_line_that_changes_its_kind_is_no_other_lane(slot: int) -> None:
    profile = known()
    changed = [*COUNTRY]
    changed[slot] = DASHED if COUNTRY[slot] == SOLID else SOLID
    for _ in range(20):
        drive(profile, (changed[0], changed[1], changed[2], changed[3]), 1)
        assert profile.lanes[SAME] > 0.9
    assert tuple(profile.known.argmax(axis=1)) == tuple(changed)


def test_an_intersection_without_a_line_is_no_other_lane() -> None:
    profile = known()
    for _ in range(6):
        profile.move(1.0, 0)
    drive(profile, COUNTRY, 3)
    assert profile.lanes[SAME] > 0.98


def test_lamps_that_hide_lines_are_no_other_lane() -> None:
    profile = known()
    for hidden in ((0,), (1,), (2, 3), (0, 1)):
        drive(profile, COUNTRY, 3, seen=1, hidden=hidden)
        assert profile.lanes[SAME] > 0.9


def test_lanes_that_look_alike_are_not_told_apart() -> None:
    profile = known(MOTORWAY)
    before = profile.lanes[SAME]
    profile.move(4.0, 0)
    drive(profile, MOTORWAY, 6)
    assert 0.9 < profile.lanes[SAME] < before


def test_a_car_that_stands_gathers_no_evidence() -> None:
    profile = known()
    before = profile.lanes.copy(), profile.known.copy()
    for _ in range(100):
        look(profile, ONCOMING)
    np.testing.assert_allclose(profile.lanes, before[0], atol=1e-12)
    np.testing.assert_allclose(profile.known, before[1], atol=1e-12)


def test_who_looks_more_often_learns_no_more() -> None:
    seldom, often = RoadProfile(), RoadProfile()
    drive(seldom, COUNTRY, 3)
    for _ in range(30):
        often.move(0.1, 2)
        look(often, COUNTRY)
    np.testing.assert_allclose(often.known, seldom.known, atol=0.02)


def test_what_was_not_seen_for_long_is_forgotten() -> None:
    profile = known()
    profile.move(500.0, 2)
    look(profile, (NONE,) * 4, hidden=(0, 3))
    assert profile.dashed == pytest.approx((0.0, 0.0), abs=0.1)


def test_after_a_stretch_without_lines_another_lane_is_likelier() -> None:
    blind, plain = known(), known()
    blind.move(4.0, 0)
    plain.move(4.0, 2)
    for profile in (blind, plain):
        look(profile, ONCOMING)
    assert 10.0 * blind.lanes[SAME] < plain.lanes[SAME]


def test_dead_reckoning_that_bears_out_the_lane_leaves_a_worn_line_to_be_one_of_another_kind() -> None:
    """Behind a blind way its solid line looks dashed, as that of the oncoming lane: worn, or hidden by lamps."""
    told, untold = known(), known()
    for profile in (told, untold):
        profile.move(4.0, 0)
    told.land(1e-4, 1e-4)
    for profile in (told, untold):
        look(profile, (NONE, NONE, DASHED, NONE), hidden=(0, 3))
    assert told.lanes[SAME] > 0.99
    assert untold.lanes[SAME] < 0.8


def test_dead_reckoning_that_puts_the_car_on_one_side_speaks_against_the_other_lane_alone() -> None:
    profile = known()
    profile.move(4.0, 0)
    profile.land(1.0, 1e-4)
    look(profile, (NONE, NONE, DASHED, NONE), hidden=(0, 3))
    assert profile.lanes[LEFT_LANE] > 0.2
    assert profile.lanes[RIGHT_LANE] < 1e-3


def test_what_dead_reckoning_said_of_a_blind_way_says_nothing_of_the_next_one() -> None:
    profile = known()
    profile.move(4.0, 0)
    profile.land(0.0, 0.0)
    profile.move(4.0, 0)
    look(profile, ONCOMING)
    assert profile.lanes[LEFT_LANE] > 0.9


def test_the_log_odds_of_dashes_are_those_of_the_lane_that_is_followed_now() -> None:
    profile = known(COUNTRY)
    profile.move(4.0, 0)
    drive(profile, ONCOMING, 3)
    left, right = profile.dashed
    assert left < -1.0
    assert right > 1.0


@pytest.mark.parametrize(("side", "kinds"), [(+1, ONCOMING), (-1, (DASHED, SOLID, NONE, NONE))])
def test_after_a_lane_change_the_lines_are_those_of_the_next_lane(side: int, kinds: Kinds) -> None:
    profile = known()
    profile.change_lane(side)
    expected = {+1: (None, SOLID, DASHED, SOLID), -1: (DASHED, SOLID, NONE, None)}[side]
    for slot, kind in enumerate(expected):
        assert kind is None or profile.known[slot].argmax() == kind
    drive(profile, kinds, 10)
    assert profile.lanes[SAME] > 0.95


def test_what_was_known_of_a_lane_that_was_lost_counts_for_less() -> None:
    profile = known()
    left, right = profile.dashed
    profile.fade(0.3)
    assert 0.5 < profile.dashed[0] < left
    assert right < profile.dashed[1] < -0.5
    assert profile.lanes[SAME] == 1.0
