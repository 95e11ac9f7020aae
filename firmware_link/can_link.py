"""A full-size vehicle behind a CAN bus as a `VehicleLink`: supervised state in, limited commands out."""

from __future__ import annotations

import contextlib
import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from automodel.config import CanConfig, CanMessage, ConfigError, VehicleConfig
from automodel.signals import Command, VehicleState
from firmware_link.can_limits import acceleration_mps2, limited_acceleration_mps2, limited_steering_rad
from firmware_link.can_port import BusTrouble, CanPort, WhitelistedPort
from firmware_link.can_receiver import CanReceiver, Functions, MessageWriter, Snapshot
from firmware_link.can_torque import TorqueSteering
from firmware_link.errors import HandshakeError, LinkError, PortLost

_MS = 1_000_000
HELLO_TIMEOUT_NS = 5_000 * _MS  # a vehicle that was just switched on needs seconds
ARM_NS = 300 * _MS  # the vehicle's time to engage
VALID_NS = 100 * _MS  # no command is valid for longer
ERRORS_MAX = 3  # error frames in `ERRORS_NS` that are a fault: a disturbance is one or two, a wrong bit rate many
ERRORS_NS = 100 * _MS
LASTING_NS = 100 * _MS  # what one frame shows lasts so long: a second sender, a touch of the brake
EARLY_NS = 1 * _MS  # a message leaves that much before its time rather than wait: a loop's shortest wait
OVERDUE_SHARE = 0.25  # of a period: without a new command the last one is repeated that much after its time
PACE_SHARE = 0.05  # of how far a command comes from where it is expected, by which that moves: 20 commands, 0.4 s
SPREADS = 2.0  # mean deviations of the commands' times by which a message comes after their mean: 95 % of a normal one
WAIT_SHARE = 0.25  # of a period that a command waits for its message at most
NEEDED = ("speed_mps", "steering_rad")  # without these no command can be limited


@dataclass(slots=True)
class _Schedule:
    """When a message is sent.

    Commands come when a step is done, which takes longer now and then. A message that leaves with each command repeats
    that unevenness; one that leaves `SPREADS` mean deviations after their mean time does not, but for the rest.
    """

    due_ns: int
    sent_ns: int
    spread_ns: float = 0.0  # mean deviation of the commands' times


@dataclass(slots=True)
class _Session:
    """The state since the bus was joined."""

    opened_ns: int | None = None
    ready: bool = False  # every supervised message has been seen and was good
    snapshot: Snapshot = field(default_factory=lambda: Snapshot(t_ns=None, values={}, faults=()))
    heard_ns: int = 0  # the newest time of a valid state
    errors_ns: deque[int] = field(default_factory=deque)
    intruded_ns: int | None = None  # when somebody else sent our messages last
    boot_id: float | None = None  # as it was told last
    overridden_ns: int | None = None  # when the driver did something last
    wants_armed: bool = False
    armed: bool = False
    arm_ns: int = 0
    latched: list[str] = field(default_factory=list)  # why it was disarmed, until it is armed again
    command: Command | None = None
    command_ns: int = 0  # when it was given
    ramp_mps2: float = 0.0  # by which its speed is below that of the command before
    steering_rad: float = 0.0  # as it was sent last
    accel_mps2: float = 0.0  # likewise; 0 while nothing is asked for
    sent_ns: int | None = None
    schedules: dict[str, _Schedule] = field(default_factory=dict)  # by the message's name; missing: to be sent at once


class CanLink:
    """The vehicle of a CAN mapping.

    - Messages go out in their period, from `send` and `poll`, which `wake_ns` asks for: a loop that hangs sends
      nothing, and no timer or thread sends for it. Their times move to where most commands are there. A command is
      valid for 100 ms at most; expired, it disarms.
    - While the vehicle is not armed, messages are sent with enable 0 and the measured steering angle, so that nothing
      jumps when it is engaged.
    - Armed means that a person asked for it, the vehicle says that it is engaged (where it can), and nothing is wrong:
      every supervised message valid, no error on the bus, no hand or foot of the driver, gear D. Whatever of this ends
      also ends the arming, in the same `poll`, until `arm` is called again. `VehicleState.faults` tells the cause.
    - Steering obeys `can_limits` by the measured speed, as an angle or by a torque that is limited itself; the speed is
      reached by a limited acceleration.

    After a LinkError (bus-off, full queue) call `close`, then `open` until it succeeds; the car stays disarmed.
    """

    def __init__(
        self, port: CanPort, database: Any, config: CanConfig, vehicle: VehicleConfig, functions: Functions
    ) -> None:
        self._database, self._config, self._functions = database, config, functions
        self._wheelbase_m = vehicle.wheelbase_m
        told = {value.value for value in config.state}
        missing = [name for name in NEEDED if name not in told]
        if missing:
            raise ConfigError(f"[link.can] state: {missing[0]} is missing; no command can be limited without it")
        commanded = {value.value for value in config.command}
        if "enable" not in commanded or not commanded & {"steering_rad", "torque_nm"}:
            raise ConfigError("[link.can] command: expected at least enable, and steering_rad or torque_nm")
        self._torque = TorqueSteering(config, vehicle.wheelbase_m)
        self._writers = [self._writer(message) for message in config.send]
        self._own = {(writer.frame_id, writer.extended) for writer in self._writers}
        if self._own & self._receiver().watches.keys():
            raise ConfigError("[link.can] send: a message has the identifier of one that is received")
        allowed = frozenset((writer.frame_id, writer.extended, writer.length) for writer in self._writers)
        self._port = WhitelistedPort(port, allowed)
        self._supervision = self._receiver()
        self._session: _Session | None = None

    def _receiver(self) -> CanReceiver:
        return CanReceiver(self._database, self._config, self._functions)

    def _writer(self, message: CanMessage) -> MessageWriter:
        values = [value for value in self._config.command if value.message == message.name]
        return MessageWriter(self._database, message, values, self._functions)

    def open(self) -> None:
        """Join the bus; raises LinkError."""
        self._session = None
        self._port.open()
        self._supervision = self._receiver()
        self._session = _Session()

    def poll(self, now_ns: int) -> VehicleState | None:
        """Judge what has come, and send what is due; None until every supervised message has been good."""
        session = self._live()
        if session.opened_ns is None:
            session.opened_ns = now_ns
        self._hear(session, now_ns)
        if not session.ready:
            return None
        self._judge(session, now_ns)
        self._transmit(session, now_ns)
        return self._state(session, now_ns)

    @property
    def command(self) -> Command | None:
        """The command that messages carry, None while there is none."""
        return None if self._session is None else self._session.command

    @property
    def wake_ns(self) -> int | None:
        """When `poll` has the next message to send, on the clock of `poll`; None while nothing may be sent."""
        session = self._session
        if session is None or not session.ready or not session.schedules:
            return None
        return min(self._leaves_ns(session, writer) for writer in self._writers if writer.name in session.schedules)

    def send(self, command: Command, now_ns: int) -> None:
        """Take over a command and send it when its message is due; ignored while `poll` still gives None."""
        session = self._live()
        if session.ready and now_ns <= command.valid_until_ns:
            session.ramp_mps2 = _ramp_mps2(session.command, command)
            session.command, session.command_ns = command, now_ns
            self._keep_pace(session, now_ns)
            self._transmit(session, now_ns, EARLY_NS)

    def arm(self, now_ns: int) -> None:
        """Ask the vehicle to follow; ignored where something is wrong or a person drives."""
        session = self._live()
        if not session.ready or session.wants_armed:
            return
        session.latched.clear()
        fault = self._fault(session, now_ns)
        if fault is not None:
            session.latched.append(fault)
            return
        session.wants_armed, session.arm_ns = True, now_ns
        session.command, session.sent_ns = None, now_ns

    def disarm(self, now_ns: int) -> None:
        """Let the vehicle go at once."""
        session = self._live()
        self._let_go(session)
        if session.ready:
            self._transmit(session, now_ns, math.inf)

    def close(self) -> None:
        """Let the vehicle go if the bus allows it, and leave the bus."""
        session, self._session = self._session, None
        if session is not None and session.ready:
            self._let_go(session)
            with contextlib.suppress(LinkError):
                self._transmit(session, session.heard_ns, math.inf)
        self._port.close()

    def _live(self) -> _Session:
        if self._session is None:
            raise PortLost(f"{self._port.place}: not open")
        return self._session

    def _hear(self, session: _Session, now_ns: int) -> None:
        received = self._port.receive(now_ns)
        if BusTrouble.OFF in received.troubles:
            self._let_go(session)
            raise PortLost(f"{self._port.place}: the controller has left the bus (bus-off); look at wires and bit rate")
        for trouble in received.troubles:
            session.errors_ns.extend([now_ns] * (ERRORS_MAX if trouble is BusTrouble.PASSIVE else 1))
        while session.errors_ns and now_ns - session.errors_ns[0] > ERRORS_NS:
            session.errors_ns.popleft()
        for frame in received.frames:
            if (frame.frame_id, frame.extended) in self._own:
                session.intruded_ns = frame.t_ns
            self._supervision.take(frame)
            if self._overridden(self._supervision.snapshot(frame.t_ns).values):
                session.overridden_ns = frame.t_ns  # also where the driver has let go before the loop looks
        session.snapshot = self._supervision.snapshot(now_ns)
        if session.snapshot.t_ns is not None and not session.snapshot.faults:
            session.ready = True
            if self._bus_fault(session, now_ns) is None:  # otherwise the state grows old, and the loop stops
                session.heard_ns = max(session.heard_ns, session.snapshot.t_ns)
        elif not session.ready and now_ns - (session.opened_ns or 0) > HELLO_TIMEOUT_NS:
            missing = ", ".join(fault.partition(":")[2] for fault in session.snapshot.faults)
            raise HandshakeError(
                f"{self._port.place}: nothing valid of {missing}; look at [link.can], dbc and bit rate"
            )

    def _judge(self, session: _Session, now_ns: int) -> None:
        """End the arming where anything is wrong."""
        fault = self._fault(session, now_ns)
        if fault is not None:
            self._end(session, fault)
        engaged = session.snapshot.values.get("engaged")
        if session.wants_armed and not session.armed:
            session.armed = engaged is None or engaged != 0
            if not session.armed and now_ns - session.arm_ns > ARM_NS:
                self._end(session, "not_engaged")
        elif session.armed and engaged == 0:
            self._end(session, "disengaged")
        given_ns = session.arm_ns if session.command is None else session.command_ns
        until_ns = given_ns + VALID_NS
        if session.command is not None:
            until_ns = min(until_ns, session.command.valid_until_ns)
        if session.armed and now_ns > until_ns and now_ns - session.arm_ns > VALID_NS:
            self._end(session, "command_timeout")

    def _fault(self, session: _Session, now_ns: int) -> str | None:
        """Why the vehicle must not be commanded now."""
        if session.snapshot.faults:
            return session.snapshot.faults[0]
        fault = self._bus_fault(session, now_ns)
        if fault is None and _lasts(session.overridden_ns, now_ns):
            return "driver_override"
        return fault

    def _bus_fault(self, session: _Session, now_ns: int) -> str | None:
        if len(session.errors_ns) >= ERRORS_MAX:
            return "can_bus_errors"
        return "can_second_sender" if _lasts(session.intruded_ns, now_ns) else None

    def _overridden(self, values: Mapping[str, float]) -> bool:
        config = self._config
        gear = self._gear(values)
        return (
            abs(values.get("driver_torque_nm", 0.0)) > config.override_torque_nm
            or values.get("brake", 0.0) != 0
            or values.get("accelerator", 0.0) > config.override_accelerator
            or (gear is not None and gear != "D")
        )

    def _gear(self, values: Mapping[str, float]) -> str | None:
        if "gear" not in values:
            return None
        index = round(values["gear"])
        return self._config.gears[index] if 0 <= index < len(self._config.gears) else "?"

    def _end(self, session: _Session, fault: str) -> None:
        if session.wants_armed and fault not in session.latched:
            session.latched.append(fault)
        self._let_go(session)

    def _let_go(self, session: _Session) -> None:
        if session.wants_armed:
            session.schedules.clear()  # tell it at once
        session.wants_armed = session.armed = False
        session.command = None

    def _keep_pace(self, session: _Session, now_ns: int) -> None:
        """Move the times of messages to where most commands are there: one that just misses its message waits."""
        for writer in self._writers:
            schedule = session.schedules.get(writer.name)
            if schedule is None:
                continue
            half_ns = writer.period_ns // 2
            late_ns = (now_ns - schedule.due_ns + half_ns) % writer.period_ns - half_ns
            off_ns = late_ns + min(SPREADS * schedule.spread_ns, WAIT_SHARE * writer.period_ns)
            schedule.due_ns += round(PACE_SHARE * off_ns)
            schedule.spread_ns += PACE_SHARE * (abs(off_ns) - schedule.spread_ns)

    def _leaves_ns(self, session: _Session, writer: MessageWriter) -> int:
        """When a message is to be sent: at its time with a new command, later without one."""
        schedule = session.schedules[writer.name]
        fresh = session.command is not None and session.command_ns > schedule.sent_ns
        return schedule.due_ns + (0 if fresh else round(OVERDUE_SHARE * writer.period_ns))

    def _transmit(self, session: _Session, now_ns: int, early_ns: float = 0.0) -> None:
        """Send the messages that leave within `early_ns`, and those that were never sent."""
        due = [
            writer
            for writer in self._writers
            if writer.name not in session.schedules or now_ns >= self._leaves_ns(session, writer) - early_ns
        ]
        if not due:
            return
        intent = self._intent(session, now_ns)
        told = {**intent, "steering_rad": intent["steering_rad"] * self._config.steering_ratio}
        for writer in due:
            self._port.send(writer.frame_id, writer.payload(told), writer.extended)
            schedule = session.schedules.setdefault(writer.name, _Schedule(now_ns, now_ns))
            late = abs(now_ns - schedule.due_ns) > writer.period_ns
            schedule.due_ns = (now_ns if late else schedule.due_ns) + writer.period_ns
            schedule.sent_ns = now_ns
        session.steering_rad, session.accel_mps2 = intent["steering_rad"], intent.get("accel_mps2", 0.0)
        session.sent_ns = now_ns

    def _intent(self, session: _Session, now_ns: int) -> dict[str, float]:
        """What is asked of the vehicle now."""
        values = session.snapshot.values
        measured_rad, measured_mps = values.get("steering_rad"), values.get("speed_mps")
        if not session.wants_armed or measured_rad is None or measured_mps is None:
            following_rad = session.steering_rad if measured_rad is None else measured_rad
            self._torque.reset()
            return {"enable": 0.0, "steering_rad": following_rad, "speed_mps": max(measured_mps or 0.0, 0.0)}
        command, config = session.command, self._config
        dt_s = 0.0 if session.sent_ns is None else (now_ns - session.sent_ns) * 1e-9
        wanted_rad = session.steering_rad if command is None else command.steering_rad
        wanted_mps = measured_mps if command is None else command.speed_mps
        wanted_mps2 = acceleration_mps2(
            wanted_mps,
            measured_mps,
            config.accel_gain_per_s,
            config.accel_max_mps2,
            config.decel_max_mps2,
            0.0 if command is None else session.ramp_mps2,
        )
        steering_rad = limited_steering_rad(wanted_rad, session.steering_rad, measured_mps, dt_s, self._wheelbase_m)
        return {
            "enable": 1.0,
            "steering_rad": steering_rad,
            "torque_nm": self._torque.step(steering_rad, measured_rad, measured_mps, dt_s),
            "speed_mps": max(wanted_mps, 0.0) if math.isfinite(wanted_mps) else 0.0,
            "accel_mps2": limited_acceleration_mps2(wanted_mps2, session.accel_mps2, dt_s),
        }

    def _state(self, session: _Session, now_ns: int) -> VehicleState:
        values = session.snapshot.values
        engaged, boot_id = values.get("engaged"), values.get("boot_id", session.boot_id)
        session.boot_id = boot_id  # a heartbeat that is missing is no restart
        return VehicleState(
            t_ns=session.heard_ns,
            speed_mps=values.get("speed_mps"),
            yaw_rate_radps=values.get("yaw_rate_radps"),
            steering_rad=values.get("steering_rad"),
            battery_v=values.get("battery_v"),
            armed=session.armed,
            faults=tuple(dict.fromkeys((*session.latched, *session.snapshot.faults))),
            boot_id=None if boot_id is None else round(boot_id),
            engaged=None if engaged is None else engaged != 0,
            driver_override=_lasts(session.overridden_ns, now_ns),
            gear=self._gear(values),
        )


def _lasts(seen_ns: int | None, now_ns: int) -> bool:
    """Whether what was seen at that time counts now."""
    return seen_ns is not None and now_ns - seen_ns <= LASTING_NS


def _ramp_mps2(before: Command | None, command: Command) -> float:
    """How fast the speed falls from one command to the next [m/s^2], as a number below 0.

    0 where the one before is not valid any more, and where the speed rises: that is trailed, not exceeded at its end.
    """
    if before is None or not 0 < command.t_ns - before.t_ns <= VALID_NS:
        return 0.0
    return min((command.speed_mps - before.speed_mps) / ((command.t_ns - before.t_ns) * 1e-9), 0.0)
