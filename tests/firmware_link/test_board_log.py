"""The board's words, written down, and its times in the host's."""

from __future__ import annotations

import numpy as np
import pytest

from automodel.signals import BoardSensors
from firmware_link import messages
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.pty import BenchPeripherals
from firmware_link.messages import Odometry, Status
from firmware_link.transport import LoggedTransport, MemoryTransport

MS = 1_000_000


class Wire:
    """A transport that gives what it is told to, and a clock."""

    def __init__(self) -> None:
        self.data, self.now, self.sent = b"", 0, b""

    def now_ns(self) -> int:
        return self.now

    def open(self) -> None: ...

    def close(self) -> None: ...

    def write(self, data: bytes) -> None:
        self.sent += data

    def read(self) -> bytes:
        data, self.data = self.data, b""
        return data


def odometry(time_us: int, ticks: int = 0) -> bytes:
    return messages.encode(Odometry(time_us=time_us % (1 << 32), wheel_ticks=ticks, yaw_rate_radps=None), 0)


def status(time_us: int, servo_us: float) -> bytes:
    said = Status(time_us=time_us, servo_us=servo_us, motor_us=1500.0, faults=0, nonce=0, command_counter=0, flags=0)
    return messages.encode(said, 0)


def test_it_passes_on_and_keeps() -> None:
    wire = Wire()
    log = LoggedTransport(wire, wire)
    log.open()
    wire.data = said = status(21_000, 1480.0) + odometry(31_000, 7)
    assert log.read() == said
    log.write(b"abc")
    assert wire.sent == b"abc"
    assert [tuple(p) for p in log.pins] == [(20 * MS, 1480.0, 1500.0)]  # a status tells of a millisecond before
    assert [tuple(r) for r in log.rolled] == [(31 * MS, 7, None)]
    log.open()
    assert (log.pins, log.rolled) == ([], [])


def test_pulses_are_dated_when_they_reach_the_pin() -> None:
    class Clock:
        now = 0

        def now_ns(self) -> int:
            return self.now

    clock, bench = Clock(), BenchPeripherals()
    bench.sensors = BoardSensors(ranges_m=(None,) * 3, wheel_ticks=3, battery_v=7.0, yaw_rate_radps=0.5)
    log = LoggedTransport(MemoryTransport(EmulatedArduino(bench), clock), clock)
    log.open()
    for t_ms in range(0, 2000, 7):
        clock.now = t_ms * MS
        log.read()
    frames = [t for t, _, _ in bench.pulses][1:]  # the first is the bootloader's
    assert [p.board_ns for p in log.pins] == [t - frames[0] for t in frames[: len(log.pins)]]
    host = log.host_ns([p.board_ns for p in log.pins])
    # later by the bytes' way over the wire, and by what the reading comes later, at its best
    late = host - np.array(frames[: len(log.pins)])
    assert late.min() > 0.0
    assert late.max() < 6 * MS


def test_a_board_whose_resonator_is_off_is_dated_by_the_host() -> None:
    wire = Wire()
    log = LoggedTransport(wire, wire)
    log.open()
    rng = np.random.default_rng(1)
    start_us = (1 << 32) - 5_000_000  # its time wraps meanwhile
    true = np.arange(0, 20_000) * MS
    for t_ns in true[::20].tolist():
        wire.now = t_ns + 2 * MS + int(rng.exponential(4 * MS))
        wire.data = odometry(start_us + round(t_ns * 1.004 / 1000))
        log.read()
    host = log.host_ns([row.board_ns for row in log.rolled])
    off_ms = (host - true[::20]) / MS
    assert off_ms == pytest.approx(2.0, abs=1.0)
    assert np.diff([row.board_ns for row in log.rolled]) == pytest.approx(20 * MS * 1.004, rel=1e-3)


def test_a_board_that_restarts_begins_anew() -> None:
    wire = Wire()
    log = LoggedTransport(wire, wire)
    log.open()
    for time_us in (5_000_000, 5_020_000, 20_000):
        wire.data = odometry(time_us)
        log.read()
    assert [row.board_ns for row in log.rolled] == [20 * MS]
