"""Single windows on lines, what ends a walk, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from automodel.config import CarConfig
from automodel.geometry import BirdsEye, GroundCamera, View
from automodel.perception.windows.line_following import LineFollowing
from automodel.perception.windows.line_windows import LineWindows, beside_piece, look
from automodel.perception.windows.window_tracker import HEADING, NO_PATH, ExpectedLine, Path, beside, resampled
from tests.support.drawn_roads import LANE_M, MARKING_M, STRAIGHT, Road
from tests.support.drawn_views import Shape, bar, binary, disc, line_at

VIEW = View(x_near_m=0.36, x_far_m=2.28, half_width_m=0.64, m_per_px=0.008)
LONG_ROWS = replace(VIEW, m_per_row=0.012)


def slanted(x_m: float, y_m: float, direction_rad: float) -> Shape:
    """A line through a point, of any direction."""

    def painted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        off = (y - y_m) * math.cos(direction_rad) - (x - x_m) * math.sin(direction_rad)
        return np.abs(off) <= 0.5 * MARKING_M

    return painted


@pytest.mark.parametrize("view", [VIEW, LONG_ROWS], ids=["square", "long rows"])
@pytest.mark.parametrize("direction_deg", [0, 15, 30, 44, 46, 60, 75, 90, -20, -44, -50, -85, 120])
def test_a_window_tells_a_lines_place_and_direction(view: View, direction_deg: float) -> None:
    direction = math.radians(direction_deg)
    features = binary(view, slanted(1.2, 0.1, direction), samples=4)
    layout = LineWindows(view, MARKING_M).layout
    normal = np.array([-math.sin(direction), math.cos(direction)])
    for aside in (-0.03, -0.01, 0.0, 0.02, 0.03):  # at 3 cm a part of the line is outside the window
        x, y = np.array([1.2, 0.1]) + aside * normal
        seen = look(features, layout, float(x), float(y), direction + math.radians(5.0))
        off = np.array([seen.x_m - 1.2, seen.y_m - 0.1]) @ normal
        assert abs(off) <= 0.51 * view.m_per_px  # along a row or column it may lie anywhere in its pixels
        assert seen.direction_rad == pytest.approx(direction, abs=math.radians(5.0))


def test_areas_crossing_lines_and_specks_are_no_pieces() -> None:
    layout = LineWindows(VIEW, MARKING_M).layout
    for shape in (disc(1.2, 0.0, 0.2), line_at(0.0, 0.08), bar(1.18, 0.03), disc(1.2, 0.0, 0.008)):
        assert math.isnan(look(binary(VIEW, shape), layout, 1.2, 0.0, 0.0).x_m)


def test_a_disc_has_no_direction() -> None:
    layout = LineWindows(VIEW, MARKING_M).layout
    seen = look(binary(VIEW, disc(1.2, 0.0, 0.7 * MARKING_M)), layout, 1.2, 0.0, 0.0)
    assert math.isfinite(seen.x_m)
    assert math.isnan(seen.direction_rad)


def test_of_two_lines_in_a_window_the_one_ahead_counts() -> None:
    layout = LineWindows(VIEW, MARKING_M).layout
    features = binary(VIEW, line_at(0.0), line_at(0.052))
    seen = look(features, layout, 1.2, 0.0, 0.0)
    assert abs(seen.y_m) < 0.5 * VIEW.m_per_px


def test_what_lies_beside_a_piece() -> None:
    layout = LineWindows(VIEW, MARKING_M).layout

    def about(*shapes: Shape, x_m: float = 1.2, heading_rad: float = 0.0) -> tuple[float, float]:
        return beside_piece(binary(VIEW, *shapes), layout, x_m, 0.0, heading_rad)

    assert about(line_at(0.0)) == (0.0, 0.0)
    assert min(about(*(line_at(0.1 * k, 0.05) for k in (-1, 0, 1)))) > 1.0
    left, right = about(line_at(0.0), line_at(0.1))
    assert left > 0.7
    assert right == 0.0
    aside = about(bar(1.2, 0.03), bar(1.1, 0.03), x_m=1.215, heading_rad=0.5 * math.pi)
    assert min(aside) == 0.0
    assert max(aside) > 0.7


class TestSight:
    CAMERA = GroundCamera.from_config(CarConfig().camera)
    VISIBLE = BirdsEye(CAMERA, VIEW).mask

    @pytest.mark.parametrize("road", [Road(), Road(heading_rad=math.radians(25.0)), Road(curvature_per_m=-0.8)])
    def test_no_point_is_drawn_aside_by_the_edge_of_what_is_seen(self, road: Road) -> None:
        errors = []
        for d in (0.2, -0.2):
            features = binary(VIEW, road.line(d), samples=3) & self.VISIBLE
            wlf = LineFollowing(VIEW, LANE_M, MARKING_M, self.VISIBLE)
            line = wlf.follow(features, road.expected(d), 0.02)
            errors.append(road.beside(*line.points_m.T) - d)
            column, row = np.rint(VIEW.to_px(line.points_m)).astype(int).T
            assert (self.VISIBLE[row, column] > 0).all()
        assert len(np.concatenate(errors)) > 10
        assert np.abs(np.concatenate(errors)).max() < 0.5 * VIEW.m_per_px

    def test_a_line_that_leaves_the_view_is_not_lost(self) -> None:
        road = Road(heading_rad=math.radians(35.0))
        line = LineFollowing(VIEW, LANE_M, MARKING_M).follow(binary(VIEW, road.line(0.0)), road.expected(0.0))
        assert len(line) > 3
        assert line.lost_m is None

    def test_a_line_out_of_sight_has_no_points(self) -> None:
        road = Road(aside_m=2.0)
        line = LineFollowing(VIEW, LANE_M, MARKING_M).follow(binary(VIEW, STRAIGHT.line(0.2)), road.expected(0.0))
        assert len(line) == 0
        assert line.lost_m is None


class TestExpectations:
    def test_where_the_expectation_is_a_guess_the_line_that_is_seen_counts(self) -> None:
        bend, wlf = Road(curvature_per_m=1.0), LineFollowing(VIEW, LANE_M, MARKING_M)

        def beside(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            return np.where(x < 0.9, y, bend.beside(x - 0.9, y)) + 0.2  # the line bends 0.9 m ahead

        features = binary(VIEW, lambda x, y: np.abs(beside(x, y)) <= 0.5 * MARKING_M, samples=3)
        straight = STRAIGHT.expected(-0.2, behind_m=0.0)
        firm = wlf.follow(features, straight, 0.02)
        guess = wlf.follow(features, replace(straight, known_m=0.9), 0.02)
        assert firm.points_m[:, 1].max() < 0.0
        assert guess.points_m[:, 1].max() > 0.4
        for line in (firm, guess):
            assert np.abs(beside(*line.points_m.T)).max() < 0.5 * VIEW.m_per_px

    def test_the_place_beside_a_point_moves_along_its_line(self) -> None:
        line = Road(curvature_per_m=0.5).expected(0.0, behind_m=0.0, ahead_m=2.0)
        nodes = resampled(line.points_m, line.heading_rad, 0.1, 100)
        path = Path(nodes, step_m=0.1, known_m=math.inf, reach_m=0.0, from_m=0.0)
        assert nodes[1, HEADING] - nodes[0, HEADING] == pytest.approx(0.05, abs=1e-3)
        at = beside(
            path, 0, math.sin(0.5) * 2.0 - 0.03 * math.sin(0.5), 2.0 - 1.97 * math.cos(0.5)
        )  # 1 m along the arc
        assert at == 10
        assert nodes[at] == pytest.approx((math.sin(0.5) * 2.0, 2.0 - 2.0 * math.cos(0.5), 0.5), abs=1e-3)
        assert beside(path, at, 0.0, 0.0) == at  # never back
        assert beside(path, at, 9.0, 9.0) == NO_PATH

    def test_a_very_long_expectation_costs_no_more_than_a_long_one(self) -> None:
        s = np.array([0.0, 1e9])
        endless = ExpectedLine(points_m=np.stack((s, 0.2 + 0.0 * s), axis=-1), heading_rad=np.zeros(2))
        line = LineFollowing(VIEW, LANE_M, MARKING_M).follow(binary(VIEW, line_at(0.2)), endless)
        assert len(line) > 20

    @pytest.mark.parametrize(
        ("points", "heading"),
        [
            (np.zeros((1, 2)), np.zeros(1)),
            (np.zeros((3, 2)), np.zeros(2)),
            (np.zeros((3, 3)), np.zeros(3)),
            (np.array([[0.0, 0.0], [np.nan, 0.0]]), np.zeros(2)),
            (np.zeros((2, 2)), np.array([0.0, np.inf])),
        ],
    )
    def test_unusable_expectations_are_refused(self, points: np.ndarray, heading: np.ndarray) -> None:
        with pytest.raises(ValueError, match="ExpectedLine"):
            ExpectedLine(points_m=points, heading_rad=heading)

    def test_a_single_place_is_no_line(self) -> None:
        wlf = LineFollowing(VIEW, LANE_M, MARKING_M)
        features = binary(VIEW, line_at(0.2))
        point = ExpectedLine(points_m=np.full((2, 2), 0.5), heading_rad=np.zeros(2))
        assert len(wlf.follow(features, point, 0.05)) <= 1
