"""The serial Arduino as a `VehicleLink`: commands to pulses and bytes, bytes to vehicle states."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass, field

from automodel.config import LinkConfig, VehicleConfig
from automodel.signals import Command, VehicleState
from firmware_link import messages
from firmware_link.errors import HandshakeError, LinkError, PortLost
from firmware_link.framing import FrameErrors
from firmware_link.messages import CommandFlag, Fault, StatusFlag
from firmware_link.pulses import PulseTable
from firmware_link.timing import BoardClock, SpeedMeter
from firmware_link.transport import Transport

LATCHED_FAULTS = frozenset({"command_timeout", "board_restarted", "link_silent"})  # they explain why it is disarmed
LASTING_NS = 1_000_000_000  # longer than the voltage drop of a starting motor
FITTED_V = 1.0  # below this nothing is connected to the board's input

_MS = 1_000_000
_HELLO_TIMEOUT_NS = 5_000 * _MS  # the slowest bootloaders wait 2 s
_VALID_NS = 100 * _MS  # no command is valid for longer than the board's timer
_SETUP_RETRY_NS = 100 * _MS
_ARM_RETRY_NS = 50 * _MS  # two statuses
_ARM_NS = 300 * _MS
_SILENT_NS = 200 * _MS  # ten missing statuses
_FAULT_NAMES = tuple((int(fault), str(fault.name).lower()) for fault in Fault)


class BatteryMeter:
    """The battery is low after its voltage was below `low_v` for a second, until it was above for a second."""

    def __init__(self, low_v: float) -> None:
        self._low_v = low_v
        self.reset()

    def reset(self) -> None:
        """Forget all readings."""
        self.voltage_v: float | None = None  # the last reading
        self.low = False
        self._other_since_ns: int | None = None  # since when the readings contradict `low`

    def step(self, voltage_v: float, t_ns: int) -> bool:
        """Process a reading; gives whether the battery is low."""
        self.voltage_v = voltage_v
        if (FITTED_V <= voltage_v < self._low_v) is self.low:
            self._other_since_ns = None
        elif self._other_since_ns is None:
            self._other_since_ns = t_ns
        elif t_ns - self._other_since_ns >= LASTING_NS:
            self.low, self._other_since_ns = not self.low, None
        return self.low


@dataclass(slots=True)
class _Session:
    """The state of the connection since the port was opened."""

    opened_ns: int | None = None
    hello: messages.Hello | None = None
    status: messages.Status | None = None
    status_ns: int = 0
    faults: int = 0
    odometry: messages.Odometry | None = None
    ranges: messages.Ranges | None = None  # received since the last status
    reported_ranges: messages.Ranges | None = None  # of that status: each reading is reported in one state only
    speed_mps: float | None = None
    limits_known: bool = False  # the board has confirmed our limits
    setup_ns: int | None = None  # when Limits were last sent
    restarted: bool = False
    silent: bool = False
    wants_armed: bool = False
    arm_ns: int = 0  # when arming was requested
    arm_sent_ns: int | None = None
    armed_nonce: int | None = None  # of the arming in force
    void_nonce: int | None = None  # a Disarm was sent for it; the board's next nonce confirms it
    disarm_sent_ns: int | None = None
    clock: BoardClock = field(default_factory=BoardClock)


class ArduinoLink:
    """The car behind an Arduino, by the protocol of `messages`.

    - Nothing is sent before the board's Hello. Then the limits of the pulse tables are sent until the board confirms
      them; from its first status on, `poll` gives a state.
    - Until `arm` is called, and after `disarm`, every command is sent as neutral and straight. So is a command that is
      past its `valid_until_ns` or not finite; it does not feed the board's timer.
    - A fresh command has a deadline in board time, at most 100 ms ahead, so that a delayed one is not taken for fresh.
    - `arm` is tried for 300 ms. Arming ends with the board's command timer, a restart or 200 ms of silence; then only
      another `arm` restores it. Until then the faults of `LATCHED_FAULTS` report the cause.

    After a LinkError call `close`, then `open` until it succeeds; the car stays disarmed. HandshakeError is permanent.
    """

    def __init__(
        self,
        transport: Transport,
        link_config: LinkConfig,
        vehicle_config: VehicleConfig,
        *,
        servo_slew_us: float = 200.0,
        motor_slew_us: float = 100.0,
    ) -> None:
        self._transport = transport
        self._place = f"{link_config.port} at {link_config.baud} baud"
        self._servo = PulseTable(link_config.servo.pulse_us, link_config.servo.steering_rad)
        self._motor = PulseTable(link_config.motor.pulse_us, link_config.motor.speed_mps)
        self._limits = messages.Limits(
            servo_min_us=self._servo.min_us,
            servo_straight_us=self._servo.zero_us,
            servo_max_us=self._servo.max_us,
            motor_min_us=self._motor.min_us,
            motor_neutral_us=self._motor.zero_us,
            motor_max_us=self._motor.max_us,
            servo_slew_us=servo_slew_us,
            motor_slew_us=motor_slew_us,
        )
        self._limits_crc = messages.limits_crc(self._limits)
        self._decoder = messages.decoder(on_board=False)
        self._speed = SpeedMeter(vehicle_config.ticks_per_m)
        self._battery = BatteryMeter(vehicle_config.battery_low_v)
        self._session: _Session | None = None
        self._counter = 0
        self.last_command: tuple[int, messages.Command] | None = None  # that was written, with its counter

    @property
    def errors(self) -> FrameErrors:
        """Damaged frames since the link was created."""
        return self._decoder.errors

    @property
    def status(self) -> messages.Status | None:
        """The board's newest Status, None before the first."""
        return None if self._session is None else self._session.status

    @property
    def neutral_us(self) -> tuple[float, float]:
        """The pulses (servo, motor) [us] for straight ahead and neutral."""
        return self._servo.zero_us, self._motor.zero_us

    @property
    def hello(self) -> messages.Hello | None:
        """The board's newest Hello, None before the first."""
        return None if self._session is None else self._session.hello

    def open(self) -> None:
        """Open the pipe, which may reset the board; raises LinkError."""
        self._session = None
        self._transport.open()
        self._decoder.reset()
        self._speed.reset()
        self._battery.reset()
        self._session = _Session()

    def poll(self, now_ns: int) -> VehicleState | None:
        """Process the received bytes; None until the board has sent a Hello and confirmed the limits."""
        session = self._live()
        if session.opened_ns is None:
            session.opened_ns = now_ns
        faults = None
        for frame in self._decoder.feed(self._transport.read()):
            message = messages.decode(frame)
            if isinstance(message, messages.Status):
                faults = (faults or 0) | message.faults
                self._take_status(session, message, now_ns)
            elif isinstance(message, messages.Odometry):
                self._take_odometry(session, message, now_ns)
            elif isinstance(message, messages.Ranges):
                session.ranges = message
                self._battery.step(message.battery_v, now_ns)
            elif isinstance(message, messages.Hello):
                self._take_hello(session, message)
        if faults is not None:
            session.faults = faults
        self._follow_up(session, now_ns)
        return self._state(session) if session.limits_known and session.status is not None else None

    def send(self, command: Command, now_ns: int) -> None:
        """Send the command; ignored while `poll` still gives None."""
        session = self._live()
        valid_until_ns = min(command.valid_until_ns, now_ns + _VALID_NS)
        deadline_ns = session.clock.board_ns(valid_until_ns)
        if not session.limits_known or deadline_ns is None:
            return
        fresh = (
            session.wants_armed
            and now_ns <= command.valid_until_ns
            and math.isfinite(command.steering_rad)
            and math.isfinite(command.speed_mps)
        )
        message = messages.Command(
            servo_us=self._servo.pulse_us(command.steering_rad) if fresh else self._servo.zero_us,
            motor_us=self._motor.pulse_us(command.speed_mps) if fresh else self._motor.zero_us,
            deadline_ms=deadline_ns // _MS & 0xFFFF,
            flags=int(CommandFlag.FRESH) if fresh else 0,
        )
        self._write(message)
        self.last_command = self._counter, message

    def arm(self, now_ns: int) -> None:
        """Request the board to accept commands; ignored while `poll` still gives None."""
        session = self._live()
        if session.limits_known and session.status is not None and session.armed_nonce is None:
            session.wants_armed, session.arm_ns, session.arm_sent_ns = True, now_ns, None
            session.restarted = session.silent = False
            self._follow_up(session, now_ns)

    def disarm(self, now_ns: int) -> None:
        """Neutral at once, straight once the car has rolled out; repeated until the board confirms it."""
        session = self._live()
        _end_arming(session)
        if session.hello is not None:
            session.void_nonce = None if session.status is None else session.status.nonce
            session.disarm_sent_ns = now_ns
            self._write(messages.Disarm())

    def close(self) -> None:
        """Disarm if the pipe allows it, and close."""
        if self._session is not None and self._session.hello is not None:
            with contextlib.suppress(LinkError):
                self._write(messages.Disarm())
        self._session = None
        self._transport.close()

    def _live(self) -> _Session:
        if self._session is None:
            raise PortLost(f"{self._place}: not open")
        return self._session

    def _write(self, message: messages.ToBoard) -> None:
        self._counter = (self._counter + 1) & 0xFF
        self._transport.write(messages.encode(message, self._counter))

    def _take_hello(self, session: _Session, hello: messages.Hello) -> None:
        if (hello.table_hash, hello.version) != (messages.TABLE_HASH, messages.PROTOCOL_VERSION):
            raise HandshakeError(
                f"{self._place}: the board has message table {hello.table_hash:#06x} version {hello.version}, this "
                f"program {messages.TABLE_HASH:#06x} version {messages.PROTOCOL_VERSION}; flash the matching firmware"
            )
        if session.hello is not None and session.hello.boot_id != hello.boot_id:
            self._board_restarted(session)
        session.hello = hello
        session.limits_known = hello.limits_crc == self._limits_crc and session.setup_ns is not None

    def _take_status(self, session: _Session, status: messages.Status, now_ns: int) -> None:
        if session.status is not None and status.time_us == session.status.time_us:
            return  # a board that repeats itself says nothing
        self._board_time(session, status.time_us, now_ns)
        session.status, session.status_ns = status, now_ns
        session.reported_ranges, session.ranges = session.ranges, None
        if status.flags & StatusFlag.NO_LIMITS:
            session.limits_known = False
        if not status.flags & StatusFlag.ARMED:
            if session.armed_nonce is not None:
                _end_arming(session)
        elif session.wants_armed and status.nonce != session.void_nonce:
            session.armed_nonce = status.nonce

    def _take_odometry(self, session: _Session, odometry: messages.Odometry, now_ns: int) -> None:
        board_ns = self._board_time(session, odometry.time_us, now_ns)
        session.odometry = odometry
        session.speed_mps = self._speed.step(board_ns, odometry.wheel_ticks)

    def _board_time(self, session: _Session, time_us: int, now_ns: int) -> int:
        board_ns = session.clock.observe(time_us, now_ns)
        if board_ns is None:
            self._board_restarted(session)
            self._write(messages.HelloRequest())  # its first Hello was lost
            board_ns = session.clock.observe(time_us, now_ns) or 0
        return board_ns

    def _board_restarted(self, session: _Session) -> None:
        session.restarted = True
        _end_arming(session)
        session.clock.reset()
        self._speed.reset()

    def _follow_up(self, session: _Session, now_ns: int) -> None:
        if session.hello is None:
            if session.opened_ns is not None and now_ns - session.opened_ns > _HELLO_TIMEOUT_NS:
                raise HandshakeError(f"{self._place}: no Hello from the board; check port, baud rate and firmware")
            return
        if not session.limits_known and _due(session.setup_ns, _SETUP_RETRY_NS, now_ns):
            session.setup_ns = now_ns
            self._write(messages.Disarm())  # a board that did not reset may still be armed, and then refuses limits
            self._write(self._limits)
        status = session.status
        if status is None:
            return
        if now_ns - session.status_ns > _SILENT_NS:
            session.silent = True
            _end_arming(session)
        if status.flags & StatusFlag.ARMED and not session.wants_armed:
            session.void_nonce = status.nonce
        if status.nonce == session.void_nonce:
            if _due(session.disarm_sent_ns, _ARM_RETRY_NS, now_ns):
                session.disarm_sent_ns = now_ns
                self._write(messages.Disarm())
        elif session.wants_armed and session.armed_nonce is None:
            self._try_arming(session, session.hello, status, now_ns)

    def _try_arming(self, session: _Session, hello: messages.Hello, status: messages.Status, now_ns: int) -> None:
        if now_ns - session.arm_ns > _ARM_NS:
            _end_arming(session)
        elif _due(session.arm_sent_ns, _ARM_RETRY_NS, now_ns):
            session.arm_sent_ns = now_ns
            self._write(messages.Arm(nonce=status.nonce, boot_id=hello.boot_id))

    def _state(self, session: _Session) -> VehicleState:
        status, odometry, ranges = session.status, session.odometry, session.reported_ranges
        faults = [name for bit, name in _FAULT_NAMES if session.faults & bit] if session.faults else []
        if session.restarted:
            faults.append("board_restarted")
        if session.silent:
            faults.append("link_silent")
        if self._battery.low:
            faults.append("battery_low")
        return VehicleState(
            t_ns=session.status_ns,
            speed_mps=session.speed_mps,
            yaw_rate_radps=None if odometry is None else odometry.yaw_rate_radps,
            steering_rad=None if status is None else self._servo.value(status.servo_us),
            ranges_m=() if ranges is None else (ranges.left_m, ranges.centre_m, ranges.right_m),
            battery_v=self._battery.voltage_v,
            armed=session.armed_nonce is not None,
            faults=tuple(faults),
            boot_id=None if session.hello is None else session.hello.boot_id,
        )


def _end_arming(session: _Session) -> None:
    session.wants_armed, session.armed_nonce = False, None


def _due(last_ns: int | None, period_ns: int, now_ns: int) -> bool:
    return last_ns is None or now_ns - last_ns >= period_ns
