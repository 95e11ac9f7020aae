from __future__ import annotations

from pathlib import Path

import pytest

from firmware_link.emulator import avr

KEYS = ["link", "stage", "samples", "p50_ms", "p99_ms", "max_ms", "clock"]
QUICK = ("bench", "latency", "--pipeline", "windows", "--frames", "60", "--json")


def check(rows: list[dict], link: str, commands: int) -> None:
    assert [list(row) for row in rows] == [KEYS, KEYS]
    assert [row["stage"] for row in rows] == ["frame -> write", "write -> pulse"]
    assert {row["link"] for row in rows} == {link}
    assert all(0 < row["p50_ms"] <= row["p99_ms"] <= row["max_ms"] for row in rows)
    applied = rows[1]
    assert (applied["samples"], applied["clock"]) == (commands, "board")
    # A servo frame of 20 ms in any phase, with the line, the loop and the pulse of 1.5 ms: 3 to 23 ms and some.
    assert applied["p99_ms"] <= 25.0
    assert applied["max_ms"] > 15.0
    assert 8.0 < applied["p50_ms"] < 18.0


def test_the_emulated_board(cli) -> None:
    said = cli(*QUICK, "--commands", "40")
    assert (said.code, said.err) == (0, "")
    check(said.rows, "emulated", 40)


@pytest.mark.slow
def test_the_firmware_on_a_simulated_chip(cli) -> None:
    missing = avr.missing_tools()
    if missing:
        pytest.skip(f"{', '.join(missing)}: missing for the simulated AVR; apt-get install {avr.PACKAGES}")
    said = cli(*QUICK, "--link", "avr", "--commands", "200")
    assert (said.code, said.err) == (0, "")
    check(said.rows, "avr", 200)


def test_a_car_with_other_firmware_is_refused(cli, tmp_path: Path) -> None:
    car = tmp_path / "car.toml"
    car.write_text('[link]\nkind = "autonomos"\n')
    said = cli("bench", "latency", "--car", car)
    assert said.code == 2
    assert said.line() == (f"automodel: {car}: [link] kind 'autonomos': only a board with our firmware can be measured")
