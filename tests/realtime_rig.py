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
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from avr_board import HeardAvr

from firmware_link.emulator.bench import BenchPeripherals
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.options import BoardOptions
from firmware_link.emulator.pty import PtyBoard

TESTS = Path(__file__).parent
MS = 1_000_000
NEUTRAL_US = 1500.0
STEP_MAX_NS = 3 * MS
PATIENCE_S = 60.0  # real time until a test gives up; nothing is judged by it
BOOT_NS = 50 * MS
MakeBoard = Callable[[BenchPeripherals], Any]


class BoardClock:
    """The board's time [ns]; told through a file, so that the driving program has the same."""

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
    """A board that notes when the host's bytes come."""

    def __init__(self, board: Any) -> None:
        self.board = board
        self.heard_ns: list[int] = []
        self.reset, self.room = board.reset, board.room
        self.transmit, self.advance = board.transmit, board.advance

    def receive(self, data: bytes, now_ns: int) -> int:
        if data:
            self.heard_ns.append(now_ns)
        return self.board.receive(data, now_ns)


class Bench:
    """The board, served in a thread, and what is at its pins."""

    def __init__(self, make_board: MakeBoard, folder: Path) -> None:
        self.peripherals = BenchPeripherals()
        self.clock_file = folder / "clock"
        self.clock = BoardClock(self.clock_file)
        self.line = Listening(make_board(self.peripherals))
        self.pty = PtyBoard(self.line, clock=self.clock)
        self.pty.start()

    def close(self) -> None:
        self.pty.close()
        self.clock.close()
        if isinstance(self.line.board, HeardAvr):
            self.line.board.close()

    @property
    def driving(self) -> bool:
        return bool(self.peripherals.pulses) and self.peripherals.at_pins[1] not in (0.0, NEUTRAL_US)

    def wait(self, ms: float) -> None:
        """So long in the board's time."""
        end_ns, given_up = self.clock.now_ns + round(ms * MS), time.monotonic() + PATIENCE_S
        while self.clock.now_ns < end_ns:
            assert time.monotonic() < given_up, "the board's thread does not run"
            time.sleep(0.002)

    def at_fault(self, fault: Callable[[], None]) -> int | None:
        """Let it happen while the board stands still; when that was, or None where the car did not drive."""
        at_ns: list[int] = []

        def strike() -> None:
            if self.driving:
                at_ns.append(self.clock.now_ns)
                fault()

        self.pty.call(strike)
        return at_ns[0] if at_ns else None

    def stopped_ns(self, since_ns: int) -> int:
        """When the motor's pulse was neutral, or gone, and stayed so; checks that it did not stop before `since_ns`."""
        pulses = [(t_ns, motor_us) for t_ns, _, motor_us in self.peripherals.pulses if t_ns > since_ns - 25 * MS]
        driven = [index for index, (_, motor_us) in enumerate(pulses) if motor_us not in (0.0, NEUTRAL_US)]
        assert driven, "it had stopped before"
        assert driven[-1] + 1 < len(pulses), "it drives on"
        return pulses[driven[-1] + 1][0]

    def silent_from_ns(self, since_ns: int, gap_ms: float) -> int:
        """When the host's last bytes came before it was silent for so long."""
        heard = [t_ns for t_ns in self.line.heard_ns if t_ns >= since_ns - 50 * MS] + [self.clock.now_ns]
        return next(a for a, b in itertools.pairwise(heard) if b - a >= gap_ms * MS)


def _signals_of_a_terminal() -> None:
    """SIGINT is not ignored, as it is in background jobs; what the tests say by SIGUSR is, until it is listened to."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)
    signal.signal(signal.SIGUSR2, signal.SIG_IGN)


class Car:
    """A driving program and its board."""

    def __init__(self, bench: Bench, command: list[str]) -> None:
        self.bench = bench
        path = os.pathsep.join(str(TESTS / name) for name in (".", "cli"))
        self.child = subprocess.Popen(
            [sys.executable, *command],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONPATH": path},
            start_new_session=True,
            preexec_fn=_signals_of_a_terminal,
        )

    def kill(self, number: int) -> None:
        os.kill(self.child.pid, number)

    def close(self) -> None:
        if self.child.poll() is None:
            self.kill(signal.SIGKILL)
        if self.child.stdout is not None and not self.child.stdout.closed:
            self.child.communicate()

    def until_driving(self, press: bool = False) -> None:
        """Wait until the motor's pulse is not neutral; a person presses again and again where `press`."""
        given_up = time.monotonic() + PATIENCE_S
        while not self.bench.driving:
            assert self.child.poll() is None, self.child.communicate()[0].decode()
            assert time.monotonic() < given_up, "it does not drive"
            if press:
                self.kill(signal.SIGUSR1)
            time.sleep(0.1)

    def struck(self, fault: Callable[[], None], phase_ms: float) -> int:
        """Drive, and let the fault happen `phase_ms` later; when that was in the board's time.

        A busy machine may stop the car, rightly: then it is armed once more.
        """
        for _ in range(20):
            self.until_driving(press=True)
            self.bench.wait(phase_ms)
            at_ns = self.bench.at_fault(fault)
            if at_ns is not None:
                return at_ns
        raise AssertionError("the car does not drive for long enough")


def emulated(peripherals: BenchPeripherals) -> EmulatedArduino:
    return EmulatedArduino(peripherals, options=BoardOptions(boot_ns=BOOT_NS))


def firmware(peripherals: BenchPeripherals) -> HeardAvr:
    return HeardAvr(peripherals, boot_ns=BOOT_NS)


BOARDS = [pytest.param(emulated, id="emulated"), pytest.param(firmware, id="avr")]
