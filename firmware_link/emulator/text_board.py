"""A board that speaks text and is not there: power, serial line, time; what it says and does comes from a subclass."""

from __future__ import annotations

import abc
import sys

from firmware_link.emulator.board import Peripherals
from firmware_link.emulator.options import BoardCounters
from firmware_link.emulator.uart import UartLine

NEUTRAL_US = 1500.0
BOOT_NS = 1_000_000_000  # bootloader, and the gyro's start
NEVER = sys.maxsize
_WIRE_BYTES = 4096


class Pins:
    """The servo's and the motor's pulses, which may come from two boards; 0 is none."""

    def __init__(self, peripherals: Peripherals) -> None:
        self.peripherals = peripherals
        self._t_ns = 0
        self.servo_us, self.motor_us = 0.0, NEUTRAL_US

    def set(self, t_ns: int, *, servo_us: float | None = None, motor_us: float | None = None) -> None:
        """The pulses from `t_ns` on; None leaves one as it is."""
        self._t_ns = max(t_ns, self._t_ns)
        self.servo_us = self.servo_us if servo_us is None else servo_us
        self.motor_us = self.motor_us if motor_us is None else motor_us
        self.peripherals.set_pulses(self._t_ns, self.servo_us, self.motor_us)


class TextBoard(abc.ABC):
    """What the boards have in common: power, serial line, time. A `Board` for `MemoryTransport` and `PtyBoard`.

    A board that hangs leaves its pins as they are for good: none has a watchdog.
    """

    def __init__(self, pins: Pins, baud: int = 115200, boot_ns: int = BOOT_NS) -> None:
        self._pins = pins
        self._boot_ns = boot_ns
        self._rx = UartLine(baud, _WIRE_BYTES)
        self._tx = UartLine(baud, _WIRE_BYTES)
        self._sent = b""  # on the host's side, as in a tty's buffer
        self._on = False
        self._boot_end_ns: int | None = None  # while it boots
        self._hung = False
        self.counters = BoardCounters()

    def reset(self, now_ns: int) -> None:
        """Restart, as the reset line does when a host opens the port."""
        if self._on:
            self.advance(now_ns)
        self._on, self._hung = True, False
        self._boot_end_ns = now_ns + self._boot_ns
        self._tx.clear()
        self.counters.starts += 1
        self._stop(now_ns)

    def brown_out(self, now_ns: int) -> None:
        """Fault: the supply dips."""
        self.reset(now_ns)

    def hang(self, now_ns: int) -> None:
        """Fault: the program stops."""
        self.advance(now_ns)
        self._hung = True

    def room(self, now_ns: int) -> int:
        """How many bytes `receive` takes at `now_ns`."""
        return self._rx.room(now_ns)

    def receive(self, data: bytes, now_ns: int) -> int:
        """Put the host's bytes on the line; how many there was room for, the others are lost."""
        taken = data[: self._rx.room(now_ns)]
        if taken:
            self._rx.put(taken, now_ns)
        return len(taken)

    def transmit(self, now_ns: int) -> bytes:
        """The bytes whose last bit has left by `now_ns`, since the last call; 4096 at most, the newest are lost."""
        self._collect(now_ns)
        sent, self._sent = self._sent, b""
        return sent

    def advance(self, now_ns: int) -> None:
        """Do all that happens up to `now_ns`; times never go back. The first call switches the power on."""
        if not self._on:
            self.reset(now_ns)
        while (t_ns := self._next_ns()) <= now_ns:
            if self._boot_end_ns is not None:
                self.counters.rx_in_boot += len(self._rx.take(t_ns))
                self._boot_end_ns = None
                self._begin(t_ns)
                continue
            for byte in self._rx.take(t_ns):
                if not self._hung:
                    self._hear(chr(byte), t_ns)
            if t_ns >= self._due_ns():
                self._act(t_ns)

    def _next_ns(self) -> int:
        if self._boot_end_ns is not None:
            return self._boot_end_ns
        arrival_ns = self._rx.next_ns()
        return min(self._due_ns(), NEVER if arrival_ns is None else arrival_ns)

    def _say(self, text: bytes, t_ns: int) -> None:
        self._collect(t_ns)
        if len(text) <= self._tx.room(t_ns):
            self._tx.put(text, t_ns)

    def _collect(self, now_ns: int) -> None:
        arrived = self._tx.take(now_ns)
        if arrived:
            self._sent = (self._sent + arrived)[:_WIRE_BYTES]

    @abc.abstractmethod
    def _stop(self, t_ns: int) -> None:
        """A reset: everything forgotten, and what becomes of the pins."""

    @abc.abstractmethod
    def _begin(self, t_ns: int) -> None:
        """The program begins."""

    @abc.abstractmethod
    def _due_ns(self) -> int:
        """When the program does something by itself; NEVER where it does not."""

    @abc.abstractmethod
    def _act(self, t_ns: int) -> None:
        """Do it."""

    @abc.abstractmethod
    def _hear(self, char: str, t_ns: int) -> None:
        """A byte from the host."""
