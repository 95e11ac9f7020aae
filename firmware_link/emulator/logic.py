"""The logic of the board without its registers: the reference for the real firmware; and the emulator's options.

Time is an argument: the board's time in whole milliseconds since its program started. Integer arithmetic on half
microseconds is sufficient.
"""

from __future__ import annotations

from dataclasses import dataclass

from firmware_link import messages
from firmware_link.messages import PULSE_RANGE_US, Arm, Command, CommandFlag, Fault, Limits, StatusFlag

COMMAND_TIMEOUT_MS = 100
ROLL_OUT_MS = 2000  # how long a model car rolls at neutral with a freewheeling motor controller, at most
STAND_MS = 200  # a car whose wheel has not ticked for so long may stand
STAND_GAPS = 3  # and stands where that is so many times the last gap between two ticks
MAX_GAP_MS = 1000  # a longer gap is no measure of how a car slows down: it then rolls out for the whole ROLL_OUT_MS
MAX_DEADLINE_MS = 150  # a deadline further ahead is a past one, wrapped around


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardOptions:
    """Options of an emulated board.

    `table_hash` is that of its program's message table, `limits` what its EEPROM has (None: nothing valid).
    """

    boot_ns: int = 300_000_000  # duration of the bootloader, which neither receives nor sends
    watchdog_ns: int = 60_000_000  # time until a program that hangs is restarted
    boot_id: int = 1  # of the first start
    table_hash: int = messages.TABLE_HASH
    limits: Limits | None = None

    def __post_init__(self) -> None:
        if self.boot_ns < 0 or self.watchdog_ns <= 0:
            raise ValueError(f"boot_ns, watchdog_ns: expected >= 0 and > 0, got {self.boot_ns}, {self.watchdog_ns}")


@dataclass(slots=True, kw_only=True)
class BoardCounters:
    """Error counters of the board since power-on."""

    rx_in_boot: int = 0  # bytes that came while the bootloader ran
    rx_lost: int = 0  # bytes that were lost: the ring buffer was full
    tx_skipped: int = 0  # frames that were not sent: the ring buffer was full
    starts: int = 0


# No valid limits: the pulses are 0, that is, there are none.
NO_LIMITS = Limits(
    servo_min_us=0.0,
    servo_straight_us=0.0,
    servo_max_us=0.0,
    motor_min_us=0.0,
    motor_neutral_us=0.0,
    motor_max_us=0.0,
    servo_slew_us=0.0,
    motor_slew_us=0.0,
)
NONCE_STEP = 0x9E37  # odd, so that all 65536 nonces are used before one repeats


def limits_fit(limits: Limits) -> bool:
    """Whether the limits are valid pulses, in order, and allow the pulses to change."""
    low, high = PULSE_RANGE_US
    return (
        low <= limits.servo_min_us <= limits.servo_straight_us <= limits.servo_max_us <= high
        and low <= limits.motor_min_us <= limits.motor_neutral_us <= limits.motor_max_us <= high
        and limits.servo_slew_us > 0
        and limits.motor_slew_us > 0
    )


class CommandTimer:
    """Expires 100 ms after it was last fed; stopped until it is first fed."""

    def __init__(self) -> None:
        self.due_ms: int | None = None

    def feed(self, t_ms: int) -> None:
        """Restart the 100 ms."""
        self.due_ms = t_ms + COMMAND_TIMEOUT_MS

    def stop(self) -> None:
        """Stop the timer."""
        self.due_ms = None

    def expired(self, t_ms: int) -> bool:
        """Whether the timer has expired."""
        return self.due_ms is not None and t_ms >= self.due_ms


class Arming:
    """The arming state. Each arming requires a new nonce: an Arm from before a Disarm or restart is invalid."""

    def __init__(self, boot_id: int) -> None:
        self._boot_id = boot_id
        self.armed = False
        self.nonce = boot_id

    def arm(self, message: Arm) -> bool:
        """Arm if nonce and boot id are correct; gives whether they were."""
        if (message.nonce, message.boot_id) != (self.nonce, self._boot_id):
            return False
        self.armed = True
        return True

    def disarm(self) -> None:
        """Disarm, and invalidate every Arm in transmission."""
        self.armed = False
        self.nonce = (self.nonce + NONCE_STEP) & 0xFFFF


class CommandGate:
    """Checks commands; gives the fault, or None for a valid command."""

    def __init__(self) -> None:
        self._counter = 0

    def start(self, counter: int) -> None:
        """Count from `counter` on."""
        self._counter = counter

    def fault_of(self, command: Command, counter: int, t_ms: int) -> Fault | None:
        """The fault of the command: its values, its counter (must be 1 .. 127 ahead) or its deadline; None if valid."""
        low, high = PULSE_RANGE_US
        if not (low <= command.servo_us <= high and low <= command.motor_us <= high):
            return Fault.COMMAND_REFUSED
        if command.flags & ~int(CommandFlag.FRESH):
            return Fault.COMMAND_REFUSED
        if not 1 <= (counter - self._counter) & 0xFF <= 127:
            return Fault.COMMAND_REPEATED
        if command.flags & CommandFlag.FRESH and (command.deadline_ms - t_ms) & 0xFFFF > MAX_DEADLINE_MS:
            return Fault.COMMAND_LATE
        self._counter = counter
        return None


class Pulses:
    """Limits the commanded pulses: clamped on command, slew-rate limited at each 20 ms servo frame.

    Towards neutral the motor has no slew limit, so that a stop is never delayed.
    """

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.straight_ms: int | None = None  # when a car that rolls out gets straight wheels
        self.straighten()

    @property
    def limited(self) -> bool:
        """Whether the limits are valid; without, the pulses are 0: there are none."""
        return limits_fit(self.limits)

    @property
    def drives(self) -> bool:
        """Whether the motor's pulse is not neutral."""
        return self.motor_us != self.limits.motor_neutral_us

    def set_target(self, servo_us: float, motor_us: float) -> None:
        """Set the pulses from the next servo frame on."""
        limits = self.limits
        self.straight_ms = None
        self._servo_target_us = min(max(servo_us, limits.servo_min_us), limits.servo_max_us)
        self._motor_target_us = min(max(motor_us, limits.motor_min_us), limits.motor_max_us)

    def roll_out(self, t_ms: int) -> None:
        """Neutral from the next servo frame on, without slewing; the steering goes on to its target, then straight.

        It is straight `ROLL_OUT_MS` later, or when the car stands. A car that is rolling out already is given no more
        time.
        """
        self.motor_us = self._motor_target_us = self.limits.motor_neutral_us
        if self.straight_ms is None:
            self.straight_ms = t_ms + ROLL_OUT_MS

    def tick(self, t_ms: int) -> None:
        """Each millisecond: end the roll-out."""
        if self.straight_ms is not None and t_ms >= self.straight_ms:
            self.straighten()

    def stand(self) -> None:
        """The car stands: end the roll-out."""
        if self.straight_ms is not None:
            self.straighten()

    def straighten(self) -> None:
        """Straight and neutral from the next servo frame on, without slewing."""
        self.straight_ms = None
        self.servo_us = self._servo_target_us = self.limits.servo_straight_us
        self.motor_us = self._motor_target_us = self.limits.motor_neutral_us

    def frame(self) -> None:
        """Start a servo frame: `servo_us` and `motor_us` are its pulses."""
        limits = self.limits
        slew = limits.servo_slew_us
        self.servo_us = min(max(self._servo_target_us, self.servo_us - slew), self.servo_us + slew)
        now = self.motor_us - limits.motor_neutral_us
        target = self._motor_target_us - limits.motor_neutral_us
        reach = (abs(now) if now * target > 0 else 0.0) + limits.motor_slew_us
        self.motor_us = limits.motor_neutral_us + min(max(target, -reach), reach)


class Standstill:
    """Whether the car stands, as the wheel's ticks say: a car that rolls out needs its steering no longer.

    At a constant deceleration the time from the last tick to standstill is at most 2.42 (1 + the root of 2) times the
    gap between the last two ticks, however far apart they are on the floor. A wheel that gave no tick while the motor
    turned says nothing, as one without a sensor: then the car may still roll.
    """

    def __init__(self) -> None:
        self._ticks: int | None = None
        self._ticked_ms = 0
        self._gap_ms = MAX_GAP_MS
        self._counts = False  # whether the sensor counted while the motor last turned, or since then

    def step(self, ticks: int, drives: bool, t_ms: int) -> bool:
        """Process a reading, at which the motor turns or does not; gives whether the car stands."""
        if self._ticks is not None and ticks != self._ticks:
            self._gap_ms = min((t_ms - self._ticked_ms) & 0xFFFFFFFF, MAX_GAP_MS)
            self._ticked_ms = t_ms
            self._counts = True
        self._ticks = ticks
        quiet_ms = (t_ms - self._ticked_ms) & 0xFFFFFFFF
        stands = quiet_ms >= max(STAND_MS, STAND_GAPS * self._gap_ms)
        if drives and stands:
            self._counts = False
        return self._counts and stands and not drives


class BoardLogic:
    """The state machine between messages and pulses; its table is in `EmulatedArduino`."""

    def __init__(self, boot_id: int, limits: Limits) -> None:
        self.arming = Arming(boot_id)
        self.timer = CommandTimer()
        self.pulses = Pulses(limits)
        self.command_counter = 0
        self._standstill = Standstill()
        self._gate = CommandGate()
        self._events = 0
        self._timed_out = False

    def on_command(self, command: Command, counter: int, t_ms: int) -> None:
        """Follow a valid command while armed; only a fresh one feeds the timer."""
        self.command_counter = counter
        if not self.arming.armed:
            return
        fault = self._gate.fault_of(command, counter, t_ms)
        if fault is not None:
            self.event(fault)
        elif command.flags & CommandFlag.FRESH:
            self.timer.feed(t_ms)
            self.pulses.set_target(command.servo_us, command.motor_us)
        else:
            self.pulses.roll_out(t_ms)

    def on_arm(self, message: Arm, counter: int, t_ms: int) -> None:
        """Disarmed -> armed; the first fresh command must follow within the timer's 100 ms."""
        if self.arming.armed:
            return
        if not self.pulses.limited or not self.arming.arm(message):
            self.event(Fault.ARM_REFUSED)
            return
        self._timed_out = False
        self.pulses.straighten()
        self._gate.start(counter)
        self.timer.feed(t_ms)

    def on_disarm(self, t_ms: int) -> None:
        """Any state -> disarmed; a car that drove rolls out."""
        self.arming.disarm()
        self.timer.stop()
        self.pulses.roll_out(t_ms)

    def on_limits(self, limits: Limits) -> bool:
        """Accept new limits while disarmed; gives whether they were accepted."""
        if self.arming.armed or not limits_fit(limits):
            self.event(Fault.LIMITS_REFUSED)
            return False
        self.pulses = Pulses(limits)
        return True

    def tick(self, t_ms: int) -> None:
        """Each millisecond, after the messages: end the roll-out, and disarm if the timer has expired."""
        self.pulses.tick(t_ms)
        if self.timer.expired(t_ms):
            self.on_disarm(t_ms)
            self._timed_out = True

    def on_wheel(self, ticks: int, t_ms: int) -> None:
        """End the roll-out of a car that stands; called with each reading of the wheel's ticks."""
        if self._standstill.step(ticks, self.pulses.drives, t_ms):
            self.pulses.stand()

    def event(self, fault: Fault) -> None:
        """Record a fault for the next status."""
        self._events |= int(fault)

    def status_flags(self) -> StatusFlag:
        """The flags of a status."""
        armed = StatusFlag.ARMED if self.arming.armed else StatusFlag(0)
        return armed if self.pulses.limited else armed | StatusFlag.NO_LIMITS

    def take_faults(self) -> int:
        """The faults for a status; they are cleared."""
        events, self._events = self._events, 0
        return events | (int(Fault.COMMAND_TIMEOUT) if self._timed_out else 0)
