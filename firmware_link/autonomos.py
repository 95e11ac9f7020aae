"""The AutoNOMOS model cars as a `VehicleLink`: what their boards leave undone is done here, as far as a host can."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from automodel.config import LinkConfig, VehicleConfig
from automodel.signals import Command, VehicleState
from firmware_link.autonomos_text import STEERING_MAX, CarText, OneBoard, Said, TwoBoards
from firmware_link.errors import HandshakeError, LinkError, PortLost
from firmware_link.pulses import PulseTable
from firmware_link.timing import LineSpeedMeter
from firmware_link.transport import Transport

_MS = 1_000_000
_HELLO_TIMEOUT_NS = 5_000 * _MS
_VALID_NS = 100 * _MS  # no command is good for longer, as with a board that has a timer of its own
_REPEAT_NS = 50 * _MS
_ENABLE_NS = 100 * _MS
_STOPPING_NS = 300 * _MS  # straight and at speed 0 before the actuators go off: a servo that is off holds nothing
_ASK_NS = 20 * _MS
_SILENT_NS = 200 * _MS
_TAIL_BYTES = 128


@dataclass(slots=True, kw_only=True)
class LineErrors:
    """How many lines were thrown away."""

    total: int = 0


@dataclass(slots=True)
class _Session:
    """What is known of the car since the ports were opened."""

    tails: list[bytes]
    steering: int  # the numbers that were written last
    motor: int = 0
    direction: int = 1  # of the last speed that was not 0
    opened_ns: int | None = None  # or when its program began anew
    ready: bool = False
    heard_ns: int = 0
    lines: int = 0  # with the encoder's count
    encoder: int | None = None
    ticks: int = 0
    speed_mps: float | None = None
    armed: bool = False
    deadline_ns: int = 0  # when the newest fresh command is none any more
    stopped_ns: int | None = None  # when arming ended
    written_ns: int | None = None
    enabled_ns: int | None = None
    asked_ns: int | None = None
    faults: list[str] = field(default_factory=list)


class AutonomosLink:
    """The car behind its text (`autonomos_text`): one port, or two where the motor's controller has its own.

    The car checks nothing and times nothing: a damaged line may be a wrong steering or speed, and the last speed holds
    until another comes. So the host

    - sends each order again after 50 ms at the latest, `en` after 100 ms;
    - ends arming when no fresh command has come for 100 ms (`command_timeout`), when the car has said nothing for
      200 ms (`link_silent`), when its program starts anew (`board_restarted`); only another `arm` brings it back;
    - then orders straight and speed 0 for 300 ms, and `di` from then on, ten times a second;
    - says both at once when it closes, and to what is left when a port fails.

    It can do none of that when it is killed, stopped or cut off: **then the car drives on**. `armed` is what the host
    has asked for: the car does not say. Nothing but a stop is sent before the car's first line.
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
        """Take in what has arrived, and say again what must be; None until the car has said something."""
        session = self._live()
        if session.opened_ns is None:
            session.opened_ns = now_ns
        with self._stopping():
            self._take_in(session, now_ns)
            self._watch(session, now_ns)
            self._say_again(session, now_ns)
        return self._state(session) if session.ready else None

    def send(self, command: Command, now_ns: int) -> None:
        """Write the command's numbers; nothing while disarmed, when `poll` says what must be."""
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
        """Switch the actuators on and obey `send`; ignored while `poll` still gives None, or armed already."""
        session = self._live()
        if session.ready and not session.armed:
            session.armed, session.deadline_ns, session.enabled_ns = True, now_ns + _VALID_NS, None
            session.faults.clear()
            with self._stopping():
                self._say_again(session, now_ns)

    def disarm(self, now_ns: int) -> None:
        """Straight and speed 0, at once, and the actuators off 300 ms later."""
        session = self._live()
        self._end_arming(session, now_ns)
        if session.ready:
            with self._stopping():
                self._drive(session, now_ns)

    def close(self) -> None:
        """Straight, speed 0 and actuators off, as far as the ports allow, and close."""
        self._say_last()
        self._session = None
        for port in self._ports:
            port.close()

    def _live(self) -> _Session:
        if self._session is None:
            raise PortLost(f"{self._place}: not open")
        return self._session

    @contextlib.contextmanager
    def _stopping(self) -> Iterator[None]:
        """A port that fails ends it all: the others are told to stop."""
        try:
            yield
        except LinkError:
            self._say_last()
            raise

    def _say_last(self) -> None:
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
            except LinkError as error:  # the other port must be told all the same
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
                said = self._text.heard(index, line.rstrip(b"\r"))
                if said is not None:
                    self._take(session, said, now_ns)
                elif session.ready:  # the first line may lack its beginning
                    self.errors.total += 1
        if session.heard_ns and now_ns - (session.opened_ns or 0) >= self._text.mute_ns:
            session.ready = True
        if session.encoder is not None:
            session.speed_mps = self._speed.step(session.lines, session.ticks, now_ns)

    def _take(self, session: _Session, said: Said, now_ns: int) -> None:
        if said.started:
            if session.ready:
                self._starts += 1
                self._end_arming(session, now_ns, "board_restarted")
            session.ready, session.heard_ns, session.encoder = False, 0, None
            session.opened_ns = now_ns
            self._speed.reset()
        elif said.ticks is not None:
            before = said.ticks if session.encoder is None else session.encoder
            step = (said.ticks - before + 0x8000 & 0xFFFF) - 0x8000
            session.encoder, session.lines = said.ticks, session.lines + 1
            session.ticks += session.direction * abs(step)  # the Arduino does not see which way it goes either
            session.heard_ns = now_ns
        elif said.motor is not None:
            session.speed_mps = said.motor * self._mps_per_number
            session.heard_ns = now_ns

    def _watch(self, session: _Session, now_ns: int) -> None:
        if not session.ready:
            if now_ns - (session.opened_ns or 0) > _HELLO_TIMEOUT_NS:
                raise HandshakeError(f"{self._place}: the car says nothing; check ports, baud rate and [link] kind")
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

    def _say_again(self, session: _Session, now_ns: int) -> None:
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
