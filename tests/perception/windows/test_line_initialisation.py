"""Where the lane's lines begin, on drawn binary views."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from automodel.config import CarConfig
from automodel.geometry import BirdsEye, GroundCamera, View
from automodel.perception.windows.line_initialisation import LineInitialisation, LineStart
from tests.support.drawn_roads import LANE_M, MARKING_M, STRAIGHT, Road, within, zebra
from tests.support.drawn_views import Shape, binary, disc

VIEW = View(x_near_m=0.36, x_far_m=2.28, half_width_m=0.64, m_per_px=0.008)
REFERENCE_M = 0.13
HALF = 0.5 * LANE_M
VISIBLE = BirdsEye(GroundCamera.from_config(CarConfig().camera), VIEW).mask
Found = tuple[LineStart | None, LineStart | None]


def find(*shapes: Shape, view: View = VIEW, visible: np.ndarray | None = None) -> Found:
    features = binary(view, *shapes, samples=2)
    return LineInitialisation(view, LANE_M, MARKING_M, REFERENCE_M).step(
        features if visible is None else features & visible
    )


def check(start: LineStart | None, road: Road, d_m: float) -> None:
    """A start on a line: within a marking's width, 10 deg and a quarter of a lane's inverse."""
    assert start is not None
    x, y = (np.array([value]) for value in start.point_m)
    assert abs(float(road.beside(x, y)[0]) - d_m) < MARKING_M
    direction = road.heading_rad + road.curvature_per_m * float(road.along(x, y)[0])
    assert start.direction_rad == pytest.approx(direction, abs=math.radians(10.0))
    curvature = road.curvature_per_m / (1.0 - road.curvature_per_m * d_m)
    assert start.curvature_per_m == pytest.approx(curvature, abs=0.25 / LANE_M + 0.25 * abs(curvature))


@given(bend=st.integers(-125, 125), heading=st.integers(-40, 40), aside=st.integers(-12, 12))
@settings(max_examples=40, deadline=None, derandomize=True)
def test_the_lines_of_any_lane_are_found_left_and_right(bend: int, heading: int, aside: int) -> None:
    road = Road(curvature_per_m=0.01 * bend, heading_rad=math.radians(heading), aside_m=0.01 * aside)
    found = find(road.line(HALF), road.line(-HALF))
    assert any(found)
    for start, d in zip(found, (HALF, -HALF), strict=True):
        if start is not None:
            check(start, road, d)


@pytest.mark.parametrize("bend", [0.0, 0.8, -0.8])
@pytest.mark.parametrize("from_m", [0.0, 0.1, 0.2, 0.3])
def test_dashes_make_a_pair_with_a_whole_line(bend: float, from_m: float) -> None:
    road = Road(curvature_per_m=bend)
    found = find(road.dashed(HALF, 0.2, 0.2, from_m), road.line(-HALF), visible=VISIBLE)
    if bend >= 0.0:  # in a bend the inner line leaves the image at once
        check(found[1], road, -HALF)
    if bend <= 0.0:
        check(found[0], road, HALF)


@pytest.mark.parametrize("width", [0.7, 1.0, 1.3])
def test_lanes_of_other_widths_are_found(width: float) -> None:
    found = find(STRAIGHT.line(width * HALF), STRAIGHT.line(-width * HALF))
    check(found[0], STRAIGHT, width * HALF)
    check(found[1], STRAIGHT, -width * HALF)


@pytest.mark.parametrize("lane", [-1, 0, 1])
@pytest.mark.parametrize("bend", [0.0, -0.7])
def test_of_several_lanes_the_cars_own_is_found(lane: int, bend: float) -> None:
    road = Road(curvature_per_m=bend)
    lines = [road.line((2 * k + 1) * HALF) for k in range(lane - 2, lane + 2)]
    left, right = find(*lines)
    check(left, road, HALF)
    check(right, road, -HALF)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("road", [STRAIGHT, Road(curvature_per_m=0.6), Road(heading_rad=0.5, aside_m=-0.1)])
def test_one_line_alone_is_found_on_its_side(side: int, road: Road) -> None:
    found = find(road.line(side * HALF))
    check(found[0 if side > 0 else 1], road, side * HALF)
    assert found[1 if side > 0 else 0] is None


def test_the_inner_line_that_a_camera_does_not_see_is_not_taken_from_the_next_lane() -> None:
    """In a bend to the right, of three lines the two left ones are in the image: one of them is the lane's."""
    road = Road(curvature_per_m=-0.8)
    found = find(road.line(3 * HALF), road.dashed(HALF, 0.2, 0.2), road.line(-HALF), visible=VISIBLE)
    check(found[0], road, HALF)


def test_bare_near_rows_are_passed() -> None:
    lines = [within(STRAIGHT.line(d), 0.7, 9.0) for d in (HALF, -HALF)]
    found = find(*lines)
    check(found[0], STRAIGHT, HALF)
    check(found[1], STRAIGHT, -HALF)
    assert found[0] is not None
    assert found[0].point_m[0] > 0.65


def test_areas_specks_and_bars_are_no_lines() -> None:
    rng = np.random.default_rng(0)
    specks = [disc(float(x), float(y), 0.01) for x, y in rng.uniform((0.4, -0.6), (1.2, 0.6), (20, 2))]
    half_floor: Shape = lambda x, y: y > 0.1  # noqa: E731
    for shapes in ([half_floor], specks, [zebra(0.5)]):
        assert find(*shapes) == (None, None)
    full = np.full((VIEW.height_px, VIEW.width_px), 255, np.uint8)
    assert LineInitialisation(VIEW, LANE_M, MARKING_M).step(full) == (None, None)


def test_a_line_beside_an_area_is_found() -> None:
    found = find(STRAIGHT.line(HALF), STRAIGHT.line(-HALF), lambda x, y: y < -0.45)
    check(found[0], STRAIGHT, HALF)
    check(found[1], STRAIGHT, -HALF)


def test_full_scale_with_rows_coarser_than_columns() -> None:
    """Lanes of 10 m, lines of 0.25 m, in a view 38 m deep."""
    view = View(x_near_m=3.0, x_far_m=41.0, half_width_m=10.0, m_per_px=0.08, m_per_row=0.16)
    road = Road(curvature_per_m=-0.02, heading_rad=0.2)
    features = binary(view, road.line(5.0, 0.25), road.line(-5.0, 0.25), samples=2)
    left, right = LineInitialisation(view, 10.0, 0.25, 1.2).step(features)
    assert left is not None
    assert right is not None
    for start, d in ((left, 5.0), (right, -5.0)):
        x, y = (np.array([value]) for value in start.point_m)
        assert float(road.beside(x, y)[0]) == pytest.approx(d, abs=0.3)
