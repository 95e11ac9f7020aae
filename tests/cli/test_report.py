"""`automodel report` from recorded runs and images to a page."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest


def test_a_recorded_run_with_its_truth_and_another_pipeline(driven: Path, tmp_path: Path, cli) -> None:
    page = tmp_path / "report.html"
    truth = ["--truth", driven / "truth.csv", "--pipeline", "windows"]
    said = cli("report", driven / "run.mcap", *truth, "--html", page, "--json")
    assert said.code == 0, said.err
    recorded, windows = said.rows
    assert (recorded["pipeline"], windows["pipeline"]) == ("recorded", "windows")
    assert recorded["frames"] == windows["frames"] == 120
    assert windows["misled_pct"] == 0.0
    assert windows["offset_mae_m"] < 0.02
    assert windows["disagreement_p99_m"] < 0.05
    text = page.read_text(encoding="utf-8")
    assert text.count("data:image/jpeg") >= 2
    assert "drifts" not in text  # the map is the truth's

    part = cli("report", driven / "run.mcap", "--from", 0.5, "--to", 1.0, "--html", page, "--json")
    assert part.rows[0]["frames"] == pytest.approx(31, abs=1)
    assert "drifts" in page.read_text(encoding="utf-8")


def test_the_results_of_a_bench_stand_beside_a_run(driven: Path, tmp_path: Path, cli) -> None:
    bench, page = tmp_path / "speed.json", tmp_path / "report.html"
    bench.write_text(
        json.dumps({"version": "0", "command": "bench speed", "rows": [{"stage": "<all>\ud800", "p50_ms": 1.25}]})
    )
    truth = ["--truth", driven / "truth.csv"]
    said = cli("report", bench, driven / "run.mcap", *truth, "--to", 0.3, "--html", page, "--json")
    assert said.code == 0, said.err
    assert [row["run"] for row in said.rows] == ["run.mcap"]
    text = page.read_text(encoding="utf-8")
    for shown in ("Worst moments", "automodel bench speed", "p50 [ms]", "&lt;all&gt;", ">1.25<"):
        assert shown in text

    alone = cli("report", bench, "--html", page, "--json")
    assert (alone.code, alone.rows) == (0, [])
    assert "Worst moments" not in page.read_text(encoding="utf-8")


@pytest.mark.slow
def test_pipelines_of_one_camera_and_of_two_on_the_same_frames(tmp_path: Path, cli) -> None:
    car, run, page = tmp_path / "car.toml", tmp_path / "run.mcap", tmp_path / "report.html"
    assert cli("init", "sim-stereo", "--out", car).code == 0
    assert cli("run", "--car", car, "--track", "tmr", "--duration", 0.5, "--record", run).code == 0
    names = ("stereo", "contour")
    said = cli("report", run, *(word for name in names for word in ("--pipeline", name)), "--html", page, "--json")
    assert said.code == 0, said.err
    assert [row["pipeline"] for row in said.rows] == ["recorded", *names]
    assert min(row["availability_pct"] for row in said.rows) > 80.0
    assert page.read_text(encoding="utf-8").count("data:image/jpeg") >= 3


@pytest.mark.parametrize(
    ("arguments", "said_line"),
    [
        ("run.mcap --html folder", "automodel: --html folder: is a folder; give the name of a file"),
        ("run.mcap --html run.mcap", "automodel: --html run.mcap: is the same file as RUN 1; choose another name"),
        ("missing.mcap --html x.html", "automodel: missing.mcap: no such file"),
        (
            "run.mcap --from 50 --html x.html",
            "automodel: run.mcap: no frames between --from 50 and --to inf s",
        ),
        (
            "run.mcap run.mcap --truth truth.csv --html x.html",
            "automodel report: --truth and --motion belong to one RUN; give one (see automodel report --help)",
        ),
        (
            "run.mcap --truth text.csv --html x.html",
            "automodel: text.csv:2: expected numbers in frame,offset_m,x_m,y_m,t_s, as run --truth writes",
        ),
        (
            "text.json --truth truth.csv --html x.html",
            "automodel report: --truth and --motion belong to one RUN; give one (see automodel report --help)",
        ),
        (
            "run.mcap text.json --html x.html",
            "automodel: text.json: not a JSON file; expected what automodel bench ... --json prints",
        ),
        ("run.mcap --truth folder --html x.html", "automodel: folder: cannot be read: Is a directory"),
        (
            "run.mcap --truth other.csv --html x.html",
            "automodel: other.csv: has none of the run's frames; is it the truth.csv of another run?",
        ),
    ],
)
def test_what_is_wrong_is_one_line_and_writes_nothing(
    arguments: str, said_line: str, driven: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(driven / "run.mcap", "run.mcap")
    shutil.copy(driven / "truth.csv", "truth.csv")
    Path("folder").mkdir()
    Path("text.json").write_text("none")
    Path("text.csv").write_text("frame,offset_m\nx,y\n")
    Path("other.csv").write_text("t_s,frame,offset_m,x_m,y_m\n0,99999,0,0,0\n")
    said = cli("report", *arguments.split())
    assert (said.code, said.out, said.line()) == (2, "", said_line)
    assert not Path("x.html").exists()
