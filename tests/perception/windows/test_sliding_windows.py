"""Histogram start and sliding windows on drawn binary views."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.geometry import View
from automodel.perception.windows.sliding_windows import HistogramStart, SlidingWindows, StartCandidate
from tests.support.drawn_views import Shape, bar, binary, dashed, line_at

LANE_M, MARKING_M, REFERENCE_M = 0.4, 0.03, 0.13
VIEW = View(x_near_m=0.36, x_far_m=1.56, half_width_m=0.64, m_per_px=0.006)
FINE = View(x_near_m=0.36, x_far_m=1.56, half_width_m=0.64, m_per_px=0.004, m_per_row=0.006)


def true_y(x: np.ndarray, y_m: float, slope: float, bend_per_m: float) -> np.ndarray:
    return y_m + slope * x + 0.5 * bend_per_m * x * x


class TestSlidingWindows:
    @pytest.mark.parametrize("view", [VIEW, FINE], ids=["5 px", "7.5 px"])
    @pytest.mark.parametrize(
        ("y_m", "slope", "bend_per_m"),
        [
            (0.2, 0.0, 0.0),
            (-0.2033, 0.0, 0.0),
            (0.1, 0.25, 0.0),
            (0.15, -0.05, -0.5),
            (-0.2, 0.0, 0.6),
            (0.0, 0.1, -0.7),
        ],
    )
    def test_points_lie_on_the_line(self, view: View, y_m: float, slope: float, bend_per_m: float) -> None:
        windows = SlidingWindows(view, MARKING_M)
        lines = binary(view, line_at(y_m, MARKING_M, slope, bend_per_m))
        expected = true_y(windows.centre_x_m, y_m, slope, bend_per_m)
        inside = np.abs(expected) < view.half_width_m - 0.05
        points = windows.follow(lines, expected)
        assert len(points) >= inside.sum()
        assert (np.diff(points[:, 0]) > 0).all()
        away = points[:, 1] - true_y(points[:, 0], y_m, slope, bend_per_m)
        assert np.abs(away).max() < 0.0015
        assert abs(away.mean()) < 0.0012

    @pytest.mark.parametrize("aside_m", [-0.03, 0.03])
    def test_an_expectation_that_is_off_is_made_good(self, aside_m: float) -> None:
        windows = SlidingWindows(VIEW, MARKING_M)
        lines = binary(VIEW, line_at(0.1, MARKING_M, 0.1, 0.0))
        for drift in (0.0, 0.5 * aside_m):
            expected = true_y(windows.centre_x_m, 0.1, 0.1, 0.0) + aside_m + drift * (windows.centre_x_m - 0.36)
            points = windows.follow(lines, expected)
            assert len(points) >= 11
            assert np.abs(points[2:, 1] - true_y(points[2:, 0], 0.1, 0.1, 0.0)).max() < 0.0015

    def test_bends_beyond_the_expectation_are_followed(self) -> None:
        windows = SlidingWindows(VIEW, MARKING_M)
        for bend in (-0.3, 0.3):
            lines = binary(VIEW, line_at(0.0, MARKING_M, 0.0, bend))
            points = windows.follow(lines, np.zeros(windows.COUNT))
            assert len(points) >= 10
            assert np.abs(points[:, 1] - 0.5 * bend * points[:, 0] ** 2).max() < 0.004

    @pytest.mark.parametrize("from_m", [0.0, 0.1, 0.27])
    def test_dashes_give_points_where_there_is_paint(self, from_m: float) -> None:
        windows = SlidingWindows(VIEW, MARKING_M)
        lines = binary(VIEW, dashed(line_at(0.2, MARKING_M, 0.05), 0.2, 0.2, from_m))
        points = windows.follow(lines, true_y(windows.centre_x_m, 0.2, 0.05, 0.0))
        assert 4 <= len(points) < windows.COUNT
        assert np.abs(points[:, 1] - true_y(points[:, 0], 0.2, 0.05, 0.0)).max() < 0.0015
        assert ((points[:, 0] - from_m) % 0.4 < 0.201).all()

    def test_nothing_is_found_where_nothing_is(self) -> None:
        windows = SlidingWindows(VIEW, MARKING_M)
        lines = binary(VIEW, line_at(0.2))
        empty = np.zeros_like(lines)
        assert windows.follow(empty, np.full(windows.COUNT, 0.2)).shape == (0, 2)
        assert windows.follow(lines, np.full(windows.COUNT, -0.2)).shape == (0, 2)
        assert windows.follow(lines, np.full(windows.COUNT, np.nan)).shape == (0, 2)
        assert windows.follow(lines, np.full(windows.COUNT, 5.0)).shape == (0, 2)

    def test_no_window_looks_before_the_line_is_expected(self) -> None:
        windows = SlidingWindows(VIEW, MARKING_M)
        expected = np.full(windows.COUNT, 0.2)
        expected[:4] = np.nan
        points = windows.follow(binary(VIEW, line_at(0.2)), expected)
        assert len(points) == windows.COUNT - 4
        assert points[:, 0] == pytest.approx(windows.centre_x_m[4:], abs=0.002)

    def test_a_line_is_followed_on_where_the_expectation_ends(self) -> None:
        windows = SlidingWindows(VIEW, MARKING_M)
        expected = np.full(windows.COUNT, np.nan)
        expected[:3] = 0.2
        assert len(windows.follow(binary(VIEW, line_at(0.2)), expected)) == windows.COUNT

    def test_a_bar_across_is_no_point(self) -> None:
        windows = SlidingWindows(VIEW, MARKING_M)
        lines = binary(VIEW, line_at(0.2), bar(0.8, 0.12))
        points = windows.follow(lines, np.full(windows.COUNT, 0.2))
        assert len(points) >= 8
        assert np.abs(points[:, 1] - 0.2).max() < 0.003


def starts_of(*shapes: Shape, view: View = VIEW) -> list[StartCandidate]:
    return HistogramStart(view, LANE_M, MARKING_M, REFERENCE_M).step(binary(view, *shapes))


def pair(offset_m: float, heading_rad: float, width_m: float = LANE_M) -> tuple[Shape, Shape]:
    """The lines of a straight lane in which the reference point has this pose."""
    slope = math.tan(-heading_rad)
    places = [(side * 0.5 * width_m - offset_m) / math.cos(heading_rad) for side in (1, -1)]
    left, right = (line_at(place - slope * REFERENCE_M, MARKING_M, slope) for place in places)
    return left, right


class TestHistogramStart:
    @pytest.mark.parametrize("heading_deg", [-40.0, -33.0, -20.0, -6.0, 0.0, 10.0, 26.0, 40.0])
    @pytest.mark.parametrize("offset_m", [-0.06, 0.0, 0.08])
    def test_pairs_at_any_heading(self, heading_deg: float, offset_m: float) -> None:
        heading = math.radians(heading_deg)
        starts = starts_of(*pair(offset_m, heading))
        assert starts
        best = starts[0]
        assert math.atan(best.slope) == pytest.approx(-heading, abs=math.radians(12.0))
        # where a line lies in the middle of the near part, which the start is made from
        middle = VIEW.x_near_m + 0.75 * LANE_M - REFERENCE_M
        for side, place in ((1, best.left_m), (-1, best.right_m)):
            if place is None:  # at these headings one of them is out of sight
                assert abs(heading_deg) > 25.0
                continue
            there = (side * 0.5 * LANE_M - offset_m) / math.cos(heading) - math.tan(heading) * middle
            assert place + best.slope * middle == pytest.approx(there, abs=0.06)

    @pytest.mark.parametrize("place_m", [0.2, 0.15, -0.2, -0.3])
    def test_a_line_is_found_left_or_right(self, place_m: float) -> None:
        best = starts_of(line_at(place_m))[0]
        seen, missing = (best.left_m, best.right_m) if place_m > 0 else (best.right_m, best.left_m)
        assert seen == pytest.approx(place_m, abs=0.02)
        assert missing is None
        assert best.slope == pytest.approx(0.0, abs=0.01)

    def test_dashes_make_a_pair_with_a_solid_line(self) -> None:
        for left, right in ((0.2, -0.2), (0.24, -0.16)):
            best = starts_of(dashed(line_at(left), 0.2, 0.2), line_at(right))[0]
            assert best.left_m == pytest.approx(left, abs=0.02)
            assert best.right_m == pytest.approx(right, abs=0.02)
            assert best.slope == pytest.approx(0.0, abs=0.01)

    @pytest.mark.parametrize(("left_m", "right_m"), [(0.32, 0.12), (-0.1, -0.5), (0.35, -0.35), (0.1, -0.1)])
    def test_lines_that_are_no_lane_make_no_pair(self, left_m: float, right_m: float) -> None:
        starts = starts_of(line_at(left_m), line_at(right_m))
        assert starts
        for start in starts:
            assert start.left_m is None or start.right_m is None

    def test_nothing_makes_no_start(self) -> None:
        start = HistogramStart(VIEW, LANE_M, MARKING_M, REFERENCE_M)
        lines = np.zeros((VIEW.height_px, VIEW.width_px), np.uint8)
        assert not start.step(lines)
        lines[np.random.default_rng(0).random(lines.shape) < 0.002] = 255
        assert not start.step(lines)

    def test_the_own_lane_is_preferred_to_its_neighbour(self) -> None:
        best = starts_of(line_at(0.2), line_at(-0.2), line_at(0.6))[0]
        assert best.left_m == pytest.approx(0.2, abs=0.02)
        assert best.right_m == pytest.approx(-0.2, abs=0.02)
