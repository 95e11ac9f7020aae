from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_link.emulator.uart import UartLine
from firmware_link.pulses import PulseTable
from firmware_link.timing import BoardClock, LineSpeedMeter, SpeedMeter

MS = 1_000_000


def test_board_time_is_behind_by_the_least_delay() -> None:
    clock = BoardClock()
    assert clock.board_ns(0) is None
    for number, delay_ms in enumerate([9, 4, 30, 2, 17, 8]):
        board_ms = 100 + 20 * number
        assert clock.observe(board_ms * 1000, (7_000 + board_ms + delay_ms) * MS) == board_ms * MS
    assert clock.board_ns((7_000 + 500) * MS) == (500 - 2) * MS


def test_board_time_follows_drift_within_a_second() -> None:
    clock = BoardClock()
    for number in range(500):
        true_ns = number * 20 * MS
        board_ns = round(true_ns * 0.995)  # a ceramic resonator
        clock.observe(board_ns // 1000, true_ns + MS)
        got = clock.board_ns(true_ns + MS)
        assert got is not None
        assert -3 * MS <= got - board_ns <= 6 * MS


def test_board_time_falls_behind_when_everything_is_late() -> None:
    clock = BoardClock()
    for number in range(100):
        clock.observe(number * 20_000, number * 20 * MS + MS)
    for number in range(100, 200):
        clock.observe(number * 20_000, number * 20 * MS + 300 * MS)
    assert clock.board_ns(199 * 20 * MS + 300 * MS) == 199 * 20 * MS


def test_one_late_message_does_not_hide_the_least_delay_of_the_second_before() -> None:
    clock = BoardClock()
    for number in range(26):  # 0 .. 500 ms: the last begins another half second, late
        clock.observe(number * 20_000, number * 20 * MS + (40 if number >= 25 else 2) * MS)
    assert clock.board_ns(600 * MS) == 598 * MS


def test_board_time_wraps_and_restarts() -> None:
    clock = BoardClock()
    wrap_us = 1 << 32
    first = clock.observe(wrap_us - 10_000, 0)
    second = clock.observe(10_000, 20 * MS)
    assert first is not None
    assert second is not None
    assert second - first == 20 * MS
    assert clock.observe(9_000, 40 * MS) is None
    clock.reset()
    assert clock.observe(9_000, 40 * MS) == 9 * MS


def test_speed_is_signed_and_needs_two_readings() -> None:
    meter = SpeedMeter(200.0)
    assert meter.step(0, 1000) is None
    assert meter.step(20 * MS, 998) == pytest.approx(-0.5)
    assert meter.step(40 * MS, 996) == pytest.approx(-0.5)
    for number in range(3, 10):
        speed = meter.step(number * 20 * MS, 996)
    assert speed == 0.0


def test_speed_starts_anew_after_a_gap_or_a_restart() -> None:
    meter = SpeedMeter(200.0)
    meter.step(0, 0)
    meter.step(20 * MS, 4)
    assert meter.step(900 * MS, 400) is None
    assert meter.step(20 * MS, 0) is None
    meter.reset()
    assert meter.step(40 * MS, 0) is None


@pytest.mark.parametrize("period_ms", [5, 10, 20])
def test_speed_by_the_rhythm_of_lines_does_not_need_their_times(period_ms: int) -> None:
    """Constant speed, 400 ticks a metre; the host looks at uneven times and sees only the newest line."""
    meter, speeds = LineSpeedMeter(400.0), []
    now_ms = 1000.0
    for turn in range(300):
        now_ms += (7.0, 19.0, 31.0)[turn % 3]
        lines = int(now_ms // period_ms)
        speed = meter.step(lines, -int(1.5 * 400.0 * lines * period_ms * 1e-3), round(now_ms * MS))
        if now_ms < 1200:
            assert speed is None
        elif turn > 60:
            assert speed is not None
            speeds.append(speed)
    one_tick_mps = 1 / 400.0 / 0.05
    assert all(abs(speed + 1.5) <= one_tick_mps + 0.03 * 1.5 for speed in speeds)
    assert np.mean(speeds) == pytest.approx(-1.5, rel=0.01)


def test_speed_by_the_rhythm_starts_anew_after_a_gap_and_a_reset() -> None:
    meter = LineSpeedMeter(400.0)
    for turn in range(30):
        meter.step(turn, 0, turn * 10 * MS)
    assert meter.step(30, 0, 300 * MS) == 0.0
    assert meter.step(31, 0, 900 * MS) is None
    for turn in range(30):
        meter.step(turn, 0, (1000 + turn * 10) * MS)
    meter.reset()
    assert meter.step(30, 0, 1300 * MS) is None


def test_speed_by_the_rhythm_is_none_while_no_line_comes() -> None:
    meter = LineSpeedMeter(400.0)
    assert {meter.step(7, 3, turn * 10 * MS) for turn in range(200)} == {None}


TABLES = st.lists(st.integers(1000, 5000), min_size=2, max_size=6, unique=True).flatmap(
    lambda pulses: st.tuples(
        st.just([p / 2 for p in sorted(pulses)]),
        st.lists(st.integers(-50, 50), min_size=len(pulses), max_size=len(pulses), unique=True).map(sorted),
        st.booleans(),
    )
)


@given(TABLES, st.floats(-60, 60))
def test_pulse_table_is_linear_interpolation(table: tuple[list[float], list[int], bool], value: float) -> None:
    pulses, values, falling = table
    if falling:
        values = values[::-1]
    pulse_table = PulseTable(pulses, values)
    ascending = sorted(zip(values, pulses, strict=True))
    want = np.interp(value, [v for v, _ in ascending], [p for _, p in ascending])
    got = pulse_table.pulse_us(value)
    assert abs(got - want) <= 0.25 + 1e-9
    assert got * 2 == int(got * 2)
    assert pulse_table.value(got) == pytest.approx(float(np.interp(got, pulses, values)), abs=1e-9)
    assert (pulse_table.min_us, pulse_table.max_us) == (pulses[0], pulses[-1])


@given(
    st.lists(st.tuples(st.integers(0, 30 * MS), st.binary(max_size=20)), max_size=10),
    st.sampled_from([9600, 57600, 115200, 1_000_000]),
)
def test_line_delivers_every_byte_in_its_time(bursts: list[tuple[int, bytes]], baud: int) -> None:
    """Against a model of one byte at a time."""
    line = UartLine(baud, 1 << 20)
    now_ns = free_ns = 0
    due: list[tuple[int, int]] = []
    got: list[int] = []
    for gap_ns, data in bursts:
        now_ns += gap_ns
        got += line.take(now_ns)
        assert got == [byte for t_ns, byte in due if t_ns <= now_ns]
        upcoming = [t_ns for t_ns, _ in due if t_ns > now_ns]
        assert line.next_ns() == (upcoming[0] if upcoming else None)
        if data:
            line.put(data, now_ns)
            start_ns = max(now_ns, free_ns)
            due += [(start_ns + (i + 1) * 10_000_000_000 // baud, byte) for i, byte in enumerate(data)]
            free_ns = due[-1][0]
        waiting = (max(free_ns - now_ns, 0)) * baud / 1e10
        assert (1 << 20) - line.room(now_ns) == pytest.approx(waiting, abs=1.0)
    assert got + list(line.take(free_ns)) == [byte for _, byte in due]
