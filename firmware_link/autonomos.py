"""The AutoNOMOS model cars (Freie Universität Berlin, 2015 to 2017) as a `VehicleLink`, and their text protocol.

There are two kinds of cars, both at 115200 baud:

- 2015 and 2016: an Arduino for the servo with the commands `<0-180>`, `en` and `di`, each ended by CR, without answers;
  and on a second line a Faulhaber motion controller with `v<rpm>`, `en`, `di` and `gn` (read the speed), ended by CR
  LF, which answers each with a line.
- 2017: one Arduino with `S<0-180 or en or di>L<lights>M<-1000..1000>` and CR; it sends `y<yaw>s<time>e<encoder>` and LF
  100 times a second. Later cars use rosserial, which is not supported.

Sources: github.com/AutoModelCar/auto_arduino_nano (main/main.ino) and /model_car (motor_communication,
send_steering_light_speed); Faulhaber's Communication and Function Manual MCBL 300x RS.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from automodel.config import LinkConfig, VehicleConfig
from automodel.signals import Command, VehicleState
from firmware_link.errors import HandshakeError, LinkError, PortLost
from firmware_link.pulses import PulseTable
from firmware_link.timing import LineSpeedMeter
from firmware_link.transport import Transport

STEERING_MAX = 180
_ENCODER = re.compile(rb"(?:y[^s]*)?s\d+e(-?\d+)")
_FIRST_LINE = b"Initializing I2C"  # the first line of a program that starts
_BANNER = (b"Initializing", b"Testing", b"MPU6050", b"Enabling", b"DMP", b"FIFO")
_NUMBER = re.compile(rb"-?\d+")
_MS = 1_000_000
_HELLO_TIMEOUT_NS = 5_000 * _MS
_VALID_NS = 100 * _MS  # no command is valid for longer, as with a board that has its own timer
_REPEAT_NS = 50 * _MS
_ENABLE_NS = 100 * _MS
_STOPPING_NS = 300 * _MS  # straight and at speed 0 before the actuators are switched off: a servo that is off is free
_ASK_NS = 20 * _MS
_SILENT_NS = 200 * _MS
_TAIL_BYTES = 128


class Report(NamedTuple):
    """The contents of a line from the car."""

    ticks: int | None = None  # the encoder, modulo 65536
    motor: int | None = None  # the speed as a motor number
    started: bool = False  # the car's program has just started


class CarText(Protocol):
    """The text protocol of one kind of car; the methods give one text per port, empty if there is nothing to send."""

    ports: int
    mute_ns: int  # time after opening in which the car may ignore commands
    motor_max: int

    def drive(self, steering: int, motor: int) -> tuple[bytes, ...]:
        """Steering number 0 .. 180 and motor number."""
        ...

    def enable(self, motor: int) -> tuple[bytes, ...]:
        """Switch the actuators on, with the motor's current number."""
        ...

    def disable(self) -> tuple[bytes, ...]:
        """Stop the motor and switch the actuators off."""
        ...

    def greet(self) -> tuple[bytes, ...]:
        """The text until the car answers: a stop where that is safe, and a request for an answer."""
        ...

    def ask(self) -> tuple[bytes, ...]:
        """A request for an answer."""
        ...

    def heard(self, port: int, line: bytes) -> Report | None:
        """The contents of a line without its end; None for a damaged one."""
        ...


class OneBoard:
    """The cars of 2017: one Arduino for everything. The lights stay off."""

    ports = 1
    mute_ns = 0
    motor_max = 1000  # the duty is a quarter of it and overflows beyond 1023

    def drive(self, steering: int, motor: int) -> tuple[bytes, ...]:
        """One line for both."""
        return (b"S%dLdiLM%d\r" % (steering, motor),)

    def enable(self, motor: int) -> tuple[bytes, ...]:
        """Servo on; the motor has no switch."""
        return (b"SenLdiLM%d\r" % motor,)

    def disable(self) -> tuple[bytes, ...]:
        """Servo off, motor at 0."""
        return (b"SdiLdiLM0\r",)

    def greet(self) -> tuple[bytes, ...]:
        """Nothing: its bootloader must not receive anything, and opening the port has stopped the car."""
        return (b"",)

    def ask(self) -> tuple[bytes, ...]:
        """Nothing: it reports periodically."""
        return (b"",)

    def heard(self, port: int, line: bytes) -> Report | None:
        """The encoder, or a line of the start-up banner."""
        encoder = _ENCODER.fullmatch(line)
        if encoder is not None:
            return Report(ticks=int(encoder[1]) & 0xFFFF)
        if _FIRST_LINE in line:  # possibly after the rest of a line that the reset has cut
            return Report(started=True)
        return Report() if line.startswith(_BANNER) else None


class TwoBoards:
    """The cars of 2015 and 2016: an Arduino for the servo on the first port, a motion controller on the second."""

    ports = 2
    mute_ns = 2_000_000_000  # the Arduino's bootloader, whose end is not reported
    motor_max = 30_000  # rpm

    def drive(self, steering: int, motor: int) -> tuple[bytes, ...]:
        """One line for each port."""
        return b"%d\r" % steering, b"v%d\r\n" % motor

    def enable(self, motor: int) -> tuple[bytes, ...]:
        """Both on; the speed first, so that no earlier one takes effect."""
        return b"en\r", b"v%d\r\nen\r\n" % motor

    def disable(self) -> tuple[bytes, ...]:
        """Both off."""
        return b"di\r", b"v0\r\ndi\r\n"

    def greet(self) -> tuple[bytes, ...]:
        """Stop the motion controller: it has no bootloader and may still execute commands of an earlier host."""
        return b"", b"v0\r\ndi\r\ngn\r\n"

    def ask(self) -> tuple[bytes, ...]:
        """Only the motion controller answers."""
        return b"", b"gn\r\n"

    def heard(self, port: int, line: bytes) -> Report | None:
        """The motor's speed, or the acknowledgement of a command."""
        if port == 1 and _NUMBER.fullmatch(line):
            return Report(motor=int(line))
        return Report() if line.isascii() and line.decode("ascii").isprintable() else None


@dataclass(slots=True, kw_only=True)
class LineErrors:
    """The number of rejected lines."""

    total: int = 0


@dataclass(slots=True)
class _Session:
    """The state of the connection since the ports were opened."""

    tails: list[bytes]
    steering: int  # the last numbers that were sent
    motor: int = 0
    direction: int = 1  # of the last speed other than 0
    opened_ns: int | None = None  # or when its program restarted
    ready: bool = False
    heard_ns: int = 0
    lines: int = 0  # with the encoder's count
    encoder: int | None = None
    ticks: int = 0
    speed_mps: float | None = None
    armed: bool = False
    deadline_ns: int = 0  # when the newest fresh command expires
    stopped_ns: int | None = None  # when arming ended
    written_ns: int | None = None
    enabled_ns: int | None = None
    asked_ns: int | None = None
    faults: list[str] = field(default_factory=list)


class AutonomosLink:
    """The car with its text protocol: one port, or two if the motor's controller has its own.

    The car has no checksums and no timers: a damaged line may be a wrong steering angle or speed, and the last speed is
    kept until the next one. Therefore the host

    - repeats each command after 50 ms at the latest, and `en` after 100 ms;
    - ends arming if no fresh command has come for 100 ms (`command_timeout`), if the car has been silent for 200 ms
      (`link_silent`), or if its program restarts (`board_restarted`); only another `arm` restores it;
    - then commands straight and speed 0 for 300 ms, and after that `di`, ten times a second;
    - sends both on closing, and to the other port when one fails.

    It cannot do this when it is killed, stopped or disconnected: **then the car keeps driving**. `armed` is the host's
    request, as the car does not report it. Only a stop is sent before the car's first line.
    """

    def __init__(self, ports: Sequence[Transport], link_config: LinkConfig, vehicle_config: VehicleConfig) -> None:
        self._ports = tuple(ports)
        self._text: CarText = OneBoard() if len(self._ports) == 1 else TwoBoards()
        own = link_config.autonomos
        names = (link_config.port, own.motor_port)[: len(self._ports)]
        self._place = f"{' and '.join(names)} at {link_config.baud} baud"
        self._servo = PulseTable(link_config.servo.pulse_us, link_config.servo.steering_rad)
        self._servo_0_us, servo_180_us = own.servo_us
        self._step_us = (servo_180_us - self._servo_0_us) / STEERING_MAX
        self._mps_per_number = own.at_1000_mps / 1000.0
        self._speed = LineSpeedMeter(vehicle_config.ticks_per_m)
        self._session: _Session | None = None
        self._starts = 0
        self.errors = LineErrors()

    def open(self) -> None:
        """Open the ports, which may reset the boards; raises LinkError."""
        self._session = None
        try:
            for port in self._ports:
                port.open()
        except LinkError:
            self.close()
            raise
        self._speed.reset()
        self._starts += 1
        self._session = _Session(tails=[b""] * len(self._ports), steering=self._steering_number(0.0))

    def poll(self, now_ns: int) -> VehicleState | None:
        """Process the received lines and repeat commands; None until the car has sent a line."""
        session = self._live()
        if session.opened_ns is None:
            session.opened_ns = now_ns
        with self._stopping():
            self._take_in(session, now_ns)
            self._watch(session, now_ns)
            self._repeat(session, now_ns)
        return self._state(session) if session.ready else None

    def send(self, command: Command, now_ns: int) -> None:
        """Send the command; ignored while disarmed, when `poll` sends the stop."""
        session = self._live()
        if not session.armed:
            return
        finite = math.isfinite(command.steering_rad) and math.isfinite(command.speed_mps)
        if finite and now_ns <= command.valid_until_ns:
            session.deadline_ns = min(command.valid_until_ns, now_ns + _VALID_NS)
            session.steering = self._steering_number(command.steering_rad)
            session.motor = self._motor_number(command.speed_mps)
        else:
            session.steering, session.motor = self._steering_number(0.0), 0
        with self._stopping():
            self._drive(session, now_ns)

    def arm(self, now_ns: int) -> None:
        """Switch the actuators on and accept `send`; ignored while `poll` still gives None, or if armed."""
        session = self._live()
        if session.ready and not session.armed:
            session.armed, session.deadline_ns, session.enabled_ns = True, now_ns + _VALID_NS, None
            session.faults.clear()
            with self._stopping():
                self._repeat(session, now_ns)

    def disarm(self, now_ns: int) -> None:
        """Straight and speed 0 at once; the actuators are switched off 300 ms later."""
        session = self._live()
        self._end_arming(session, now_ns)
        if session.ready:
            with self._stopping():
                self._drive(session, now_ns)

    def close(self) -> None:
        """Straight, speed 0 and actuators off, if the ports allow it, and close."""
        self._send_stop()
        self._session = None
        for port in self._ports:
            port.close()

    def _live(self) -> _Session:
        if self._session is None:
            raise PortLost(f"{self._place}: not open")
        return self._session

    @contextlib.contextmanager
    def _stopping(self) -> Iterator[None]:
        """If a port fails, stop the boards on the other ports."""
        try:
            yield
        except LinkError:
            self._send_stop()
            raise

    def _send_stop(self) -> None:
        session = self._session
        if session is not None and session.ready:
            for lines in (self._text.drive(self._steering_number(0.0), 0), self._text.disable()):
                with contextlib.suppress(LinkError):
                    self._write(lines)

    def _write(self, lines: Sequence[bytes]) -> None:
        failed: LinkError | None = None
        for port, text in zip(self._ports, lines, strict=True):
            try:
                if text:
                    port.write(text)
            except LinkError as error:  # the other port must get its text all the same
                failed = failed or error
        if failed is not None:
            raise failed

    def _drive(self, session: _Session, now_ns: int) -> None:
        session.written_ns = now_ns
        if session.motor:
            session.direction = 1 if session.motor * self._mps_per_number > 0 else -1
        self._write(self._text.drive(session.steering, session.motor))

    def _take_in(self, session: _Session, now_ns: int) -> None:
        for index, port in enumerate(self._ports):
            *lines, tail = (session.tails[index] + port.read()).split(b"\n")
            session.tails[index] = tail[:_TAIL_BYTES]
            for line in lines:
                report = self._text.heard(index, line.rstrip(b"\r"))
                if report is not None:
                    self._take(session, report, now_ns)
                elif session.ready:  # the first line may lack its start
                    self.errors.total += 1
        if session.heard_ns and now_ns - (session.opened_ns or 0) >= self._text.mute_ns:
            session.ready = True
        if session.encoder is not None:
            session.speed_mps = self._speed.step(session.lines, session.ticks, now_ns)

    def _take(self, session: _Session, report: Report, now_ns: int) -> None:
        if report.started:
            if session.ready:
                self._starts += 1
                self._end_arming(session, now_ns, "board_restarted")
            session.ready, session.heard_ns, session.encoder = False, 0, None
            session.opened_ns = now_ns
            self._speed.reset()
        elif report.ticks is not None:
            before = report.ticks if session.encoder is None else session.encoder
            step = (report.ticks - before + 0x8000 & 0xFFFF) - 0x8000
            session.encoder, session.lines = report.ticks, session.lines + 1
            session.ticks += session.direction * abs(step)  # the Arduino does not detect the direction either
            session.heard_ns = now_ns
        elif report.motor is not None:
            session.speed_mps = report.motor * self._mps_per_number
            session.heard_ns = now_ns

    def _watch(self, session: _Session, now_ns: int) -> None:
        if not session.ready:
            if now_ns - (session.opened_ns or 0) > _HELLO_TIMEOUT_NS:
                raise HandshakeError(f"{self._place}: the car sends nothing; check ports, baud rate and [link] kind")
        elif now_ns - session.heard_ns > _SILENT_NS:
            self._end_arming(session, now_ns, "link_silent")
        elif session.armed and now_ns > session.deadline_ns:
            self._end_arming(session, now_ns, "command_timeout")

    def _end_arming(self, session: _Session, now_ns: int, fault: str | None = None) -> None:
        if session.armed:
            session.armed, session.stopped_ns, session.written_ns = False, now_ns, None
        session.steering, session.motor = self._steering_number(0.0), 0
        if fault is not None and fault not in session.faults:
            session.faults.append(fault)

    def _repeat(self, session: _Session, now_ns: int) -> None:
        if _due(session.asked_ns, _ASK_NS, now_ns):
            session.asked_ns = now_ns
            self._write(self._text.ask() if session.ready else self._text.greet())
        if not session.ready:
            return
        stopping = session.stopped_ns is not None and now_ns - session.stopped_ns < _STOPPING_NS
        if session.armed and _due(session.enabled_ns, _ENABLE_NS, now_ns):
            session.enabled_ns = now_ns
            self._write(self._text.enable(session.motor))
        if session.armed or stopping:
            if _due(session.written_ns, _REPEAT_NS, now_ns):
                self._drive(session, now_ns)
        elif _due(session.written_ns, _ENABLE_NS, now_ns):
            session.written_ns = now_ns
            self._write(self._text.disable())

    def _steering_number(self, steering_rad: float) -> int:
        number = round((self._servo.pulse_us(steering_rad) - self._servo_0_us) / self._step_us)
        return min(max(number, 0), STEERING_MAX)

    def _motor_number(self, speed_mps: float) -> int:
        most = self._text.motor_max
        return min(max(round(speed_mps / self._mps_per_number), -most), most)

    def _state(self, session: _Session) -> VehicleState:
        return VehicleState(
            t_ns=session.heard_ns,
            speed_mps=session.speed_mps,
            steering_rad=self._servo.value(self._servo_0_us + session.steering * self._step_us),
            armed=session.armed,
            faults=tuple(session.faults),
            boot_id=self._starts,
        )


def _due(last_ns: int | None, period_ns: int, now_ns: int) -> bool:
    return last_ns is None or now_ns - last_ns >= period_ns
