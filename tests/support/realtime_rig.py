"""A program that drives, in a process of its own, and a board on a pseudo terminal that lives in its own time.

The board's clock follows the real one, but goes 3 ms on at most at each of its steps: a machine that holds the board's
thread up takes nothing from the board, whose time is what is judged. The driving program has the same clock, so that a
busy machine makes everything slow, and nothing late.
"""

from __future__ import annotations

import itertools
import mmap
import os
import signal
import struct
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from firmware_link import messages
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.logic import BoardOptions
from firmware_link.emulator.pty import BenchPeripherals, PtyBoard
from firmware_link.messages import Command, CommandFlag, Message
from tests.support.avr_board import HeardAvr
from tests.support.terminal_signals import signals_of_a_terminal

ROOT = Path(__file__).resolve().parents[2]
MS = 1_000_000
NEUTRAL_US = 1500.0
STEP_MAX_NS = 3 * MS
PATIENCE_S = 30.0  # real time until a test gives up; nothing is judged by it
BOOT_NS = 50 * MS
REST_NS = 200 * MS  # a car that was neutral for so long has stopped; a gap of a frame or two is none
TIMER_MS = (
    130.0  # from the last command to drive to neutral: the board's timer, a servo frame, the line, the pulse itself
)
MakeBoard = Callable[[BenchPeripherals], Any]


class BoardClock:
    """The board's time [ns]; written to a file, so that the driving program has the same."""

    def __init__(self, path: Path) -> None:
        path.write_bytes(bytes(8))
        self._file = path.open("r+b")
        self._shared = mmap.mmap(self._file.fileno(), 8)
        self._real_ns = self.now_ns = time.monotonic_ns()

    def __call__(self) -> int:
        real_ns = time.monotonic_ns()
        self.now_ns += min(real_ns - self._real_ns, STEP_MAX_NS)
        self._real_ns = real_ns
        struct.pack_into("=q", self._shared, 0, self.now_ns)
        return self.now_ns

    def close(self) -> None:
        self._shared.close()
        self._file.close()


class Listening:
    """A board that notes what the host says, and when."""

    def __init__(self, board: Any) -> None:
        self.board = board
        self.heard: list[tuple[int, Message]] = []
        self.opened_ns: list[int] = []
        self.room, self.transmit, self.advance = board.room, board.transmit, board.advance
        self._decoder = messages.decoder(on_board=True)

    def reset(self, now_ns: int) -> None:
        self.opened_ns.append(now_ns)
        self._decoder.reset()
        self.board.reset(now_ns)

    def receive(self, data: bytes, now_ns: int) -> int:
        self.heard += [(now_ns, messages.decode(frame)) for frame in self._decoder.feed(data)]
        return self.board.receive(data, now_ns)


class Bench:
    """The board, served in a thread, and what is at its pins."""

    def __init__(self, make_board: MakeBoard, folder: Path) -> None:
        self.peripherals = BenchPeripherals()
        self.peripherals.pulses = deque()  # all of them
        self.clock_file = folder / "clock"
        self.clock = BoardClock(self.clock_file)
        self.line = Listening(make_board(self.peripherals))
        self.asked_ns: list[int] = []  # when a person pressed
        self.pty = PtyBoard(self.line, clock=self.clock)
        self.pty.start()

    @property
    def board(self) -> Any:
        return self.line.board

    def close(self) -> None:
        self.pty.close()
        self.clock.close()
        if isinstance(self.board, HeardAvr):
            self.board.close()

    @property
    def driving(self) -> bool:
        return bool(self.peripherals.pulses) and self.peripherals.at_pins[1] not in (0.0, NEUTRAL_US)

    def wait(self, ms: float) -> None:
        """So long in the board's time."""
        end_ns = self.clock.now_ns + round(ms * MS)
        self.until(lambda: self.clock.now_ns >= end_ns, "the board's thread does not run")

    def until(self, wanted: Callable[[], bool], otherwise: str) -> None:
        """Wait for what must come; how long that takes is not judged."""
        given_up = time.monotonic() + PATIENCE_S
        while not wanted():
            assert time.monotonic() < given_up, otherwise
            time.sleep(0.002)

    def at_fault(self, fault: Callable[[], object]) -> int | None:
        """Let it happen while the board stands still; when that was, or None where the car did not drive."""
        at_ns: list[int] = []

        def strike() -> None:
            if self.driving:
                at_ns.append(self.clock.now_ns)
                fault()

        self.pty.call(strike)
        return at_ns[0] if at_ns else None

    def pulses(self) -> list[tuple[int, bool]]:
        """When which pulse came, and whether the motor turns by it."""
        noted: list[list[tuple[int, float, float]]] = []
        self.pty.call(lambda: noted.append(list(self.peripherals.pulses)))
        return [(t_ns, motor_us not in (0.0, NEUTRAL_US)) for t_ns, _, motor_us in noted[0]]

    def stopped_ns(self, since_ns: int) -> int:
        """When the motor's pulse was neutral, or gone, and stayed so; checks that it did not stop before `since_ns`."""
        pulses = [(t_ns, drives) for t_ns, drives in self.pulses() if t_ns > since_ns - 25 * MS]
        driven = [index for index, (_, drives) in enumerate(pulses) if drives]
        assert driven, "it had stopped before"
        assert driven[-1] + 1 < len(pulses), "it drives on"
        return pulses[driven[-1] + 1][0]

    def last_drive_ns(self, before_ns: int) -> int:
        """When the host's last command came that turns the motor."""
        return max(t_ns for t_ns, said in self.line.heard if t_ns < before_ns and _drives(said))

    def starts_ns(self) -> list[int]:
        """When the car drove off from rest."""
        driven = [t_ns for t_ns, drives in self.pulses() if drives]
        return driven[:1] + [b for a, b in itertools.pairwise(driven) if b - a > REST_NS]

    def check_asked_for(self, since_ns: int = 0) -> None:
        """It has not driven off since then but when a person had pressed since it last stopped."""
        driven = [t_ns for t_ns, drives in self.pulses() if drives]
        for start_ns in self.starts_ns():
            before_ns = max((t_ns for t_ns in driven if t_ns < start_ns), default=0)
            asked = any(before_ns < asked_ns < start_ns for asked_ns in self.asked_ns)
            assert asked or start_ns < since_ns, "it drove off by itself"


def _drives(message: Message) -> bool:
    return isinstance(message, Command) and bool(message.flags & CommandFlag.FRESH) and message.motor_us != NEUTRAL_US


class Car:
    """A driving program and its board. What it says goes to a file: a pipe that nobody reads would hold it up."""

    def __init__(self, bench: Bench, folder: Path, command: list[str]) -> None:
        self.bench = bench
        self.folder = folder
        path = str(ROOT)
        with (folder / "said").open("wb") as said, signals_of_a_terminal():
            self.child = subprocess.Popen(
                [sys.executable, *command],
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=subprocess.STDOUT,
                env={**os.environ, "PYTHONPATH": path},
                start_new_session=True,
            )

    @property
    def said(self) -> str:
        return (self.folder / "said").read_text()

    @property
    def alive(self) -> bool:
        return self.child.poll() is None

    def kill(self, number: int) -> None:
        os.kill(self.child.pid, number)

    def press(self) -> None:
        """A person asks to arm."""
        self.bench.asked_ns.append(self.bench.clock.now_ns)
        self.kill(signal.SIGUSR1)

    def close(self) -> None:
        """Kill it, stopped or not, and everything around it."""
        try:
            if self.alive:
                self.kill(signal.SIGKILL)
            self.child.wait(PATIENCE_S)
        finally:
            self.bench.close()

    def ended(self) -> int:
        """The exit code, once it has ended by itself."""
        return self.child.wait(PATIENCE_S)

    def until_driving(self, press: bool = False) -> None:
        """Wait until the motor's pulse is not neutral; a person presses again and again where `press`."""
        given_up = time.monotonic() + PATIENCE_S
        while not self.bench.driving:
            assert self.alive, self.said
            assert time.monotonic() < given_up, f"it does not drive: {self.said[-2000:]}"
            if press:
                self.press()
            time.sleep(0.05)

    def struck(self, fault: Callable[[], object], phase_ms: float, press: bool = True) -> int:
        """Drive, and let the fault happen `phase_ms` later; when that was in the board's time.

        A busy machine may stop the car, rightly: then it is armed once more.
        """
        given_up = time.monotonic() + PATIENCE_S
        while time.monotonic() < given_up:
            self.until_driving(press)
            self.bench.wait(phase_ms)
            at_ns = self.bench.at_fault(fault)
            if at_ns is not None:
                return at_ns
        raise AssertionError(f"the car does not drive for long enough: {self.said[-2000:]}")


def emulated(peripherals: BenchPeripherals) -> EmulatedArduino:
    return EmulatedArduino(peripherals, options=BoardOptions(boot_ns=BOOT_NS))


def firmware(peripherals: BenchPeripherals) -> HeardAvr:
    return HeardAvr(peripherals, boot_ns=BOOT_NS)


BOARDS = [pytest.param(emulated, id="emulated"), pytest.param(firmware, id="avr")]
