"""Window line following on drawn binary views."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from automodel.geometry import SE2, View
from automodel.perception.markings.binary_views import FeaturePoints
from automodel.perception.windows.line_following import FollowedLine, LineFollowing
from automodel.perception.windows.window_tracker import ExpectedLine
from automodel.sim.track import Lane
from automodel.sim.track_files import load_track
from tests.support.drawn_roads import LANE_M, MARKING_M, STRAIGHT, Road, crossing, within, zebra
from tests.support.drawn_views import Shape, bar, binary, disc, line_at
from tests.support.rendered_drives import CAR, renderer

VIEW = View(x_near_m=0.36, x_far_m=2.28, half_width_m=0.64, m_per_px=0.008)
LONG_ROWS = View(x_near_m=0.36, x_far_m=2.28, half_width_m=0.64, m_per_px=0.008, m_per_row=0.012)
FINE = View(x_near_m=0.36, x_far_m=1.86, half_width_m=0.64, m_per_px=0.005)
REFERENCE_M = 0.13
HALF = 0.5 * LANE_M
PAIR = (STRAIGHT.line(HALF), STRAIGHT.line(-HALF))


def following(view: View = VIEW, visible: np.ndarray | None = None) -> LineFollowing:
    return LineFollowing(view, LANE_M, MARKING_M, visible)


def draw(*shapes: Shape, view: View = VIEW) -> np.ndarray:
    return binary(view, *shapes, samples=3)


def start_on(road: Road, d_m: float, ahead_m: float = 0.4) -> ExpectedLine:
    """The first piece of a line alone, not quite where it is: half a marking aside, 3 deg askew."""
    points = road.expected(d_m, -ahead_m, ahead_m + 1.0)
    x, y = points.points_m[0]
    heading = float(points.heading_rad[0]) + math.radians(3.0)
    first = np.array((x, y + 0.5 * MARKING_M))
    along = 0.1 * np.array((math.cos(heading), math.sin(heading)))
    return ExpectedLine(points_m=np.stack((first, first + along)), heading_rad=np.full(2, heading))


def away(line: FollowedLine, road: Road, d_m: float) -> np.ndarray:
    """How far [m] the points lie to the left of the line at d."""
    return road.beside(line.points_m[:, 0], line.points_m[:, 1]) - d_m


def check_on(line: FollowedLine, road: Road, d_m: float, view: View, least: int) -> None:
    error = away(line, road, d_m)
    assert len(line) >= least
    assert math.sqrt(float((error**2).mean())) < 0.25 * view.m_per_px
    assert np.abs(error).max() < 0.75 * view.m_per_px
    steps = np.diff(road.along(line.points_m[:, 0], line.points_m[:, 1]))
    assert (steps > 0.0).all()


BENDS = [
    Road(),
    Road(heading_rad=math.radians(20.0), aside_m=-0.2),
    Road(heading_rad=math.radians(-40.0), aside_m=0.5),
    Road(heading_rad=math.radians(40.0), aside_m=-0.5),
    Road(curvature_per_m=0.5),
    Road(curvature_per_m=-0.7, heading_rad=math.radians(20.0)),
    Road(curvature_per_m=1.25, heading_rad=math.radians(-40.0), aside_m=0.2),
    Road(curvature_per_m=-1.25, heading_rad=math.radians(40.0), aside_m=-0.2),
]


class TestCleanLines:
    @pytest.mark.parametrize("view", [VIEW, LONG_ROWS, FINE], ids=["square", "long rows", "fine"])
    @pytest.mark.parametrize("road", BENDS)
    def test_points_lie_on_the_middle(self, view: View, road: Road) -> None:
        line = following(view).follow(draw(road.line(0.0), view=view), road.expected(0.0), 0.02)
        check_on(line, road, 0.0, view, least=9)
        assert line.lost_m is None
        assert not line.after_gap[1:].any()

    def test_a_line_may_turn_till_it_goes_sideways(self) -> None:
        road = Road(curvature_per_m=1.25, aside_m=-0.4)  # two lanes' radius
        line = following().follow(draw(road.line(0.0)), start_on(road, 0.0, 0.45))
        check_on(line, road, 0.0, VIEW, least=12)
        last = line.points_m[-1] - line.points_m[-2]
        assert math.degrees(math.atan2(last[1], last[0])) > 75.0

    def test_an_s_bend(self) -> None:
        """Two arcs of 2.5 lanes' radius, one after the other, each of 1 rad."""
        first = Road(curvature_per_m=1.0, aside_m=-0.5)
        end = np.array([math.sin(1.0), 0.5 - math.cos(1.0)])
        centre = end + np.array([math.sin(1.0), -math.cos(1.0)])

        def beside(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            return np.where(x < end[0], first.beside(x, y), np.hypot(x - centre[0], y - centre[1]) - 1.0)

        def painted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            return (np.abs(beside(x, y)) <= 0.5 * MARKING_M) & (y > -0.5) & ((x < end[0]) | (y > centre[1]))

        s = np.linspace(0.0, 1.0, 40)
        points = np.concatenate(
            (
                np.stack((np.sin(s), 0.5 - np.cos(s)), axis=-1),
                centre + np.stack((-np.sin(1.0 - s[1:]), np.cos(1.0 - s[1:])), axis=-1),
            )
        )
        expected = ExpectedLine(points_m=points, heading_rad=np.concatenate((s, 1.0 - s[1:])))
        wlf, features = following(), draw(painted)
        line = wlf.follow(features, expected, 0.02)
        error = beside(*line.points_m.T)
        assert line.points_m[:, 0].max() > 1.6
        assert math.sqrt(float((error**2).mean())) < 0.25 * VIEW.m_per_px

    def test_sigma_grows_with_the_distance(self) -> None:
        line = following().follow(draw(*PAIR), start_on(STRAIGHT, HALF))
        assert line.sigma_m.shape == (len(line),)
        assert (np.diff(line.sigma_m) > 0.0).all()
        assert line.sigma_m[0] > 0.0
        assert not line.points_m.flags.writeable


class TestGaps:
    @pytest.mark.parametrize("road", [Road(), Road(curvature_per_m=0.8), Road(curvature_per_m=-0.9, aside_m=0.1)])
    @pytest.mark.parametrize("dash", [(0.2, 0.2), (0.15, 0.25)])
    def test_dashes_are_followed(self, road: Road, dash: tuple[float, float]) -> None:
        d = -HALF if road.curvature_per_m > 0 else HALF  # the outer line stays in view
        features = draw(road.dashed(d, *dash, from_m=0.1))
        wlf = following()
        line = wlf.follow(features, road.expected(d), 0.02)
        error = away(line, road, d)
        assert np.abs(error).max() < 0.004
        s = road.along(line.points_m[:, 0], line.points_m[:, 1])
        dashes = np.unique(np.floor((s - 0.1) / sum(dash)))
        assert len(dashes) >= 3
        assert line.after_gap.sum() >= len(dashes) - 1

    @pytest.mark.parametrize("shift_m", [-0.06, 0.06])
    def test_what_is_not_where_expected_is_searched_for_within_the_breadth(self, shift_m: float) -> None:
        features = draw(STRAIGHT.line(HALF + shift_m))
        wlf, expected = following(), STRAIGHT.expected(HALF)
        found = wlf.follow(features, expected, 0.08)
        check_on(found, STRAIGHT, HALF + shift_m, VIEW, least=20)
        tolerant = wlf.follow(features, expected, 0.0).points_m[:, 0]  # the tolerance grows with the distance
        assert (tolerant > 0.36 + 0.4).all()

    def test_a_long_gap_is_crossed_with_an_expectation_only(self) -> None:
        features = draw(within(STRAIGHT.line(HALF), 0.0, 0.8), within(STRAIGHT.line(HALF), 1.6, 9.0))
        wlf = following()
        across = wlf.follow(features, STRAIGHT.expected(HALF), 0.02)
        check_on(across, STRAIGHT, HALF, VIEW, least=12)
        assert across.points_m[:, 0].max() > 2.1
        assert across.after_gap.sum() >= 1
        alone = wlf.follow(features, start_on(STRAIGHT, HALF))
        assert alone.points_m[:, 0].max() < 0.85
        assert alone.lost_m is not None
        assert 0.8 < alone.lost_m[0] < 1.0

    def test_what_crosses_the_expected_direction_is_not_the_line_found_again(self) -> None:
        slanting = within(line_at(HALF - 0.8 * 1.6, MARKING_M, slope=0.8), 1.2, 9.0)
        features = draw(within(STRAIGHT.line(HALF), 0.0, 0.8), slanting)
        line = following().follow(features, STRAIGHT.expected(HALF), 0.02)
        assert len(line) >= 4
        assert np.abs(away(line, STRAIGHT, HALF)).max() < 0.004

    def test_a_line_that_begins_far_is_found_where_it_begins(self) -> None:
        line = following().follow(draw(within(STRAIGHT.line(-HALF), 1.2, 9.0)), STRAIGHT.expected(-HALF), 0.03)
        check_on(line, STRAIGHT, -HALF, VIEW, least=11)
        assert line.points_m[0, 0] < 1.35
        assert line.after_gap[0]


class TestOtherPaint:
    @pytest.mark.parametrize("side", [1, -1])
    def test_the_neighbour_lanes_lines_are_left_alone(self, side: int) -> None:
        lines = [STRAIGHT.line(d * HALF) for d in (-3, -1, 1, 3)]
        wlf = following()
        line = wlf.follow(draw(*lines), STRAIGHT.expected(side * HALF), 0.05)
        check_on(line, STRAIGHT, side * HALF, VIEW, least=20)
        missing = draw(*(STRAIGHT.line(d * HALF) for d in (-3, -1, 1, 3) if d != side))
        assert len(wlf.follow(missing, STRAIGHT.expected(side * HALF), 0.2)) == 0

    @pytest.mark.parametrize("corner_m", [0.0, 0.2, 0.4])
    @pytest.mark.parametrize("side", [1, -1])
    def test_a_crossing_road_is_passed_straight_on(self, corner_m: float, side: int) -> None:
        features = draw(*crossing(1.0, 0.5, corner_m))
        line = following().follow(features, STRAIGHT.expected(side * HALF), 0.03)
        assert np.abs(away(line, STRAIGHT, side * HALF)).max() < 0.012
        near = line.points_m[:, 0] < 1.0
        assert near.sum() >= 2
        if corner_m < 0.3:
            assert (~near).sum() >= 3

    def test_without_an_expectation_a_narrow_corner_is_not_followed_round(self) -> None:
        line = following().follow(draw(*crossing(1.0, 0.8, 0.15)), start_on(STRAIGHT, HALF))
        assert np.abs(away(line, STRAIGHT, HALF)).max() < 0.02

    def test_of_two_branches_the_expected_one_is_taken(self) -> None:
        bend = Road(curvature_per_m=0.6)
        branch = within(bend.line(-HALF), 0.7, 9.0)
        features = draw(STRAIGHT.line(-HALF), branch)
        wlf = following()
        straight = wlf.follow(features, STRAIGHT.expected(-HALF), 0.02)
        assert np.abs(away(straight, STRAIGHT, -HALF)).max() < 0.01
        assert straight.points_m[-1, 0] > 2.0
        turning = wlf.follow(features, bend.expected(-HALF), 0.02)
        assert np.abs(away(turning, bend, -HALF)).max() < 0.01
        assert turning.points_m[-1, 1] > 0.4

    @pytest.mark.parametrize("x_m", [0.45, 0.8, 1.4])
    @pytest.mark.parametrize("shift_m", [0.0, 0.05])
    def test_a_zebra_across_changes_nothing(self, x_m: float, shift_m: float) -> None:
        wlf = following()
        for gap in (False, True):
            lines = list(PAIR)
            if gap:
                lines = [within(line, *reach) for line in PAIR for reach in ((-9.0, x_m - 0.05), (x_m + 0.25, 9.0))]
            features = draw(*lines, within(zebra(x_m, shift_m=shift_m), 0.0, 9.0))
            for d in (HALF, -HALF):
                line = wlf.follow(features, STRAIGHT.expected(d), 0.02)
                assert len(line) >= 12
                assert np.abs(away(line, STRAIGHT, d)).max() < 0.008

    def test_bars_alone_are_no_line(self) -> None:
        features = draw(zebra(0.8, shift_m=0.05), zebra(1.2, shift_m=0.05))
        for d in (HALF, -HALF, 0.0):
            assert len(following().follow(features, STRAIGHT.expected(d), 0.05)) == 0

    def test_a_stop_line_does_not_shift_the_points(self) -> None:
        features = draw(*PAIR, bar(1.0, 0.05, half_m=HALF))
        line = following().follow(features, STRAIGHT.expected(HALF), 0.02)
        assert len(line) >= 19
        assert np.abs(away(line, STRAIGHT, HALF)).max() < 0.5 * VIEW.m_per_px

    def test_blobs_are_no_lines_and_hardly_move_one(self) -> None:
        rng = np.random.default_rng(1)
        places = rng.uniform((0.4, -0.6), (2.2, 0.6), (25, 2))
        blobs = [
            disc(float(x), float(y), float(r)) for (x, y), r in zip(places, rng.uniform(0.005, 0.04, 25), strict=True)
        ]
        wlf = following()
        for d in (HALF, -HALF, 0.0):
            assert len(wlf.follow(draw(*blobs), STRAIGHT.expected(d), 0.05)) <= 1  # two side by side
        for d in (HALF, -HALF):
            line = wlf.follow(draw(*PAIR, *blobs), STRAIGHT.expected(d), 0.02)
            assert len(line) >= 15
            assert np.abs(away(line, STRAIGHT, d)).max() < 0.5 * MARKING_M

    @pytest.mark.parametrize("value", [0, 255])
    def test_bare_and_full_views_have_no_points(self, value: int) -> None:
        wlf = following()
        features = np.full((VIEW.height_px, VIEW.width_px), value, np.uint8)
        line = wlf.follow(features, STRAIGHT.expected(HALF), 0.05)
        assert line.points_m.shape == (0, 2)
        assert line.sigma_m.shape == line.after_gap.shape == (0,)


def expected(lane: Lane, pose: SE2, s_m: float, side_m: float, turn_rad: float) -> ExpectedLine:
    """The lane's line, turned about the car: a model is never quite right."""
    s = np.linspace(s_m - 0.4, s_m + 2.2, 60)
    wrong = SE2(0.0, 0.005, turn_rad) @ pose.inverse()
    points = wrong.apply(lane.centerline.offset_position(s, side_m))
    return ExpectedLine(points_m=points, heading_rad=lane.centerline.heading(s) + wrong.yaw_rad)


@pytest.mark.parametrize(
    ("track", "direction", "stations"),
    [
        ("tmr", "forward", np.arange(0.25, 46.0, 3.5)),
        ("tmr", "forward", np.arange(4.0, 7.5, 0.5)),  # both intersections with their zebras
        ("tmr", "reverse", np.arange(44.0, 47.5, 0.5)),
        ("chicane", "forward", np.arange(0.0, 20.0, 1.5)),
        ("oval", "reverse", np.arange(0.0, 12.0, 2.0)),
    ],
)
def test_points_lie_on_the_lanes_lines(track: str, direction: str, stations: np.ndarray) -> None:
    world = load_track(track)
    lane, eye = world.lane(direction), renderer(world, CAR)
    half = 0.5 * float(lane.width_m(0.0))
    features = FeaturePoints(CAR.camera, VIEW, MARKING_M)
    following = LineFollowing(VIEW, 2.0 * half, MARKING_M, features.visible)
    errors: list[float] = []
    for s in stations.tolist():
        pose = lane.pose(s, 0.04 * math.sin(3.0 * s), 0.1 * math.cos(2.3 * s))
        mask = cv2.resize(eye.render_mask(pose.x_m, pose.y_m, pose.yaw_rad), (512, 256), interpolation=cv2.INTER_AREA)
        view = features.step(np.asarray(mask, dtype=np.uint8))
        for side in (half, -half):
            line = following.follow(view, expected(lane, pose, s, side, 0.02 * math.sin(s)), 0.03)
            for point in pose.apply(line.points_m):
                errors.append(lane.centerline.project(point, near_s_m=s + 1.0, reach_m=2.0)[1] - side)
    away = np.abs(errors)
    assert len(away) > 8 * len(stations)
    assert math.sqrt(float((away**2).mean())) < 0.25 * VIEW.m_per_px
    assert away.max() < MARKING_M
