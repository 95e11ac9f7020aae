"""The shipped tracks and what is painted on them."""

from __future__ import annotations

import itertools
import math

import cv2
import numpy as np
import pytest

from automodel.sim.paint import Paint
from automodel.sim.track import Track
from automodel.sim.track_files import load_track, parse_track

SHIPPED = ("tmr", "oval", "chicane")
ROAD = """
name = "road"
closed = false
[floor]
x0_m = -1.0
y0_m = -2.0
x1_m = 6.0
y1_m = 2.0
[[pieces]]
kind = "line"
length_m = 5.0
"""


@pytest.fixture(scope="module", params=SHIPPED)
def track(request: pytest.FixtureRequest) -> Track:
    return load_track(request.param)


@pytest.fixture(scope="module")
def tmr() -> Track:
    return load_track("tmr")


def area_m2(paint: Paint) -> float:
    x, y = paint.polygon_m.T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def covered(track: Track, points: np.ndarray) -> np.ndarray:
    """Whether each point (n, 2) lies on paint."""
    hit = np.zeros(len(points), dtype=bool)
    for paint in track.paint():
        low, high = paint.polygon_m.min(axis=0), paint.polygon_m.max(axis=0)
        outline = paint.polygon_m.astype(np.float32)
        for i in np.flatnonzero(((points >= low) & (points <= high)).all(axis=1)):
            hit[i] |= cv2.pointPolygonTest(outline, tuple(map(float, points[i])), False) >= 0
    return hit


class TestShipped:
    def test_lies_on_its_floor(self, track: Track) -> None:
        x0, y0, x1, y1 = track.floor
        points = np.vstack([paint.polygon_m for paint in track.paint()])
        assert (points > (x0 + 0.1, y0 + 0.1)).all()
        assert (points < (x1 - 0.1, y1 - 0.1)).all()
        assert track.closed

    def test_closes_within_a_micrometre(self, track: Track) -> None:
        first, last = track.road.pieces[0], track.road.pieces[-1]  # type: ignore[attr-defined]
        assert last.position(last.length_m) == pytest.approx(first.position(0.0), abs=1e-6)
        turn = float(last.heading(last.length_m) - first.heading(0.0))
        assert math.remainder(turn, math.tau) == pytest.approx(0.0, abs=1e-9)

    @pytest.mark.parametrize("direction", ["forward", "reverse"])
    def test_lanes_lie_right_of_the_middle(self, track: Track, direction: str) -> None:
        lane = track.lane(direction)
        assert lane.centerline.closed
        for s in np.linspace(0.0, lane.centerline.length_m, 23)[:-1]:
            assert float(lane.width_m(s)) == 0.4
            ahead = float(lane.centerline.heading(s))
            for line, side in ((lane.left, 0.2), (lane.right, -0.2)):
                foot_s, d = line.project(
                    lane.centerline.position(s), near_s_m=s / lane.centerline.length_m * line.length_m, reach_m=3.0
                )
                assert d == pytest.approx(-side, abs=1e-6)
                assert math.remainder(float(line.heading(foot_s)) - ahead, math.tau) == pytest.approx(0.0, abs=1e-6)
        sign = 1.0 if direction == "forward" else -1.0
        s = float(lane.centerline.project(track.road.offset_position(1.0, -0.2 * sign))[0])
        away = math.remainder(float(lane.centerline.heading(s) - track.road.heading(1.0)), math.tau)
        assert abs(away) == pytest.approx(0.0 if sign > 0 else math.pi, abs=1e-6)

    def test_start_is_on_the_forward_lane(self, track: Track) -> None:
        lane = track.lane(track.start_direction)
        s, d = lane.centerline.project((track.start.x_m, track.start.y_m))
        assert d == pytest.approx(0.0, abs=1e-9)
        assert math.remainder(float(lane.centerline.heading(s)) - track.start.yaw_rad, math.tau) == pytest.approx(0.0)

    def test_paint_is_in_small_pieces_that_follow_the_lines(self, track: Track) -> None:
        dense = np.linspace(0.0, track.road.length_m, 200_000)
        middle, theta = track.road.position(dense), track.road.heading(dense)
        checked = 0
        for paint in track.paint():
            extent = np.ptp(paint.polygon_m, axis=0)
            assert extent.max() <= 2.1
            if paint.kind not in ("line", "dash"):
                continue
            lines = np.array([0.0] if paint.kind == "dash" else [-0.4, 0.4])
            corners, following = paint.polygon_m, np.roll(paint.polygon_m, -1, axis=0)
            is_end = np.abs(np.hypot(*(following - corners).T) - 0.03) < 1e-9
            along = np.vstack((corners, 0.5 * (corners + following)[~is_end]))
            for x, y in along[:: max(len(corners) // 6, 1)]:
                near = np.argmin((middle[:, 0] - x) ** 2 + (middle[:, 1] - y) ** 2)
                d = (y - middle[near, 1]) * math.cos(theta[near]) - (x - middle[near, 0]) * math.sin(theta[near])
                assert np.abs(np.abs(d - lines) - 0.015).min() < 5e-4
                checked += 1
        assert checked > 100

    def test_loads_are_alike(self, track: Track) -> None:
        again = load_track(track.name)
        assert len(again.paint()) == len(track.paint())
        for a, b in zip(again.paint(), track.paint(), strict=True):
            assert (a.polygon_m == b.polygon_m).all()
            assert not a.polygon_m.flags.writeable


class TestTmr:
    def test_measures_of_the_rule_book(self, tmr: Track) -> None:
        assert tmr.floor == (0.0, 0.0, 12.0, 8.0)
        points = tmr.road.position(np.linspace(0.0, tmr.road.length_m, 5000))
        assert points.min(axis=0) == pytest.approx([0.78, 0.88], abs=1e-6)
        assert points.max(axis=0) == pytest.approx([11.18, 7.08], abs=1e-6)
        curvature = tmr.road.curvature(np.linspace(0.0, tmr.road.length_m, 5000))
        assert set(np.round(curvature, 9)) == {0.0, round(-1 / 1.4, 9)}
        for centre in ((3.78, 4.48), (8.18, 4.48)):
            assert abs(tmr.road.project(np.add(centre, (0.0, 1.4)))[1]) < 1e-9
            assert abs(tmr.road.project(np.add(centre, (0.0, -1.4)))[1]) < 1e-9

    def test_crosses_itself_twice_at_right_angles(self, tmr: Track) -> None:
        places = [tmr.road.position(c.s_first_m) for c in tmr.crossings]
        assert np.array(places) == pytest.approx(np.array([(5.18, 3.08), (6.78, 3.08)]), abs=1e-9)
        for crossing in tmr.crossings:
            assert tmr.road.position(crossing.s_second_m) == pytest.approx(tmr.road.position(crossing.s_first_m))
            assert crossing.angle_rad == pytest.approx(math.pi / 2)

    def test_forward_lane_is_the_inner_one(self, tmr: Track) -> None:
        lane = tmr.lane("forward").centerline
        curvature = lane.curvature(np.linspace(0.0, lane.length_m, 3000))
        assert curvature.min() == pytest.approx(-1 / 1.2)

    def test_nothing_is_painted_inside_the_intersections(self, tmr: Track) -> None:
        grid = np.stack(np.meshgrid(np.linspace(-0.38, 0.38, 21), np.linspace(-0.38, 0.38, 21)), axis=-1).reshape(-1, 2)
        for centre in ((5.18, 3.08), (6.78, 3.08)):
            assert not covered(tmr, grid + centre).any()

    def test_edges_run_up_to_the_intersections(self, tmr: Track) -> None:
        corners = np.array(list(itertools.product((-0.4, 0.4), (-0.4, 0.4))))
        for centre in ((5.18, 3.08), (6.78, 3.08)):
            assert covered(tmr, corners * 1.01 + centre).all()

    def test_zebra_bars_at_each_arm(self, tmr: Track) -> None:
        bars = [paint for paint in tmr.paint() if paint.kind == "zebra"]
        assert len(bars) == 2 * 4 * 7
        assert [area_m2(bar) for bar in bars] == pytest.approx([0.05 * 0.20] * len(bars))
        middles = np.array([bar.polygon_m.mean(axis=0) for bar in bars])
        expected = [
            np.array(centre) + rotation @ (0.4 + 0.05 + 0.10, across)
            for centre in ((5.18, 3.08), (6.78, 3.08))
            for rotation in (np.array([[c, -s], [s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1)))
            for across in np.arange(-3, 4) * 0.10
        ]
        for middle in expected:
            assert np.hypot(*(middles - middle).T).min() < 1e-6

    def test_dashes_have_the_carolo_pattern(self, tmr: Track) -> None:
        areas = np.array([area_m2(paint) for paint in tmr.paint() if paint.kind == "dash"]) / 0.03
        assert np.median(areas) == pytest.approx(0.20, rel=0.01)
        assert areas.max() < 0.203
        edges = sum(area_m2(paint) for paint in tmr.paint() if paint.kind == "line") / 0.03
        crossings = 2 * 4 * (0.8 - 0.03)  # two lines of each pass, interrupted between the inner borders
        assert edges == pytest.approx(2 * tmr.road.length_m - crossings, abs=0.03)


def test_chicane_bends_to_both_sides_down_to_the_stated_radius() -> None:
    track = load_track("chicane")
    for direction in ("forward", "reverse"):
        lane = track.lane(direction).centerline
        curvature = lane.curvature(np.linspace(0.0, lane.length_m, 5000))
        inner = curvature.min() if direction == "forward" else curvature.max()  # forward: right bends; reverse: both
        assert abs(curvature).max() == pytest.approx(1 / 0.6)
        assert curvature.min() < -0.9
        assert curvature.max() > 0.9
        assert abs(inner) > 0.9


def test_single_lane_is_driven_both_ways() -> None:
    text = ROAD.replace("[[pieces]]", "[lanes]\ncount = 1\nwidth_m = 0.5\n[[pieces]]")
    track = parse_track(text, "road.toml")
    forward, reverse = track.lane("forward"), track.lane("reverse")
    assert forward.centerline.position(1.0) == pytest.approx([1.0, 0.0])
    assert reverse.centerline.position(1.0) == pytest.approx([4.0, 0.0])
    assert forward.left.position(1.0) == pytest.approx([1.0, 0.25])
    assert reverse.left.position(1.0) == pytest.approx([4.0, -0.25])
    assert {paint.kind for paint in track.paint()} == {"line"}


def test_stop_lines_gaps_colours_and_obstacles() -> None:
    text = ROAD + (
        '[markings.left]\nstyle = "solid"\ncolour = "yellow"\nwidth_m = 0.02\n'
        '[markings.centre]\nstyle = "none"\n[markings.right]\nstyle = "dashed"\ndash_m = 0.3\ngap_m = 0.7\n'
        "[[stop_lines]]\ns_m = 2.0\nwidth_m = 0.05\n"
        '[[stop_lines]]\ns_m = 3.0\ndirection = "reverse"\n'
        '[[gaps]]\nfrom_m = 1.0\nto_m = 1.5\nlines = ["left"]\n'
        "[[obstacles]]\nx_m = 2.0\ny_m = 1.0\nheading_rad = 1.5707963267948966\nlength_m = 0.4\n"
        "height_m = 0.3\ngrey = 90\n"
    )
    track = parse_track(text, "road.toml")
    assert not track.closed
    by_kind = {kind: [p for p in track.paint() if p.kind == kind] for kind in ("line", "dash", "stop", "zebra")}
    assert {p.colour for p in by_kind["line"]} == {"yellow"}
    assert sum(area_m2(p) for p in by_kind["line"]) == pytest.approx(4.5 * 0.02)
    assert [sorted(p.polygon_m[:, 0])[0] for p in by_kind["dash"]] == pytest.approx([0.0, 1.0, 2.0, 3.0, 4.0])
    assert by_kind["zebra"] == []
    forward, reverse = (p.polygon_m for p in by_kind["stop"])
    assert np.ptp(forward, axis=0) == pytest.approx([0.05, 0.4 - 0.015], abs=1e-6)
    assert forward[:, 1].max() <= 0.0 <= reverse[:, 1].min()
    obstacle = track.obstacles[0]
    assert obstacle.polygon_m.min(axis=0) == pytest.approx([1.9, 0.8])
    assert obstacle.polygon_m.max(axis=0) == pytest.approx([2.1, 1.2])
    assert (obstacle.height_m, obstacle.grey) == (0.3, 90)


def test_oblique_crossing_has_no_lines_inside() -> None:
    third = 2 * math.pi / 3
    text = ROAD.replace("length_m = 5.0\n", "length_m = 4.0\n").replace("x1_m = 6.0", "x1_m = 9.0")
    text += f'[[pieces]]\nkind = "arc"\nradius_m = 1.0\nturn_rad = {2 * third!r}\n'
    text += '[[pieces]]\nkind = "line"\nlength_m = 5.0\n'
    track = parse_track(text + "[crossings.zebra]\n", "road.toml")
    (crossing,) = track.crossings
    assert crossing.angle_rad == pytest.approx(math.pi / 3)
    for own, other in ((crossing.s_first_m, crossing.s_second_m), (crossing.s_second_m, crossing.s_first_m)):
        for d in (-0.4, 0.0, 0.4):
            points = track.road.offset_position(np.linspace(own - 1.5, own + 1.5, 400), d)
            beside = np.array([track.road.project(p, near_s_m=other, reach_m=1.5)[1] for p in points])
            assert not covered(track, points[np.abs(beside) < 0.36]).any()
            if d:
                assert covered(track, points[np.abs(beside) > 0.43]).all()


@pytest.mark.parametrize(("direction", "index"), [("backward", 0), ("forward", 1), ("forward", -1)])
def test_lanes_that_are_not_there(tmr: Track, direction: str, index: int) -> None:
    with pytest.raises(ValueError, match=r"direction:|index:"):
        tmr.lane(direction, index)
