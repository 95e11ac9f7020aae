"""An emulated Arduino with the real wire format; time is an argument."""

from __future__ import annotations

import enum
from typing import Protocol

from automodel.signals import BoardSensors
from firmware_link import messages
from firmware_link.emulator.logic import NO_LIMITS, BoardCounters, BoardLogic, BoardOptions
from firmware_link.emulator.uart import UartBoard
from firmware_link.framing import RawFrame
from firmware_link.messages import Fault, ResetCause

TICK_NS = 1_000_000  # the main loop
SERVO_FRAME_NS = 20_000_000
REPORT_NS = 20_000_000
HELLO_NS = 500_000_000
_STATUS_PHASE_NS = 1_000_000  # after the servo frame's start, so that it reports this frame's pulses
_SENSOR_PHASE_NS = 11_000_000  # halfway between two statuses
_RX_RING_BYTES = 64
_TX_RING_BYTES = 128


class Peripherals(Protocol):
    """The devices at the board's pins. Times never decrease."""

    def set_pulses(self, t_ns: int, servo_us: float, motor_us: float) -> None:
        """The pulses [us] at the pins from `t_ns` on, 0 where there are none; called at each servo frame."""
        ...

    def read_sensors(self, t_ns: int) -> BoardSensors:
        """The sensor readings at `t_ns`."""
        ...


class _State(enum.Enum):
    OFF = "off"
    BOOT = "boot"
    RUN = "run"
    HUNG = "hung"


class EmulatedArduino(UartBoard):
    """The board: UART, 1 ms main loop, 50 Hz servo pulses, watchdog. The real firmware behaves in the same way.

    Except in BOOT: a real board has no pulses while its bootloader runs, as `AvrBoard`.

    ===========  ==========================================  =====================================================
    state        event                                       becomes
    ===========  ==========================================  =====================================================
    any          power, reset line, brown-out, watchdog      BOOT: straight and neutral, no communication, new boot id
    BOOT         `boot_ns` over                              DISARMED, new nonce; sends Hello
    any but BOOT HelloRequest; every 500 ms                  unchanged; sends Hello
    DISARMED     Arm with the current nonce and boot id      ARMED, command timer starts, counter set
    DISARMED     Arm with others, or without valid Limits    DISARMED, fault ARM_REFUSED
    DISARMED     valid Limits                                DISARMED, limits kept over restarts; sends Hello
    DISARMED     Command                                     DISARMED, ignored
    ARMED        Command, fresh, counter 1..127 ahead,       ARMED, timer restarts; the pulses, clamped and
                 deadline 0..150 ms ahead                    slewed, from the next servo frame on
    ARMED        Command, not fresh, counter ahead           ARMED, rolls out; the timer keeps running
    ARMED        Command that is late, repeated, invalid     ARMED, a fault; otherwise ignored
    ARMED        Limits; Arm                                 ARMED, fault LIMITS_REFUSED; nothing
    ARMED        command timer: 100 ms without a fresh one   DISARMED (latched), new nonce, fault COMMAND_TIMEOUT
    any but BOOT Disarm                                      DISARMED, new nonce
    ===========  ==========================================  =====================================================

    DISARMED always means neutral, without slewing, from the next servo frame on. A car that drove rolls out: the
    steering of the last command stays, so that a car that coasts through a bend stays in its lane, and is straight
    once its wheel's ticks show that it stands (`Standstill`), after 2 s, or at once with an Arm, new Limits or a
    restart. Nothing prolongs the 2 s from the first neutral on.
    DISARMED ends with an Arm that the host sends on a person's request: the nonce changes with every disarming, so
    that no older Arm is valid.
    What is straight and neutral is in the Limits: without valid ones (flag NO_LIMITS) there are no pulses.
    COMMAND_TIMEOUT is reported until the next valid Arm.

    `advance` runs only the ticks of the main loop in which something happens. The first call switches the power on. A
    program that hangs leaves its last pulses at the pins (a timer generates them) until the watchdog restarts it.
    """

    def __init__(self, peripherals: Peripherals, baud: int = 115200, options: BoardOptions | None = None) -> None:
        super().__init__(baud, _TX_RING_BYTES)
        self._peripherals = peripherals
        self._options = options or BoardOptions()
        self._boot_id = (self._options.boot_id - 1) & 0xFFFF
        self._limits = self._options.limits or NO_LIMITS
        self._limits_crc = messages.limits_crc(self._limits)
        self._decoder = messages.decoder(on_board=True, table_hash=self._options.table_hash)
        self._logic = BoardLogic(self._boot_id, self._limits)
        self._cause = ResetCause.POWER_ON
        self._state = _State.OFF
        self._start_ns = 0  # board time zero
        self._until_ns = 0  # end of booting, or the watchdog's time
        self._servo_due_ns = self._status_due_ns = self._sensors_due_ns = self._hello_due_ns = 0
        self._counter = 0
        self._errors_reported = 0
        self.counters = BoardCounters()

    @property
    def armed(self) -> bool:
        """Whether commands take effect."""
        return self._logic.arming.armed

    @property
    def boot_id(self) -> int:
        """The number of this start."""
        return self._boot_id

    def reset(self, now_ns: int, cause: ResetCause = ResetCause.EXTERNAL) -> None:
        """Restart, as the reset line does when a host opens the port."""
        if self._state is not _State.OFF:
            self.advance(now_ns)
        self._restart(now_ns, cause)

    def hang(self, now_ns: int) -> None:
        """Fault: the program stops; the watchdog restarts it."""
        self.advance(now_ns)
        if self._state is _State.RUN:
            self._state = _State.HUNG
            self._until_ns = now_ns + self._options.watchdog_ns

    def brown_out(self, now_ns: int) -> None:
        """Fault: the supply dips."""
        self.reset(now_ns, ResetCause.BROWN_OUT)

    def advance(self, now_ns: int) -> None:
        """Run up to `now_ns`; times never decrease."""
        if self._state is _State.OFF:
            self._restart(now_ns, ResetCause.POWER_ON)
        while (t_ns := self._next_ns()) <= now_ns:
            if self._state is _State.RUN:
                self._loop(t_ns)
            elif self._state is _State.BOOT:
                self._run(t_ns)
            else:
                self._restart(t_ns, ResetCause.WATCHDOG)

    def _next_ns(self) -> int:
        if self._state is not _State.RUN:
            return self._until_ns
        due = min(self._servo_due_ns, self._status_due_ns, self._sensors_due_ns, self._hello_due_ns)
        for due_ms in (self._logic.timer.due_ms, self._logic.pulses.straight_ms):
            if due_ms is not None:
                due = min(due, self._start_ns + due_ms * TICK_NS)
        arrival_ns = self._rx.next_ns()
        if arrival_ns is not None:
            ticks = -(-(arrival_ns - self._start_ns) // TICK_NS)
            due = min(due, self._start_ns + ticks * TICK_NS)
        return due

    def _restart(self, t_ns: int, cause: ResetCause) -> None:
        self._collect(t_ns)
        self._tx.clear()
        self.counters.starts += 1
        self._boot_id = (self._boot_id + 1) & 0xFFFF
        self._cause = cause
        self._logic = BoardLogic(self._boot_id, self._limits)
        self._decoder.reset()
        self._state = _State.BOOT
        self._until_ns = t_ns + self._options.boot_ns
        self._rx.take(t_ns)
        self._pulses(t_ns)

    def _run(self, t_ns: int) -> None:
        self.counters.rx_in_boot += len(self._rx.take(t_ns))
        self._state = _State.RUN
        self._start_ns = self._servo_due_ns = self._hello_due_ns = t_ns
        self._status_due_ns = t_ns + _STATUS_PHASE_NS
        self._sensors_due_ns = t_ns + _SENSOR_PHASE_NS
        self._counter = 0
        self._errors_reported = self._decoder.errors.total

    def _loop(self, t_ns: int) -> None:
        """One iteration of the main loop, in the order of the real one."""
        t_ms = (t_ns - self._start_ns) // TICK_NS
        data = self._rx.take(t_ns)
        if data:
            self._take(data, t_ms)
        self._logic.tick(t_ms)
        if t_ns >= self._servo_due_ns:
            self._servo_due_ns += SERVO_FRAME_NS
            self._logic.pulses.frame()
            self._pulses(t_ns)
        if t_ns >= self._status_due_ns:
            self._status_due_ns += REPORT_NS
            self._say_status(t_ns)
        if t_ns >= self._sensors_due_ns:
            self._sensors_due_ns += REPORT_NS
            self._say_sensors(t_ns)
        if t_ns >= self._hello_due_ns:
            self._hello_due_ns += HELLO_NS
            self._say_hello(t_ns)

    def _take(self, data: bytes, t_ms: int) -> None:
        lost = len(data) - _RX_RING_BYTES  # the loop empties the ring once a tick
        if lost > 0:
            self.counters.rx_lost += lost
            self._logic.event(Fault.RX_OVERFLOW)
            data = data[:_RX_RING_BYTES]
        for frame in self._decoder.feed(data):
            self._obey(frame, t_ms)

    def _obey(self, frame: RawFrame, t_ms: int) -> None:
        message = messages.decode(frame)
        if isinstance(message, messages.Command):
            self._logic.on_command(message, frame.counter, t_ms)
        elif isinstance(message, messages.Arm):
            self._logic.on_arm(message, frame.counter, t_ms)
        elif isinstance(message, messages.Disarm):
            self._logic.on_disarm(t_ms)
        elif isinstance(message, messages.Limits):
            if self._logic.on_limits(message):
                self._limits = message
                self._limits_crc = messages.limits_crc(message)
                self._say_hello(self._start_ns + t_ms * TICK_NS)
        elif isinstance(message, messages.HelloRequest):
            self._say_hello(self._start_ns + t_ms * TICK_NS)

    def _pulses(self, t_ns: int) -> None:
        pulses = self._logic.pulses
        self._at_pin = (pulses.servo_us, pulses.motor_us)
        self._peripherals.set_pulses(t_ns, *self._at_pin)

    def _say_hello(self, t_ns: int) -> None:
        hello = messages.Hello(
            table_hash=self._options.table_hash,
            version=messages.PROTOCOL_VERSION,
            reset_cause=int(self._cause),
            boot_id=self._boot_id,
            limits_crc=self._limits_crc,
        )
        self._say(hello, t_ns)

    def _say_status(self, t_ns: int) -> None:
        if self._decoder.errors.total != self._errors_reported:
            self._errors_reported = self._decoder.errors.total
            self._logic.event(Fault.FRAME_ERRORS)
        servo_us, motor_us = self._at_pin
        status = messages.Status(
            time_us=self._time_us(t_ns),
            servo_us=servo_us,
            motor_us=motor_us,
            faults=self._logic.take_faults(),
            nonce=self._logic.arming.nonce,
            command_counter=self._logic.command_counter,
            flags=int(self._logic.status_flags()),
        )
        self._say(status, t_ns)

    def _say_sensors(self, t_ns: int) -> None:
        sensors = self._peripherals.read_sensors(t_ns)
        self._logic.on_wheel(sensors.wheel_ticks, (t_ns - self._start_ns) // TICK_NS)
        time_us = self._time_us(t_ns)
        odometry = messages.Odometry(
            time_us=time_us, wheel_ticks=sensors.wheel_ticks, yaw_rate_radps=sensors.yaw_rate_radps
        )
        left_m, centre_m, right_m = sensors.ranges_m
        ranges = messages.Ranges(
            time_us=time_us, left_m=left_m, centre_m=centre_m, right_m=right_m, battery_v=sensors.battery_v
        )
        self._say(odometry, t_ns)
        self._say(ranges, t_ns)

    def _time_us(self, t_ns: int) -> int:
        return (t_ns - self._start_ns) // 1000 & 0xFFFFFFFF

    def _say(self, message: messages.FromBoard, t_ns: int) -> None:
        frame = messages.encode(message, self._counter, self._options.table_hash)
        if len(frame) > self._tx.room(t_ns):
            self.counters.tx_skipped += 1
            self._logic.event(Fault.TX_OVERFLOW)
            return
        self._counter = (self._counter + 1) & 0xFF
        self._collect(t_ns)
        self._tx.put(frame, t_ns)
