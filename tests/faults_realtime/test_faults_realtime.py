"""What stops the car when the program that drives it fails, against the real clock; judged in the board's own time."""

from __future__ import annotations

import random
import signal
from collections.abc import Callable

import pytest
from realtime_rig import BOARDS, MS, Bench, Car, MakeBoard, emulated

pytestmark = [pytest.mark.realtime, pytest.mark.slow]
REACTION_MS = 150.0  # from the fault to neutral at the pin
QUIET_MS = 700.0  # watched for a restart that nobody asked for
MakeCar = Callable[..., Car]


def phase_ms(name: str) -> float:
    """When in the loop's and the servo's period the fault comes; another for each test."""
    return random.Random(name).uniform(50.0, 90.0)


def check_stop(bench: Bench, fault_ns: int) -> None:
    """Neutral in time, and neutral it stays."""
    bench.wait(QUIET_MS)
    assert (bench.stopped_ns(fault_ns) - fault_ns) / MS <= REACTION_MS


@pytest.fixture(scope="module", params=BOARDS)
def car(request: pytest.FixtureRequest, make_car: MakeCar) -> Car:
    """A program that survives what is done to it: one serves several tests."""
    return make_car(request.param)


def test_stopped_and_continued(car: Car) -> None:
    """SIGSTOP, as a debugger or a machine that swaps does; what it had in mind is old when it wakes."""
    stopped_ns = car.struck(lambda: car.kill(signal.SIGSTOP), phase_ms("stop"))
    try:
        check_stop(car.bench, stopped_ns)
    finally:
        car.kill(signal.SIGCONT)
    continued_ns = car.bench.clock.now_ns
    car.bench.wait(QUIET_MS)
    assert not car.bench.driving
    assert all(motor_us == 1500.0 for t_ns, _, motor_us in car.bench.peripherals.pulses if t_ns > continued_ns)


def test_a_stall_of_100_ms_in_the_loop(car: Car) -> None:
    asked_ns = car.struck(lambda: car.kill(signal.SIGUSR2), phase_ms("stall"))
    car.bench.wait(QUIET_MS)
    check_stop(car.bench, car.bench.silent_from_ns(asked_ns, gap_ms=60.0))


def test_an_unplugged_port(car: Car) -> None:
    pty = car.bench.pty
    check_stop(car.bench, car.struck(pty.unplug, phase_ms("unplug")))
    plugged_ns = car.bench.clock.now_ns
    pty.replug()
    car.bench.wait(1500.0)  # the program has it open again within this time
    assert car.bench.line.heard_ns[-1] > plugged_ns
    assert not car.bench.driving
    assert all(motor_us in (0.0, 1500.0) for t_ns, _, motor_us in car.bench.peripherals.pulses if t_ns > plugged_ns)


def test_a_collection_over_a_million_objects(make_car: MakeCar) -> None:
    """It takes some hundred milliseconds."""
    car = make_car(emulated, "collect")
    try:
        asked_ns = car.struck(lambda: car.kill(signal.SIGUSR2), phase_ms("collect"))
        car.bench.wait(QUIET_MS)
        check_stop(car.bench, car.bench.silent_from_ns(asked_ns, gap_ms=60.0))
    finally:
        car.close()


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGKILL"])
def test_a_signal_that_ends_the_program(name: str, make_car: MakeCar) -> None:
    car = make_car(emulated)
    try:
        check_stop(car.bench, car.struck(lambda: car.kill(signal.Signals[name]), phase_ms(name)))
        assert car.child.wait(30.0) in (0, 1, -signal.SIGKILL)
    finally:
        car.close()


@pytest.mark.parametrize("make_board", BOARDS)
@pytest.mark.parametrize("seed", range(2))
def test_a_host_that_is_killed_in_any_phase(
    make_board: MakeBoard, seed: int, killed_host: Callable[[MakeBoard], Car]
) -> None:
    car = killed_host(make_board)
    car.until_driving()
    car.bench.wait(random.Random(seed).uniform(20.0, 60.0))
    killed_ns = None
    while killed_ns is None:
        car.until_driving()
        killed_ns = car.bench.at_fault(lambda: car.kill(signal.SIGKILL))
    car.bench.wait(300.0)
    assert (car.bench.stopped_ns(killed_ns) - killed_ns) / MS <= REACTION_MS
