"""A link and a board: over memory in virtual time, over a pty in real time; and a board alone on the bench."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from avr_board import HeardAvr
from compiled_board import load
from firmware_build import host_library

from automodel.config import LinkConfig, MotorConfig, ServoConfig, VehicleConfig
from automodel.signals import Command, VehicleState
from firmware_link import messages
from firmware_link.arduino import ArduinoLink
from firmware_link.emulator.bench import BenchPeripherals
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.options import BoardOptions
from firmware_link.emulator.pty import PtyBoard
from firmware_link.transport import MemoryTransport, SerialTransport

MS = 1_000_000
PERIOD_NS = 16_666_667
CONFIG = LinkConfig(
    servo=ServoConfig(pulse_us=(1100.0, 1520.0, 1900.0), steering_rad=(0.4, 0.0, -0.5)),
    motor=MotorConfig(pulse_us=(1200.0, 1500.0, 1800.0), speed_mps=(-3.0, 0.0, 3.0)),
)


class Rig:
    """A link and the board behind it, in virtual time."""

    realtime = False
    config = CONFIG

    def __init__(self, options: BoardOptions | None = None) -> None:
        self.peripherals = BenchPeripherals()
        self.board: Any = self.make_board(options)
        self.t_ns = 1_000_000 * MS
        self.cable = self.transport()
        self.link = ArduinoLink(self.cable, CONFIG, VehicleConfig())

    def make_board(self, options: BoardOptions | None) -> Any:
        return EmulatedArduino(self.peripherals, CONFIG.baud, options)

    def transport(self) -> MemoryTransport | SerialTransport:
        return MemoryTransport(self.board, self)

    def now_ns(self) -> int:
        return self.t_ns

    def wait(self, period_ns: int = PERIOD_NS) -> None:
        self.t_ns += period_ns

    def do(self, function: Callable[[], None]) -> None:
        function()

    def unplug(self) -> None:
        self.cable.unplug()

    def replug(self) -> None:
        self.cable.replug()

    def close(self) -> None:
        self.link.close()

    def command(self, steering_rad: float, speed_mps: float) -> Command:
        now_ns = self.now_ns()
        return Command(t_ns=now_ns, steering_rad=steering_rad, speed_mps=speed_mps, valid_until_ns=now_ns + 100 * MS)

    def until(
        self,
        wanted: Callable[[VehicleState | None], bool],
        drive: tuple[float, float] | None = None,
        limit_ns: int = 10_000 * MS,
    ) -> VehicleState | None:
        """Poll, and send where `drive` is given, until the state is as wanted."""
        end_ns = self.now_ns() + limit_ns
        while self.now_ns() < end_ns:
            state = self.link.poll(self.now_ns())
            if wanted(state):
                return state
            if drive is not None:
                self.link.send(self.command(*drive), self.now_ns())
            self.wait()
        raise AssertionError(f"never came to be: {state}")

    def ready(self) -> VehicleState:
        state = self.until(lambda s: s is not None)
        assert state is not None
        return state

    def drive(self, steering_rad: float, speed_mps: float, pulses: tuple[float, float]) -> None:
        self.driving((steering_rad, speed_mps), lambda s: s.armed and self.peripherals.at_pins == pulses)

    def driving(self, drive: tuple[float, float], wanted: Callable[[VehicleState], bool]) -> VehicleState:
        """Arm and drive until the state is as wanted; in real time a machine that was held up may try again."""
        for tries_left in reversed(range(10 if self.realtime else 1)):
            self.link.arm(self.now_ns())
            try:
                state = self.until(lambda s: s is not None and wanted(s), drive, 1_000 * MS)
            except AssertionError:
                if not tries_left:
                    raise
            else:
                assert state is not None
                return state
        raise AssertionError


class PtyRig(Rig):
    """The same over a pty, against the real clock."""

    realtime = True

    def transport(self) -> MemoryTransport | SerialTransport:
        self.pty = PtyBoard(self.board)
        self.pty.start()
        return SerialTransport(self.pty.path, CONFIG.baud)

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def wait(self, period_ns: int = PERIOD_NS) -> None:
        time.sleep(period_ns * 1e-9)

    def do(self, function: Callable[[], None]) -> None:
        self.pty.call(function)

    def unplug(self) -> None:
        self.pty.unplug()

    def replug(self) -> None:
        self.pty.replug()

    def close(self) -> None:
        self.link.close()
        self.pty.close()


class AvrRig(Rig):
    """A link and the firmware on a simulated chip, in virtual time."""

    def make_board(self, options: BoardOptions | None) -> Any:
        if options is not None:
            pytest.skip("the firmware's own message table is the only one it has")
        return HeardAvr(self.peripherals, boot_ns=300 * MS)

    def close(self) -> None:
        super().close()
        self.board.close()


RIGS = [
    pytest.param(Rig, id="memory"),
    pytest.param(PtyRig, id="pty", marks=pytest.mark.realtime),
    pytest.param(AvrRig, id="avr"),
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


@pytest.fixture
def make_rig() -> Callable[..., Rig]:
    return Rig


class Bench:
    """A board, a clock, and what the board has said."""

    def __init__(self, baud: int = 115200, **options: int) -> None:
        self.peripherals = BenchPeripherals()
        self.board = EmulatedArduino(self.peripherals, baud, BoardOptions(**options))
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
