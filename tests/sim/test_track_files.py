"""Track files and racetracks as CSV; what is wrong with one is refused with file, line, key and reason."""

from __future__ import annotations

import math
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from automodel.config.toml_reader import ConfigError
from automodel.sim.track_files import load_track, parse_track, read_racetrack

GOOD = resources.files("tracks").joinpath("oval.toml").read_text(encoding="utf-8")


def line_of(text: str, fragment: str, nth: int = 0) -> int:
    return [i for i, row in enumerate(text.splitlines(), 1) if fragment in row][nth]


def refused(text: str, line: int | None, *words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_track(text, "my.toml")
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"my.toml:{line}:" if line else "my.toml:"), message
    for word in words:
        assert word in message, message


def test_the_good_file_is_good() -> None:
    assert parse_track(GOOD, "my.toml").name == "oval"


def test_a_gap_is_refused_and_told() -> None:
    text = GOOD.replace("length_m = 3.0", "length_m = 3.0015", 1)
    refused(text, line_of(text, "closed"), "closed", "1.50 mm", "0.000 deg")


def test_a_gap_of_less_than_a_millimetre_is_allowed() -> None:
    assert parse_track(GOOD.replace("length_m = 3.0", "length_m = 3.0008", 1), "my.toml").closed


def test_a_kink_is_refused_and_told() -> None:
    tiny = 'kind = "clothoid"\nstart_per_m = 0.0\nend_per_m = 8.0\nlength_m = 0.0005\n'  # turns 0.002 rad, 0.115 deg
    text = GOOD.replace("radius_m = 1.2\n", "radius_m = 1.2\n", 1) + "\n[[pieces]]\n" + tiny
    text = text.replace("width_m = 0.40", "width_m = 0.10")
    refused(text, line_of(text, "closed"), "closed", "0.115 deg")


def test_an_open_road_need_not_close() -> None:
    text = GOOD.replace("closed = true", "closed = false").replace("length_m = 3.0", "length_m = 3.2", 1)
    assert not parse_track(text, "my.toml").closed


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("width_m = 0.40", "width_m = -0.40", ("[lanes] width_m", "-0.4", "positive")),
        ("width_m = 0.03", "width_m = -0.03", ("[markings.left] width_m", "-0.03", "positive")),
        ("width_m = 0.40", "width_m = nan", ("[lanes] width_m", "nan", "finite")),
        ("x_m = 2.0", "x_m = nan", ("[origin] x_m", "nan", "finite")),
        ("y_m = 0.8", 'y_m = "low"', ("[origin] y_m", "'low'", "finite number")),
        ("width_m = 0.40", "widht_m = 0.40", ("[lanes] widht_m", "unknown key", "did you mean width_m")),
        ("count = 2", "count = 3", ("[lanes] count", "1 or 2")),
        ('style = "solid"', 'style = "wavy"', ("[markings.left] style", "'wavy'", "dashed")),
        ("dash_m = 0.20", "dash_m = 0.0", ("[markings.centre] dash_m", "positive")),
        ('direction = "forward"', 'direction = "back"', ("[start] direction", "'back'", "reverse")),
        ("x1_m = 7.0", "x1_m = -7.0", ("[floor] x1_m", "-7.0", "more than x0_m")),
        ('name = "oval"', 'name = "oval"\nspeed = 3', ("speed", "unknown key")),
        ("closed = true", "closed = 1", ("closed", "true or false")),
    ],
)
def test_wrong_values(old: str, new: str, words: tuple[str, ...]) -> None:
    text = GOOD.replace(old, new, 1)
    assert text != GOOD
    refused(text, line_of(text, new.splitlines()[-1]), *words)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("radius_m = 1.2", "radius_m = nan", ("[pieces] radius_m", "nan", "finite")),
        ("radius_m = 1.2", "radius_m = -1.2", ("[pieces] radius_m", "positive")),
        ("radius_m = 1.2", "radius_m = 0.4", ("[pieces] radius_m", "radius 0.4 m", "0.8 m wide")),
        ("radius_m = 1.2", "radius = 1.2", ("[pieces] radius", "unknown key", "did you mean radius_m")),
        ('kind = "arc"', 'kind = "bend"', ("[pieces] kind", "'bend'", "line, arc, clothoid")),
        ("turn_rad = 3.14", "turn_rad = 0.0 # 3.14", ("[pieces] turn_rad", "0")),
    ],
)
def test_wrong_pieces_are_named_by_their_own_line(old: str, new: str, words: tuple[str, ...]) -> None:
    head, middle, tail = GOOD.rpartition(old)  # the last piece: its line, not the first one's, must be told
    text = head + new + tail
    assert middle
    refused(text, text[: len(head)].count("\n") + 1, *words)


def test_a_clothoid_that_folds_the_edge_is_refused() -> None:
    text = GOOD + '\n[[pieces]]\nkind = "clothoid"\nstart_per_m = 0.0\nend_per_m = -2.5\nlength_m = 0.1\n'
    refused(text, line_of(text, "start_per_m"), "[pieces] start_per_m", "radius 0.4 m")


def test_a_missing_key_is_named() -> None:
    text = GOOD.replace("closed = true\n", "")
    refused(text, None, "closed is missing")
    text = GOOD.replace("radius_m = 1.2\n", "", 1)
    refused(text, line_of(text, "[[pieces]]", 1), "[pieces]", "radius_m is missing")


def test_no_pieces() -> None:
    refused(GOOD[: GOOD.index("[[pieces]]")], None, "pieces", "expected at least one")
    refused("pieces = []\n" + GOOD[: GOOD.index("[[pieces]]")], 1, "pieces", "expected at least one")
    refused("pieces = 3\n" + GOOD[: GOOD.index("[[pieces]]")], 1, "pieces", "[[pieces]]")


def test_a_centre_line_in_a_single_lane_is_refused() -> None:
    text = GOOD.replace("count = 2", "count = 1")
    refused(text, line_of(text, 'style = "dashed"'), "[markings.centre] style", "single lane")


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("[[stop_lines]]\ns_m = 99.0\n", ("[stop_lines] s_m", "99.0", "off the road")),
        ("[[gaps]]\nfrom_m = 2.0\nto_m = 1.0\n", ("[gaps] to_m", "more than from_m")),
        ('[[gaps]]\nfrom_m = 1.0\nto_m = 2.0\nlines = ["middle"]\n', ("[gaps] lines", "'middle'", "centre")),
        ("[[obstacles]]\nx_m = 1.0\ny_m = 1.0\nwidth_m = -0.1\n", ("[obstacles] width_m", "positive")),
        ("[[obstacles]]\nx_m = 1.0\ny_m = 1.0\ngrey = 300\n", ("[obstacles] grey", "0 .. 255")),
    ],
)
def test_wrong_things_on_the_road(entry: str, words: tuple[str, ...]) -> None:
    key = words[0].split()[1]
    text = f"{GOOD}\n{entry}"
    line = next(i for i, row in enumerate(text.splitlines(), 1) if row.startswith(key) and i > GOOD.count("\n"))
    refused(text, line, *words)


def test_pieces_may_be_written_in_line() -> None:
    head = GOOD[: GOOD.index("[[pieces]]")].replace("closed = true", "closed = false")
    track = parse_track('pieces = [{kind = "line", length_m = 2.0}]\n' + head, "my.toml")
    assert track.road.length_m == pytest.approx(2.0)
    refused('pieces = [{kind = "line", length_m = -2.0}]\n' + head, 1, "pieces", "length_m", "positive")


def test_not_toml() -> None:
    refused(GOOD.replace("closed = true", "closed = yes please"), 4, "not TOML")


def test_no_such_track_names_the_shipped_ones() -> None:
    with pytest.raises(ConfigError, match=r"^tnr: no such track; expected one of chicane, circuit, oval, ring, tmr"):
        load_track("tnr")


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"mine\.toml: no such file"):
        load_track(tmp_path / "mine.toml")


def test_a_track_of_ones_own_is_found_by_its_path(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(GOOD.replace('name = "oval"', 'name = "mine"'), encoding="utf-8")
    assert load_track(path).name == "mine"
    assert load_track(str(path)).name == "mine"


HEADER = "# x_m,y_m,w_tr_right_m,w_tr_left_m\n"


def ring(right_m: float = 3.0, left_m: float = 5.0, radius_m: float = 60.0, count: int = 72) -> str:
    """A circle driven anticlockwise, 5 m steps, its line not in the middle between the edges."""
    angle = np.arange(count) / count * math.tau
    rows = [f"{radius_m * math.cos(a):.6f},{radius_m * math.sin(a):.6f},{right_m},{left_m}" for a in angle]
    return HEADER + "\n".join(rows) + "\n"


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "ring.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_centerline_is_the_middle_between_the_edges(tmp_path: Path) -> None:
    track = load_track(write(tmp_path, ring()))  # edges at radii 55 (left) and 63
    assert track.name == "ring"
    lane = track.lane()
    assert lane.centerline.length_m == pytest.approx(math.tau * 59.0, rel=1e-5)
    s = np.linspace(0.0, lane.centerline.length_m, 50)
    assert np.hypot(*lane.centerline.position(s).T) == pytest.approx(np.full(50, 59.0), abs=1e-3)
    assert lane.width_m(s) == pytest.approx(np.full(50, 8.0), abs=1e-3)
    for line, radius in ((lane.left, 55.0), (lane.right, 63.0)):
        points = line.position(np.linspace(0.0, line.length_m, 50))
        assert np.hypot(*points.T) == pytest.approx(np.full(50, radius), abs=2e-3)


def test_reverse_turns_everything_round(tmp_path: Path) -> None:
    track = read_racetrack(write(tmp_path, ring()))
    lane = track.lane("reverse")
    assert lane.left.length_m == pytest.approx(math.tau * 63.0, rel=1e-4)
    assert float(lane.centerline.curvature(3.0)) == pytest.approx(-1 / 59.0, rel=1e-3)


def test_varying_width_is_that_of_the_place_in_both_directions(tmp_path: Path) -> None:
    rows = ring(count=72).splitlines()
    wide = [row.replace(",3.0,5.0", ",4.0,6.0") if 30 <= i <= 40 else row for i, row in enumerate(rows)]
    track = read_racetrack(write(tmp_path, "\n".join(wide)))
    forward, reverse = track.lane("forward"), track.lane("reverse")
    s = float(forward.centerline.project((-58.0, 0.0))[0])  # row 36 + 1 of 72: half way round
    assert float(forward.width_m(s)) == pytest.approx(10.0, abs=0.05)
    assert float(reverse.width_m(forward.centerline.length_m - s)) == pytest.approx(float(forward.width_m(s)))
    assert float(forward.width_m(0.0)) == pytest.approx(8.0, abs=0.05)


def test_paint_is_two_white_edge_lines_in_pieces_of_20_m(tmp_path: Path) -> None:
    track = read_racetrack(write(tmp_path, ring()))
    assert {(paint.kind, paint.colour) for paint in track.paint()} == {("line", "white")}
    assert max(float(np.ptp(paint.polygon_m, axis=0).max()) for paint in track.paint()) <= 20.2
    radii = np.concatenate([np.hypot(*paint.polygon_m.T) for paint in track.paint()])
    away = np.minimum(np.abs(np.abs(radii - 55.0) - 0.075), np.abs(np.abs(radii - 63.0) - 0.075))
    assert away.max() < 5e-3


def test_a_repeated_closing_point_and_a_missing_header_are_fine(tmp_path: Path) -> None:
    rows = ring().splitlines()[1:]
    track = read_racetrack(write(tmp_path, "\n".join([*rows, rows[0]])))
    assert track.road.length_m == pytest.approx(math.tau * 59.0, rel=1e-5)


def test_a_hairpin_too_tight_for_its_width_is_made_narrower(tmp_path: Path) -> None:
    straight = [(x, 0.0) for x in range(0, 100, 5)] + [(100 + 8 * math.sin(a), 8 - 8 * math.cos(a)) for a in (0.6, 1.2)]
    straight += [(108, 8)] + [(100 + 8 * math.sin(a), 8 - 8 * math.cos(a)) for a in (1.94, 2.54)]
    back = [(x, 16.0) for x in range(100, 0, -5)] + [(8 * math.sin(a), 8 - 8 * math.cos(a)) for a in (3.7, 4.7, 5.7)]
    text = HEADER + "\n".join(f"{x},{y},7.9,7.9" for x, y in straight + back)
    lane = read_racetrack(write(tmp_path, text)).lane()
    s = np.linspace(0.0, lane.centerline.length_m, 2000)
    width = lane.width_m(s)
    assert width.min() < 14.0
    assert (np.abs(lane.centerline.curvature(s)) * 0.5 * width < 1.0).all()
    assert float(lane.width_m(50.0)) == pytest.approx(15.8, abs=0.1)


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("1.0,2.0,3.0", r"ring\.csv:5: expected the columns x_m,y_m,w_tr_right_m,w_tr_left_m, got 3"),
        ("1.0,2.0,wide,3.0", r"ring\.csv:5: w_tr_right_m: 'wide' is not a number"),
        ("1.0,nan,3.0,3.0", r"ring\.csv:5: y_m: expected a finite number, got nan"),
        ("1.0,2.0,-3.0,3.0", r"ring\.csv:5: w_tr_right_m, w_tr_left_m: .* negative"),
        ("1.0,2.0,0.0,0.0", r"ring\.csv:5: w_tr_right_m, w_tr_left_m: .* both be 0"),
        ("REPEAT", r"ring\.csv:5: repeats the point"),
    ],
)
def test_a_wrong_row_is_named(tmp_path: Path, row: str, words: str) -> None:
    rows = ring().splitlines()
    rows[4] = rows[3] if row == "REPEAT" else row
    with pytest.raises(ConfigError, match=words):
        load_track(write(tmp_path, "\n".join(rows)))


def test_too_few_points(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"ring\.csv: expected at least 4 lines of .*, got 2"):
        load_track(write(tmp_path, "\n".join(ring().splitlines()[:3])))


def test_no_such_racetrack(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.csv: no such file"):
        load_track(tmp_path / "none.csv")


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "length_m"), [("Monza", 5790), ("Zandvoort", 4320), ("Norisring", 2300), ("BrandsHatch", 3910)]
)
def test_real_tracks(data_root: Path, name: str, length_m: float) -> None:
    path = data_root / "racetracks" / f"{name}.csv"
    track = load_track(path)
    assert track.road.length_m == pytest.approx(length_m, rel=5e-3)
    rows = np.loadtxt(path, delimiter=",")
    # the edges of the file, by differences along its line instead of a spline's normals
    along = np.roll(rows[:, :2], -1, axis=0) - np.roll(rows[:, :2], 1, axis=0)
    normal = np.stack((-along[:, 1], along[:, 0]), axis=-1) / np.hypot(*along.T)[:, None]
    lane = track.lane()
    for line, edge in (
        (lane.left, rows[:, :2] + rows[:, 3:4] * normal),
        (lane.right, rows[:, :2] - rows[:, 2:3] * normal),
    ):
        points = line.position(np.linspace(0.0, line.length_m, 10_000))
        away = np.array([np.hypot(*(points - e).T).min() for e in edge[::5]])
        assert np.median(away) < 0.2
        assert np.quantile(away, 0.9 if name == "Norisring" else 1.0) < 0.3  # its hairpins are made narrower
