"""The board's state table, row by row, on frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest

from firmware_link import messages
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.pty import BenchPeripherals
from firmware_link.messages import Fault, ResetCause
from tests.support.wide_limits import WIDE_LIMITS

MS = 1_000_000
NEUTRAL = (1500.0, 1500.0)


def test_boots_silent_with_straight_pulses_then_says_hello(make_bench: Callable[..., Any]) -> None:
    bench = make_bench(boot_ns=300 * MS, boot_id=77)
    assert bench.wait(299) == []
    assert bench.peripherals.at_pins == NEUTRAL
    said = bench.wait(10)
    assert said[0] == messages.Hello(
        table_hash=messages.TABLE_HASH,
        version=messages.PROTOCOL_VERSION,
        reset_cause=ResetCause.EXTERNAL,
        boot_id=77,
        limits_crc=messages.limits_crc(WIDE_LIMITS),
    )


def test_first_advance_switches_the_power_on() -> None:
    board = EmulatedArduino(BenchPeripherals())
    board.advance(10 * MS)
    board.advance(320 * MS)
    hello = messages.decode(messages.decoder(on_board=False).feed(board.transmit(320 * MS))[0])
    assert isinstance(hello, messages.Hello)
    assert hello.reset_cause == ResetCause.POWER_ON


def test_reports_come_at_their_rates_and_bytes_at_the_baud_rate(make_bench: Callable[..., Any]) -> None:
    bench = make_bench().running()
    said = bench.wait(2000)
    kinds = [type(message) for message in said]
    assert [kinds.count(k) for k in (messages.Hello, messages.Status, messages.Odometry, messages.Ranges)] == [
        4,
        100,
        100,
        100,
    ]
    assert len(bench.peripherals.pulses) == 1 + 2 + 100  # at the reset, in the first 30 ms, and since
    steps = [
        b[0] - a[0]
        for a, b in zip(list(bench.peripherals.pulses)[2:-1], list(bench.peripherals.pulses)[3:], strict=True)
    ]
    assert set(steps) == {20 * MS}


def test_bytes_leave_when_their_last_bit_has(make_bench: Callable[..., Any]) -> None:
    bench = make_bench(baud=9600)
    bench.wait(300)  # the hello begins to leave now: 15 bytes of 10 bits
    for count in range(1, 16):
        out_ns = bench.t_ns + count * 10_000_000_000 // 9600
        bench.board.advance(out_ns)
        assert bench.board.transmit(out_ns - 1) == b""
        assert len(bench.board.transmit(out_ns)) == 1


def test_bytes_during_boot_are_lost_and_counted(make_bench: Callable[..., Any]) -> None:
    bench = make_bench()
    bench.send(messages.HelloRequest())
    bench.running()
    assert bench.board.counters.rx_in_boot == len(messages.encode(messages.HelloRequest(), 1))


def test_hello_when_asked(make_bench: Callable[..., Any]) -> None:
    bench = make_bench().running()
    bench.send(messages.HelloRequest())
    assert [type(m) for m in bench.wait(8)].count(messages.Hello) == 1


def test_disarmed_commands_do_nothing_but_are_echoed(make_bench: Callable[..., Any]) -> None:
    bench = make_bench().running()
    for _ in range(10):
        bench.send(bench.command())
        bench.wait(20)
    assert bench.peripherals.at_pins == NEUTRAL
    assert bench.status.command_counter == bench.counter
    assert bench.status.flags == 0
    assert bench.status.faults == 0


@pytest.mark.parametrize(("nonce", "boot_id"), [(1, 0), (0, 1), (0x9E37, 0), (0, 0xFFFF)])
def test_arm_with_wrong_numbers_is_refused(make_bench: Callable[..., Any], nonce: int, boot_id: int) -> None:
    bench = make_bench().running()
    bench.send(messages.Arm(nonce=bench.status.nonce + nonce & 0xFFFF, boot_id=bench.board.boot_id + boot_id & 0xFFFF))
    assert bench.faults() == Fault.ARM_REFUSED
    assert not bench.board.armed


def test_armed_follows_fresh_commands_at_the_servo_frame(make_bench: Callable[..., Any]) -> None:
    bench = make_bench().running().arm()
    bench.send(bench.command(1600.0, 1550.0))
    bench.wait(22)
    t_ns, *pulses = bench.peripherals.pulses[-1]
    assert pulses == [1600.0, 1550.0]
    assert (t_ns - bench.board._start_ns) % (20 * MS) == 0
    bench.wait(25)
    assert (bench.status.servo_us, bench.status.motor_us) == (1600.0, 1550.0)
    assert bench.status.flags == messages.StatusFlag.ARMED


def test_armed_without_commands_times_out(make_bench: Callable[..., Any]) -> None:
    bench = make_bench().running().arm()
    bench.wait(93)
    assert bench.board.armed
    bench.wait(12)
    assert not bench.board.armed
    nonce = bench.status.nonce
    assert bench.faults() == Fault.COMMAND_TIMEOUT
    assert bench.status.nonce != nonce
    bench.wait(500)
    assert bench.status.faults == Fault.COMMAND_TIMEOUT
    bench.arm()
    bench.send(bench.command())
    bench.wait(25)
    assert bench.status.faults == 0


def test_timer_counts_from_the_last_fresh_command_only(make_bench: Callable[..., Any]) -> None:
    bench = make_bench().running().arm()
    bench.send(bench.command())
    fed_ns = bench.t_ns
    nonce = bench.status.nonce
    for _ in range(17):
        bench.wait(7)
        if not bench.board.armed:
            break
        bench.send(bench.command(flags=0))  # neutral on purpose
        bench.send(bench.command(), step=0)  # repeated
        bench.send(bench.command(deadline_ms=bench.t_ms() - 1 & 0xFFFF))  # late
        bench.send(bench.command(servo_us=400.0))  # no pulse
        bench.send(messages.HelloRequest())
        bench.send(messages.Arm(nonce=nonce, boot_id=bench.board.boot_id))
    assert not bench.board.armed
    assert 95 * MS <= bench.t_ns - fed_ns <= 112 * MS
    bench.wait(20)
    assert bench.peripherals.at_pins == (1600.0, 1500.0)


def rolling(make_bench: Callable[..., Any]) -> Any:
    """An armed board's steering at 1900 us, the motor at 1600 us."""
    bench = make_bench().running().arm()
    bench.send(bench.command(1900.0, 1600.0))
    bench.wait(60)
    assert bench.peripherals.at_pins == (1900.0, 1600.0)
    return bench


def test_command_that_is_not_fresh_is_neutral_at_once_and_keeps_the_steering(make_bench: Callable[..., Any]) -> None:
    bench = rolling(make_bench)
    bench.send(bench.command(1100.0, 1600.0, flags=0))
    bench.wait(22)
    assert bench.peripherals.at_pins == (1900.0, 1500.0)
    assert bench.board.armed


def test_steering_is_kept_for_2_s_after_the_first_neutral_and_nothing_prolongs_it(
    make_bench: Callable[..., Any],
) -> None:
    bench = rolling(make_bench)
    start_ns = bench.t_ns
    bench.send(bench.command(flags=0))
    bench.wait(40)
    while bench.t_ns < start_ns + 1940 * MS:
        bench.send(messages.Disarm())
        bench.send(bench.command(1100.0, 1600.0))  # nobody is armed any more
        bench.wait(50)
        assert bench.peripherals.at_pins == (1900.0, 1500.0)
    bench.wait(90)
    assert bench.peripherals.at_pins == NEUTRAL
    straight_ns = next(t for t, servo_us, _ in bench.peripherals.pulses if t > start_ns and servo_us == NEUTRAL[0])
    assert 2000 * MS <= straight_ns - start_ns <= 2025 * MS


def turned(bench: Any, ms: float, ticks: int = 4) -> None:
    """The wheel turns for so long, by `ticks` in 20 ms."""
    for _ in range(round(ms / 20)):
        sensors = bench.peripherals.sensors
        bench.peripherals.sensors = dataclasses.replace(sensors, wheel_ticks=sensors.wheel_ticks + ticks)
        bench.wait(20)


@pytest.mark.parametrize("how", ["disarm", "command", "timer"])
def test_a_car_that_stands_has_straight_wheels_at_once(make_bench: Callable[..., Any], how: str) -> None:
    bench = rolling(make_bench)
    turned(bench, 60)
    bench.send(bench.command(1900.0, 1600.0))
    turned(bench, 60)
    if how != "timer":
        bench.send(messages.Disarm() if how == "disarm" else bench.command(flags=0))
    turned(bench, 400)  # it rolls
    assert bench.peripherals.at_pins == (1900.0, 1500.0)
    bench.wait(180)
    assert bench.peripherals.at_pins == (1900.0, 1500.0)
    bench.wait(80)
    assert bench.peripherals.at_pins == NEUTRAL


def test_a_wheel_that_did_not_tick_while_the_motor_turned_says_nothing(make_bench: Callable[..., Any]) -> None:
    bench = make_bench().running().arm()
    bench.send(bench.command(1900.0, 1600.0))
    turned(bench, 60)  # then it fails
    for _ in range(5):
        bench.send(bench.command(1900.0, 1600.0))
        bench.wait(60)
    bench.send(messages.Disarm())
    bench.wait(1900)
    assert bench.peripherals.at_pins == (1900.0, 1500.0)
    turned(bench, 40)  # it works again, but the 2 s are over first
    bench.wait(90)
    assert bench.peripherals.at_pins == NEUTRAL


@pytest.mark.parametrize("how", ["arm", "limits", "reset"])
def test_an_arm_new_limits_or_a_restart_end_the_roll_out(make_bench: Callable[..., Any], how: str) -> None:
    bench = rolling(make_bench)
    bench.send(messages.Disarm())
    bench.wait(42)
    assert bench.peripherals.at_pins == (1900.0, 1500.0)
    if how == "arm":
        bench.arm()
    elif how == "limits":
        bench.send(WIDE_LIMITS)
    else:
        bench.board.reset(bench.t_ns)
    bench.wait(42)
    assert bench.peripherals.at_pins == NEUTRAL


@pytest.mark.parametrize(
    ("servo_us", "motor_us", "flags", "fault"),
    [
        (499.5, 1500.0, 1, Fault.COMMAND_REFUSED),
        (1500.0, 2500.5, 1, Fault.COMMAND_REFUSED),
        (0.0, 0.0, 0, Fault.COMMAND_REFUSED),
        (1500.0, 1500.0, 2, Fault.COMMAND_REFUSED),
        (1500.0, 1500.0, 0x81, Fault.COMMAND_REFUSED),
        (2500.0, 500.0, 1, 0),
    ],
)
def test_impossible_commands_are_refused(
    make_bench: Callable[..., Any], servo_us: float, motor_us: float, flags: int, fault: int
) -> None:
    bench = make_bench().running().arm()
    bench.send(bench.command(servo_us, motor_us, flags=flags))
    assert bench.faults() == fault


@pytest.mark.parametrize(("ahead_ms", "late"), [(-2, True), (3, False), (150, False), (153, True), (0x8000, True)])
def test_deadline(make_bench: Callable[..., Any], ahead_ms: int, late: bool) -> None:
    bench = make_bench().running().arm()
    bench.send(bench.command(deadline_ms=(bench.t_ms() + ahead_ms) & 0xFFFF))
    assert bench.faults() == (Fault.COMMAND_LATE if late else 0)


@pytest.mark.parametrize(("step", "repeated"), [(0, True), (1, False), (127, False), (128, True), (255, True)])
def test_counter(make_bench: Callable[..., Any], step: int, repeated: bool) -> None:
    bench = make_bench().running().arm()
    bench.send(bench.command(), step=step)
    assert bench.faults() == (Fault.COMMAND_REPEATED if repeated else 0)


def test_disarm_is_taken_in_every_state_and_voids_arms_under_way(make_bench: Callable[..., Any]) -> None:
    bench = make_bench().running()
    nonce = bench.status.nonce
    bench.send(messages.Disarm())
    bench.send(messages.Arm(nonce=nonce, boot_id=bench.board.boot_id))
    bench.wait(25)
    assert not bench.board.armed
    bench.arm()
    bench.send(bench.command(1600.0, 1550.0))
    bench.wait(22)
    bench.send(messages.Disarm())
    bench.wait(22)
    assert bench.peripherals.at_pins == (1600.0, 1500.0)
    assert bench.faults() == 0
    assert bench.status.nonce != nonce
