"""`bench latency`: from a frame to its command's bytes, and from the bytes to the pulse at the servo's pin.

The first is this machine's own time in the loop that drives the simulated car. The second is in the board's time, with
the bytes on a real pseudo terminal: it does not depend on how busy this machine is.
"""

from __future__ import annotations

import contextlib
import random
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from automodel.assembly.parts import build_run, make_loop, run_config
from automodel.assembly.run_watcher import Stopwatch, TimedLink, TimedSource
from automodel.assembly.simulated_car import Simulation, lock_step
from automodel.bench.accuracy import Row
from automodel.config import CarConfig
from automodel.console.progress import progress
from automodel.runtime.latencies import Latencies
from automodel.runtime.os_signals import Interrupted
from automodel.runtime.runner import Runner
from automodel.signals import Command
from firmware_link.arduino import ArduinoLink
from firmware_link.emulator.avr import AvrBoard, build_avr
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.pty import BenchPeripherals, PtyBoard
from firmware_link.errors import LinkError
from firmware_link.pulses import PulseTable
from firmware_link.transport import SerialTransport

COLUMNS = ("link", "stage", "p50_ms", "p99_ms", "max_ms", "samples", "clock")
_MS = 1_000_000
_STEP_NS = _MS  # how often a board on a pseudo terminal reads it
_KERNEL_S = 0.0001  # the kernel passes a pseudo terminal's bytes on with a delay
_PATIENCE_S = 5.0
_READY_NS = 5_000 * _MS
_ANGLES_RAD = (0.05, -0.05)  # near enough for one servo frame, whatever the slew
_GAPS_MS = (30.0, 50.0)  # between two commands: they come in every phase of the servo's frame
_VALID_NS = 100 * _MS


def measure(car: CarConfig, link: str, frames: int, commands: int) -> list[Row]:
    """A row a stage: median, 99th percentile and greatest [ms], and whose clock they are of.

    Raises LinkError where the board does not answer.
    """
    with progress("bench latency", frames + commands, threaded=False) as tick:
        return [
            _row(link, "frame -> write", _frame_to_write(car, frames, tick), "this machine"),
            _row(link, "write -> pulse", _write_to_pulse(car, link, commands, tick), "board"),
        ]


def _row(link: str, stage: str, times: Latencies, clock: str) -> Row:
    median, p99, most = (times.percentile_ms(share) for share in (50, 99, 100))
    samples = len(times)
    return {
        "link": link, "stage": stage, "samples": samples, "p50_ms": median, "p99_ms": p99, "max_ms": most,
        "clock": clock,
    }  # fmt: skip


def _frame_to_write(car: CarConfig, frames: int, tick: Callable[[], None]) -> Latencies:
    """This machine's times from each frame's delivery to its command on the wire, in a simulated drive."""
    watch = Stopwatch()
    simulated = lock_step(car, Simulation(track="oval"), lambda scene: tick())
    with contextlib.closing(simulated):
        parts = build_run(
            car,
            source=TimedSource(simulated.source, watch),
            link=TimedLink(simulated.link, watch),
            clock=simulated.clock,
            loop=make_loop(car),
        )
        result = Runner(parts, run_config(car, collector_off=True)).run(max_frames=frames)
    if result.interrupted:
        raise Interrupted
    return watch.latencies


def _write_to_pulse(car: CarConfig, link: str, commands: int, tick: Callable[[], None]) -> Latencies:
    """The board's times from each write to the end of the first pulse that is the commanded one."""
    with contextlib.ExitStack() as leaving:
        peripherals = BenchPeripherals()
        board: EmulatedArduino | AvrBoard
        if link == "avr":
            folder = leaving.enter_context(tempfile.TemporaryDirectory(prefix="avr-"))
            board = AvrBoard(build_avr(Path(folder), car.link.baud), peripherals, car.link.baud)
            leaving.callback(board.close)
        else:
            board = EmulatedArduino(peripherals, car.link.baud)
        line = Line(board, peripherals, car)
        leaving.callback(line.close)
        line.arm()
        rng = random.Random(0)
        times = Latencies()
        for index in range(commands):
            times.add(line.command(index, rng.uniform(*_GAPS_MS)))
            tick()
        return times


class Line:
    """Link and board with a real pseudo terminal between them, in the board's time, which this advances."""

    def __init__(self, board: EmulatedArduino | AvrBoard, peripherals: BenchPeripherals, car: CarConfig) -> None:
        self._pulses_end = isinstance(board, AvrBoard)  # its pulses are reported at their end, else at their start
        self._peripherals = peripherals
        self._board = Counted(board)
        self._pty = PtyBoard(self._board)
        self._link = ArduinoLink(SerialTransport(self._pty.path, car.link.baud), car.link, car.vehicle)
        self._servo = PulseTable(car.link.servo.pulse_us, car.link.servo.steering_rad)
        self._now_ns = 0
        self._link.open()

    def close(self) -> None:
        """Close link and terminal."""
        self._link.close()
        self._pty.close()

    def arm(self) -> None:
        """Wait until the board is armed; raises LinkError."""
        while True:
            self._wait(20.0)
            state = self._link.poll(self._now_ns)
            if state is not None and state.armed:
                return
            if self._now_ns > _READY_NS:
                raise LinkError("the board does not arm")
            if state is not None:
                self._link.arm(self._now_ns)
            self._link.send(self._order(0.0), self._now_ns)

    def command(self, index: int, wait_ms: float) -> int:
        """Write a command, wait, and give the end of its pulse [ns after the write]; raises LinkError."""
        angle = _ANGLES_RAD[index % 2]
        written_ns = self._now_ns
        self._send(angle)
        self._wait(wait_ms)
        self._link.poll(self._now_ns)
        commanded_us = self._servo.pulse_us(angle)
        for t_ns, servo_us, _ in self._peripherals.pulses:
            if t_ns > written_ns and servo_us == commanded_us:
                return t_ns - written_ns + (0 if self._pulses_end else round(servo_us * 1000))
        raise LinkError("a command never became a pulse")

    def _order(self, steering_rad: float) -> Command:
        return Command(
            t_ns=self._now_ns, steering_rad=steering_rad, speed_mps=0.0, valid_until_ns=self._now_ns + _VALID_NS
        )

    def _send(self, steering_rad: float) -> None:
        """Send; the board's time stands still until the kernel has passed the bytes on."""
        before = self._board.received
        self._link.send(self._order(steering_rad), self._now_ns)
        self._now_ns += -self._now_ns % _STEP_NS
        deadline_s = time.monotonic() + _PATIENCE_S
        while self._board.received == before:
            self._pty.step(self._now_ns)
            if time.monotonic() > deadline_s:
                raise LinkError("the pseudo terminal does not pass bytes on")

    def _wait(self, wait_ms: float) -> None:
        end_ns = self._now_ns + round(wait_ms * _MS)
        while self._now_ns < end_ns:
            self._now_ns = min(self._now_ns + _STEP_NS - self._now_ns % _STEP_NS, end_ns)
            if self._now_ns % _STEP_NS == 0:
                self._pty.step(self._now_ns)
                time.sleep(_KERNEL_S)


class Counted:
    """A board that counts the bytes from the host."""

    def __init__(self, board: EmulatedArduino | AvrBoard) -> None:
        self._board = board
        self.received = 0
        self.reset, self.room = board.reset, board.room
        self.transmit, self.advance = board.transmit, board.advance

    def receive(self, data: bytes, now_ns: int) -> int:
        """As the board's."""
        self.received += len(data)
        return self._board.receive(data, now_ns)
