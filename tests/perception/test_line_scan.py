"""The lines of drawn views: where they are found, what is joined to one, and what is none."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from automodel.geometry import View
from automodel.perception.line_scan import LineScan, SightedLine, _areas
from tests.support.drawn_roads import LANE_M, MARKING_M, STRAIGHT, Road, within, zebra
from tests.support.drawn_views import Shape, bar, binary, disc, line_at

VIEW = View(x_near_m=0.3, x_far_m=2.3, half_width_m=0.8, m_per_px=0.0075)
DASH_M, GAP_M = 0.2, 0.2
BENDS = [
    STRAIGHT,
    Road(curvature_per_m=0.35),
    Road(curvature_per_m=-0.35, aside_m=0.05),
    Road(heading_rad=0.25, aside_m=-0.2),
    Road(heading_rad=-0.3, aside_m=0.2),
]


def scanned(*shapes: Shape, view: View = VIEW) -> tuple[SightedLine, ...]:
    return LineScan(view, LANE_M, MARKING_M).step(binary(view, *shapes, samples=4))


def within_lane(shape: Shape) -> Shape:
    """The part of a shape between a straight lane's lines, apart from them."""
    return lambda x, y: shape(x, y) & (np.abs(y) < 0.15)


def lateral(road: Road, line: SightedLine) -> np.ndarray:
    """How far a line's points lie to the left of the road's centre."""
    return road.beside(line.points_m[:, 0], line.points_m[:, 1])


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.5, 0.7, 1.0])
def test_areas_are_the_connected_ones_of_opencv(share: float) -> None:
    rng = np.random.default_rng(5)
    for height, width in ((1, 1), (7, 1), (1, 9), (40, 61)):
        lines = (rng.random((height, width)) < share).astype(np.uint8) * 255
        count, labels = cv2.connectedComponents(lines, connectivity=8)
        known = set()
        for label in range(1, count):
            row, column = np.nonzero(labels == label)
            middle_of = [(r, column[row == r].mean(), (row == r).sum()) for r in np.unique(row)]
            known.add(tuple(tuple(round(float(value), 9) for value in each) for each in middle_of))
        rows, middles, sizes, ends = _areas(lines, lines)
        each_row = list(zip(rows.tolist(), middles.tolist(), sizes.tolist(), strict=True))
        starts = [0, *ends.tolist()][:-1]
        areas = [each_row[start:end] for start, end in zip(starts, ends.tolist(), strict=True)]
        found = {tuple(tuple(round(float(value), 9) for value in each) for each in area) for area in areas}
        assert found == known
        assert len(areas) == len(known)


@pytest.mark.parametrize("road", BENDS)
def test_a_solid_and_a_dashed_line_are_found_as_two(road: Road) -> None:
    lines = scanned(road.line(-0.5 * LANE_M), road.dashed(0.5 * LANE_M, DASH_M, GAP_M))
    assert len(lines) == 2
    solid, dashed = sorted(lines, key=lambda line: float(lateral(road, line).mean()))
    for line, place in ((solid, -0.5), (dashed, 0.5)):
        assert lateral(road, line) == pytest.approx(np.full(len(line.points_m), place * LANE_M), abs=0.01)
        assert (np.diff(line.points_m[:, 0]) > 0.0).all()  # near to far
    assert dashed.span_m > 1.0  # joined over its gaps


@pytest.mark.parametrize("curvature", [1.3, -1.3])
def test_a_line_through_a_tight_bend_is_found_up_to_where_it_lies_across(curvature: float) -> None:
    """It bends by more than a parabola follows, and is one connected area."""
    road = Road(curvature_per_m=curvature)
    for place in (-0.5, 0.5):
        lines = scanned(road.line(place * LANE_M))
        assert lines
        for line in lines:
            assert lateral(road, line) == pytest.approx(np.full(len(line.points_m), place * LANE_M), abs=0.015)
        assert sum(line.painted_m for line in lines) > 0.35


def test_a_solid_line_is_painted_all_along_and_a_dashed_one_by_its_share() -> None:
    solid, dashed = scanned(STRAIGHT.line(-0.2)), scanned(STRAIGHT.dashed(0.2, DASH_M, GAP_M))
    assert solid[0].painted_m == pytest.approx(2.0, abs=0.05)
    assert solid[0].span_m == pytest.approx(2.0, abs=0.05)
    assert dashed[0].painted_m / dashed[0].span_m == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("heading", [0.0, 0.3, -0.3])
def test_lengths_count_along_the_line_and_not_along_the_view(heading: float) -> None:
    road = Road(heading_rad=heading)
    line = scanned(lambda x, y: road.line(0.0)(x, y) & (road.along(x, y) > 0.6) & (road.along(x, y) < 1.4))
    assert len(line) == 1
    assert line[0].painted_m == pytest.approx(0.8, abs=0.04)
    assert line[0].span_m == pytest.approx(0.8, abs=0.04)


@pytest.mark.parametrize("gap_m", [0.1, 0.3, 0.44])
def test_pieces_that_continue_each_other_are_one_line(gap_m: float) -> None:
    line = STRAIGHT.line(0.2)
    assert len(scanned(within(line, 0.3, 0.9), within(line, 0.9 + gap_m, 2.3))) == 1


def test_pieces_that_are_far_apart_or_beside_each_other_are_two_lines() -> None:
    line = STRAIGHT.line(0.2)
    assert len(scanned(within(line, 0.3, 0.9), within(line, 1.5, 2.3))) == 2  # 1.5 lane widths apart
    assert len(scanned(within(line, 0.3, 0.9), within(STRAIGHT.line(0.35), 1.0, 2.3))) == 2
    across = Road(heading_rad=0.6, aside_m=-0.5)
    assert len(scanned(within(line, 0.3, 0.9), within(across.line(0.0), 1.0, 2.0))) == 2


@pytest.mark.parametrize("shift_m", [0.0, 0.03, 0.05])
def test_the_bars_of_a_zebra_are_no_lines(shift_m: float) -> None:
    assert scanned(zebra(1.0, 0.3, shift_m)) == ()


def test_the_lines_of_a_double_one_are_no_bars() -> None:
    assert len(scanned(STRAIGHT.line(0.2), STRAIGHT.line(0.28), STRAIGHT.line(-0.2))) == 3


def test_beside_bars_the_lanes_own_lines_are_found() -> None:
    lines = scanned(within_lane(zebra(1.0, 0.3)), STRAIGHT.line(0.2), STRAIGHT.line(-0.2))
    own = [line for line in lines if line.span_m > 1.0]
    assert [float(line.points_m[:, 1].mean()) for line in own] == pytest.approx([0.2, -0.2], abs=0.006)
    assert len(lines) == len(own)


def test_what_lies_across_is_broad_or_small_is_no_line() -> None:
    assert scanned(bar(1.0, MARKING_M)) == ()  # a stop line
    assert scanned(disc(1.0, 0.2, 0.15)) == ()
    assert scanned(disc(1.0, 0.2, 0.02), disc(1.5, -0.2, 0.02)) == ()
    assert scanned(STRAIGHT.line(0.2, width_m=0.12)) == ()


def test_an_empty_view_and_a_white_one_show_no_line() -> None:
    scan, shape = LineScan(VIEW, LANE_M, MARKING_M), (VIEW.height_px, VIEW.width_px)
    assert scan.step(np.zeros(shape, np.uint8)) == ()
    assert scan.step(np.full(shape, 255, np.uint8)) == ()


def test_noise_does_not_raise_and_gives_finite_lines() -> None:
    scan = LineScan(VIEW, LANE_M, MARKING_M)
    for seed, share in enumerate((0.01, 0.1, 0.3, 0.6)):
        noise = np.random.default_rng(seed).random((VIEW.height_px, VIEW.width_px)) < share
        for line in scan.step(np.where(noise, 255, 0).astype(np.uint8)):
            assert np.isfinite(line.points_m).all()
            assert 0.0 < line.painted_m <= line.span_m + 1e-9


def test_a_road_ten_times_as_large_has_the_same_lines() -> None:
    big_view = View(x_near_m=3.0, x_far_m=23.0, half_width_m=8.0, m_per_px=0.075)
    shapes = [STRAIGHT.line(-0.2), STRAIGHT.dashed(0.2, DASH_M, GAP_M), zebra(1.0, 0.3)]
    image = binary(VIEW, *shapes, samples=4)
    small = LineScan(VIEW, LANE_M, MARKING_M).step(image)
    big = LineScan(big_view, 10.0 * LANE_M, 10.0 * MARKING_M).step(image)
    assert len(big) == len(small)
    for one, other in zip(small, big, strict=True):
        assert other.points_m == pytest.approx(10.0 * one.points_m, rel=1e-3)
        assert other.span_m == pytest.approx(10.0 * one.span_m)
        assert other.painted_m == pytest.approx(10.0 * one.painted_m)


def test_points_are_as_far_apart_as_the_scale_says() -> None:
    line = scanned(STRAIGHT.line(0.0))[0]
    steps = np.hypot(*np.diff(line.points_m, axis=0).T)
    assert float(np.median(steps)) == pytest.approx(0.2 * LANE_M, abs=0.01)


def test_specks_of_worn_paint_are_a_line_where_the_paint_connects_them() -> None:
    """Each is shorter than a piece may be; other paint, which is not connected, joins nothing."""
    dash = STRAIGHT.dashed(0.0, 10.0 * DASH_M, GAP_M)
    worn = within(lambda x, y: dash(x, y) & ((x / MARKING_M) % 2.0 < 1.2), 0.5, 0.5 + DASH_M)
    view, whole = binary(VIEW, worn, samples=4), binary(VIEW, within(dash, 0.5, 0.5 + DASH_M), samples=4)
    scan = LineScan(VIEW, LANE_M, MARKING_M)
    assert scan.step(view) == scan.step(view, np.roll(whole, 20, axis=1)) == ()
    (line,) = scan.step(view, whole)
    assert line.painted_m == pytest.approx(DASH_M, abs=2.0 * MARKING_M)
    assert line.points_m[:, 1] == pytest.approx(np.zeros(len(line.points_m)), abs=0.005)
    everywhere = np.full_like(view, 255)  # paint that is wide is none of the line
    (wide,) = scan.step(view, everywhere)
    assert wide.points_m == pytest.approx(line.points_m)


def test_worn_paint_is_no_gap_and_gaps_between_dashes_are() -> None:
    """The pieces of both are as long; the paint between them tells, down the line itself."""
    road, scan = STRAIGHT, LineScan(VIEW, LANE_M, MARKING_M)
    pieces = binary(VIEW, road.dashed(0.5 * LANE_M, DASH_M, GAP_M), samples=4)
    (dashed,) = scan.step(pieces)
    (worn,) = scan.step(pieces, binary(VIEW, road.line(0.5 * LANE_M), samples=4))
    assert worn.span_m == dashed.span_m
    np.testing.assert_array_equal(worn.points_m, dashed.points_m)
    assert worn.painted_m == pytest.approx(worn.span_m)
    assert dashed.painted_m / dashed.span_m == pytest.approx(DASH_M / (DASH_M + GAP_M), abs=0.1)
    (aside,) = scan.step(pieces, pieces | binary(VIEW, road.line(-0.5 * LANE_M), samples=4))
    assert aside.painted_m == dashed.painted_m  # another line's paint


def test_a_streak_that_crosses_a_line_is_of_no_piece_with_it() -> None:
    scan, line, streak = LineScan(VIEW, LANE_M, MARKING_M), line_at(-0.6, slope=0.6), line_at(0.3, slope=-0.1)
    one, other = binary(VIEW, line), binary(VIEW, streak)
    found = scan.step(one | other, apart=np.where(one > 0, 0, other).astype(np.uint8))
    assert len(found) == 2
    for shape in (line, streak):
        assert any(shape(*each.points_m.T).all() for each in found)
    assert not any(shape(*each.points_m.T).all() for each in scan.step(one | other) for shape in (line, streak))


def test_what_goes_on_with_a_line_is_of_one_piece_with_it() -> None:
    """A part of a bend points to the camera, as a streak does."""
    scan, bend = LineScan(VIEW, LANE_M, MARKING_M), binary(VIEW, line_at(0.4, MARKING_M, -0.8, 0.7))
    part = bend.copy()
    part[:120] = part[132:] = 0
    (whole,), (cut,) = scan.step(bend), scan.step(bend, apart=part)
    np.testing.assert_array_equal(cut.points_m, whole.points_m)


def test_a_line_with_short_gaps_is_worn() -> None:
    short_m = 0.2 * LANE_M
    worn = max(scanned(STRAIGHT.dashed(0.5 * LANE_M, DASH_M, short_m)), key=lambda line: line.span_m)
    assert worn.span_m > 2.0 * LANE_M
    assert worn.painted_m == pytest.approx(worn.span_m)


@pytest.mark.parametrize(
    ("painted", "span_lanes", "least", "most"),
    [
        (0.55, 3.0, 3.0, math.inf),
        (1.0, 3.0, -math.inf, -3.0),
        (0.55, 0.0, 0.0, 0.0),  # of unknown length
        (1.0, 0.3, -0.2, 0.0),  # a dash, or the end of a line
        (0.8, 3.0, -2.0, 2.0),
    ],
)
def test_dashes_are_told_from_a_solid_line_where_enough_is_in_view(
    painted: float, span_lanes: float, least: float, most: float
) -> None:
    span_m = span_lanes * LANE_M
    line = SightedLine(points_m=np.zeros((2, 2)), painted_m=painted * span_m, span_m=span_m)
    assert least <= line.looks_dashed(LANE_M) <= most
