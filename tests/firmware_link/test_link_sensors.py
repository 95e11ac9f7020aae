"""What the link makes of the board's sensors, in virtual time."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from automodel.config import LinkConfig, VehicleConfig
from automodel.runtime.clocks import VirtualClock
from automodel.signals import VehicleState
from firmware_link.arduino import ArduinoLink
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.pty import BenchPeripherals
from firmware_link.transport import MemoryTransport

MS = 1_000_000


class Counting(BenchPeripherals):
    """Each reading of the range ahead is 1 mm longer than the one before."""

    def read_sensors(self, t_ns: int):
        centre_m = round((self.sensors.ranges_m[1] or 0.0) + 0.001, 3)
        self.sensors = dataclasses.replace(self.sensors, ranges_m=(None, centre_m, None))
        return self.sensors


def states(peripherals: BenchPeripherals, seconds: float, poll_ms: float, low_v: float = 6.4) -> list[VehicleState]:
    """The states of polls each `poll_ms`, each once."""
    clock = VirtualClock(0)
    board = EmulatedArduino(peripherals)
    link = ArduinoLink(MemoryTransport(board, clock), LinkConfig(), VehicleConfig(battery_low_v=low_v))
    link.open()
    said: list[VehicleState] = []
    while clock.now_ns() < seconds * 1e9:
        state = link.poll(clock.now_ns())
        if state is not None and (not said or state.t_ns != said[-1].t_ns):
            said.append(state)
        clock.sleep(poll_ms * 1e-3)
    link.close()
    return said


@pytest.mark.parametrize("poll_ms", [3.0, 7.0, 1000 / 60, 19.0])
def test_a_state_never_tells_of_a_reading_that_another_has_told(poll_ms: float) -> None:
    told: list[Any] = [state.ranges_m[1] for state in states(Counting(), 3.0, poll_ms) if state.ranges_m]
    assert len(told) > 100
    assert len(set(told)) == len(told)
    assert told == sorted(told)
    # 50 readings a second, and a reading for nearly every one of them
    assert len(told) >= 0.95 * (round(1000 * (told[-1] - told[0])) + 1)


def test_the_battery_is_told_beside_ranges_that_are_not_new() -> None:
    volts = [state.battery_v for state in states(BenchPeripherals(), 1.0, 3.0)]
    assert volts[-20:] == [pytest.approx(7.4)] * 20


def test_a_low_battery_is_a_fault_after_a_second() -> None:
    bench = BenchPeripherals()
    bench.sensors = dataclasses.replace(bench.sensors, battery_v=6.0)
    said = states(bench, 3.0, 1000 / 60)
    low = ["battery_low" in state.faults for state in said]
    assert not any(low[:45])
    assert all(low[60:])
    assert not any("battery_low" in state.faults for state in states(bench, 3.0, 1000 / 60, low_v=5.9))
