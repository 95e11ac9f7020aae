"""The board's C++ decisions against the emulated board, which is the reference: fields, limits, and whole sessions."""

from __future__ import annotations

import ctypes
import random
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from automodel.signals import BoardSensors
from firmware_link import messages
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.logic import BoardLogic, BoardOptions, Standstill, limits_fit
from firmware_link.emulator.pty import BenchPeripherals
from firmware_link.messages import PULSE_STEP_US, Arm, Command, Limits, ResetCause
from tests.support.compiled_board import CompiledArduino
from tests.support.wide_limits import WIDE_LIMITS

MS = 1_000_000
CODECS = {entry.codec.cls: entry.codec for entry in messages.TABLE}


def swept(library: Any, commands: list[Command], counters: list[int], t_ms: int) -> list[tuple[int, int, int]]:
    """Fault and pulses [0.5 us] that each command makes on its own, by the library."""
    count = len(commands)
    out = [(ctypes.c_uint16 * count)() for _ in range(3)]
    payloads = b"".join(CODECS[Command].pack(command) for command in commands)
    library.sweep_commands(
        CODECS[Limits].pack(WIDE_LIMITS), payloads, bytes(counters), count, ctypes.c_uint32(t_ms), *out
    )
    return list(zip(*out, strict=True))


def expected(command: Command, counter: int, t_ms: int) -> tuple[int, int, int]:
    logic = BoardLogic(1, WIDE_LIMITS)
    logic.on_arm(Arm(nonce=1, boot_id=1), 0, t_ms)
    logic.on_command(command, counter, t_ms)
    logic.pulses.frame()
    return logic.take_faults(), round(logic.pulses.servo_us * 2), round(logic.pulses.motor_us * 2)


def command(**changes: Any) -> Command:
    values = {"servo_us": 1600.0, "motor_us": 1550.0, "deadline_ms": 300, "flags": 1} | changes
    return Command(**values)


@pytest.mark.parametrize("field", ["servo_us", "motor_us", "deadline_ms"])
def test_every_value_of_a_command_field_does_what_it_does_on_the_emulated_board(library: Any, field: str) -> None:
    scale = 1 if field == "deadline_ms" else PULSE_STEP_US
    commands = [command(**{field: raw * scale}) for raw in range(65536)]
    got = swept(library, commands, [1] * 65536, 300)
    assert got == [expected(c, 1, 300) for c in commands]
    good = sum(fault == 0 for fault, _, _ in got)
    assert good == {"servo_us": 4001, "motor_us": 4001, "deadline_ms": 151}[field]


@pytest.mark.parametrize("t_ms", [0, 65_500, (1 << 32) - 50])
def test_every_flag_counter_and_deadline_around_the_wraps_of_time(library: Any, t_ms: int) -> None:
    commands = [command(flags=flags, deadline_ms=t_ms + 100 & 0xFFFF) for flags in range(256)]
    commands += [command(deadline_ms=t_ms + 100 & 0xFFFF)] * 256
    commands += [command(deadline_ms=t_ms + ahead & 0xFFFF) for ahead in range(-200, 400)]
    counters = [1] * 256 + list(range(256)) + [127] * 600
    assert swept(library, commands, counters, t_ms) == [
        expected(c, counter, t_ms) for c, counter in zip(commands, counters, strict=True)
    ]


def test_limits_fit_in_the_same_cases(library: Any) -> None:
    rng = random.Random(5)
    edges = [0.0, 499.5, 500.0, 1000.0, 1500.0, 2000.0, 2500.0, 2500.5, 32767.5]
    cases = []
    for _ in range(20_000):
        pulses = [rng.choice(edges) for _ in range(6)]
        if rng.random() < 0.7:
            pulses = sorted(pulses[:3]) + sorted(pulses[3:])
        names = [field.name for field in CODECS[Limits].fields]
        cases.append(Limits(**dict(zip(names, [*pulses, rng.choice([0.0, 4.0, 1020.0]), 4.0], strict=True))))
    fit = (ctypes.c_uint8 * len(cases))()
    library.sweep_limits(b"".join(CODECS[Limits].pack(case) for case in cases), len(cases), fit)
    assert list(fit) == [int(limits_fit(case)) for case in cases]
    assert 100 < sum(fit) < len(cases) - 100


class Sensors(BenchPeripherals):
    """Readings that change with time, the same on both boards."""

    def read_sensors(self, t_ns: int) -> BoardSensors:
        rng = random.Random(t_ns)
        phase = random.Random(t_ns // (700 * MS))  # in which the wheel turns, or stands
        turning = phase.random() < 0.5
        ranges = [rng.choice([None, rng.uniform(0.02, 4.0)]) for _ in range(3)]
        return BoardSensors(
            ranges_m=(ranges[0], ranges[1], ranges[2]),
            wheel_ticks=(rng if turning else phase).randrange(-(1 << 31), 1 << 31),
            battery_v=rng.uniform(0.0, 20.0),
            yaw_rate_radps=rng.choice([None, rng.uniform(-9.0, 9.0)]),
        )


@pytest.mark.parametrize("ticks_per_m", [2.0, 7.0, 30.0, 200.0, 5000.0])
@pytest.mark.parametrize("coast_s", [0.1, 0.5, 1.0, 1.9])
def test_both_boards_know_when_a_car_that_rolls_out_stands(library: Any, ticks_per_m: float, coast_s: float) -> None:
    """At a constant deceleration never before it stands, whatever the wheel's resolution."""
    speed_mps, drive_ms = 1.3, 3000
    coarse = speed_mps * coast_s * ticks_per_m < 4  # hardly a tick in all the way: nothing can be said
    standstill = Standstill()
    ticks, drives, known = [], [], []
    for t_ms in range(11, 8000, 20):
        rolled_s = min(max(t_ms - drive_ms, 0) * 1e-3, coast_s)
        rolled_m = speed_mps * (rolled_s - 0.5 * rolled_s * rolled_s / coast_s)
        ticks.append(int((speed_mps * min(t_ms, drive_ms) * 1e-3 + rolled_m) * ticks_per_m))
        drives.append(t_ms < drive_ms)
        known.append(standstill.step(ticks[-1], drives[-1], t_ms))
    got = (ctypes.c_uint8 * len(ticks))()
    library.sweep_standstill(
        (ctypes.c_int32 * len(ticks))(*ticks), (ctypes.c_uint8 * len(ticks))(*drives), len(ticks), got
    )
    assert [bool(stands) for stands in got] == known
    since_ms = next((11 + 20 * index for index, stands in enumerate(known) if stands), None)
    assert coarse or since_ms is not None
    if since_ms is not None:
        assert since_ms >= drive_ms + coast_s * 1e3 - 20  # a reading's period
        assert ticks_per_m < 200 or since_ms <= drive_ms + coast_s * 1e3 + 420


class Pair:
    """The emulated and the compiled board, given the same and compared after each step."""

    def __init__(self, library: Any, seed: int, baud: int) -> None:
        self.rng = random.Random(seed)
        options = BoardOptions(limits=WIDE_LIMITS if seed % 2 else None)  # without, until some come
        self.emulated = EmulatedArduino(Sensors(), baud, options)
        self.compiled = CompiledArduino(library, Sensors(), baud, options)
        self.t_ns = 1_000 * MS
        self.counter = 0
        self.said = b""
        for board in (self.emulated, self.compiled):
            board.reset(self.t_ns)

    def wait(self, ns: int) -> None:
        self.t_ns += ns
        outs = []
        for board in (self.emulated, self.compiled):
            board.advance(self.t_ns)
            outs.append((board.transmit(self.t_ns), list(board._peripherals.pulses)))  # type: ignore[attr-defined]
            board._peripherals.pulses.clear()  # type: ignore[attr-defined]
        assert outs[0] == outs[1]
        self.said += outs[0][0]

    def send(self, data: bytes) -> None:
        assert self.emulated.receive(data, self.t_ns) == self.compiled.receive(data, self.t_ns)

    def message(self) -> messages.ToBoard:
        rng, logic = self.rng, self.emulated._logic
        t_ms = (self.t_ns - self.emulated._start_ns) // MS
        kind = rng.choices(["command", "arm", "disarm", "limits", "hello"], [40, 8, 2, 3, 1])[0]
        if kind == "command":
            servo_us, motor_us = rng.uniform(900.0, 2100.0), rng.uniform(900.0, 2100.0)
            if rng.random() < 0.1:
                servo_us, motor_us = rng.uniform(0.0, 4000.0), rng.choice([0.0, 499.5, 500.0, 2500.0, 2500.5])
            ahead_ms = rng.randrange(60, 130) if rng.random() < 0.9 else rng.choice([-3, -1, 150, 151, 152, 30_000])
            flags = rng.choices([1, 0, 2, 0x81], [85, 10, 3, 2])[0]
            return Command(servo_us=servo_us, motor_us=motor_us, deadline_ms=t_ms + ahead_ms & 0xFFFF, flags=flags)
        if kind == "arm":
            wrong = rng.choices([0, 1, 0x9E37], [8, 1, 1])[0]
            return Arm(nonce=logic.arming.nonce + wrong & 0xFFFF, boot_id=self.emulated.boot_id)
        if kind == "limits":
            pulses = [sorted(rng.uniform(495.0, 2505.0) for _ in range(3)) for _ in range(2)]
            names = [field.name for field in CODECS[Limits].fields]
            slews = [rng.choice([0.0, 4.0, 40.0, 200.0, 1020.0]) for _ in range(2)]
            return Limits(**dict(zip(names, [*pulses[0], *pulses[1], *slews], strict=True)))
        return messages.Disarm() if kind == "disarm" else messages.HelloRequest()

    def event(self) -> None:
        rng = self.rng
        what = rng.random()
        if what < 0.003:
            cause = rng.choice(list(ResetCause))
            self.emulated.reset(self.t_ns, cause)
            self.compiled.reset(self.t_ns, cause)
        elif what < 0.005:
            self.emulated.hang(self.t_ns)
            self.compiled.hang(self.t_ns)
        elif what < 0.015:
            self.wait(round(rng.uniform(1.9e9, 2.3e9)))  # a car that was armed has rolled out, or nearly
        elif what < 0.03:
            self.send(rng.randbytes(rng.choice([1, 5, 30, 300])))
        else:
            self.counter = (self.counter + rng.choices([1, 0, 2, 200], [90, 4, 4, 2])[0]) & 0xFF
            frame = bytearray(messages.encode(self.message(), self.counter))
            damage = rng.random()
            if damage < 0.03:
                frame[rng.randrange(len(frame))] ^= 1 << rng.randrange(8)
            elif damage < 0.05:
                del frame[rng.randrange(len(frame)) :]
            self.send(bytes(frame))


@pytest.mark.parametrize(("seed", "baud"), [(1, 115200), (2, 115200), (3, 9600), (4, 1_000_000)])
def test_random_sessions_give_the_same_bytes_and_pulses(library: Any, seed: int, baud: int) -> None:
    pair = Pair(library, seed, baud)
    try:
        for _ in range(1500):
            pair.event()
            pair.wait(round(pair.rng.expovariate(1 / (8 * MS))))
    finally:
        pair.compiled.close()
    decoder = messages.decoder(on_board=False)
    kinds = [messages.decode(frame) for frame in decoder.feed(pair.said)]
    statuses = [message for message in kinds if isinstance(message, messages.Status)]
    faults = np.bitwise_or.reduce([status.faults for status in statuses])
    assert any(status.flags for status in statuses)  # it was armed, and each kind of fault came up
    assert faults & 0b110011111 == 0b110011111 if baud == 115200 else faults


@pytest.fixture
def compiled(library: Any) -> Iterator[CompiledArduino]:
    board = CompiledArduino(library, BenchPeripherals())
    yield board
    board.close()


def test_a_gyros_failure_is_told_while_it_lasts(compiled: CompiledArduino) -> None:
    decoder = messages.decoder(on_board=False)

    def faults(from_ms: int, to_ms: int, bits: int) -> set[int]:
        compiled._turn.sensor_faults = bits
        seen = set()
        for t_ms in range(from_ms, to_ms):
            compiled.advance(t_ms * MS)
            for frame in decoder.feed(compiled.transmit(t_ms * MS)):
                message = messages.decode(frame)
                if isinstance(message, messages.Status):
                    seen.add(message.faults)
        return seen

    assert faults(0, 500, 0) == {0}
    assert faults(510, 700, int(messages.Fault.GYRO_FAILED)) == {messages.Fault.GYRO_FAILED}
    assert faults(710, 900, 0) == {0}


def test_rounds_that_were_missed_are_left_out(library: Any) -> None:
    """A loop that was held up says one status for all that were due, and goes on in the old rhythm."""
    board = CompiledArduino(library, BenchPeripherals())
    board.advance(0)
    board.advance(300 * MS)
    try:
        board._tick_ns += 70 * MS  # the loop sleeps for 70 ms
        decoder = messages.decoder(on_board=False)
        times_us = []
        for t_ms in range(301, 500):
            board.advance(t_ms * MS)
            decoded = [messages.decode(frame) for frame in decoder.feed(board.transmit(t_ms * MS))]
            times_us += [message.time_us for message in decoded if isinstance(message, messages.Status)]
    finally:
        board.close()
    assert times_us[:4] == [71_000, 81_000, 101_000, 121_000]
