"""Histogram start and sliding windows on drawn binary views."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from automodel.geometry import View
from automodel.perception.windows.sliding_windows import HistogramStart, SlidingWindows, moments
from tests.support.drawn_views import bar, binary, dashed, line_at

LANE_M, MARKING_M, REFERENCE_M = 0.4, 0.03, 0.13
VIEW = View(x_near_m=0.36, x_far_m=1.56, half_width_m=0.64, m_per_px=0.006)
FINE = View(x_near_m=0.36, x_far_m=1.56, half_width_m=0.64, m_per_px=0.004, m_per_row=0.006)


def true_y(x: np.ndarray, y_m: float, slope: float, bend_per_m: float) -> np.ndarray:
    return y_m + slope * x + 0.5 * bend_per_m * x * x


def testmoments_are_those_of_opencv() -> None:
    lines = (np.random.default_rng(2).random((40, 60)) < 0.3).astype(np.uint8) * 255
    known = cv2.moments(lines[7:29, 11:53], True)
    area, m10, m01, m20, m11, m02 = moments(lines, 7, 29, 11, 53)
    found = (area, m10, m01, m20, m11, m02)
    assert found == pytest.approx([known[name] for name in ("m00", "m10", "m01", "m20", "m11", "m02")], rel=1e-12)


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


class TestHistogramStart:
    """Where a line starts, beside where it is expected."""

    @pytest.mark.parametrize("away_m", [-0.06, -0.03, 0.0, 0.03, 0.06])
    @pytest.mark.parametrize("slope", [0.0, 0.3])
    def test_the_line_nearby_is_found(self, away_m: float, slope: float) -> None:
        windows = SlidingWindows(VIEW, MARKING_M)
        expected = true_y(windows.centre_x_m, 0.1, slope, 0.0)
        lines = binary(VIEW, line_at(0.1 + away_m, MARKING_M, slope), line_at(-0.3, MARKING_M, slope))
        found = HistogramStart(VIEW, MARKING_M).step(lines, windows.centre_x_m, expected, 0.1)
        assert found == pytest.approx(away_m, abs=0.5 * MARKING_M)

    def test_what_is_out_of_reach_and_nothing_are_no_start(self) -> None:
        windows = SlidingWindows(VIEW, MARKING_M)
        start, expected = HistogramStart(VIEW, MARKING_M), np.full(windows.COUNT, 0.2)
        assert start.step(binary(VIEW, line_at(-0.1)), windows.centre_x_m, expected, 0.1) == 0.0
        nothing = np.zeros((VIEW.height_px, VIEW.width_px), np.uint8)
        assert start.step(nothing, windows.centre_x_m, expected, 0.1) == 0.0
        assert start.step(binary(VIEW, line_at(0.2)), windows.centre_x_m, np.full(windows.COUNT, np.nan), 0.1) == 0.0
