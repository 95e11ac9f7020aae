"""A link and what is behind it: over memory in virtual time, over a pty in real time; with each kind of board."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from automodel.config import LinkConfig, MotorConfig, ServoConfig, VehicleConfig
from automodel.signals import Command, VehicleState
from firmware_link.arduino import ArduinoLink
from firmware_link.autonomos import AutonomosLink
from firmware_link.emulator.autonomos import EmulatedAutonomos, EmulatedMotorController, EmulatedServoBoard, Pins
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.logic import BoardOptions
from firmware_link.emulator.pty import BenchPeripherals, PtyBoard
from firmware_link.transport import MemoryTransport, SerialTransport
from tests.support.avr_board import HeardAvr

MS = 1_000_000
PERIOD_NS = 16_666_667
CONFIG = LinkConfig(
    servo=ServoConfig(pulse_us=(1100.0, 1520.0, 1900.0), steering_rad=(0.4, 0.0, -0.5)),
    motor=MotorConfig(pulse_us=(1200.0, 1500.0, 1800.0), speed_mps=(-3.0, 0.0, 3.0)),
)


class Rig:
    """A link and the board behind it, in virtual time.

    `driven` has the pulses that the orders (0.2 rad, 1 m/s) and (-0.25 rad, -1 m/s) make, `resting` the steering pulses
    of a car at rest. What a car does not tell, or does not do, is False.
    """

    realtime = False
    config = CONFIG
    driven: tuple[tuple[float, float], tuple[float, float]] = ((1310.0, 1600.0), (1710.0, 1400.0))
    resting: frozenset[float] = frozenset({1520.0})
    has_sensors = tells_boot_id = tells_restart = has_watchdog = True

    def __init__(self, options: BoardOptions | None = None) -> None:
        self.peripherals = BenchPeripherals()
        self.board: Any = self.make_board(options)
        self.t_ns = 1_000_000 * MS
        self.cable: Any = self.transport()
        self.link: Any = self.make_link()

    def make_link(self) -> Any:
        return ArduinoLink(self.cable, CONFIG, VehicleConfig())

    def at_rest(self, pulses: tuple[float, float] | None = None) -> bool:
        """Whether these pulses, those at the pins, are those of a car at rest."""
        servo_us, motor_us = pulses or self.peripherals.at_pins
        return servo_us in self.resting and motor_us == 1500.0

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


class AutonomosRig(Rig):
    """A link and an AutoNOMOS car of 2017, whose steering has steps of 5.6 us and whose motor has 250."""

    driven = ((1311.0, 1599.2), (1711.0, 1400.8))
    resting = frozenset({0.0, 1500.0, 1522.0})  # off; the servo library's own; straight
    has_sensors = tells_boot_id = has_watchdog = False

    def make_board(self, options: BoardOptions | None) -> Any:
        if options is not None:
            pytest.skip("the text has no versions")
        return EmulatedAutonomos(self.peripherals, CONFIG.baud, 300 * MS)

    def make_link(self) -> Any:
        return AutonomosLink([self.cable], CONFIG, VehicleConfig())


class AutonomosPtyRig(AutonomosRig, PtyRig):
    """The same over a pty, against the real clock."""


class BothBoards:
    """The two boards of an AutoNOMOS car of 2015."""

    def __init__(self, peripherals: BenchPeripherals) -> None:
        pins = Pins(peripherals)
        self.servo = EmulatedServoBoard(pins, CONFIG.baud, 300 * MS)
        self.motor = EmulatedMotorController(pins, CONFIG.baud)
        self.counters = self.servo.counters

    @property
    def armed(self) -> bool:
        return self.motor.armed

    def advance(self, now_ns: int) -> None:
        self.servo.advance(now_ns)
        self.motor.advance(now_ns)

    def transmit(self, now_ns: int) -> bytes:
        return self.servo.transmit(now_ns) + self.motor.transmit(now_ns)


class AutonomosOf2015Rig(AutonomosRig):
    """A link and an AutoNOMOS car of 2015: two ports."""

    driven = ((1311.0, 1600.0), (1711.0, 1400.0))
    tells_restart = False

    def make_board(self, options: BoardOptions | None) -> Any:
        if options is not None:
            pytest.skip("the text has no versions")
        return BothBoards(self.peripherals)

    def transport(self) -> MemoryTransport | SerialTransport:
        self.motor_cable = MemoryTransport(self.board.motor, self)
        return MemoryTransport(self.board.servo, self)

    def make_link(self) -> Any:
        return AutonomosLink([self.cable, self.motor_cable], CONFIG, VehicleConfig())

    def unplug(self) -> None:
        self.cable.unplug()
        self.motor_cable.unplug()

    def replug(self) -> None:
        self.cable.replug()
        self.motor_cable.replug()
