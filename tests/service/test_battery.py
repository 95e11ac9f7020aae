from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from automodel.runtime.run_types import TickRecord
from automodel.service import battery
from automodel.service.battery import FLAG, LASTING_S, LowBattery
from automodel.signals import VehicleState
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.pty import BenchPeripherals, PtyBoard
from tests.service.test_notify import record
from tests.support.command_line import Cli, cli
from tests.support.fake_cars import StillCamera, car_toml, road

__all__ = ["cli"]
S = 1_000_000_000


def cycle(t_s: float, low: bool) -> TickRecord:
    faults = ("command_timeout", "battery_low") if low else ("command_timeout",)
    return dataclasses.replace(record(), t_ns=round(t_s * S), state=VehicleState(t_ns=0, battery_v=6.1, faults=faults))


def test_a_battery_that_stays_low_ends_the_run_and_flags_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    watch = LowBattery(tmp_path)
    for t_s in range(100, 100 + int(LASTING_S)):
        watch.on_tick(cycle(t_s, low=True))
        assert not watch.over()
    watch.on_tick(cycle(100 + LASTING_S, low=True))
    assert watch.over()
    assert (tmp_path / FLAG).exists()
    assert capsys.readouterr().err == "the battery has been low for 10 s (6.10 V): the run ends; charge it\n"


def test_a_battery_that_recovers_and_a_vehicle_that_says_nothing_end_nothing(tmp_path: Path) -> None:
    watch = LowBattery(tmp_path)
    for t_s in range(1000):
        watch.on_tick(cycle(t_s, low=t_s % 10 != 0))
    for t_s in range(1000, 1100):
        watch.on_tick(dataclasses.replace(cycle(t_s, low=True), state=None))
    assert not watch.over()
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_ends_the_run_all_the_same(tmp_path: Path) -> None:
    watch = LowBattery(tmp_path / "missing")
    watch.on_tick(cycle(0, low=True))
    watch.on_tick(cycle(LASTING_S, low=True))
    assert watch.over()


@pytest.mark.slow
@pytest.mark.realtime
def test_a_run_ends_when_the_boards_battery_stays_low(tmp_path: Path, monkeypatch, cli: Cli) -> None:
    image = road()
    monkeypatch.setattr("automodel.assembly.drive.make_camera", lambda car: StillCamera(image))
    monkeypatch.setattr(battery, "LASTING_S", 0.5)
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    bench = BenchPeripherals()
    bench.sensors = dataclasses.replace(bench.sensors, battery_v=5.9)
    with PtyBoard(EmulatedArduino(bench, 115200)) as port:
        said = cli("run", "--car", car_toml(tmp_path, port.path), "--until-battery-low", "--duration", "60")
    assert "the battery has been low for 0.5 s (5.9" in said.err
    assert (tmp_path / FLAG).exists()
    assert said.code == 0
