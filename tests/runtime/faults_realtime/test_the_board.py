"""What the car does when the cable or the board fails while it drives, and afterwards."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.support.avr_board import HeardAvr
from tests.support.realtime_rig import Car
from tests.support.realtime_stops import QUIET_MS, check_never_drives, check_stop, phase_ms

pytestmark = [pytest.mark.realtime, pytest.mark.slow, pytest.mark.timeout(120)]


BoardFault = Callable[[Any, int], None]
REBOOT_MS = 200.0  # until the program has heard a board that has started again
WATCHDOG = 8  # in MCUSR
BOARD_FAULTS: dict[str, BoardFault] = {
    "hang": lambda board, now_ns: board.hang(now_ns),
    "brown-out": lambda board, now_ns: board.brown_out(now_ns),
    "restart": lambda board, now_ns: board.reset(now_ns),
}


def test_unplugged_and_plugged_in_again(car: Car) -> None:
    pty = car.bench.pty
    check_stop(car.bench, car.struck(pty.unplug, phase_ms("unplug")))
    plugged_ns = car.bench.clock.now_ns
    pty.replug()
    car.bench.until(lambda: car.bench.line.heard[-1][0] > plugged_ns, f"it never opens the port again: {car.said}")
    car.bench.wait(QUIET_MS)
    check_never_drives(car.bench, plugged_ns)
    car.until_driving(press=True)


@pytest.mark.parametrize("fault", BOARD_FAULTS)
def test_a_board_that_fails(fault: str, car: Car) -> None:
    check_a_fault_of_the_board(car, BOARD_FAULTS[fault], fault)


def test_a_chip_that_is_deaf_to_its_interrupts(car: Car) -> None:
    """Nothing but its watchdog is left."""
    if not isinstance(car.bench.board, HeardAvr):
        pytest.skip("the emulated board has no interrupts")
    check_a_fault_of_the_board(car, lambda board, now_ns: board.hang(now_ns, deaf=True), "deaf")
    assert car.bench.board.resets[-1][1] & WATCHDOG


def check_a_fault_of_the_board(car: Car, fault: BoardFault, name: str) -> None:
    """A stop in time, a person who is told, and a car that drives again when asked."""
    bench = car.bench
    said_before: list[int] = []

    def strike() -> None:
        said_before.append(len(car.said))
        fault(bench.board, bench.clock.now_ns)

    check_stop(bench, car.struck(strike, phase_ms(name)))
    bench.wait(REBOOT_MS)
    bench.until(lambda: "stop: " in car.said[said_before[0] :], f"nobody is told: {car.said}")
    car.until_driving(press=True)
