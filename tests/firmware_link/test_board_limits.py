"""The board's limits: what is taken over, and what they do to the pulses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_link import messages
from firmware_link.emulator.logic import Pulses, limits_fit
from firmware_link.messages import Fault, ResetCause

MS = 1_000_000


LIMITS = messages.Limits(
    servo_min_us=1100.0,
    servo_straight_us=1520.0,
    servo_max_us=1900.0,
    motor_min_us=1400.0,
    motor_neutral_us=1500.0,
    motor_max_us=1600.0,
    servo_slew_us=40.0,
    motor_slew_us=20.0,
)


def changed(**changes: float) -> messages.Limits:
    values = {f.name: getattr(LIMITS, f.name) for f in messages.TABLE[1].codec.fields}
    return messages.Limits(**(values | changes))


def test_limits_are_taken_while_disarmed_answered_and_kept_over_restarts(make_bench: Callable[..., Any]) -> None:
    bench = make_bench().running()
    bench.send(LIMITS)
    hello = next(m for m in bench.wait(10) if isinstance(m, messages.Hello))
    assert hello.limits_crc == messages.limits_crc(LIMITS)
    bench.board.brown_out(bench.t_ns)
    assert bench.peripherals.at_pins == (1520.0, 1500.0)
    bench.running()
    hello = bench.last(messages.Hello)
    assert isinstance(hello, messages.Hello)
    assert (hello.limits_crc, hello.reset_cause) == (messages.limits_crc(LIMITS), ResetCause.BROWN_OUT)


def test_limits_are_refused_while_armed(make_bench: Callable[..., Any]) -> None:
    bench = make_bench().running().arm()
    bench.send(LIMITS)
    assert bench.faults() == Fault.LIMITS_REFUSED
    assert bench.board.armed


@pytest.mark.parametrize(
    "limits",
    [
        changed(servo_min_us=1530.0),
        changed(servo_max_us=1510.0),
        changed(motor_neutral_us=1700.0),
        changed(motor_min_us=499.5),
        changed(servo_max_us=2500.5),
        changed(servo_slew_us=0.0),
        changed(motor_slew_us=0.0),
    ],
)
def test_limits_that_do_not_fit_are_refused(make_bench: Callable[..., Any], limits: messages.Limits) -> None:
    bench = make_bench().running()
    bench.send(limits)
    assert bench.faults() == Fault.LIMITS_REFUSED
    assert limits_fit(LIMITS)


def test_pulses_are_clamped_and_slewed_but_never_delay_a_stop() -> None:
    pulses = Pulses(LIMITS)
    pulses.set_target(2500.0, 2500.0)
    seen = []
    for _ in range(12):
        pulses.frame()
        seen.append((pulses.servo_us, pulses.motor_us))
    assert seen[:3] == [(1560.0, 1520.0), (1600.0, 1540.0), (1640.0, 1560.0)]
    assert seen[-1] == (1900.0, 1600.0)
    pulses.set_target(1900.0, 1500.0)
    pulses.frame()
    assert pulses.motor_us == 1500.0  # neutral at once
    pulses.set_target(1900.0, 1600.0)
    for _ in range(5):
        pulses.frame()
    pulses.set_target(1900.0, 1400.0)
    pulses.frame()
    assert pulses.motor_us == 1480.0  # through neutral at once, then as slowly as from neutral
    pulses.straighten()
    pulses.frame()
    assert (pulses.servo_us, pulses.motor_us) == (1520.0, 1500.0)


@given(st.lists(st.tuples(st.floats(500, 2500), st.floats(500, 2500)), max_size=60))
def test_pulses_never_leave_the_limits_nor_jump(wanted: list[tuple[float, float]]) -> None:
    pulses = Pulses(LIMITS)
    for servo_us, motor_us in wanted:
        before = pulses.servo_us, abs(pulses.motor_us - 1500.0)
        pulses.set_target(servo_us, motor_us)
        pulses.frame()
        assert 1100.0 <= pulses.servo_us <= 1900.0
        assert 1400.0 <= pulses.motor_us <= 1600.0
        assert abs(pulses.servo_us - before[0]) <= 40.0 + 1e-9
        assert abs(pulses.motor_us - 1500.0) <= before[1] + 20.0 + 1e-9
