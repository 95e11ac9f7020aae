"""Rigs, and a board alone on the bench."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from firmware_link import messages
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.logic import BoardOptions
from firmware_link.emulator.pty import BenchPeripherals
from tests.support.avr_board import HeardAvr
from tests.support.compiled_board import load
from tests.support.firmware_build import host_library
from tests.support.link_rigs import MS, AutonomosOf2015Rig, AutonomosPtyRig, AutonomosRig, AvrRig, PtyRig, Rig
from tests.support.wide_limits import WIDE_LIMITS

RIGS = [
    pytest.param(Rig, id="memory"),
    pytest.param(PtyRig, id="pty", marks=pytest.mark.realtime),
    pytest.param(AvrRig, id="avr"),
    pytest.param(AutonomosRig, id="autonomos"),
    pytest.param(AutonomosPtyRig, id="autonomos-pty", marks=pytest.mark.realtime),
    pytest.param(AutonomosOf2015Rig, id="autonomos-2015"),
]


@pytest.fixture
def avr() -> Iterator[HeardAvr]:
    """The firmware on a simulated chip with bench sensors, without a bootloader."""
    board = HeardAvr(BenchPeripherals(), boot_ns=0)
    yield board
    board.close()


@pytest.fixture(params=RIGS)
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    rig = request.param()
    yield rig
    rig.close()


@pytest.fixture
def virtual() -> Rig:
    rig = Rig()
    rig.link.open()
    rig.ready()
    return rig


@pytest.fixture(params=[AutonomosRig, AutonomosOf2015Rig], ids=["2017", "2015"])
def autonomos(request: pytest.FixtureRequest) -> Iterator[Rig]:
    """An AutoNOMOS car of either kind in virtual time, ready."""
    rig = ready(request.param())
    yield rig
    rig.close()


def ready(rig: Rig) -> Rig:
    rig.link.open()
    rig.ready()
    return rig


@pytest.fixture
def make_autonomos() -> Callable[[], Rig]:
    """AutoNOMOS cars of 2017 in virtual time, ready."""
    return lambda: ready(AutonomosRig())


@pytest.fixture
def make_autonomos_of_2015() -> Callable[[], Rig]:
    """AutoNOMOS cars of 2015 in virtual time, ready."""
    return lambda: ready(AutonomosOf2015Rig())


@pytest.fixture
def make_rig() -> Callable[..., Rig]:
    return Rig


class Bench:
    """A board, a clock, and what the board has said."""

    def __init__(self, baud: int = 115200, limits: messages.Limits | None = WIDE_LIMITS, **options: int) -> None:
        self.peripherals = BenchPeripherals()
        self.board = EmulatedArduino(self.peripherals, baud, BoardOptions(limits=limits, **options))
        self.t_ns = 5_000 * MS
        self.counter = 0
        self.said: list[messages.Message] = []
        self._decoder = messages.decoder(on_board=False)
        self.board.reset(self.t_ns)

    def wait(self, ms: float) -> list[messages.Message]:
        end_ns = self.t_ns + round(ms * MS)
        said: list[messages.Message] = []
        while self.t_ns < end_ns:
            self.t_ns = min(self.t_ns + 100 * MS, end_ns)
            self.board.advance(self.t_ns)
            said += [messages.decode(f) for f in self._decoder.feed(self.board.transmit(self.t_ns))]
        self.said += said
        return said

    def send(self, message: messages.Message, step: int = 1) -> None:
        self.counter = (self.counter + step) & 0xFF
        self.board.receive(messages.encode(message, self.counter), self.t_ns)

    def last(self, kind: type[messages.Message]) -> messages.Message:
        return next(message for message in reversed(self.said) if type(message) is kind)

    @property
    def status(self) -> messages.Status:
        status = self.last(messages.Status)
        assert isinstance(status, messages.Status)
        return status

    def faults(self) -> int:
        """Of the statuses of the next 25 ms, together."""
        faults = 0
        for message in self.wait(25):
            if isinstance(message, messages.Status):
                faults |= message.faults
        return faults

    def t_ms(self) -> int:
        return (self.t_ns - self.board._start_ns) // MS

    def command(self, servo_us: float = 1600.0, motor_us: float = 1550.0, **changes: int) -> messages.Command:
        values = {"deadline_ms": (self.t_ms() + 100) & 0xFFFF, "flags": 1} | changes
        return messages.Command(servo_us=servo_us, motor_us=motor_us, **values)

    def running(self) -> Bench:
        self.wait(330)
        return self

    def arm(self) -> Bench:
        self.send(messages.Arm(nonce=self.board._logic.arming.nonce, boot_id=self.board.boot_id))
        self.wait(3)
        assert self.board.armed
        return self


@pytest.fixture
def make_bench() -> Callable[..., Bench]:
    return Bench


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The board's C++ decisions; built elsewhere (with sanitizers, counting lines) where $FIRMWARE_LIBRARY says so."""
    path = os.environ.get("FIRMWARE_LIBRARY")
    return load(Path(path) if path else host_library(tmp_path_factory.mktemp("firmware")))
