"""`bench page`: drives in real time with open pages, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from automodel.bench.page import COLUMNS, SETTLED_S, Drive


@pytest.mark.realtime
def test_drives_with_and_without_a_page_and_stops(cli) -> None:
    said = cli("bench", "page", "--pipeline", "contour", "--duration", "10", "--rounds", "1", "--pages", "2",
               "--stops", "2", "--json")  # fmt: skip
    assert (said.code, said.err) == (0, "")
    assert [list(row) for row in said.rows] == [list(COLUMNS)] * 3
    without, page, stops = said.rows
    assert [(row["stage"], row["pages"]) for row in said.rows] == [
        ("frame -> write", 0), ("frame -> write", 2), ("STOP -> write", 2)
    ]  # fmt: skip
    assert min(without["samples"], page["samples"]) > 100
    assert stops["samples"] in (1, 2)  # a car that an overloaded machine had stopped already says nothing
    assert "stopped at t = " in stops["ended"]
    assert all(0.0 < row["p50_ms"] <= row["p99_ms"] <= row["max_ms"] for row in said.rows)
    assert without["page_mb"] is None
    assert page["page_mb"] > 10.0


def test_memory_is_told_from_when_a_process_has_settled() -> None:
    drive = Drive(pids=[1, 2], url="", pipe=None)  # type: ignore[arg-type]
    assert drive.memory(0) == (None, None)
    samples = [(0.0, 100.0), (SETTLED_S, 150.0), (2.0 * SETTLED_S, 153.0), (3.0 * SETTLED_S, 149.0)]
    drive.memory_mb = [(t_s, [mb, 10.0]) for t_s, mb in samples]
    assert drive.memory(0) == (150.0, 3.0)
    assert drive.memory(1) == (10.0, 0.0)
    assert drive.memory(2) == (None, None)  # there was no page


def test_a_real_car_is_refused(cli, tmp_path: Path) -> None:
    car = tmp_path / "car.toml"
    car.write_text('[camera]\nsource = "csi"\n[link]\nport = "/dev/ttyUSB0"\n')
    said = cli("bench", "page", "--car", car)
    assert said.code == 2
    assert said.line() == f"automodel: {car}: names a real car; bench page drives the simulated one"


def test_a_drive_that_cannot_begin_says_why(cli) -> None:
    said = cli("bench", "page", "--pipeline", "stereo")
    assert said.code == 2
    assert "needs two cameras" in said.line()
