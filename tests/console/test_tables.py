"""Results at 80 columns: every command's real columns are readable, with units, and JSON has all of them."""

from __future__ import annotations

import json

import pytest

from automodel.assembly import replay
from automodel.bench import accuracy, centerline_paper, contour_paper, latency, speed, stereo_paper, tusimple
from automodel.bench.accuracy import AccuracyMeter
from automodel.bench.contour_paper import ClaimMeter
from automodel.bench.faults import measure as faults
from automodel.bench.faults.catalogue import listing
from automodel.bench.windows_paper import WindowsPaperMeter
from automodel.console.tables import SHORT, show, show_tables

METRICS = dict.fromkeys(AccuracyMeter().row(), 1234.5678)
CASE = {"pipeline": "centerline", "track": "chicane", "style": "oscillating", "seed": 12}
RIDE = centerline_paper.ride_row(("A", "oscillating", "wet"), ("centerline", "command"), AccuracyMeter())
WINDOWS = WindowsPaperMeter(m_per_px=0.005, m_per_row=0.01, gate_m=0.2)
CLAIM = {"law": "gradient_descent", "rate_hz": 60, "speed": "+20 %", **ClaimMeter().row()}
RUN = (
    "laps",
    "lap_s",
    "max_abs_offset_m",
    "mae_offset_m",
    "left_lane",
    "estimate_mae_m",
    "misled_pct",
    "bound_exceeded_pct",
    "stops",
    "latency_p50_ms",
    "latency_p99_ms",
)
# command -> a row as wide as its real ones, and its chief columns
COMMANDS: dict[str, tuple[dict[str, object], tuple[str, ...]]] = {
    "run": (dict.fromkeys((*RUN, "frames", "skipped"), 123.456), ()),
    "bench accuracy": ({**CASE, **METRICS}, accuracy.COLUMNS),
    "centerline-paper": ({**dict.fromkeys(RIDE, 1234.5678), **{k: v for k, v in RIDE.items() if v}},
                         centerline_paper.COLUMNS),
    "costs": (centerline_paper.cost_rows([RIDE])[0], ()),
    "windows-paper lines": (WINDOWS.line_rows()[0], ()),
    "windows-paper crossing": (WINDOWS.crossing_row(), ()),
    "windows-paper rates": (WINDOWS.rate_rows()[0], ()),
    "bench contour-paper": (CLAIM, contour_paper.COLUMNS),
    "bench stereo-paper": ({**dict.fromkeys(stereo_paper.COLUMNS, 123.456), "ride": "night, pitch +-1 deg",
                            "pipeline": "centerline"}, stereo_paper.COLUMNS),
    "bench speed": ({"pipeline": "centerline", "stage": "preprocessing", "width_px": 1280, "height_px": 720,
                     "p50_ms": 123.456, "p99_ms": 123.456, "threads": 16}, speed.COLUMNS),
    "bench latency": ({"link": "emulated", "stage": "frame -> write", "samples": 200, "p50_ms": 1.2345,
                       "p99_ms": 1.2345, "max_ms": 1.2345, "clock": "this machine"}, latency.COLUMNS),
    "bench tusimple": ({**dict.fromkeys(tusimple.COLUMNS, 0.98765), "pipeline": "centerline"}, tusimple.COLUMNS),
    "bench faults": ({"fault": "perception-wrong-short", "runs": 300, "violations": 0, "reaction_p50_ms": 123.456,
                      "reaction_max_ms": 123.456, "left_lane": 12, "left_max_m": 0.123, "moved": 3}, faults.COLUMNS),
    "faults --list": (listing(("camera-gone",))[0], ("fault", "kind", "must", "what")),
    "calibrate servo": (dict.fromkeys(("centre_us", "left_deg", "right_deg", "play_deg", "rms_deg", "sd_max_deg",
                        "dead_ms", "dead_sd_ms", "lag_ms", "rate_radps", "holds", "strays", "max_error_deg",
                        "dead_error_ms"), 1234.5), ()),
    "calibrate odometry": (dict.fromkeys(("ticks_per_m", "sd_per_m", "scatter_per_m", "runs", "band_us",
                           "speed_rms_mps", "ticks_error_pct", "speed_error_mps"), 123.456), ()),
    "replay": ({"pipeline": "centerline", "source": "/home/team/recordings/20260101-101010.mcap",
                **dict.fromkeys(replay.COLUMNS[1:-1], 12345)}, replay.COLUMNS),
    "calibrate camera": ({"picture": "picture_012.png", "corners": 54, "tilt_deg": 31, "edge_px": 30.12,
                          "rms_px": 0.123, "left_out_px": 0.123,
                          "note": "used: 12 corners of a part of the board"},
                         ("picture", "rms_px", "left_out_px", "note", "corners")),
    "train": ({"size": "512x256", "steps": 12000, "precision": 0.98765, "recall": 0.98765, "iou": 0.98765,
               "near_precision": 0.98765, "near_recall": 0.98765}, ()),
}  # fmt: skip


@pytest.fixture
def shown(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "80")

    def lines(*arguments, **named) -> list[str]:
        show(*arguments, **named)
        return capsys.readouterr().out.splitlines()

    return lines


@pytest.mark.parametrize("command", COMMANDS)
def test_several_rows_fit_80_columns(command: str, shown) -> None:
    row, columns = COMMANDS[command]
    lines = shown(command, [row, row], False, columns)
    assert max(map(len, lines)) <= 80
    text = " ".join(" ".join(lines).split())
    names = [
        name for name in dict.fromkeys((*columns, *row)) if not columns or name in columns or row[name] is not None
    ]
    cut = text.split("only in --json: ")[1].split(", ") if "only in --json" in text else []
    words = set(text.split("only in --json")[0].split())
    for name in names:  # a column is in the table, or it is named
        assert name in cut or SHORT.get(name.split("_")[0], name.split("_")[0]) in words, name
    assert [name for name in names if name not in cut][:3] == names[:3]  # the chief ones are in the table


@pytest.mark.parametrize("command", COMMANDS)
def test_one_row_is_a_line_a_field(command: str, shown) -> None:
    row, columns = COMMANDS[command]
    lines = shown(command, [row], False, columns)
    assert max(map(len, lines)) <= 80
    fields = [line for line in lines if not line.startswith(" ")]
    expected = [name for name in row if not columns or row[name] is not None or name in columns]
    assert len(fields) == len(expected)


def test_units_are_taken_from_the_names(shown) -> None:
    row = {"lap_s": 12.3456, "offset_mae_m": 0.0123456, "speed_mps": 1.0, "sd_per_m": 3.0, "share_pct": 2.0, "runs": 3}
    assert shown("run", [row], False) == [
        "lap         12.35 s", "offset mae  0.01235 m", "speed       1 m/s", "sd          3 1/m", "share       2 %",
        "runs        3",
    ]  # fmt: skip
    header = " ".join(shown("run", [row, row], False)[:3])
    for unit in ("[s]", "[m]", "[m/s]", "[1/m]", "[%]"):
        assert unit in header


def test_a_table_is_cut_to_its_chief_columns(shown, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [{"name": name, "less": 1, "chief_ms": 2.0, "empty": None} for name in "ab"]
    monkeypatch.setenv("COLUMNS", "13")
    assert shown("run", rows, False, ("name", "chief_ms")) == [
        "      chief", "name   [ms]", "a         2", "b         2", "only in --json: less",
    ]  # fmt: skip
    monkeypatch.setenv("COLUMNS", "80")
    assert shown("run", rows, False, ("name", "chief_ms"))[1].split() == ["name", "[ms]", "less"]


def test_sentences_are_wrapped_and_words_never_cut(shown) -> None:
    path = "/a-long-name/without-a-space" * 4
    rows = [{"name": "x", "what": "several words " * 10}, {"name": "longer", "what": path}]
    head, *lines = shown("run", rows, False)
    assert head == "name    what"
    assert lines[0] == "x       several words" + " several words" * 4
    assert lines[-1] == f"longer  {path}"
    words = "several words" + " several words" * 4
    assert shown("run", rows[:1], False)[1:] == [f"what  {words}", f"      {words}"]


def test_values_for_people_and_for_programs(shown) -> None:
    row = {"found": True, "none_m": None, "large_m": 12345.678, "small": 1.23456e-5}
    assert shown("run", [row], False, ("none_m",)) == ["none   -", "found  yes", "large  12346 m", "small  1.235e-05"]
    (line,) = shown("run", [row], True, ("none_m",))
    assert json.loads(line)["rows"] == [row]
    assert shown("run", [], False) == []


def test_tables_together(capsys: pytest.CaptureFixture[str]) -> None:
    tables = {"one": [{"a": 1}, {"a": 2}], "none": [], "two": [{"b": 3}]}
    show_tables("bench", tables, True, {})
    assert json.loads(capsys.readouterr().out)["rows"] == [
        {"table": "one", "a": 1, "b": None}, {"table": "one", "a": 2, "b": None}, {"table": "two", "a": None, "b": 3},
    ]  # fmt: skip
    show_tables("bench", tables, False, {})
    assert capsys.readouterr().out == "a\n1\n2\n\nb  3\n"


def test_colours_only_on_a_terminal(shown) -> None:
    assert not any("\x1b" in line for line in shown("run", [{"a": 1}, {"a": 2}], False))
