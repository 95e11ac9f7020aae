"""`calibrate servo` by keys and by tape measure."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from automodel.assembly import calibration_rigs
from automodel.config import load_car
from automodel.runtime.clocks import VirtualClock
from calibration import servo_dialogue
from calibration.drive import Rig, Ticks
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.logic import ROLL_OUT_MS, BoardOptions
from firmware_link.emulator.pty import BenchPeripherals
from firmware_link.transport import MemoryTransport
from tests.support.calibrated_cars import untouched
from tests.support.wide_limits import WIDE_LIMITS


def test_circles_become_a_table(car: Path, tmp_path: Path, cli) -> None:
    (tmp_path / "circles.csv").write_text("pulse_us,diameter_m,side\n1100,1.20,left\n1900,1.35,right\n\n")
    said = cli(
        "calibrate", "servo", "--manual", "--car", car, "--circles", tmp_path / "circles.csv",
        "--circle", "1510,,straight", "--circle", "1300,2.6,left", "--json",
    )  # fmt: skip
    assert said.code == 0, said.err
    assert said.rows[0]["circles"] == 4
    servo = load_car(car).link.servo
    assert servo.pulse_us == (1100.0, 1300.0, 1510.0, 1900.0)
    # tan(delta) = wheelbase / radius
    assert servo.steering_rad == pytest.approx((0.40890, 0.19740, 0.0, -0.36767), abs=2e-5)


@pytest.mark.parametrize(
    ("circles", "told"),
    [
        (("1100,1.2,left", "1300,1.0,left", "1900,1.3,right"), "contradict the other circles"),
        (("1100,1.2,left", "1900,1.3"), "--circle 1900,1.3: expected pulse_us,diameter_m,side, for example 1200"),
        (("1100,wide,left",), "--circle 1100,wide,left: pulse and diameter must be numbers"),
        (("1100,1.2,up",), "expected one of left, right, straight, got 'up'"),
    ],
)
def test_circles_that_make_no_table(circles: tuple[str, ...], told: str, car: Path, cli) -> None:
    said = cli("calibrate", "servo", "--manual", "--car", car, *[a for c in circles for a in ("--circle", c)])
    assert said.code == 2
    assert told in said.line()
    assert untouched(car)


def test_a_csv_without_its_header_names_the_line(car: Path, tmp_path: Path, cli) -> None:
    (tmp_path / "circles.csv").write_text("1100,1.2,left\n")
    said = cli("calibrate", "servo", "--manual", "--car", car, "--circles", tmp_path / "circles.csv")
    assert said.code == 2
    assert "circles.csv:1: the first line must be pulse_us,diameter_m,side" in said.line()


class Person:
    """At the keys, on virtual time: each text of `script` is typed as soon as the one before has done its work."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, script: list[str]) -> None:
        self.bench, self.script, self.turns = BenchPeripherals(), script, 0
        board = EmulatedArduino(self.bench, options=BoardOptions(limits=WIDE_LIMITS))
        self.clock = VirtualClock(0, board.advance)
        transport = MemoryTransport(board, self.clock)

        def rig(car, *_: object) -> Rig:
            return calibration_rigs.rig_on(car, transport, self.clock, Ticks(self.clock), auto_arm=False, plant=None)

        monkeypatch.setattr(servo_dialogue, "Terminal", lambda: self)
        monkeypatch.setattr(calibration_rigs, "real_rig", rig)
        self.board = board

    def __enter__(self) -> Person:
        return self

    def __exit__(self, *error: object) -> None: ...

    def pressed(self) -> list[str]:
        self.turns += 1
        if self.turns % 75 or not self.script:  # one and a half seconds
            return []
        text = self.script.pop(0)
        if text == "^C":
            os.kill(os.getpid(), signal.SIGINT)
            return []
        return servo_dialogue.keys_of(text)


def test_by_hand(car: Path, monkeypatch: pytest.MonkeyPatch, cli) -> None:
    person = Person(monkeypatch, ["\r", "...c", "[[[[[[[[[[[[l", "g", "]]]]]]]]]]r", "\r"])
    said = cli("calibrate", "servo", "--car", car, "--left-deg", 24)
    assert said.code == 0, said.err
    servo = load_car(car).link.servo
    assert servo.pulse_us == (1203.0, 1503.0, 1753.0)
    assert servo.steering_rad == pytest.approx((0.418879, 0.0, -0.45), abs=1e-5)
    assert "  1203 us   left 1203   straight 1503   right -" in said.err
    assert "the board keeps to 1203 .. 1753 us now, straight at 1503 us" in said.err
    servos = [us for _, us, _ in person.bench.pulses]
    assert {motor for _, _, motor in person.bench.pulses} == {1500.0}
    assert (min(servos), max(servos)) == (1203.0, 1753.0)
    assert person.bench.at_pins == (1503.0, 1500.0)  # disarmed, and straight is where it was found
    assert not person.board.armed


@pytest.mark.parametrize("end", ["q", "^C"])
def test_by_hand_and_given_up(end: str, car: Path, monkeypatch: pytest.MonkeyPatch, cli) -> None:
    person = Person(monkeypatch, ["\r", "[[[c", end])
    said = cli("calibrate", "servo", "--car", car)
    assert said.code == 1
    assert said.err.splitlines()[-1].endswith("; nothing was written")
    person.clock.sleep(0.1)
    assert 1425.0 in {us for _, us, _ in person.bench.pulses}
    assert person.bench.at_pins[1] == 1500.0
    person.clock.sleep(ROLL_OUT_MS * 1e-3)
    assert person.bench.at_pins == (1500.0, 1500.0)
    assert not person.board.armed
    assert untouched(car)


def test_keys_before_arming_move_nothing(car: Path, monkeypatch: pytest.MonkeyPatch, cli) -> None:
    person = Person(monkeypatch, ["[[[", "q"])
    assert cli("calibrate", "servo", "--car", car).code == 1
    assert {us for _, us, _ in person.bench.pulses} == {1500.0}
