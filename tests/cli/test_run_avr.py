"""`automodel run --link avr`: the simulated car driven by the firmware itself."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from automodel.recording.reader import Recording
from automodel.signals import VehicleState
from firmware_link.emulator import avr


@pytest.fixture
def toolchain() -> None:
    missing = avr.missing_tools()
    if missing:
        pytest.skip(f"{', '.join(missing)}: missing for the simulated AVR; apt-get install {avr.PACKAGES}")


@pytest.mark.slow
def test_a_lap_is_driven_by_the_firmware(toolchain: None, cli) -> None:
    said = cli("run", "--laps", "1", "--track", "oval", "--link", "avr", "--json")
    assert (said.code, said.line()) == (0, "drove 1 lap and stayed in its lane")
    (row,) = said.rows
    assert (row["laps"], row["left_lane"], row["stops"]) == (1, 0, 0)
    assert row["mae_offset_m"] <= row["max_abs_offset_m"] <= 0.10


def test_the_same_seed_gives_the_same_run_to_the_last_bit(toolchain: None, cli, tmp_path: Path) -> None:
    truths = []
    for name in ("one.csv", "two.csv"):
        arguments = ["--track", "oval", "--pipeline", "windows", "--duration", "2", "--seed", "3", "--link", "avr"]
        assert cli("run", *arguments, "--truth", tmp_path / name).code == 0
        truths.append((tmp_path / name).read_bytes())
    assert truths[0] == truths[1]
    first, *_, last = [line.split(",") for line in truths[0].decode().splitlines()[1:]]
    assert first[6:] != last[6:]  # it drove


def test_what_the_firmware_says_is_recorded(toolchain: None, cli, tmp_path: Path) -> None:
    recording = tmp_path / "run.mcap"
    run = ["run", "--track", "oval", "--pipeline", "windows", "--duration", "2.5", "--link", "avr"]
    assert cli(*run, "--record", recording).code == 0
    states = [m.value for m in Recording(recording) if isinstance(m.value, VehicleState)]
    assert states[-1].armed
    assert states[-1].faults == ()
    assert states[-1].boot_id == 1  # the first start of a chip with a blank EEPROM
    assert states[-1].speed_mps == pytest.approx(1.0, abs=0.1)
    assert states[-1].battery_v == pytest.approx(7.6, abs=0.05)
    assert any(abs(state.yaw_rate_radps or 0.0) > 0.05 for state in states)


def test_a_missing_toolchain_is_one_line_that_says_what_to_install(cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda tool: None if tool == "avr-g++" else f"/usr/bin/{tool}")
    monkeypatch.setattr(avr, "_has_header", lambda compiler, name: name != "simavr/sim_avr.h")
    said = cli("run", "--link", "avr", "--duration", "1")
    assert said.code == 2
    assert said.line() == (
        "automodel: avr-g++, simavr/sim_avr.h: missing for the simulated AVR; "
        "apt-get install make gcc gcc-avr avr-libc libsimavr-dev libelf-dev"
    )


def test_an_installed_package_has_no_simulator(cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(avr, "FIRMWARE", tmp_path)
    said = cli("run", "--link", "avr", "--duration", "1")
    assert said.code == 2
    assert said.line().endswith("the simulated AVR is not part of the installed package, use a checkout")


def test_a_simulator_that_does_not_compile_is_one_line(
    toolchain: None, cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "simavr").mkdir()
    (tmp_path / "Makefile").write_text("%:\n\t@echo 'x.cpp:1: error: no such thing' >&2; false\n")
    monkeypatch.setattr(avr, "FIRMWARE", tmp_path)
    said = cli("run", "--link", "avr", "--duration", "1")
    assert said.code == 2
    assert said.line() == "automodel: firmware.elf: cannot be built: x.cpp:1: error: no such thing"


def test_link_is_for_the_simulated_car(cli, tmp_path: Path) -> None:
    car = tmp_path / "car.toml"
    car.write_text('[camera]\nsource = "usb"\n[link]\nport = "/dev/nowhere"\n')
    said = cli("run", "--car", car, "--link", "avr")
    assert said.code == 2
    assert said.line().startswith("automodel: --link: is for the simulated car")
