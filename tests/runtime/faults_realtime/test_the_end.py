"""What becomes of the car when the program that drives it ends, at any time, in order or not."""

from __future__ import annotations

import random
import signal
from collections.abc import Callable

import pytest

from firmware_link.messages import Command, Disarm
from tests.support.realtime_rig import BOARDS, MS, NEUTRAL_US, Bench, Car, MakeBoard, emulated
from tests.support.realtime_stops import LAST_TURN_MS, QUIET_MS, REACTION_MS, check_never_drives, check_stop, phase_ms

pytestmark = [pytest.mark.realtime, pytest.mark.slow, pytest.mark.timeout(120)]
LIFE_MS = (80.0, 400.0)  # of the simplest host since it opened the port: it arms the board, and drives for a while


def check_last_words(bench: Bench) -> None:
    """Neutral, then Disarm: it left in order, and not by the board's timer."""
    said = [message for _, message in bench.line.heard]
    assert isinstance(said[-1], Disarm)
    last = next(message for message in reversed(said) if isinstance(message, Command))
    assert last.motor_us == NEUTRAL_US


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_signal_while_driving(name: str, make_car: Callable[..., Car]) -> None:
    car = make_car(emulated)
    check_stop(car.bench, car.struck(lambda: car.kill(signal.Signals[name]), phase_ms(name)), LAST_TURN_MS)
    assert car.ended() in (0, 1)  # 1 where a busy machine had stopped it before
    assert f"stopped by {name}" in car.said
    check_last_words(car.bench)
    car.bench.check_asked_for()


@pytest.mark.parametrize(("name", "seed"), [("SIGINT", 1), ("SIGTERM", 2)])
def test_a_signal_while_it_meets_the_board(name: str, seed: int, make_car: Callable[..., Car]) -> None:
    """From opening the port to being armed; a person presses all the while."""
    car = make_car(emulated)
    car.bench.until(lambda: bool(car.bench.line.opened_ns), "it never opened the port")
    end_ns = car.bench.line.opened_ns[0] + random.Random(seed).uniform(20.0, 800.0) * MS
    while car.bench.clock.now_ns < end_ns and car.alive:
        car.press()
        car.bench.wait(10.0)
    signalled_ns = car.bench.clock.now_ns
    car.kill(signal.Signals[name])
    assert car.ended() in (0, 1)
    car.bench.wait(QUIET_MS)
    check_never_drives(car.bench, signalled_ns + LAST_TURN_MS * MS)
    assert f"stopped by {name}" in car.said
    car.bench.check_asked_for()


@pytest.mark.parametrize("make_board", BOARDS)
@pytest.mark.parametrize("seed", range(2))
def test_a_host_that_is_killed_in_any_phase(
    make_board: MakeBoard, seed: int, killed_host: Callable[[MakeBoard], Car]
) -> None:
    """About to drive, or driving: what is under way then moves nothing for long."""
    car = killed_host(make_board)
    car.bench.until(lambda: bool(car.bench.line.opened_ns), "it never opened the port")
    car.bench.wait(random.Random(seed).uniform(*LIFE_MS))
    killed_ns: list[int] = []

    def strike() -> None:
        killed_ns.append(car.bench.clock.now_ns)
        car.kill(signal.SIGKILL)

    car.bench.pty.call(strike)
    car.bench.wait(QUIET_MS)
    check_never_drives(car.bench, killed_ns[0] + REACTION_MS * MS)
