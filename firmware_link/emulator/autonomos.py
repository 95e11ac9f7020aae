"""Emulated boards of the AutoNOMOS cars with their text protocol; time is an argument.

They have the weaknesses of the real programs: no checksum, no timer, and a lost byte may give another number. Damaged
text has the same effect as in the sources that `firmware_link.autonomos` names.
"""

from __future__ import annotations

import abc
import re
import sys

from firmware_link.emulator.board import SERVO_FRAME_NS, Peripherals
from firmware_link.emulator.logic import BoardCounters
from firmware_link.emulator.uart import WIRE_BYTES, UartBoard

NEUTRAL_US = 1500.0
BOOT_NS = 1_000_000_000  # bootloader and start of the gyro
REPORT_NS = 10_000_000  # the period of the gyro's readings
SERVO_US = (900, 1900)  # the pulses of 0 and 180
FULL_US = 400.0  # motor pulse above neutral for the motor number 1000: the simulated car's motor has pulse inputs
NEVER = sys.maxsize
_FULL_DUTY = 250
_WHOLE = re.compile(r"\s*(-?\d+)")
_BANNER = b"Initializing I2C devices...\r\nTesting device connections...\r\nMPU6050 connection successful\r\n"


class Pins:
    """The pulses of servo and motor, which may come from two boards; 0 is no pulse."""

    def __init__(self, peripherals: Peripherals) -> None:
        self.peripherals = peripherals
        self._t_ns = 0
        self.servo_us, self.motor_us = 0.0, NEUTRAL_US

    def set(self, t_ns: int, *, servo_us: float | None = None, motor_us: float | None = None) -> None:
        """Set the pulses from `t_ns` on; None keeps a pulse."""
        self._t_ns = max(t_ns, self._t_ns)
        self.servo_us = self.servo_us if servo_us is None else servo_us
        self.motor_us = self.motor_us if motor_us is None else motor_us
        self.peripherals.set_pulses(self._t_ns, self.servo_us, self.motor_us)


class TextBoard(UartBoard, abc.ABC):
    """The common part of the boards: power, serial line, time. A `Board` for `MemoryTransport` and `PtyBoard`.

    A board that hangs keeps its pins: there is no watchdog.
    """

    def __init__(self, pins: Pins, baud: int = 115200, boot_ns: int = BOOT_NS) -> None:
        super().__init__(baud, WIRE_BYTES)
        self._pins = pins
        self._boot_ns = boot_ns
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

    def advance(self, now_ns: int) -> None:
        """Run up to `now_ns`; times never decrease. The first call switches the power on."""
        if not self._on:
            self.reset(now_ns)
        while (t_ns := self._next_ns()) <= now_ns:
            if self._boot_end_ns is not None:
                self.counters.rx_in_boot += len(self._rx.take(t_ns))
                self._boot_end_ns = None
                self._start(t_ns)
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

    @abc.abstractmethod
    def _stop(self, t_ns: int) -> None:
        """Reset the program's state and the pins."""

    @abc.abstractmethod
    def _start(self, t_ns: int) -> None:
        """Start the program."""

    @abc.abstractmethod
    def _due_ns(self) -> int:
        """The time of the program's next own action; NEVER without one."""

    @abc.abstractmethod
    def _act(self, t_ns: int) -> None:
        """Perform that action."""

    @abc.abstractmethod
    def _hear(self, char: str, t_ns: int) -> None:
        """Process a byte from the host."""


class _ServoPin:
    """The Arduino's servo library: a pulse each 20 ms while attached."""

    def __init__(self, pins: Pins) -> None:
        self._pins = pins
        self.due_ns = NEVER
        self.reset()

    def reset(self) -> None:
        self.due_ns, self._us = NEVER, NEUTRAL_US

    def order(self, word: str, t_ns: int, *, in_range: bool) -> None:
        """`en`, `di`, or a number, 0 if invalid. `in_range`: numbers outside 0 .. 180 are ignored."""
        if word == "en":
            self.due_ns = min(self.due_ns, t_ns)
        elif word == "di":
            self.due_ns = NEVER
            self._pins.set(t_ns, servo_us=0.0)
        else:
            number = whole(word)
            if 0 <= number <= 180 or not in_range:
                low, high = SERVO_US
                self._us = float(min(max(low + int(number * (high - low) / 180), 544), 2400))

    def frame(self, t_ns: int) -> None:
        self.due_ns += SERVO_FRAME_NS
        self._pins.set(t_ns, servo_us=self._us)


class EmulatedAutonomos(TextBoard):
    """The Arduino of 2017: servo and motor by one line, the encoder reported 100 times a second.

    The motor's number takes effect at once, independently of the servo, and the last one is kept. The encoder counts in
    the commanded direction.
    """

    def __init__(self, peripherals: Peripherals, baud: int = 115200, boot_ns: int = BOOT_NS) -> None:
        super().__init__(Pins(peripherals), baud, boot_ns)
        self._servo = _ServoPin(self._pins)
        self._report_due_ns = NEVER
        self._encoder = 0
        self._counting = 1
        self._ticks: int | None = None
        self._words = ["", "", ""]  # steering, lights, motor
        self._word = 0

    @property
    def boot_id(self) -> int:
        """The number of starts."""
        return self.counters.starts

    @property
    def armed(self) -> bool:
        """Whether it drives the motor."""
        return self._pins.motor_us != NEUTRAL_US

    def _stop(self, t_ns: int) -> None:
        self._servo.reset()
        self._report_due_ns, self._encoder, self._ticks = NEVER, 0, None
        self._words, self._word = ["", "", ""], 0
        self._pins.set(t_ns, servo_us=0.0, motor_us=NEUTRAL_US)

    def _start(self, t_ns: int) -> None:
        self._say(_BANNER, t_ns)
        self._servo.order("en", t_ns, in_range=True)
        self._report_due_ns = t_ns + 2 * REPORT_NS

    def _due_ns(self) -> int:
        return min(self._servo.due_ns, self._report_due_ns)

    def _act(self, t_ns: int) -> None:
        if t_ns >= self._servo.due_ns:
            self._servo.frame(t_ns)
        if t_ns >= self._report_due_ns:
            self._report_due_ns += REPORT_NS
            ticks = self._pins.peripherals.read_sensors(t_ns).wheel_ticks
            self._encoder += self._counting * abs(ticks - (ticks if self._ticks is None else self._ticks))
            self._ticks = ticks
            if not self._hung:
                self._say(b"y0.00s0e%d\n" % int16(self._encoder), t_ns)

    def _hear(self, char: str, t_ns: int) -> None:
        if char == "S":
            self._words, self._word = ["", "", ""], 0
            return
        if char == "L":
            self._word = max(self._word, 1)
        elif char == "M":
            self._word = 2
        if self._word < 2 or char not in "M\r":  # without an S everything is appended to the motor's number
            self._words[self._word] += char
        if char == "\r" and self._word == 2:
            self._obey(t_ns)

    def _obey(self, t_ns: int) -> None:
        steering, _, motor = self._words
        if steering:
            self._servo.order(steering, t_ns, in_range=True)
        if motor:
            number = whole(motor)
            self._counting = 1 if int(number / 4) < 0 else -1
            duty = abs(int(number / 4)) & 0xFF
            self._pins.set(t_ns, motor_us=NEUTRAL_US + self._counting * FULL_US * duty / _FULL_DUTY)


class EmulatedServoBoard(TextBoard):
    """The Arduino of 2015: only the servo, without answers."""

    def __init__(self, pins: Pins, baud: int = 115200, boot_ns: int = BOOT_NS) -> None:
        super().__init__(pins, baud, boot_ns)
        self._servo = _ServoPin(pins)
        self._text = ""

    def _stop(self, t_ns: int) -> None:
        self._servo.reset()
        self._text = ""
        self._pins.set(t_ns, servo_us=0.0)

    def _start(self, t_ns: int) -> None:
        self._servo.order("en", t_ns, in_range=False)

    def _due_ns(self) -> int:
        return self._servo.due_ns

    def _act(self, t_ns: int) -> None:
        self._servo.frame(t_ns)

    def _hear(self, char: str, t_ns: int) -> None:
        if char != "\r":
            self._text += char
            return
        word, self._text = self._text, ""
        self._servo.order(word, t_ns, in_range=False)


class EmulatedMotorController(TextBoard):
    """The motion controller of 2015: `v`, `en`, `di`, `gn`. It has no reset line: opening its port changes nothing."""

    def __init__(self, pins: Pins, baud: int = 115200) -> None:
        super().__init__(pins, baud, 0)
        self._text = ""
        self._enabled = False
        self._rpm = 0

    @property
    def armed(self) -> bool:
        """Whether it drives the motor."""
        return self._enabled and self._rpm != 0

    def reset(self, now_ns: int) -> None:
        """Only the first time, at power-on."""
        if not self._on:
            super().reset(now_ns)

    def brown_out(self, now_ns: int) -> None:
        """Fault: the supply dips."""
        self.advance(now_ns)
        super().reset(now_ns)

    def _stop(self, t_ns: int) -> None:
        self._text, self._enabled, self._rpm = "", False, 0
        self._pins.set(t_ns, motor_us=NEUTRAL_US)

    def _start(self, t_ns: int) -> None:
        """It waits for commands."""

    def _due_ns(self) -> int:
        return NEVER

    def _act(self, t_ns: int) -> None:
        """It has no actions of its own."""

    def _hear(self, char: str, t_ns: int) -> None:
        if char not in "\r\n":
            self._text += char.lower()
        if char != "\r":
            return
        word, self._text = self._text, ""
        answer = b"OK"
        if word in ("en", "di"):
            self._enabled = word == "en"
        elif re.fullmatch(r"v-?\d{1,5}", word):
            self._rpm = int(word[1:])
        elif word == "gn":
            answer = b"%d" % (self._rpm if self._enabled else 0)
        else:
            answer = b"Unknown command"
        self._pins.set(t_ns, motor_us=NEUTRAL_US - (FULL_US * self._rpm / 1000 if self._enabled else 0.0))
        self._say(answer + b"\r\n", t_ns)


def whole(word: str) -> int:
    """As Arduino's `String.toInt` into an int: the leading digits, 0 without digits, 16 bits."""
    match = _WHOLE.match(word)
    return int16(int(match[1])) if match else 0


def int16(number: int) -> int:
    """The lowest 16 bits, signed."""
    return (number + 0x8000 & 0xFFFF) - 0x8000
