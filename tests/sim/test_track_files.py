"""Track files that are wrong: refused with file, line, key and reason."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import pytest

from automodel.config.toml_reader import ConfigError
from automodel.sim.track_files import load_track, parse_track

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
    with pytest.raises(ConfigError, match=r"^tnr: no such track; expected one of chicane, circuit, oval, tmr"):
        load_track("tnr")


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"mine\.toml: no such file"):
        load_track(tmp_path / "mine.toml")


def test_a_track_of_ones_own_is_found_by_its_path(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(GOOD.replace('name = "oval"', 'name = "mine"'), encoding="utf-8")
    assert load_track(path).name == "mine"
    assert load_track(str(path)).name == "mine"
