"""What of a line is news: its place, not its frame."""

from __future__ import annotations

import numpy as np
import pytest

from automodel.geometry import SE2
from automodel.perception.line_scan import SightedLine
from automodel.tracking.seen_places import SeenPlaces
from tests.support.drawn_roads import LANE_M
from tests.support.sighted_lines import ROAD_MODEL, sighted

SAME = 0.1  # lane widths
NEWS = ROAD_MODEL.news


def line(from_m: float = 1.0, to_m: float = 2.0, y_m: float = 0.2) -> SightedLine:
    x = np.linspace(from_m, to_m, 11)
    return sighted(np.column_stack((x, np.full(11, y_m))))


def seen(*lines: SightedLine) -> SeenPlaces:
    places = SeenPlaces(SAME)
    assert places.see(lines, ROAD_MODEL) == [1.0] * len(lines)
    return places


def test_a_line_that_is_seen_again_is_news_by_the_way_driven_since() -> None:
    places = seen(line())
    assert places.see([line()], ROAD_MODEL) == [0.0]
    places.move(0.0, 0.0, 0.25 * NEWS, True)
    assert places.see([line()], ROAD_MODEL) == pytest.approx([0.25])
    places.move(0.0, 0.0, 0.5 * NEWS, True)
    assert places.see([line()], ROAD_MODEL) == pytest.approx([0.5])
    places.move(0.0, 0.0, 2.0 * NEWS, True)
    assert places.see([line()], ROAD_MODEL) == [1.0]


@pytest.mark.parametrize(
    ("other", "news"),
    [
        (line(y_m=0.2 + 0.9 * SAME * LANE_M), 0.0),
        (line(y_m=0.2 + 1.1 * SAME * LANE_M), 1.0),
        (line(1.45, 2.45), 5.0 / 11.0),  # of its points beyond the end of what was seen
        (line(3.0, 4.0), 1.0),
    ],
)
def test_a_place_that_comes_into_view_is_news(other: SightedLine, news: float) -> None:
    assert seen(line()).see([other], ROAD_MODEL) == pytest.approx([news])


def test_a_line_moves_with_the_ground() -> None:
    places, there = seen(line()), SE2.arc(0.3, 0.2).inverse()
    places.move(0.3, 0.2, 0.0, True)
    assert places.see([sighted(there.apply(line().points_m)), line()], ROAD_MODEL) == [0.0, pytest.approx(1.0, abs=0.3)]


def test_a_line_that_was_hidden_for_a_frame_is_no_news() -> None:
    places = seen(line())
    for _ in range(3):
        places.move(0.0, 0.0, 0.1 * NEWS, True)
        assert places.see([], ROAD_MODEL) == []
    assert places.see([line()], ROAD_MODEL) == pytest.approx([0.3])


def test_after_an_unknown_motion_all_may_have_been_seen_before() -> None:
    places = seen(line())
    places.move(0.0, 0.0, 0.25 * NEWS, False)
    places.move(0.1, 0.0, 0.25 * NEWS, True)
    assert places.see([line(3.0, 4.0)], ROAD_MODEL) == pytest.approx([0.5])
    assert places.see([line(5.0, 6.0)], ROAD_MODEL) == [0.0]


def test_what_is_kept_stays_little() -> None:
    """A car at rest, whose lines flicker, and one that drives along a line."""
    random, places = np.random.default_rng(1), seen(line())
    for _ in range(500):
        places.move(0.0, 0.0, 0.001 * NEWS, True)
        places.see([line(random.uniform(1.0, 1.5), random.uniform(1.5, 2.0))], ROAD_MODEL)
    assert len(places._points) < 30
    for _ in range(500):
        places.move(0.01, 0.0, 0.01 / LANE_M, True)
        places.see([line()], ROAD_MODEL)
    assert len(places._points) < 300
