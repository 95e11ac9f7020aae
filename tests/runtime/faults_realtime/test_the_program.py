"""What stops the car when the program that drives it is held up, against the real clock, in processes of their own."""

from __future__ import annotations

import signal
from collections.abc import Callable

import pytest

from tests.support.realtime_rig import MS, Car, emulated
from tests.support.realtime_stops import (
    QUIET_MS,
    check_never_drives,
    check_stop,
    check_stop_by_the_timer,
    paused_by_the_timer,
    phase_ms,
)

pytestmark = [pytest.mark.realtime, pytest.mark.slow, pytest.mark.timeout(120)]
BACKLOG_MS = 1500.0  # of words that nobody reads: more than one read of the port takes
ATTEMPTS = 5  # until a busy machine has let a stall be one of 100 ms
REARM_MS = 450.0  # the input must have been well for half a second before a request counts


def test_stopped_and_continued(car: Car) -> None:
    """SIGSTOP, as a debugger or a machine that swaps does; what it had in mind is old when it wakes."""
    stopped_ns = car.struck(lambda: car.kill(signal.SIGSTOP), phase_ms("stop"))
    try:
        check_stop(car.bench, stopped_ns)
    finally:
        car.kill(signal.SIGCONT)
    continued_ns = car.bench.clock.now_ns
    car.bench.wait(QUIET_MS)
    check_never_drives(car.bench, continued_ns)
    car.until_driving(press=True)


def test_a_backlog_of_words_that_nobody_read(make_car: Callable[..., Car]) -> None:
    """A person who presses the moment it wakes is not heard until the board's words are fresh again."""
    car = make_car(emulated)
    stopped_ns = car.struck(lambda: car.kill(signal.SIGSTOP), phase_ms("backlog"))
    try:
        check_stop(car.bench, stopped_ns)
        car.bench.wait(BACKLOG_MS)
    finally:
        car.kill(signal.SIGCONT)
    continued_ns = car.bench.clock.now_ns
    car.until_driving(press=True)
    assert (car.bench.starts_ns()[-1] - continued_ns) / MS >= REARM_MS
    car.bench.check_asked_for()


def test_a_stall_of_100_ms_in_the_loop(car: Car) -> None:
    """A car that has just driven off is slow: neutral by the board's timer, and on.

    A busy machine may make the stall longer than a car goes on after by itself: then it is stalled once more.
    """
    for attempt in range(ATTEMPTS):
        asked_ns = car.struck(lambda: car.kill(signal.SIGUSR2), phase_ms(f"stall {attempt}"))
        if paused_by_the_timer(car.bench, asked_ns):
            return
    raise AssertionError(f"it does not drive again: {car.said[-2000:]}")


def test_a_collection_over_a_million_objects(make_car: Callable[..., Car]) -> None:
    """It takes some hundred milliseconds, again and again where the machine is fast."""
    car = make_car(emulated, "collect")
    check_stop_by_the_timer(car.bench, car.struck(lambda: car.kill(signal.SIGUSR2), phase_ms("collect")))
    car.bench.check_asked_for()


def test_killed(car: Car) -> None:
    """The last of this file: whoever needs the program after this starts another one."""
    check_stop(car.bench, car.struck(lambda: car.kill(signal.SIGKILL), phase_ms("kill")))
    assert car.ended() == -signal.SIGKILL
