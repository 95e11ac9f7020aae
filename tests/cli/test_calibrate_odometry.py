"""`calibrate odometry` as a user runs it."""

from __future__ import annotations

import dataclasses
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from automodel.assembly import calibration_rigs
from automodel.config import load_car
from automodel.runtime.clocks import VirtualClock
from automodel.sim.plant import PlantConfig
from calibration import odometry_dialogue
from calibration.drive import Rig, Ticks
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.logic import BoardOptions
from firmware_link.emulator.pty import BenchPeripherals
from firmware_link.transport import MemoryTransport
from tests.support.calibrated_cars import during, untouched
from tests.support.wide_limits import WIDE_LIMITS


def test_odometry_dialoguen(car: Path, at_rest: Callable[[], bool], cli) -> None:
    said = cli("calibrate", "odometry", "--car", car, "--distance-m", 3, "--seed", 2, "--json")
    assert said.code == 0, said.err
    (row,) = said.rows
    assert abs(row["ticks_error_pct"]) < 0.5
    assert row["speed_error_mps"] < 0.03
    written = load_car(car)
    assert written.vehicle.ticks_per_m == pytest.approx(row["ticks_per_m"], abs=0.01)
    assert written.link.motor.speed_mps[0] == -4.0  # backwards nothing was driven
    assert "[calibration.odometry]" in car.read_text()
    assert (car.parent / "calibration_pictures" / "odometry.png").stat().st_size > 5_000
    assert at_rest()


def test_odometry_counted(car: Path, cli) -> None:
    said = cli("calibrate", "odometry", "--car", car, "--distance-m", 4, "--ticks", 800, "--ticks", 804)
    assert said.code == 0, said.err
    assert load_car(car).vehicle.ticks_per_m == 200.5
    assert load_car(car).link.motor == load_car(car.parent / "car.toml.bak").link.motor


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--ticks", "800", "--ticks", "640"), "measure again"),
        (("--speeds", "0.5,9"), "--speeds 9.0: above [safety] speed_max_mps"),
        (("--speeds", "slow"), "expected positive numbers with commas between"),
        (("--push",), "--push: nobody can push a simulated car"),
    ],
)
def test_odometry_that_tells_nothing(arguments: tuple[str, ...], told: str, car: Path, cli) -> None:
    said = cli("calibrate", "odometry", "--car", car, "--distance-m", 4, *arguments)
    assert said.code == 2
    assert told in said.err.splitlines()[-1]
    assert untouched(car)


def test_odometry_interrupted(car: Path, at_rest: Callable[[], bool], monkeypatch: pytest.MonkeyPatch, cli) -> None:
    during(monkeypatch, 3.0, lambda: os.kill(os.getpid(), signal.SIGINT))
    said = cli("calibrate", "odometry", "--car", car, "--distance-m", 4)
    assert said.code == 1
    assert said.err.splitlines()[-1] == "automodel calibrate odometry: stopped by SIGINT; nothing was written"
    assert at_rest()
    assert untouched(car)


def test_a_motor_that_does_not_move_the_car(car: Path, monkeypatch: pytest.MonkeyPatch, cli) -> None:
    def stuck(seed: int, plant: PlantConfig) -> PlantConfig:
        return dataclasses.replace(
            plant, motor=dataclasses.replace(plant.motor, speed_mps=(-1e-6, 0.0, 1e-6)), ticks_per_m=200.0
        )

    monkeypatch.setattr(odometry_dialogue, "randomised_motor", stuck)
    said = cli("calibrate", "odometry", "--car", car, "--distance-m", 1)
    assert said.code == 2
    assert untouched(car)


def test_a_board_that_says_neither_pulses_nor_ticks(tmp_path: Path, cli) -> None:
    path = tmp_path / "car.toml"
    path.write_text('[link]\nkind = "autonomos"\nport = "/dev/ttyUSB0"\n')
    for command in (("servo", "--auto", "--arm"), ("odometry", "--distance-m", 4)):
        said = cli("calibrate", *command, "--car", path)
        assert said.code == 2
        assert 'only the board with kind = "arduino" reports' in said.line()
    assert cli("calibrate", "odometry", "--distance-m", 4, "--ticks", 800, "--car", path).code == 0


def test_odometry_pushed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli) -> None:
    path = tmp_path / "car.toml"
    path.write_text('[camera]\nsource = "usb"\n[link]\nport = "/dev/ttyUSB0"\n')
    bench = BenchPeripherals()
    board = EmulatedArduino(bench, options=BoardOptions(limits=WIDE_LIMITS))
    clock = VirtualClock(0, board.advance)
    ticks = iter((5, 805, 805, 1607))

    def rig(car, *_: object) -> Rig:
        transport = MemoryTransport(board, clock)
        return calibration_rigs.rig_on(car, transport, clock, Ticks(clock), auto_arm=False, plant=None)

    class Key:
        def __init__(self, says: str) -> None:
            self.turns = 0

        def __enter__(self) -> Key:
            return self

        def __exit__(self, *error: object) -> None: ...

        def pressed(self) -> bool:
            """Pushed to the next mark, then a second later Enter."""
            self.turns += 1
            if self.turns % 100 == 50:
                bench.sensors = dataclasses.replace(bench.sensors, wheel_ticks=next(ticks))
            return self.turns % 100 == 0

    monkeypatch.setattr(calibration_rigs, "real_rig", rig)
    monkeypatch.setattr(odometry_dialogue, "ArmKey", Key)
    monkeypatch.setattr(odometry_dialogue, "has_terminal", lambda: True)
    said = cli("calibrate", "odometry", "--push", "--runs", 2, "--distance-m", 4, "--car", path)
    assert said.code == 0, said.err
    assert load_car(path).vehicle.ticks_per_m == pytest.approx((800 + 802) / 8.0, abs=0.01)
    assert "run 2 of 2: 802 ticks" in said.err
    assert {pins[1:] for pins in bench.pulses} == {(1500.0, 1500.0)}
    assert not board.armed
