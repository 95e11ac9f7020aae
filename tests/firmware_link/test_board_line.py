"""The board's faults, its line, that line's bounds, and random bytes."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import pytest

from firmware_link import messages
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.logic import BoardOptions
from firmware_link.emulator.pty import BenchPeripherals
from firmware_link.messages import Fault, ResetCause

MS = 1_000_000
NEUTRAL = (1500.0, 1500.0)


def test_hang_holds_the_pulses_until_the_watchdog_bites(make_bench: Callable[..., Any]) -> None:
    bench = make_bench(watchdog_ns=60 * MS).running().arm()
    bench.send(bench.command(1600.0, 1550.0))
    bench.wait(22)
    bench.board.hang(bench.t_ns)
    boot_id = bench.board.boot_id
    assert [type(m) for m in bench.wait(59)].count(messages.Status) <= 1  # what was on the line
    assert bench.peripherals.at_pins == (1600.0, 1550.0)
    bench.wait(2)
    assert bench.peripherals.at_pins == NEUTRAL
    assert bench.board.boot_id == boot_id + 1
    bench.running()
    hello = bench.last(messages.Hello)
    assert isinstance(hello, messages.Hello)
    assert hello.reset_cause == ResetCause.WATCHDOG
    assert not bench.board.armed


def test_more_bytes_a_millisecond_than_the_ring_holds_are_lost_and_told(make_bench: Callable[..., Any]) -> None:
    bench = make_bench(baud=1_000_000).running()
    bench.board.receive(b"x" * 300, bench.t_ns)
    assert bench.faults() & Fault.RX_OVERFLOW
    assert bench.board.counters.rx_lost == pytest.approx(3 * 36, abs=36)


def test_slow_line_leaves_out_whole_frames(make_bench: Callable[..., Any]) -> None:
    bench = make_bench(baud=9600).running()
    said = bench.wait(2000)  # 960 bytes a second where 2.6 kB are made
    assert len(said) > 70
    assert bench.board.counters.tx_skipped > 100
    assert bench._decoder.errors.total == 0
    assert bench.status.faults & Fault.TX_OVERFLOW


def test_damaged_frames_are_told(make_bench: Callable[..., Any]) -> None:
    bench = make_bench().running()
    frame = bytearray(messages.encode(messages.HelloRequest(), 1))
    frame[3] ^= 1
    bench.board.receive(bytes(frame), bench.t_ns)
    assert bench.faults() == Fault.FRAME_ERRORS
    assert bench.faults() == 0


def test_line_and_unread_bytes_are_bounded(make_bench: Callable[..., Any]) -> None:
    bench = make_bench().running()
    assert bench.board.receive(b"x" * 10_000, bench.t_ns) == 4096
    assert bench.board.receive(b"x", bench.t_ns) == 0
    bench.t_ns += 10 * MS
    assert bench.board.room(bench.t_ns) == 115
    for _ in range(100):
        bench.t_ns += 100 * MS
        bench.board.advance(bench.t_ns)
    assert len(bench.board.transmit(bench.t_ns)) == 4096
    assert bench.board.receive(b"x" * 10_000, bench.t_ns) == 4096


def test_random_bytes_move_nothing(make_bench: Callable[..., Any]) -> None:
    bench = make_bench().running()
    rng = random.Random(3)
    for _ in range(100):
        bench.board.receive(rng.randbytes(1000), bench.t_ns)
        bench.wait(90)
    assert not bench.board.armed
    assert {pulses[1:] for pulses in bench.peripherals.pulses} == {NEUTRAL}
    bench.wait(400)
    bench.arm()  # and it still hears


def test_same_bytes_whatever_the_steps(make_bench: Callable[..., Any]) -> None:
    """Time may be passed in any pieces: the bytes and pulses are those of the program, not of the caller's rhythm."""

    def run(steps_ms: list[float]) -> tuple[bytes, list[tuple[int, float, float]]]:
        bench = make_bench()
        out = b""
        next_ms, t_ms, index = 400.0, 0.0, 0
        while t_ms < 900:
            t_ms = min(t_ms + steps_ms[index % len(steps_ms)], next_ms, 900.0)
            index += 1
            now_ns = 5_000 * MS + round(t_ms * MS)
            bench.board.advance(now_ns)
            out += bench.board.transmit(now_ns)
            if t_ms == next_ms:
                arm = messages.Arm(nonce=bench.board._logic.arming.nonce, boot_id=bench.board.boot_id)
                bench.counter += 1
                message = arm if next_ms == 400.0 else bench.command(deadline_ms=int(t_ms) - 300 + 90)
                bench.board.receive(messages.encode(message, bench.counter), now_ns)
                next_ms += 33.3
        return out, list(bench.peripherals.pulses)

    once = run([1.0])
    assert run([0.25]) == once
    assert run([7.0, 0.1, 19.0, 60.0]) == once
    assert (1600.0, 1550.0) in {pulses[1:] for pulses in once[1]}


def test_options_are_checked() -> None:
    with pytest.raises(ValueError, match="watchdog_ns"):
        BoardOptions(watchdog_ns=0)
    with pytest.raises(ValueError, match="baud"):
        EmulatedArduino(BenchPeripherals(), 0)
