"""`calibrate servo --auto` as a user runs it, on simulated cars that hide what they are."""

from __future__ import annotations

import dataclasses
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from automodel.assembly import calibration_rigs
from automodel.config import ServoConfig, load_car
from automodel.sim.plant import CarState, Plant, Ranges
from calibration import servo_drive
from calibration.drive import DrivePlan, Leg
from tests.support.calibrated_cars import SIMULATED, during, untouched


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two seconds of driving in place of the whole sweep."""
    legs = (Leg(duration_s=1.0, steering=1500.0, speed_mps=0.0), Leg(duration_s=2.0, steering=1400.0, speed_mps=0.5))
    monkeypatch.setattr(servo_drive, "servo_plan", lambda low, high, speed: DrivePlan(legs))


def test_a_drive_writes_table_delay_record_and_picture(car: Path, pins: list, at_rest: Callable[[], bool], cli) -> None:
    said = cli("calibrate", "servo", "--auto", "--car", car, "--seed", 4, "--json")
    assert said.code == 0, said.err
    (row,) = said.rows
    assert row["max_error_deg"] <= 0.5
    assert abs(row["dead_error_ms"]) <= 10.0
    assert row["play_deg"] == pytest.approx(2.0, abs=0.3)
    text = car.read_text()
    assert text.startswith(SIMULATED)  # comments kept
    assert "[calibration.servo]" in text
    assert f"play {row['play_deg']:.1f} deg" in text
    assert (car.parent / "car.toml.bak").read_text() == SIMULATED
    written = load_car(car)
    assert written.link.servo.pulse_us[0] >= 1050.0
    assert max(written.link.servo.steering_rad) == pytest.approx(row["left_deg"] * 0.0174533, abs=1e-3)
    assert written.control.actuator_delay_s == pytest.approx((row["dead_ms"] + row["lag_ms"]) * 1e-3 + 0.022, abs=1e-3)
    assert (car.parent / "calibration_pictures" / "servo.png").stat().st_size > 10_000
    assert at_rest()
    assert max(motor for _, _, motor in pins) == 1550.0


def test_without_a_car_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, short: None, cli) -> None:
    monkeypatch.chdir(tmp_path)
    said = cli("calibrate", "servo", "--auto", "--sim")
    assert said.code == 2  # the short drive tells no table
    assert "pulses that were driven for long enough" in said.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_leaves_the_car_neutral_and_the_file_alone(
    name: str, car: Path, at_rest: Callable[[], bool], short: None, monkeypatch: pytest.MonkeyPatch, cli
) -> None:
    during(monkeypatch, 3.0, lambda: os.kill(os.getpid(), getattr(signal, name)))
    said = cli("calibrate", "servo", "--auto", "--car", car)
    assert said.code == 1
    assert said.err.splitlines()[-1] == f"automodel calibrate servo: stopped by {name}; nothing was written"
    assert at_rest()
    assert untouched(car)


def test_an_error_in_the_drive_leaves_the_car_neutral(
    car: Path, at_rest: Callable[[], bool], short: None, monkeypatch: pytest.MonkeyPatch, cli
) -> None:
    def fail() -> None:
        raise RuntimeError("boom")

    during(monkeypatch, 3.0, fail)
    said = cli("calibrate", "servo", "--auto", "--car", car)
    assert "RuntimeError: boom" in said.err
    assert said.code != 0
    assert at_rest()
    assert untouched(car)


def test_something_ahead_ends_the_drive(
    car: Path, at_rest: Callable[[], bool], short: None, monkeypatch: pytest.MonkeyPatch, cli
) -> None:
    def wall(state: CarState) -> Ranges:
        return None, 0.6 - state.distance_m, None

    monkeypatch.setattr(calibration_rigs, "Plant", lambda config: Plant(config, ranges=wall))
    said = cli("calibrate", "servo", "--auto", "--car", car)
    assert said.code == 1
    assert "something is 0.3" in said.err.splitlines()[-1]
    assert at_rest()
    assert untouched(car)


def test_a_key_ends_the_drive(
    car: Path, at_rest: Callable[[], bool], short: None, monkeypatch: pytest.MonkeyPatch, cli
) -> None:
    pressed: list[bool] = []
    monkeypatch.setattr(servo_drive, "nobody", lambda: bool(pressed) and pressed.pop())
    during(monkeypatch, 3.0, lambda: pressed.append(True))
    said = cli("calibrate", "servo", "--auto", "--car", car)
    assert (said.code, said.err.splitlines()[-1]) == (
        1,
        "automodel calibrate servo: stopped by key; nothing was written",
    )
    assert at_rest()
    assert untouched(car)


def test_a_servo_that_does_not_answer(car: Path, monkeypatch: pytest.MonkeyPatch, cli) -> None:
    dead = ServoConfig(pulse_us=(1000.0, 1500.0, 2000.0), steering_rad=(1e-6, 0.0, -1e-6))
    monkeypatch.setattr(servo_drive, "randomised_servo", lambda seed, plant: dataclasses.replace(plant, servo=dead))
    said = cli("calibrate", "servo", "--auto", "--car", car)
    assert said.code == 2
    assert "automodel: the servo does not respond: 1050 .. 1950 us" in said.err.splitlines()[-1]
    assert untouched(car)


def test_a_board_without_a_gyro(car: Path, short: None, monkeypatch: pytest.MonkeyPatch, cli) -> None:
    monkeypatch.setattr(servo_drive, "randomised_servo", lambda seed, plant: dataclasses.replace(plant, gyro=False))
    said = cli("calibrate", "servo", "--auto", "--car", car)
    assert said.code == 1
    assert "no gyro is fitted; give --yaw camera; nothing was written" in said.err.splitlines()[-1]


def test_wheels_that_nobody_counts(car: Path, short: None, monkeypatch: pytest.MonkeyPatch, cli) -> None:
    blind = lambda seed, plant: dataclasses.replace(plant, ticks_per_m=1e-9)  # noqa: E731
    monkeypatch.setattr(servo_drive, "randomised_servo", blind)
    said = cli("calibrate", "servo", "--auto", "--car", car)
    assert said.code == 2
    assert "no wheel ticks were counted" in said.err.splitlines()[-1]
    assert untouched(car)


@pytest.mark.slow
def test_the_camera_stands_in_for_the_gyro(cli) -> None:
    said = cli("calibrate", "servo", "--auto", "--sim", "--yaw", "camera", "--seed", 4, "--json")
    assert said.code == 0, said.err
    (row,) = said.rows
    assert row["max_error_deg"] <= 0.5
    assert abs(row["dead_error_ms"]) <= 10.0


def test_a_file_that_cannot_be_written_is_refused_before_anything_moves(tmp_path: Path, pins: list, cli) -> None:
    said = cli("calibrate", "servo", "--auto", "--sim", "--car", tmp_path / "gone" / "car.toml")
    assert said.code == 2
    assert "gone" in said.line()
    folder = tmp_path / "folder"
    folder.mkdir()
    said = cli("calibrate", "servo", "--auto", "--sim", "--car", folder)
    assert said.code == 2
    assert str(folder) in said.line()
    assert pins == []


def test_a_real_car_needs_somebody_to_arm_it(tmp_path: Path, cli) -> None:
    path = tmp_path / "car.toml"
    path.write_text('[camera]\nsource = "usb"\n[link]\nport = "/dev/ttyMISSING"\n')
    for arguments, told in (
        (("--auto",), "no terminal to arm from; run it in one (ssh -t), or give --arm"),
        ((), "no terminal: the servo is moved by keys; run it in one (ssh -t), or see --manual and --auto"),
        (("--auto", "--arm"), "/dev/ttyMISSING: no such port"),
    ):
        said = cli("calibrate", "servo", "--car", path, *arguments)
        assert said.code == 2
        assert told in said.err.splitlines()[-1]
    assert [p.name for p in tmp_path.iterdir()] == ["car.toml"]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--auto",), "--car: which car?"),
        (("--auto", "--manual"), "choose one of them"),
        (("--auto", "--sim", "--circle", "1,2,left"), "are for --manual"),
        (("--auto", "--sim", "--speed", "9"), "--speed 9.0: above [safety] speed_max_mps = 2.0"),
        (("--manual", "--circle", "1200,1,left"), "--car: which car?"),
    ],
)
def test_command_lines_that_make_no_sense(arguments: tuple[str, ...], told: str, cli) -> None:
    said = cli("calibrate", "servo", *arguments)
    assert said.code == 2
    assert told in said.line()
