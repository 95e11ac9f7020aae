"""The firmware itself on a simulated ATmega328P: its reactions, in the chip's own cycles."""

from __future__ import annotations

import dataclasses
import random
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from automodel.config import LinkConfig, VehicleConfig
from automodel.signals import Command as Wish
from firmware_link import messages
from firmware_link.arduino import ArduinoLink
from firmware_link.emulator.logic import NO_LIMITS
from firmware_link.emulator.pty import BenchPeripherals, PtyBoard
from firmware_link.messages import Arm, Command, Fault, Limits, ResetCause, StatusFlag
from firmware_link.transport import SerialTransport
from tests.support.realtime_rig import PATIENCE_S, BoardClock
from tests.support.wide_limits import WIDE_LIMITS

MS = 1_000_000
US = 1_000
BYTE_NS = 10_000_000_000 / 115200
NEUTRAL = (1500.0, 1500.0)


class Host:
    """Runs the board in steps of 5 ms and talks to it."""

    def __init__(self, board: Any) -> None:
        self.board = board
        self.t_ns = 0
        self.counter = 0
        self.board.advance(0)

    def wait(self, ms: float) -> list[messages.Message]:
        """What the board says meanwhile."""
        before = len(self.board.said)
        end_ns = self.t_ns + round(ms * MS)
        while self.t_ns < end_ns:
            self.t_ns = min(self.t_ns + 5 * MS, end_ns)
            self.board.advance(self.t_ns)
            self.board.transmit(self.t_ns)
        return list(self.board.said[before:])

    def send(self, message: messages.ToBoard) -> int:
        """When its last bit has arrived."""
        self.counter = (self.counter + 1) & 0xFF
        frame = messages.encode(message, self.counter)
        self.board.receive(frame, self.t_ns)
        return self.t_ns + round(len(frame) * BYTE_NS)

    @property
    def status(self) -> messages.Status:
        return next(m for m in reversed(self.board.said) if isinstance(m, messages.Status))

    @property
    def hello(self) -> messages.Hello:
        return next(m for m in reversed(self.board.said) if isinstance(m, messages.Hello))

    def t_ms(self) -> int:
        """The board's time; the program starts within the first millisecond after its reset."""
        return (self.t_ns - self.board.resets[-1][0]) // MS

    def arm(self) -> None:
        self.send(Arm(nonce=self.status.nonce, boot_id=self.hello.boot_id))
        self.wait(5)

    def command(self, servo_us: float, motor_us: float) -> int:
        deadline_ms = (self.t_ms() + 100) & 0xFFFF
        return self.send(Command(servo_us=servo_us, motor_us=motor_us, deadline_ms=deadline_ms, flags=1))

    def pulses_after(self, t_ns: int, motor: bool) -> list[Any]:
        return [pulse for pulse in self.board.pulses if pulse.t_ns > t_ns and pulse.motor is motor]


@pytest.fixture
def host(avr: Any) -> Host:
    host = Host(avr)
    host.wait(5)
    host.send(WIDE_LIMITS)
    host.wait(95)  # until they are in the EEPROM
    return host


def test_pulses_come_at_50_hz_with_the_width_told_to_a_cycle(host: Host) -> None:
    host.arm()
    for step in range(50):
        host.command(1000.0 + 20.5 * step, 1500.0 - 9.5 * step)
        host.wait(20)
    host.wait(30)
    for motor in (False, True):
        pulses = [pulse for pulse in host.board.pulses if pulse.motor is motor]
        rises = np.array([pulse.t_ns - pulse.cycles * 62.5 for pulse in pulses])
        assert np.abs(np.diff(rises) - 20 * MS).max() <= 4 * 62.5  # simavr tells between two instructions
        assert {abs(pulse.cycles - 16 * pulse.us) <= 4 for pulse in pulses} == {True}
    steering = [pulse.us for pulse in host.pulses_after(0, False)]
    start = steering.index(1123.0)  # the sixth: slewing has caught up
    assert steering[start : start + 44] == [1000.0 + 20.5 * step for step in range(6, 49)] + [2000.0]


def test_stale_commands_are_neutral_within_105_ms_in_the_registers_and_125_at_the_pins(host: Host) -> None:
    """From the last bit of the last command to the registers, and to the end of the first neutral pulse."""
    rng = random.Random(1)
    registers, pins = [], []
    for _ in range(60):
        host.arm()
        host.wait(rng.uniform(0.0, 20.0))
        arrived_ns = host.command(1600.0, 1550.0)
        host.wait(150)
        for motor in (False, True):
            writes = [w for w in host.board.registers if w.motor is motor and w.t_ns > arrived_ns]
            if not motor:  # the steering stays as long as the car rolls
                assert [write.us for write in writes] == [1600.0]
                continue
            assert [write.us for write in writes] == [1550.0, 1500.0]
            registers.append((writes[1].t_ns - arrived_ns) / MS)
            pulses = host.pulses_after(arrived_ns + 50 * MS, motor)
            pins.append((next(p.t_ns for p in pulses if p.us == 1500.0) - arrived_ns) / MS)
        assert host.status.faults == Fault.COMMAND_TIMEOUT
    assert min(registers) >= 95.0
    assert max(registers) <= 105.0
    assert max(pins) <= 125.0
    assert max(pins) - min(pins) > 10.0  # the phase of the servo frame was tried


def test_a_car_that_stands_has_straight_wheels_and_one_that_rolls_has_not(host: Host) -> None:
    """By the edges at the wheel sensor's pin."""
    host.arm()
    pins = host.board._peripherals
    for index in range(60):
        ticks = pins.sensors.wheel_ticks + (4 if index < 40 else 0)
        pins.sensors = dataclasses.replace(pins.sensors, wheel_ticks=ticks)
        if index < 10:
            host.command(1600.0, 1550.0)  # then the timer stops it: 100 ms later
        host.wait(20)
        if index == 39:
            stood_ns = host.t_ns
    steering = {pulse.us for pulse in host.pulses_after(stood_ns - 400 * MS, False) if pulse.t_ns < stood_ns + 180 * MS}
    assert steering == {1600.0}
    straight_ns = next(pulse.t_ns for pulse in host.pulses_after(stood_ns, False) if pulse.us == 1500.0)
    assert 180 * MS < straight_ns - stood_ns < 280 * MS


def test_a_command_is_a_pulse_within_25_ms_of_being_written(host: Host) -> None:
    host.arm()
    rng = random.Random(2)
    delays = []
    for index in range(200):
        wanted_us = 1500.0 + (index % 2) * 50.0
        written_ns = host.t_ns
        host.command(1500.0, wanted_us)
        host.wait(rng.uniform(26.0, 46.0))
        delays.append(min(p.t_ns for p in host.pulses_after(written_ns, True) if p.us == wanted_us) - written_ns)
    assert np.percentile(delays[1:], 99) <= 25 * MS


def test_hang_ends_in_a_restart_and_no_pulse_is_wrong_for_longer_than_the_watchdog_takes(host: Host) -> None:
    for deaf in (False, True):
        host.arm()
        host.command(1600.0, 1550.0)
        host.wait(45)
        assert host.pulses_after(0, True)[-1].us == 1550.0
        hung_ns = host.t_ns
        host.board.hang(hung_ns, deaf=deaf)
        host.wait(250)
        assert {pulse.us for pulse in host.pulses_after(hung_ns + 70 * MS, True)} == {1500.0}
        assert 50 * MS < host.board.resets[-1][0] - hung_ns < 70 * MS
        assert min(p.t_ns for p in host.pulses_after(hung_ns, True) if p.us == 1500.0) - hung_ns < 100 * MS
        assert host.hello.reset_cause == ResetCause.WATCHDOG
        assert host.status.flags == 0


@pytest.mark.parametrize("cause", [ResetCause.EXTERNAL, ResetCause.BROWN_OUT])
def test_reset_is_disarmed_neutral_and_another_boot_id(host: Host, cause: ResetCause) -> None:
    assert host.hello.reset_cause == ResetCause.POWER_ON
    for boot_id in (2, 3):
        host.arm()
        host.command(1600.0, 1550.0)
        host.wait(30)
        host.board.reset(host.t_ns, cause)
        reset_ns = host.t_ns
        host.wait(60)
        assert {pulse.us for pulse in host.pulses_after(reset_ns, True)} == {1500.0}
        assert (host.hello.boot_id, host.hello.reset_cause, host.status.flags) == (boot_id, cause, 0)
        assert host.status.nonce == boot_id


def test_while_the_bootloader_runs_there_are_no_pulses(avr: Any) -> None:
    board = type(avr)(BenchPeripherals(), boot_ns=300 * MS)
    host = Host(board)
    try:
        host.wait(290)
        assert board.said == []
        host.wait(20)
        host.send(WIDE_LIMITS)
        host.wait(60)
        assert board._peripherals.at_pins == NEUTRAL
        board.reset(host.t_ns)
        host.wait(100)
        assert board._peripherals.at_pins == (0.0, 0.0)
    finally:
        board.close()


LIMITS = Limits(
    servo_min_us=1100.0,
    servo_straight_us=1520.0,
    servo_max_us=1900.0,
    motor_min_us=1400.0,
    motor_neutral_us=1510.0,
    motor_max_us=1600.0,
    servo_slew_us=40.0,
    motor_slew_us=20.0,
)


def test_limits_are_kept_in_the_eeprom(host: Host) -> None:
    host.send(LIMITS)
    host.wait(100)
    assert host.hello.limits_crc == messages.limits_crc(LIMITS)
    host.board.brown_out(host.t_ns)
    host.wait(60)
    assert host.hello.limits_crc == messages.limits_crc(LIMITS)
    assert host.board._peripherals.at_pins == (1520.0, 1510.0)


def test_without_valid_limits_there_is_no_pulse_at_all(avr: Any) -> None:
    host = Host(avr)  # its EEPROM is blank
    host.wait(300)
    host.arm()
    host.command(1600.0, 1550.0)
    host.wait(100)
    assert host.status.flags == StatusFlag.NO_LIMITS
    assert (host.status.servo_us, host.status.motor_us) == (0.0, 0.0)
    assert not avr.pulses
    assert any(m.faults & Fault.ARM_REFUSED for m in avr.said if isinstance(m, messages.Status))
    host.send(LIMITS)
    host.wait(60)
    assert {(pulse.motor, pulse.us) for pulse in avr.pulses} == {(False, 1520.0), (True, 1510.0)}  # and none is cut
    assert host.status.flags == 0


def test_limits_cut_short_by_a_power_loss_are_none_and_give_no_pulse(host: Host) -> None:
    crcs = set()
    for wait_ms in (5, 7, 9, 12, 15, 18):
        sent = dataclasses.replace(LIMITS, servo_slew_us=4.0 * wait_ms, motor_max_us=1600.0 + wait_ms)
        host.send(sent)
        host.wait(wait_ms)
        host.board.brown_out(host.t_ns)
        reset_ns = host.t_ns
        host.wait(60)
        kept = host.hello.limits_crc == messages.limits_crc(sent)
        crcs.add(host.hello.limits_crc)
        assert kept or host.hello.limits_crc == messages.limits_crc(NO_LIMITS)
        assert {pulse.us for pulse in host.pulses_after(reset_ns + MS, True)} == ({1510.0} if kept else set())
        assert host.status.flags == (0 if kept else StatusFlag.NO_LIMITS)
    assert messages.limits_crc(NO_LIMITS) in crcs


def test_loop_ends_well_before_the_next_millisecond_whatever_comes(host: Host) -> None:
    host.arm()
    host.board.measure()
    for _ in range(100):
        host.command(1600.0, 1550.0)
        host.send(messages.HelloRequest())
        host.wait(4)
    assert host.board.measure()["longest_awake"] < 0.9 * 16_000
    assert host.board.measure()["lowest_stack"] > 0x100 + 400 + 200  # 200 bytes between the data and the stack


def test_random_bytes_move_nothing_and_leave_it_hearing(host: Host) -> None:
    rng = random.Random(3)
    for _ in range(20):
        host.board.receive(rng.randbytes(1000), host.t_ns)
        host.wait(90)
    assert {pulse.us for pulse in host.board.pulses} == {1500.0}
    assert host.status.faults & Fault.FRAME_ERRORS
    host.wait(50)
    host.arm()
    host.wait(25)  # the last garbage ended with the zero ahead of the Arm
    assert host.status.flags == messages.StatusFlag.ARMED
    host.wait(20)
    assert host.status.faults == 0


@pytest.mark.realtime
def test_the_firmware_answers_on_a_pseudo_terminal(avr: Any, tmp_path: Path) -> None:
    """What opens a serial port opens this. How long it took is not judged here.

    The host has the board's time: a machine that is too busy to simulate the chip in real time makes both slow.
    """
    config, clock = LinkConfig(), BoardClock(tmp_path / "clock")
    given_up = time.monotonic() + PATIENCE_S
    with PtyBoard(avr, clock=clock) as pty:
        link = ArduinoLink(SerialTransport(pty.path, config.baud), config, VehicleConfig())
        link.open()
        state = None
        while not (state is not None and state.armed and avr._peripherals.at_pins == (1500.0, 1600.0)):
            assert time.monotonic() < given_up, "it does not drive"
            now_ns = clock.now_ns
            state = link.poll(now_ns)
            if state is not None and not state.armed:
                link.arm(now_ns)
            link.send(Wish(t_ns=now_ns, steering_rad=0.0, speed_mps=1.0, valid_until_ns=now_ns + 100 * MS), now_ns)
            time.sleep(0.01)
        link.close()
    clock.close()
