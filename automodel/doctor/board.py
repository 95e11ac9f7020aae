"""Checks the car's board: port, hello, sensors at rest, and with consent the servo."""

from __future__ import annotations

import contextlib
import statistics
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from pathlib import Path

from automodel.config import CarConfig
from automodel.control.limits import Limits
from automodel.doctor.findings import Finding, Verdict, bounded, fail, okay, skip, warn
from automodel.runtime.clocks import SleepingClock
from automodel.signals import Command, Motion, MotionSource, VehicleState
from firmware_link.arduino import ArduinoLink
from firmware_link.autonomos import AutonomosLink
from firmware_link.errors import HandshakeError, LinkError
from firmware_link.messages import Hello, ResetCause
from firmware_link.transport import likely_ports

Board = ArduinoLink | AutonomosLink

NO_BATTERY_V = 1.0  # an open voltage divider reads nearly nothing
TURNING_RADPS = 0.05  # more than the bias of a gyro at rest
RANGE_NAMES = ("left", "centre", "right")
RESETS = {  # reset cause -> what to do; usual causes are missing
    "brown_out": "its supply dips: give the servo a supply of its own, check battery and plugs",
    "watchdog": "its program hung: flash the firmware again, and report it",
}
LISTENING_S = 1.0
POLL_S = 0.005
_HELLO_S = 7.0  # the link itself gives up after 5
_OPENING_S = 5.0
_CAN = "280"  # ARPHRD_CAN: the kernel's type of a CAN interface

CONSENT = "Are the wheels off the ground, and is nobody's hand near? The front wheels turn left, right, straight"
LOOKED = "Did the front wheels turn left first, then right, then straight ahead?"
_SHARE = 0.5  # of the largest steering angle
_HOLDING_S = 0.6  # at each angle
_ARMING_S = 1.0
_COMMAND_NS = 20_000_000  # between two commands


@dataclass(frozen=True, slots=True, kw_only=True)
class Listened:
    """What the board sent in about a second; `damaged` counts frames with errors."""

    states: tuple[VehicleState, ...]
    span_s: float
    damaged: int

    @property
    def last(self) -> VehicleState:
        """The newest state."""
        return self.states[-1]


def judge_reset(cause: str) -> Finding:
    """The board's last reset cause: `power_on`, `external`, `brown_out`, `watchdog`."""
    name = "board start"
    if cause in RESETS:
        return warn(name, f"it restarted by itself: {cause.replace('_', ' ')}", RESETS[cause])
    return okay(name, cause.replace("_", " "))


def judge_wire(listened: Listened) -> Finding:
    """Whether states come at the expected rate and undamaged."""
    name = "wire"
    rate = len({state.t_ns for state in listened.states}) / listened.span_s
    what = f"{rate:.0f} states/s, {listened.damaged} damaged frames"
    if rate < 25.0 or listened.damaged > 2:  # normal is 50 Hz; the first frame after opening may be cut
        return warn(name, what, "use a shorter USB cable, away from the motor's wires, or a lower [link] baud")
    return okay(name, what)


def judge_faults(listened: Listened) -> Finding:
    """The faults that the board reports."""
    name = "board faults"
    faults = sorted({fault for state in listened.states for fault in state.faults})
    if faults:
        return warn(name, ", ".join(faults), "firmware_link/README.md explains each; switch off and on, run again")
    return okay(name, "none")


def judge_battery(listened: Listened, car: CarConfig) -> Finding:
    """The battery's voltage against [vehicle] battery_low_v."""
    name, volts, low = "battery", listened.last.battery_v, car.vehicle.battery_low_v
    if volts is None or volts < NO_BATTERY_V:
        return skip(name, "no battery is wired to the board", "to wire it: firmware_link/firmware/README.md, pin A6")
    what = f"{volts:.1f} V; low is below {low:g} V"
    if volts < low:
        return warn(
            name, what, "charge it: a low supply restarts the board; or set [vehicle] battery_low_v for your battery"
        )
    return okay(name, what)


def judge_ranges(listened: Listened, car: CarConfig) -> Finding:
    """Which ultrasonic sensors hear an echo, and whether there is an obstacle ahead."""
    name = "ranges"
    heard: list[float | None] = [None] * len(RANGE_NAMES)
    for state in listened.states:
        for place, range_m in enumerate(state.ranges_m):
            heard[place] = heard[place] if range_m is None else range_m
    deaf = [side for side, range_m in zip(RANGE_NAMES, heard, strict=True) if range_m is None]
    what = ", ".join(
        f"{side} {'no echo' if range_m is None else f'{range_m:.2f} m'}"
        for side, range_m in zip(RANGE_NAMES, heard, strict=True)
    )
    if len(deaf) == len(RANGE_NAMES) and car.link.port == "sim":
        return okay(name, "no echo: the simulated road is free")
    if len(deaf) == len(RANGE_NAMES):
        do = "hold a hand 0.3 m in front of each and run again; without sensors the car does not stop for obstacles"
        return warn(name, "no sensor hears an echo", do)
    if deaf:
        return warn(
            name, what, f"hold a hand 0.3 m in front of {' and '.join(deaf)} and run again; else check the wires"
        )
    ahead = heard[1]
    if ahead is not None and ahead < car.control.obstacle_stop_m:
        return warn(
            name, what, f"remove the obstacle: below {car.control.obstacle_stop_m} m ahead the car does not start"
        )
    return okay(name, what)


def judge_motion(listened: Listened) -> Finding:
    """Speed and yaw rate at standstill."""
    name = "odometry"
    speeds = [abs(state.speed_mps) for state in listened.states if state.speed_mps is not None]
    turns = [state.yaw_rate_radps for state in listened.states if state.yaw_rate_radps is not None]
    turn = statistics.median(turns) if turns else None
    gyro = "no gyro: yaw rate comes from the steering" if turn is None else f"gyro reads {turn:+.3f} rad/s"
    if speeds and max(speeds) > 0.0:
        return warn(name, f"wheel ticks at standstill; {gyro}", "do not touch the car; check the wheel sensor")
    if turn is not None and abs(turn) > TURNING_RADPS:
        return warn(
            name, f"the car stands, and the {gyro}", "do not touch the car while the board starts, then run again"
        )
    return okay(name, f"wheels at rest; {gyro}")


def judge_followed(commanded_rad: Sequence[float], applied_rad: Sequence[float | None]) -> Finding:
    """Whether the board set the commanded angles [rad]."""
    name = "servo"
    off = [
        abs(angle - applied) if applied is not None else float("inf")
        for angle, applied in zip(commanded_rad, applied_rad, strict=True)
    ]
    commanded = ", ".join(f"{angle:+.2f}" for angle in commanded_rad)
    if max(off) > 0.02:
        got = ", ".join("nothing" if applied is None else f"{applied:+.2f}" for applied in applied_rad)
        return fail(name, f"commanded {commanded} rad, the board set {got}", "run again; then check the board's faults")
    return okay(name, f"the board set {commanded} rad as commanded: left, right, straight")


def board_findings(car: CarConfig, link: Board, clock: SleepingClock) -> Generator[Finding, None, bool]:
    """Port, hello, sensors; returns whether the board answers. The link is left open."""
    place = f"{car.link.port} at {car.link.baud} baud"
    opened = bounded("serial port", link.open, _OPENING_S, "try another cable and plug, then run again")
    if isinstance(opened, Finding):
        yield opened
        yield skip("board", "not checked: there is no port")
        return False
    yield okay("serial port", f"{place} opens")
    do = f"flash it: firmware_link/firmware/README.md; {likely_ports()}"
    heard = bounded("board", lambda: _listen(link, clock), _HELLO_S + 2.0 * LISTENING_S, do)
    if isinstance(heard, Finding):
        yield heard
        return False
    hello, listened = heard
    if hello is None:
        what = "an AutoNOMOS car: it reports no version, and drives on when this program is killed or disconnected"
        yield warn(
            "board", what, "flash this project's firmware, which stops by itself: firmware_link/firmware/README.md"
        )
    else:
        table = f"message table {hello.table_hash:#06x} version {hello.version}, as this program's"
        yield okay("board", f"{table}; boot id {hello.boot_id}")
        yield judge_reset(_cause(hello))
    yield judge_wire(listened)
    yield judge_faults(listened)
    yield judge_battery(listened, car)
    yield judge_ranges(listened, car)
    yield judge_motion(listened)
    return True


def can_finding(networks: Path = Path("/sys/class/net")) -> Finding:
    """The CAN interfaces of this machine; what they carry is judged from a recording."""
    found = []
    for kind in sorted(networks.glob("*/type")):
        try:
            if kind.read_text(encoding="ascii").strip() == _CAN:
                state = (kind.parent / "operstate").read_text(encoding="ascii").strip()
                found.append(f"{kind.parent.name} {state}")
        except OSError:  # it was removed meanwhile
            continue
    here = f"here are: {', '.join(found)}" if found else "this machine has no CAN interface"
    return skip("can", f'a bus is examined where car.toml has [link] kind = "can"; {here}')


def _listen(link: Board, clock: SleepingClock) -> tuple[Hello | None, Listened]:
    """The board's hello (None for a protocol without one), and a second of its states; raises LinkError."""
    start_ns = clock.now_ns()
    states: list[VehicleState] = []
    first_ns = start_ns
    while True:
        now_ns = clock.now_ns()
        state = link.poll(now_ns)
        if state is not None:
            first_ns = first_ns if states else now_ns
            states.append(state)
        elif (now_ns - start_ns) * 1e-9 > _HELLO_S:
            raise HandshakeError(
                "the board says hello, but does not accept the limits of car.toml or does not send its state"
            )
        if states and (now_ns - first_ns) * 1e-9 >= LISTENING_S:
            break
        clock.sleep(POLL_S)
    hello = link.hello if isinstance(link, ArduinoLink) else None
    if hello is None and isinstance(link, ArduinoLink):
        raise HandshakeError("the board restarted without a new hello")
    span_s = (now_ns - first_ns) * 1e-9
    return hello, Listened(states=tuple(states), span_s=span_s, damaged=link.errors.total)


def _cause(hello: Hello) -> str:
    try:
        return ResetCause(hello.reset_cause).name.lower()
    except ValueError:
        return f"unknown cause {hello.reset_cause}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Consent:
    """`given`: no question is needed; `ask` asks a person, None where there is nobody to ask."""

    given: bool
    ask: Callable[[str], bool] | None = None


def servo_finding(car: CarConfig, link: Board, clock: SleepingClock, consent: Consent) -> Finding:
    """Left, right, straight, the motor always in neutral; in any case the board is disarmed afterwards."""
    if not consent.given:
        if consent.ask is None:
            return skip("servo", "not moved: there is nobody to ask", "give --yes, with the wheels off the ground")
        if not consent.ask(CONSENT):
            return skip("servo", "not moved: no consent")
    reach = _SHARE * min(
        car.safety.steering_max_rad, max(car.link.servo.steering_rad), -min(car.link.servo.steering_rad)
    )
    angles = (reach, -reach, 0.0)
    try:
        applied = _steer(link, clock, car, angles)
    except LinkError as error:
        return fail("servo", str(error), "close other programs, check cable and supply, then run again")
    found = judge_followed(angles, applied)
    if found.verdict is Verdict.OK and not consent.given and consent.ask is not None and not consent.ask(LOOKED):
        do = "turned the other way: change the signs of [link.servo] steering_rad; not at all: check pin D9, supply"
        return fail("servo", "the board set the commanded angles, the wheels moved differently", do)
    return found


def _steer(link: Board, clock: SleepingClock, car: CarConfig, angles: tuple[float, ...]) -> list[float | None]:
    """The angle [rad] that the board set for each of the commanded `angles`; raises LinkError."""
    limits, applied = Limits(car.safety, car.vehicle), []
    try:
        _settle(link, clock, car.safety.rearm_s)
        link.arm(clock.now_ns())
        _await_armed(link, clock)
        for angle in angles:
            applied.append(_hold(link, clock, limits, angle))
    finally:
        with contextlib.suppress(LinkError):
            link.disarm(clock.now_ns())
    return applied


def _hold(link: Board, clock: SleepingClock, limits: Limits, angle_rad: float) -> float | None:
    """Command one angle at speed 0 for a while; returns the angle that the board set last."""
    end_ns = clock.now_ns() + round(_HOLDING_S * 1e9)
    state = None
    while (now_ns := clock.now_ns()) < end_ns:
        command = Command(t_ns=now_ns, steering_rad=angle_rad, speed_mps=0.0, valid_until_ns=now_ns + 5 * _COMMAND_NS)
        still = Motion(t_ns=now_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
        link.send(limits.step(command, still, now_ns).command, now_ns)
        clock.sleep(_COMMAND_NS * 1e-9)
        state = link.poll(clock.now_ns())
        if state is None or not state.armed:
            why = ", ".join(state.faults) if state is not None else "it restarted"
            raise LinkError(f"the board disarmed itself while the servo moved: {why or 'it reports no reason'}")
    return None if state is None else state.steering_rad


def _settle(link: Board, clock: SleepingClock, seconds: float) -> None:
    """Listen for a while: what came while the person answered is old."""
    end_ns = clock.now_ns() + round(seconds * 1e9)
    while clock.now_ns() < end_ns:
        link.poll(clock.now_ns())
        clock.sleep(POLL_S)


def _await_armed(link: Board, clock: SleepingClock) -> None:
    """Poll until the board is armed; raises LinkError if it is not in time."""
    end_ns = clock.now_ns() + round(_ARMING_S * 1e9)
    while clock.now_ns() < end_ns:
        state = link.poll(clock.now_ns())
        if state is not None and state.armed:
            return
        clock.sleep(POLL_S)
    raise LinkError("the board does not arm")
