"""Circuits: the shipped one, broken lines, kerbs and asphalt, and how they look; the laps that are driven on them."""

from __future__ import annotations

import math
from dataclasses import replace
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
import pytest

from automodel.bench.centerline_paper import full_scale_car
from automodel.config import PipelineConfig
from automodel.config.toml_reader import ConfigError
from automodel.curves import arc, line
from automodel.geometry import GroundCamera
from automodel.sim.appearance import Appearance
from automodel.sim.paint import broken_spans, build_roadside
from automodel.sim.renderer import Renderer
from automodel.sim.track import Track
from automodel.sim.track_files import load_track, parse_track, read_racetrack
from automodel.sim.track_sections import BrokenLines, LaneWidth, RoadsideSection, WidthAt

TEXT = resources.files("tracks").joinpath("circuit.toml").read_text(encoding="utf-8")
EYE = GroundCamera.from_config(full_scale_car(PipelineConfig()).camera)
LAP_M = 1500.0


@pytest.fixture(scope="module")
def circuit() -> Track:
    return load_track("circuit")


def ten_wide(s: object) -> np.ndarray:
    return np.full(np.shape(s), 10.0)  # type: ignore[call-overload]


def test_the_circuit_closes_and_has_its_length_and_widths(circuit: Track) -> None:
    first, last = circuit.road.pieces[0], circuit.road.pieces[-1]  # type: ignore[attr-defined]
    assert last.position(last.length_m) == pytest.approx(first.position(0.0), abs=1e-6)
    assert float(last.heading(last.length_m)) == pytest.approx(math.tau, abs=1e-9)
    assert circuit.road.length_m == pytest.approx(LAP_M, abs=1e-6)
    assert not circuit.crossings
    s = np.arange(0.0, LAP_M, 0.5)
    width = circuit.lane().width_m(s)
    assert (width.min(), width.max()) == pytest.approx((9.0, 12.0), abs=1e-9)
    bend = np.abs(circuit.road.curvature(s))
    assert 0.2 < (bend < 1e-6).mean() < 0.7  # straights
    assert bend.max() == pytest.approx(1.0 / 18.0)
    assert np.abs(np.diff(circuit.road.curvature(s))).max() < 0.005  # bends begin gently
    x0, y0, x1, y1 = circuit.floor
    points = np.vstack([paint.polygon_m for paint in (*circuit.paint(), *circuit.roadside)])
    assert (points > (x0 + 10.0, y0 + 10.0)).all()
    assert (points < (x1 - 10.0, y1 - 10.0)).all()


def test_its_width_is_that_of_the_place_in_both_directions(circuit: Track) -> None:
    for lane, s in ((circuit.lane(), 170.0), (circuit.lane("reverse"), LAP_M - 170.0)):
        assert float(lane.width_m(s)) == pytest.approx(9.4)
        middle = lane.centerline.position(s)
        for edge in (lane.left, lane.right):
            assert abs(edge.project(middle)[1]) == pytest.approx(4.7, abs=1e-3)
    start = circuit.lane().centerline.position(50.0)
    assert circuit.lane().left.project(start)[1] == pytest.approx(-6.0, abs=1e-6)


def gaps_of(circuit: Track, name: str) -> list[tuple[float, float]]:
    """Stretches of an edge line without paint, by looking every 0.1 m whether there is paint on the line's middle."""
    edge = getattr(circuit.lane(), name)
    s = np.arange(0.0, edge.length_m, 0.1)
    points, bare = edge.position(s), np.ones(len(s), np.bool_)
    for paint in circuit.paint():
        outline = paint.polygon_m.astype(np.float32)
        near = (points >= outline.min(axis=0)).all(axis=1) & (points <= outline.max(axis=0)).all(axis=1)
        for i in np.flatnonzero(near & bare):
            bare[i] = cv2.pointPolygonTest(outline, points[i].tolist(), False) < 0
    edges = np.flatnonzero(np.diff(np.concatenate(([0], bare.astype(int), [0]))))
    return [(0.1 * a, 0.1 * b) for a, b in edges.reshape(-1, 2).tolist() if b - a > 1]


@pytest.mark.parametrize("name", ["left", "right"])
def test_its_lines_are_broken_as_the_file_says(circuit: Track, name: str) -> None:
    gaps = gaps_of(circuit, name)
    lengths = [end - begin for begin, end in gaps]
    assert 0.05 < sum(lengths) / getattr(circuit.lane(), name).length_m < 0.10
    assert min(lengths) > 1.4  # on the inside of a bend a stretch is shorter than on the reference line
    assert max(lengths) < 19.0
    assert len(gaps) > 8


@pytest.mark.parametrize("seed", range(4))
def test_broken_stretches_have_their_share_and_length(seed: int) -> None:
    broken = BrokenLines(share=0.08, shortest_m=2.0, longest_m=15.0, seed=seed)
    spans = broken_spans(5800.0, broken)
    for line_spans in spans.values():
        lengths = np.diff(line_spans, axis=1)
        assert lengths.sum() / 5800.0 == pytest.approx(0.08, rel=0.15)
        assert lengths.min() >= 2.0
        assert lengths.max() <= 15.0
        begins, ends = np.array(line_spans).T
        assert (begins[1:] - ends[:-1] >= 5.0 - 1e-9).all()
        assert ends[-1] <= 5800.0
    both = set(spans["left"]) & set(spans["right"])
    assert 0.3 < len(both) / len(spans["left"]) < 0.5
    assert spans == broken_spans(5800.0, broken)
    assert spans != broken_spans(5800.0, replace(broken, seed=seed + 1))


def test_broken_stretches_must_find_room() -> None:
    with pytest.raises(ValueError, match=r"share: 0\.3 in pieces of 1\.0 m does not fit a road of 100 m"):
        broken_spans(100.0, BrokenLines(share=0.3, shortest_m=1.0, longest_m=1.0))


def test_a_width_goes_smoothly_through_its_places() -> None:
    places = (WidthAt(s_m=10.0, width_m=9.0), WidthAt(s_m=40.0, width_m=12.0), WidthAt(s_m=80.0, width_m=11.0))
    width = LaneWidth(places, 100.0, closed=True)
    assert width([10.0, 40.0, 80.0, 110.0, -20.0]) == pytest.approx([9.0, 12.0, 11.0, 9.0, 11.0])
    assert float(width(25.0)) == pytest.approx(10.5)  # half way, half the step
    assert float(width(95.0)) == pytest.approx(10.0)  # over the seam
    s = np.linspace(0.0, 100.0, 2001)
    assert (width(s).min(), width(s).max()) == pytest.approx((9.0, 12.0))
    slope = np.gradient(width(s), s)
    assert np.abs(np.diff(slope)).max() < 0.002  # no kink anywhere
    open_width = LaneWidth(places, 100.0, closed=False)
    assert open_width([0.0, 95.0]) == pytest.approx([9.0, 11.0])
    assert LaneWidth(places[:1], 100.0, closed=False)([3.0, 50.0]) == pytest.approx([9.0, 9.0])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("count = 1", "count = 2", "widths: only a single lane may have widths"),
        ("s_m = 95.0", "s_m = 295.0", "widths: s_m: must rise from place to place"),
        ("s_m = 95.0", "s_m = 9500.0", r"\[widths\] s_m: 9500.0 is off the road, 0 .. 1500"),
        ("width_m = 9.4", "width_m = 60.0", "widths: offset_m: folds back at s"),
        ("share = 0.07", "share = 0.5", r"\[broken\] share: expected at most 0.3"),
        ("share = 0.07", "share = 0.0", r"\[broken\] share: expected a positive number, got 0.0"),
        ("longest_m = 15.0", "longest_m = 1.0", r"\[broken\] longest_m: 1.0 is less than shortest_m"),
        ("block_m = 1.0", "block_m = 0.0", r"\[roadside\] block_m: expected a positive number, got 0.0"),
        ("asphalt_m = 0.6", "asphalt = 0.6", r"\[roadside\] asphalt: unknown key"),
    ],
)
def test_wrong_circuits_are_refused(old: str, new: str, words: str) -> None:
    text = TEXT.replace(old, new, 1)
    assert text != TEXT
    with pytest.raises(ConfigError, match=words) as caught:
        parse_track(text, "my.toml")
    assert str(caught.value).startswith("my.toml:")
    assert "\n" not in str(caught.value)


def test_a_stop_line_is_as_broad_as_the_lane_there() -> None:
    text = TEXT + "\n[[stop_lines]]\ns_m = 60.0\nwidth_m = 0.5\n"
    (stop,) = [paint for paint in parse_track(text, "my.toml").paint() if paint.kind == "stop"]
    assert np.ptp(stop.polygon_m[:, 1]) == pytest.approx(12.0 - 0.15, abs=1e-6)


class TestRoadside:
    def test_kerbs_lie_inside_sharp_bends_and_after_them_outside(self) -> None:
        road = arc(0.0, 0.0, 0.0, 1.0 / 30.0, 60.0)  # to the left, about (0, 30)
        kerbs = [p for p in build_roadside(road, ten_wide, RoadsideSection(), 0.15) if p.kind == "kerb"]
        away = np.hypot(*(np.vstack([p.polygon_m for p in kerbs]) - (0.0, 30.0)).T)
        assert (away.min(), away.max()) == pytest.approx((25.0 - 1.075, 25.0 - 0.075), abs=1e-3)
        assert [p.colour for p in kerbs] == ["red", "white"] * 30
        gentle = build_roadside(road, ten_wide, RoadsideSection(kerb_radius_m=29.0), 0.15)
        assert {p.kind for p in gentle} == {"ground"}

    def test_they_go_on_outside_after_the_bend(self, circuit: Track) -> None:
        lane = circuit.lane()
        kerbs = np.array([p.polygon_m.mean(axis=0) for p in circuit.roadside if p.kind == "kerb"][::5])
        feet = np.array([lane.centerline.project(k) for k in kerbs])
        beyond = np.abs(feet[:, 1]) - 0.5 * lane.width_m(feet[:, 0])
        assert beyond == pytest.approx(np.full(len(beyond), 0.575), abs=0.05)
        inside = np.sign(feet[:, 1]) * lane.centerline.curvature(feet[:, 0]) > 1.0 / 61.0
        assert 0.5 < inside.mean() < 0.9
        before = np.array([lane.centerline.curvature(s - np.arange(0.0, 16.0)) for s, _ in feet[~inside]])
        sides = np.sign(feet[~inside, 1])[:, None]
        assert (sides * before < -1.0 / 61.0).any(axis=1).all()

    def test_asphalt_lies_under_the_lane_and_no_further(self, circuit: Track) -> None:
        road, lane = circuit.road, circuit.lane()
        strips = [p.polygon_m.astype(np.float32) for p in circuit.roadside if p.kind == "ground"]
        for s in np.linspace(3.0, LAP_M, 60):
            half = 0.5 * float(lane.width_m(s))
            for d, paved in ((0.0, True), (half + 0.5, True), (-half - 0.5, True), (half + 0.7, False)):
                point = tuple(map(float, road.offset_position(s, d)))
                assert any(cv2.pointPolygonTest(strip, point, False) >= 0 for strip in strips) == paved, (s, d)

    def test_tight_bends_are_paved_to_their_middle_at_most(self) -> None:
        road = arc(0.0, 0.0, 0.0, 1.0 / 5.5, 12.0)
        pieces = build_roadside(road, ten_wide, RoadsideSection(), 0.15)
        inner = np.vstack([p.polygon_m for p in pieces]) - (0.0, 5.5)
        assert np.hypot(*inner.T).min() > 0.2
        assert np.isfinite(inner).all()

    def test_a_straight_road_has_none(self) -> None:
        pieces = build_roadside(line(0.0, 0.0, 0.3, 100.0), ten_wide, RoadsideSection(), 0.15)
        assert [p.kind for p in pieces] == ["ground"] * 5


def render(circuit: Track, look: Appearance, s_m: float, colour: bool = False, **extra: object) -> np.ndarray:
    renderer = Renderer(circuit.paint(), circuit.floor, (), EYE, look, colour=colour, **extra)  # type: ignore[arg-type]
    pose = circuit.lane().pose(s_m)
    return renderer.render(pose.x_m, pose.y_m, pose.yaw_rad)


def seen_at(circuit: Track, s_m: float, ahead_m: float, d_m: float) -> tuple[int, int]:
    """Row and column of the ground `d_m` left of the centerline, `ahead_m` along it."""
    pose = circuit.lane().pose(s_m)
    point = pose.inverse().apply(circuit.road.offset_position(s_m + ahead_m, d_m))
    u, v = EYE.ground_to_px(point).round().astype(int).tolist()
    return v, u


def test_the_ground_beside_is_grass_and_the_kerbs_red_and_white(circuit: Track) -> None:
    look = Appearance(floor_grey=70.0, surround_grey=120.0, marking_grey=220.0)
    grey = render(circuit, look, 60.0, roadside=circuit.roadside)
    assert grey[seen_at(circuit, 60.0, 10.0, 0.0)] == 70
    assert grey[seen_at(circuit, 60.0, 12.0, 6.4)] == pytest.approx(70, abs=2)
    assert grey[seen_at(circuit, 60.0, 14.0, 8.0)] == 120
    flat = render(circuit, look, 60.0)  # without a roadside the floor goes on
    assert flat[seen_at(circuit, 60.0, 14.0, 8.0)] == 70
    kerb = render(circuit, look, 118.0, colour=True, roadside=circuit.roadside)
    colours = [kerb[seen_at(circuit, 118.0, k + 0.5, -5.2)].astype(int) for k in np.arange(12.0, 16.0)]
    redness = [int(c[2] - c[0]) for c in colours]
    assert [r > 60 for r in redness] in ([True, False] * 2, [False, True] * 2)


def test_kerbs_are_no_markings(circuit: Track) -> None:
    look, pose = Appearance(), circuit.lane().pose(118.0)
    with_kerbs, without = (
        Renderer(circuit.paint(), circuit.floor, (), EYE, look, roadside=beside) for beside in (circuit.roadside, ())
    )
    arguments = (pose.x_m, pose.y_m, pose.yaw_rad)
    assert (with_kerbs.render_mask(*arguments) == without.render_mask(*arguments)).all()
    assert (with_kerbs.render(*arguments) != without.render(*arguments)).any()


@pytest.mark.parametrize("style", ["dry", "wet"])
def test_lines_stand_out_in_sun_and_rain(circuit: Track, style: str) -> None:
    pose = circuit.lane().pose(950.0)
    contrast = []
    for seed in range(3):
        look = Appearance.random(seed, style)
        assert look == Appearance.random(seed, style)
        view = Renderer(circuit.paint(), circuit.floor, (), EYE, look, roadside=circuit.roadside)
        picture = view.render(pose.x_m, pose.y_m, pose.yaw_rad)[200:].astype(float)
        mask = view.render_mask(pose.x_m, pose.y_m, pose.yaw_rad)[200:]
        contrast.append(np.median(picture[mask > 200]) - np.median(picture[mask == 0]))
    assert min(contrast) > 15.0
    assert (np.median(contrast) > 60.0) == (style == "dry")


def ring(path: Path) -> Path:
    angle = np.arange(120) / 120 * math.tau
    rows = [f"{95 * math.cos(a):.6f},{95 * math.sin(a):.6f},5.0,5.0" for a in angle]
    path.write_text("\n".join(rows), encoding="utf-8")
    return path


def test_a_csv_track_gets_broken_lines_and_a_roadside_where_asked(tmp_path: Path) -> None:
    path = ring(tmp_path / "ring.csv")
    plain = read_racetrack(path)
    worn = read_racetrack(path, BrokenLines(share=0.1, seed=2), RoadsideSection(kerb_radius_m=100.0))
    assert plain.roadside == ()

    def painted_m2(track: Track) -> float:
        return sum(cv2.contourArea(paint.polygon_m.astype(np.float32)) for paint in track.paint())

    assert painted_m2(worn) / painted_m2(plain) == pytest.approx(0.9, abs=0.025)
    assert {paint.colour for paint in worn.roadside} == {"asphalt", "red", "white"}
