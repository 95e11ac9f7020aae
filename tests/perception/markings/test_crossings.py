"""The search for lines across the lane on drawn views."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.curves.lanes import LaneShape
from automodel.estimation.polynomial.lane_fit import LaneFit, LaneFitConfig
from automodel.geometry import View
from automodel.perception.markings.crossings import CrossingScan, CrossingSearch
from tests.support.drawn_views import Shape, bar, binary, line_at

LANE_M, MARKING_M, REFERENCE_M = 0.4, 0.03, 0.13
VIEW = View(x_near_m=0.36, x_far_m=1.56, half_width_m=0.64, m_per_px=0.006)
FAR_M = VIEW.x_far_m - REFERENCE_M
FIT = LaneFit(LaneFitConfig(lane_width_m=LANE_M, reference_x_m=REFERENCE_M))
LINES = (line_at(0.2), line_at(-0.2))


def lane(offset_m: float = 0.0, heading_rad: float = 0.0, curvature_per_m: float = 0.0) -> LaneShape:
    return FIT.shape(FIT.start(offset_m, -heading_rad, curvature_per_m, LANE_M))


def search(*shapes: Shape, along: LaneShape | None = None) -> CrossingScan:
    finder = CrossingSearch(VIEW, LANE_M, MARKING_M)
    return finder.step(binary(VIEW, *shapes), along if along is not None else lane(), FAR_M)


def zebra(x_m: float, length_m: float = 0.2, bar_m: float = 0.05, gap_m: float = 0.05) -> Shape:
    """Bars along the road, one of them in the lane's middle."""

    def painted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return (x >= x_m) & (x <= x_m + length_m) & ((y + 0.5 * bar_m) % (bar_m + gap_m) < bar_m)

    return painted


@pytest.mark.parametrize("distance_m", [0.4, 0.62, 0.9, 1.2])
@pytest.mark.parametrize("depth_m", [0.04, 0.06])
def test_a_stop_line_is_reported_by_its_near_edge(distance_m: float, depth_m: float) -> None:
    crossing = search(*LINES, bar(REFERENCE_M + distance_m, depth_m)).crossing
    assert crossing is not None
    assert crossing.distance_m == pytest.approx(distance_m, abs=0.02)
    assert crossing.angle_rad == pytest.approx(0.5 * math.pi, abs=math.radians(3.0))


@pytest.mark.parametrize("skew_deg", [-10.0, -5.0, 6.0, 12.0])
def test_a_slanting_line_is_reported_with_its_angle(skew_deg: float) -> None:
    angle = 0.5 * math.pi + math.radians(skew_deg)
    crossing = search(*LINES, bar(REFERENCE_M + 0.8, 0.06, angle)).crossing
    assert crossing is not None
    assert crossing.angle_rad == pytest.approx(angle, abs=math.radians(3.0))
    assert crossing.distance_m == pytest.approx(0.8, abs=0.05)


@pytest.mark.parametrize("skew_deg", [60.0, -55.0])
def test_a_line_along_the_lane_is_none(skew_deg: float) -> None:
    angle = 0.5 * math.pi + math.radians(skew_deg)
    assert search(*LINES, bar(REFERENCE_M + 0.8, 0.04, angle)).crossing is None


@pytest.mark.parametrize("distance_m", [0.45, 0.8])
def test_a_zebra_is_reported_by_its_near_edge(distance_m: float) -> None:
    crossing = search(*LINES, zebra(REFERENCE_M + distance_m)).crossing
    assert crossing is not None
    assert crossing.distance_m == pytest.approx(distance_m, abs=0.02)
    assert crossing.angle_rad == pytest.approx(0.5 * math.pi, abs=math.radians(3.0))


def test_the_first_of_two_counts() -> None:
    crossing = search(*LINES, bar(REFERENCE_M + 0.6, 0.05), bar(REFERENCE_M + 1.0, 0.05)).crossing
    assert crossing is not None
    assert crossing.distance_m == pytest.approx(0.6, abs=0.02)


def test_a_plain_lane_has_none() -> None:
    found = search(*LINES)
    assert found.crossing is None
    assert not found.covered.any()
    assert search().crossing is None


def test_a_lane_beside_its_lines_has_none() -> None:
    for offset, heading in ((0.05, 0.0), (-0.05, 0.1), (0.0, -0.1)):  # the prediction is never quite right
        assert search(*LINES, along=lane(offset, heading)).crossing is None


def test_paint_of_the_lanes_neighbours_is_none() -> None:
    half = bar(REFERENCE_M + 0.8, 0.05)
    assert search(*LINES, lambda x, y: half(x, y) & (y > 0.25)).crossing is None
    assert search(*LINES, lambda x, y: half(x, y) & (y < -0.25)).crossing is None


@pytest.mark.parametrize("heading_deg", [-20.0, 15.0])
def test_distances_count_along_the_lane(heading_deg: float) -> None:
    """The car stands askew; the line lies square to the lane."""
    heading = math.radians(heading_deg)
    tangent = np.array([math.cos(-heading), math.sin(-heading)])

    def stop(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        along = (x - REFERENCE_M) * tangent[0] + y * tangent[1]
        return (along >= 0.7) & (along <= 0.75)

    crossing = search(stop, along=lane(0.0, heading)).crossing
    assert crossing is not None
    assert crossing.distance_m == pytest.approx(0.7, abs=0.02)
    assert crossing.angle_rad == pytest.approx(0.5 * math.pi - heading, abs=math.radians(3.0))


@pytest.mark.parametrize("curvature_per_m", [0.7, -0.7])
def test_a_stop_line_in_a_bend(curvature_per_m: float) -> None:
    centre_y = 1.0 / curvature_per_m

    def stop(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        turned = np.arctan2(x - REFERENCE_M, np.sign(curvature_per_m) * (centre_y - y))
        arc_length = turned / abs(curvature_per_m)
        return (arc_length >= 0.6) & (arc_length <= 0.65)

    crossing = search(stop, along=lane(0.0, 0.0, curvature_per_m)).crossing
    assert crossing is not None
    assert crossing.distance_m == pytest.approx(0.6, abs=0.02)
    assert crossing.angle_rad == pytest.approx(0.5 * math.pi + 0.6 * curvature_per_m, abs=math.radians(4.0))


def test_covered_tells_where_lines_are_not_trusted() -> None:
    found = search(*LINES, zebra(REFERENCE_M + 0.6, 0.2))
    places = np.array([0.35, 0.62, 0.7, 0.78, 1.0, 1.2])
    assert found.free(places).tolist() == [True, False, False, False, True, True]
    assert found.free(np.array([-1.0, 99.0])).shape == (2,)


def test_a_crossing_that_is_hardly_in_view_waits() -> None:
    narrow = View(x_near_m=0.36, x_far_m=1.56, half_width_m=0.08, m_per_px=0.006)
    finder = CrossingSearch(narrow, LANE_M, MARKING_M)
    assert finder.step(binary(narrow, bar(0.9, 0.05)), lane(), FAR_M).crossing is None


def test_lanes_too_narrow_for_a_corridor_have_none() -> None:
    tight = FIT.shape(FIT.start(0.0, 0.0, 0.0, 0.15))
    assert search(bar(0.9, 0.05), along=tight).crossing is None
