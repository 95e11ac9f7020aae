"""The AutoNOMOS cars' text, and the emulated boards: what the real programs make of it, damaged text too."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from firmware_link.autonomos import OneBoard, Report, TwoBoards
from firmware_link.emulator.autonomos import (
    EmulatedAutonomos,
    EmulatedMotorController,
    EmulatedServoBoard,
    Pins,
    TextBoard,
    int16,
    whole,
)
from firmware_link.emulator.pty import BenchPeripherals

MS = 1_000_000


class Bench:
    """A board that has booted, and what is at its pins after some text."""

    def __init__(self, make: Callable[[Pins], TextBoard]) -> None:
        self.peripherals = BenchPeripherals()
        self.board = make(Pins(self.peripherals))
        self.t_ns = 0
        self.board.advance(0)
        self.said = self.after(b"", 1100)

    def after(self, text: bytes, ms: int = 25) -> bytes:
        self.board.receive(text, self.t_ns)
        self.t_ns += ms * MS
        self.board.advance(self.t_ns)
        return self.board.transmit(self.t_ns)

    def pins(self, text: bytes) -> tuple[float, float]:
        self.after(text)
        return self.peripherals.at_pins


@pytest.fixture
def of_2017() -> Bench:
    return Bench(lambda pins: EmulatedAutonomos(pins.peripherals))


def test_one_line_steers_and_drives(of_2017: Bench) -> None:
    assert of_2017.pins(b"") == (1500.0, 1500.0)  # the servo library begins in the middle
    assert of_2017.pins(b"S0LdiLM0\r") == (900.0, 1500.0)
    assert of_2017.pins(b"S180LdiLM-1000\r") == (1900.0, 1900.0)
    assert of_2017.pins(b"S90LdiLM400\r") == (1400.0, 1340.0)
    assert of_2017.pins(b"S181LdiLM-3\r") == (1400.0, 1500.0)  # steering beyond the range is ignored
    assert of_2017.pins(b"SdiLdiLM0\r") == (0.0, 1500.0)
    assert of_2017.pins(b"S120LdiLM0\r") == (0.0, 1500.0)  # kept, for when it is on again
    assert of_2017.pins(b"SenLdiLM0\r") == (1566.0, 1500.0)


def test_the_motor_needs_no_en_and_has_no_timer(of_2017: Bench) -> None:
    of_2017.pins(b"SdiLdiLM-200\r")
    of_2017.after(b"", 600_000)
    assert of_2017.peripherals.at_pins == (0.0, 1580.0)


def test_what_damage_does_is_what_the_docs_say(of_2017: Bench) -> None:
    assert of_2017.pins(b"S90LdiLM-100\r") == (1400.0, 1540.0)
    assert of_2017.pins(b"Sx0LdiLM-100\r") == (900.0, 1540.0)  # no number is 0: full lock
    assert of_2017.pins(b"S90LdiLM-900\r")[1] == 1860.0  # one wrong bit of the first digit
    of_2017.pins(b"S90LdiLM-100\r")
    assert of_2017.pins(b"90LdiLM-100\r")[1] == 1848.8  # without the S it goes on behind the former number: -10090


def test_it_tells_its_start_and_its_encoder(of_2017: Bench) -> None:
    lines = of_2017.said.split(b"\r\n")
    assert OneBoard().heard(0, lines[0]) == Report(started=True)
    assert OneBoard().heard(0, lines[1]) == Report()
    said = of_2017.after(b"", 1000)
    assert said.count(b"\n") == 100
    assert OneBoard().heard(0, said.splitlines()[-1]) == Report(ticks=0)


def test_the_servo_board_of_2015() -> None:
    bench = Bench(EmulatedServoBoard)
    assert bench.said == b""
    assert bench.pins(b"0\r")[0] == 900.0
    assert bench.pins(b"90\r180\r")[0] == 1900.0
    assert bench.pins(b"di\r")[0] == 0.0
    assert bench.pins(b"en\r")[0] == 1900.0
    assert bench.pins(b"1\xff0\r")[0] == 905.0  # the digits up to the damage
    assert bench.pins(b"\r")[0] == 900.0
    assert bench.pins(b"999\r")[0] == 2400.0  # where the servo library ends
    assert bench.after(b"", 1000) == b""


def test_the_motor_controller_of_2015() -> None:
    bench = Bench(EmulatedMotorController)
    assert bench.after(b"v-500\r\n") == b"OK\r\n"
    assert bench.peripherals.at_pins[1] == 1500.0  # not before en
    assert bench.after(b"en\r\ngn\r\n") == b"OK\r\n-500\r\n"
    assert bench.peripherals.at_pins[1] == 1700.0
    assert bench.after(b"V-5x0\r\n") == b"Unknown command\r\n"
    assert bench.peripherals.at_pins[1] == 1700.0
    assert bench.after(b"di\rGN\r") == b"OK\r\n0\r\n"
    assert bench.peripherals.at_pins[1] == 1500.0
    bench.after(b"en\r")
    bench.board.reset(bench.t_ns)  # opening its port does nothing
    assert bench.pins(b"")[1] == 1700.0
    bench.board.brown_out(bench.t_ns)
    assert bench.pins(b"")[1] == 1500.0


@pytest.mark.parametrize(
    ("word", "number"),
    [("", 0), ("x", 0), ("12", 12), ("-7z", -7), (" 5", 5), ("--5", 0), ("70000", 4464), ("32768", -32768)],
)
def test_numbers_are_arduinos(word: str, number: int) -> None:
    assert whole(word) == number


def test_sixteen_bits() -> None:
    assert [int16(n) for n in (0, 32767, 32768, -32769, 65535)] == [0, 32767, -32768, 32767, -1]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (b"y-12.34s512e-7", Report(ticks=0xFFF9)),
        (b"ynans0e300", Report(ticks=300)),
        (b"s77e5", Report(ticks=5)),
        (b"FIFO overflow!", Report()),
        (b"DMP ready! Waiting for first interrupt...", Report()),
        (b"y1.0s5e", None),
        (b"1.0s5e7", None),
        (b"y1.0s5e7\x00", None),
        (b"", None),
    ],
)
def test_lines_of_2017(line: bytes, said: Report | None) -> None:
    assert OneBoard().heard(0, line) == said


def test_lines_of_2015() -> None:
    text = TwoBoards()
    assert text.heard(1, b"-1234") == Report(motor=-1234)
    assert text.heard(1, b"OK") == Report()
    assert text.heard(1, b"O\xcb") is None
    assert text.heard(0, b"12") == Report()
