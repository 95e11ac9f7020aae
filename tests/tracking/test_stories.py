"""The likeliest assignments of lines to roles, against what the belief says of each."""

from __future__ import annotations

import numpy as np
import pytest

from automodel.perception.line_scan import SightedLine
from automodel.tracking.belief import Evidence, LaneBelief, Played
from automodel.tracking.hypotheses import HypothesesConfig
from automodel.tracking.stories import LEFT, LEFT_FAR, RIGHT, ROLES
from tests.support.drawn_roads import LANE_M, STRAIGHT, Road
from tests.support.sighted_lines import belief, line_of, sighted

SURE = belief(STRAIGHT, (0.01, 0.02, 0.05, 0.01))
CONFIG = HypothesesConfig()
THINGS = CONFIG.things(SURE.anything(), LANE_M)


def told(
    believed: LaneBelief, *lines: SightedLine, kinds: np.ndarray | None = None, news: float = 1.0
) -> list[tuple[list[Played], float, float]]:
    """The stories of lines, of which a share is news."""
    clutter = np.array([believed.anything().of_line(line) for line in lines])
    none = np.zeros((len(lines), len(ROLES)))
    shares = np.full(len(lines), news)
    return Evidence(believed).stories(lines, THINGS, clutter, none if kinds is None else kinds, shares)


def length_odds(*lines: SightedLine) -> float:
    """By the lengths that are painted."""
    return sum(THINGS.length + THINGS.length_per_lane * line.painted_m / LANE_M for line in lines)


@pytest.mark.parametrize("wide", [False, True])
def test_the_odds_of_a_story_are_those_of_its_lines_against_clutter(wide: bool) -> None:
    believed = belief(STRAIGHT, (0.1, 0.2, 0.5, 0.05)) if wide else SURE
    road = Road(aside_m=0.02, heading_rad=0.03)
    lines = [line_of(road, role) for role in (LEFT, RIGHT, LEFT_FAR)]
    evidence = Evidence(believed)
    looks = [evidence.look(line, role) for line, role in zip(lines, (LEFT, RIGHT, LEFT_FAR), strict=True)]
    best, odds, counted = told(believed, *lines, news=0.25)[0]
    assert [(one.line, one.role, one.of) for one in best] == [
        (line, look.role, k) for k, (line, look) in enumerate(zip(lines, looks, strict=True))
    ]
    clutter = sum(believed.anything().of_line(line) for line in lines)
    against = evidence.log_likelihood(looks) - clutter - CONFIG.neighbour_price + length_odds(*lines)
    assert odds == pytest.approx(against, abs=1e-9)
    assert counted == pytest.approx(0.25 * against, abs=1e-9)


def test_a_kind_speaks_for_its_role() -> None:
    line, kinds = line_of(STRAIGHT, LEFT), np.array(((2.0, 0.0, 0.0, 0.0),))
    assert told(SURE, line, kinds=kinds)[0][1] == pytest.approx(told(SURE, line)[0][1] + 2.0)


def test_one_story_assigns_none_at_even_odds() -> None:
    stories = told(SURE, line_of(STRAIGHT, LEFT), line_of(STRAIGHT, RIGHT))
    assert ([], 0.0, 0.0) in stories
    assert 1 < len(stories) <= CONFIG.most + 1
    assert [odds for _, odds, _ in stories[:-1]] == sorted((odds for _, odds, _ in stories[:-1]), reverse=True)


def test_of_two_lines_beside_each_other_one_plays_a_role() -> None:
    one, other = line_of(STRAIGHT, LEFT), line_of(Road(aside_m=0.01), LEFT)
    assert all(len({played.role for played in story}) == len(story) for story, _, _ in told(SURE, one, other))
    near, far = line_of(STRAIGHT, LEFT, 0.2, 0.6), line_of(STRAIGHT, LEFT, 0.8, 1.2)  # dashes
    assert [played.role for played in told(SURE, near, far)[0][0]] == [LEFT, LEFT]


@pytest.mark.parametrize(("moved", "rest"), [(slice(6, None), slice(6)), (slice(3), slice(3, None))])
def test_the_part_of_a_line_that_plays_the_role_is_told_from_the_rest(moved: slice, rest: slice) -> None:
    points = line_of(STRAIGHT, LEFT, count=10).points_m.copy()
    whole = sighted(points)
    assert [one.line for one in told(SURE, whole)[0][0]] == [whole]
    points = points.copy()
    points[moved, 1] += 0.3 * LANE_M
    mixed = sighted(points)
    ((part, role, _),), odds, _ = told(SURE, mixed)[0]
    assert role == LEFT
    assert len(points[rest]) - 1 <= len(part.points_m) <= len(points[rest])
    assert part.points_m[:, 1] == pytest.approx(0.5 * LANE_M)
    assert part.painted_m == pytest.approx(mixed.painted_m * len(part.points_m) / len(points))
    near_is_other = part.points_m[0, 0] > points[0, 0]
    other = sighted(points[: -len(part.points_m)] if near_is_other else points[len(part.points_m) :])
    anything = SURE.anything()
    against = anything.of_line(other) - anything.CORNERS - anything.of_line(mixed) + length_odds(part)
    assert odds == pytest.approx(Evidence(SURE).look(part, LEFT).log_likelihood + against, abs=1e-9)
