"""The text of the AutoNOMOS model cars (Freie Universität Berlin, 2015 to 2017): lines <-> values, no I/O.

Two kinds of cars, both 115200 baud:

- 2015 and 2016: an Arduino for the servo, `<0-180>` `en` `di`, each ended by CR, which answers nothing; and on a line
  of its own a Faulhaber motion controller, `v<rpm>` `en` `di` `gn` (what is the speed?), ended by CR LF, which answers
  each with a line.
- 2017: one Arduino, `S<0-180 or en or di>L<lights>M<-1000..1000>` and CR; it says `y<yaw>s<time>e<encoder>` and LF 100
  times a second. Later cars speak rosserial, which is another matter.

Sources: github.com/AutoModelCar/auto_arduino_nano (main/main.ino) and /model_car (motor_communication,
send_steering_light_speed); Faulhaber's Communication and Function Manual MCBL 300x RS.
"""

from __future__ import annotations

import re
from typing import NamedTuple, Protocol

STRAIGHT = 90
STEERING_MAX = 180
_ENCODER = re.compile(rb"(?:y[^s]*)?s\d+e(-?\d+)")
_STARTS = b"Initializing I2C"  # the first line of a program that starts
_CHATTER = (b"Initializing", b"Testing", b"MPU6050", b"Enabling", b"DMP", b"FIFO")
_NUMBER = re.compile(rb"-?\d+")


class Said(NamedTuple):
    """What a line from the car tells."""

    ticks: int | None = None  # the encoder, modulo 65536
    motor: int | None = None  # the speed, as a motor number
    started: bool = False  # the car's program has just begun


class CarText(Protocol):
    """Lines to and from one kind of car; what is written is one text a port, empty where there is nothing to say."""

    ports: int
    mute_ns: int  # for so long after opening the car may be deaf without saying so
    motor_max: int

    def drive(self, steering: int, motor: int) -> tuple[bytes, ...]:
        """Steering number 0 .. 180 and motor number."""
        ...

    def enable(self, motor: int) -> tuple[bytes, ...]:
        """Actuators on; the motor goes on with its number."""
        ...

    def disable(self) -> tuple[bytes, ...]:
        """Motor stopped, actuators off."""
        ...

    def greet(self) -> tuple[bytes, ...]:
        """What is said until the car is known to listen: stop, where that can do no harm, and say something."""
        ...

    def ask(self) -> tuple[bytes, ...]:
        """What makes the car say something."""
        ...

    def heard(self, port: int, line: bytes) -> Said | None:
        """What a line says, without its end; None for one that is damaged."""
        ...


class OneBoard:
    """The cars of 2017: one Arduino for everything. Lights stay off."""

    ports = 1
    mute_ns = 0
    motor_max = 1000  # a quarter of it is the duty; beyond 1023 that overflows

    def drive(self, steering: int, motor: int) -> tuple[bytes, ...]:
        """One line for both."""
        return (b"S%dLdiLM%d\r" % (steering, motor),)

    def enable(self, motor: int) -> tuple[bytes, ...]:
        """The servo on; the motor has no switch."""
        return (b"SenLdiLM%d\r" % motor,)

    def disable(self) -> tuple[bytes, ...]:
        """The servo off, the motor at 0."""
        return (b"SdiLdiLM0\r",)

    def greet(self) -> tuple[bytes, ...]:
        """Nothing: its bootloader must not hear anything, and opening the port has stopped it."""
        return (b"",)

    def ask(self) -> tuple[bytes, ...]:
        """It talks by itself."""
        return (b"",)

    def heard(self, port: int, line: bytes) -> Said | None:
        """The encoder, or what it says while it starts."""
        encoder = _ENCODER.fullmatch(line)
        if encoder is not None:
            return Said(ticks=int(encoder[1]) & 0xFFFF)
        if _STARTS in line:  # behind what a line that the reset cut short has left
            return Said(started=True)
        return Said() if line.startswith(_CHATTER) else None


class TwoBoards:
    """The cars of 2015 and 2016: an Arduino for the servo on the first port, a motion controller on the second."""

    ports = 2
    mute_ns = 2_000_000_000  # the Arduino's bootloader; it never says that it is over
    motor_max = 30_000  # rpm

    def drive(self, steering: int, motor: int) -> tuple[bytes, ...]:
        """A line for each."""
        return b"%d\r" % steering, b"v%d\r\n" % motor

    def enable(self, motor: int) -> tuple[bytes, ...]:
        """Both on; the speed first, so that none from before comes back."""
        return b"en\r", b"v%d\r\nen\r\n" % motor

    def disable(self) -> tuple[bytes, ...]:
        """Both off."""
        return b"di\r", b"v0\r\ndi\r\n"

    def greet(self) -> tuple[bytes, ...]:
        """The motion controller has no bootloader, and may still drive as a former host told it to."""
        return b"", b"v0\r\ndi\r\ngn\r\n"

    def ask(self) -> tuple[bytes, ...]:
        """Only the motion controller has answers."""
        return b"", b"gn\r\n"

    def heard(self, port: int, line: bytes) -> Said | None:
        """The motor's speed, or that an order was understood."""
        if port == 1 and _NUMBER.fullmatch(line):
            return Said(motor=int(line))
        return Said() if line.isascii() and line.decode("ascii").isprintable() else None
