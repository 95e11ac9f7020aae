"""The board's C++ decisions about its sensors, without registers."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterator
from typing import Any

import pytest

NO_RANGE = 0xFFFF
SLOT_MS = 30


def stamps(distance_m: float) -> int:
    """The echo's width in 4 us: there and back at 343 m/s."""
    return round(2 * distance_m / 343.0 / 4e-6)


class Sonar:
    """Three sensors on the logic; `echoes` are widths in 4 us, None where nothing answers."""

    def __init__(self, library: Any) -> None:
        self.library, self.handle = library, library.ranging_new()
        self.t_ms = 0
        self.pins = 0
        self.triggered: list[int] = []
        self.echoes: list[int | None] = [None, None, None]

    def run(self, ms: int) -> None:
        for _ in range(ms):
            bits = self.library.ranging_tick(self.handle, self.t_ms, self.pins)
            for sensor in range(3):
                width = self.echoes[sensor]
                if bits >> sensor & 1:
                    self.triggered.append(sensor)
                    if width is not None:
                        rise = (self.t_ms * 250 + 113) & 0xFFFF
                        self.edge(sensor, True, rise)
                        self.edge(sensor, False, (rise + width) & 0xFFFF)
            self.t_ms += 1

    def edge(self, sensor: int, high: bool, at: int) -> None:
        self.library.ranging_edge(self.handle, sensor, high, at)

    @property
    def ranges(self) -> list[int]:
        return [self.library.ranging_range(self.handle, sensor) for sensor in range(3)]


@pytest.fixture
def sonar(library: Any) -> Iterator[Sonar]:
    sonar = Sonar(library)
    yield sonar
    library.ranging_delete(sonar.handle)


def test_sensors_take_turns_and_give_millimetres(sonar: Sonar) -> None:
    assert sonar.ranges == [NO_RANGE] * 3
    sonar.t_ms = 65_000  # the stamps wrap around on the way
    sonar.echoes = [stamps(0.5), stamps(1.234), stamps(3.99)]
    sonar.run(3 * SLOT_MS + 1)
    assert sonar.triggered == [0, 1, 2, 0]
    assert sonar.ranges == pytest.approx([500, 1234, 3990], abs=1)


def test_no_echo_is_no_range_whatever_was_there_before(sonar: Sonar) -> None:
    sonar.echoes = [stamps(0.5), stamps(0.6), stamps(0.7)]
    sonar.run(3 * SLOT_MS + 1)
    sonar.echoes = [None, stamps(4.01), stamps(0.001)]
    sonar.run(4 * SLOT_MS)
    assert sonar.ranges == [NO_RANGE, NO_RANGE, 20]


def test_echo_that_never_ends_is_no_range_and_is_not_triggered(sonar: Sonar) -> None:
    sonar.echoes = [stamps(0.5)] * 3
    sonar.run(3 * SLOT_MS + 1)
    sonar.pins = 0b010
    sonar.triggered.clear()
    sonar.run(3 * SLOT_MS)
    assert sonar.triggered == [2, 0]
    assert sonar.ranges == [pytest.approx(500, abs=1), NO_RANGE, pytest.approx(500, abs=1)]


def test_an_echo_that_is_still_on_when_its_slot_ends_is_no_range(sonar: Sonar) -> None:
    sonar.run(1)
    sonar.edge(0, True, 100)
    sonar.run(SLOT_MS)
    sonar.edge(0, False, 9000)  # the 38 ms of a sensor that hears nothing
    assert sonar.ranges[0] == NO_RANGE


def test_edges_of_others_and_out_of_turn_are_ignored(sonar: Sonar) -> None:
    sonar.run(1)
    sonar.edge(1, True, 5)
    sonar.edge(1, False, 500)
    sonar.edge(0, False, 10)
    sonar.edge(0, True, 100)
    sonar.edge(0, True, 300)
    sonar.edge(0, False, 100 + stamps(1.0))
    sonar.edge(0, True, 5000)
    sonar.edge(0, False, 5001)
    sonar.run(SLOT_MS)
    assert sonar.ranges == [pytest.approx(1000, abs=1), NO_RANGE, NO_RANGE]


NOTHING, START, SEND, RECEIVE, RECEIVE_LAST, STOP, OFF, CLOCK_LOW, CLOCK_HIGH = range(9)


class Mpu:
    """A device at 0x68 on a two-wire bus that obeys what the logic wants, with the status codes of the data sheet."""

    def __init__(self) -> None:
        self.registers = {0x75: 0x68, 0x6B: 0x40, 0x1B: 0x00}
        self.there = True
        self.silent = False  # the bus hangs: nothing is ever done
        self.place = 0

    def rate(self, raw: int) -> None:
        self.registers |= {0x47: raw >> 8 & 0xFF, 0x48: raw & 0xFF}

    def obey(self, action: int, state: list[str]) -> tuple[int, int] | None:
        """Status code and byte for an action, None where the bus rests."""
        what, data = action & 0xFF, action >> 8
        if what in (NOTHING, STOP, OFF, CLOCK_LOW, CLOCK_HIGH) or self.silent:
            return None
        if what == START:
            state.append("start")
            return (0x10 if state.count("start") > 1 else 0x08), 0
        if what == SEND and state[-1] == "start":
            assert data >> 1 == 0x68
            state.append("address")
            if not self.there:
                return 0x20, 0
            return (0x40 if data & 1 else 0x18), 0
        if what == SEND:
            if state[-1] == "address":
                self.place = data
            else:
                self.registers[self.place] = data
            state.append("byte")
            return 0x28, 0
        byte = self.registers.get(self.place, 0)
        self.place += 1
        return (0x50 if what == RECEIVE else 0x58), byte


class Bus:
    """The gyro's logic and the device, a tick a millisecond."""

    def __init__(self, library: Any) -> None:
        self.library, self.handle = library, library.gyro_new()
        self.device = Mpu()
        self.t_ms = 0
        self.actions: list[int] = []

    def run(self, ms: int) -> None:
        for _ in range(ms):
            action, state = self.library.gyro_tick(self.handle, self.t_ms), [""]
            self.actions.append(action & 0xFF)
            while (answer := self.device.obey(action, state)) is not None:
                action = self.library.gyro_status(self.handle, *answer)
                self.actions.append(action & 0xFF)
            self.t_ms += 1

    @property
    def yaw_rate(self) -> int | None:
        rate = int(self.library.gyro_yaw_rate(self.handle))
        return None if rate == -0x8000 else rate

    @property
    def failed(self) -> bool:
        return bool(self.library.gyro_failed(self.handle))


@pytest.fixture
def bus(library: Any) -> Iterator[Bus]:
    bus = Bus(library)
    yield bus
    library.gyro_delete(bus.handle)


def test_gyro_is_set_up_and_read(bus: Bus) -> None:
    bus.device.rate(1000)
    bus.run(30)
    assert {reg: bus.device.registers[reg] for reg in (0x6B, 0x1A, 0x1B)} == {0x6B: 1, 0x1A: 3, 0x1B: 8}
    assert bus.yaw_rate == pytest.approx(math.radians(1000 / 65.5) / 2e-4, abs=1)
    bus.device.rate(-1000)
    bus.run(10)
    assert bus.yaw_rate == pytest.approx(-math.radians(1000 / 65.5) / 2e-4, abs=1)
    assert not bus.failed


@pytest.mark.parametrize(("raw", "rate"), [(32767, 32767), (-32768, -32767), (0, 0), (1, 1), (-1, -1)])
def test_gyros_rate_on_the_wire(bus: Bus, raw: int, rate: int) -> None:
    bus.device.rate(raw)
    bus.run(30)
    assert bus.yaw_rate == rate


def test_no_gyro_is_normal_and_looked_for_again_each_second(bus: Bus) -> None:
    bus.device.there = False
    bus.run(3500)
    assert (bus.yaw_rate, bus.failed) == (None, False)
    assert bus.actions.count(START) == 4
    bus.device.there = True
    bus.device.rate(5)
    bus.run(1100)
    assert bus.yaw_rate is not None


@pytest.mark.parametrize("fault", ["gone", "silent", "asleep"])
def test_a_gyro_that_fails_is_a_fault_until_it_is_back(bus: Bus, fault: str) -> None:
    bus.device.rate(5)
    bus.run(50)
    assert bus.yaw_rate is not None
    bus.device.there, bus.device.silent = fault != "gone", fault == "silent"
    if fault == "asleep":  # its supply has dipped: it answers, but reads 0
        bus.device.registers |= {0x6B: 0x40, 0x1B: 0x00}
    within_ms = 200 if fault == "asleep" else 15
    for _ in range(within_ms):
        bus.run(1)
        if bus.failed:
            break
    assert bus.failed
    assert bus.yaw_rate is None
    bus.device.there, bus.device.silent = True, False
    bus.run(300)
    assert bus.yaw_rate is not None
    assert not bus.failed


def test_a_device_that_is_no_gyro_gives_no_yaw_rate(bus: Bus) -> None:
    bus.device.registers[0x75] = 0x10
    bus.device.rate(5)
    bus.run(500)
    assert (bus.yaw_rate, bus.failed) == (None, False)


@pytest.mark.parametrize("who", [0x68, 0x70, 0x71, 0x73])
def test_relatives_are_gyros(bus: Bus, who: int) -> None:
    bus.device.registers[0x75] = who
    bus.device.rate(5)
    bus.run(50)
    assert bus.yaw_rate is not None


def test_a_bus_that_hangs_is_let_go_and_clocked_free(bus: Bus) -> None:
    """A device that was interrupted within a byte holds the data wire until it has seen nine clocks."""
    bus.device.silent = True
    bus.run(30)
    at = bus.actions.index(OFF)
    assert bus.actions[at + 1 : at + 19] == [CLOCK_LOW, CLOCK_HIGH] * 9


def test_a_status_of_a_transfer_that_was_given_up_is_answered_by_letting_go(bus: Bus) -> None:
    bus.device.silent = True
    bus.run(10)
    assert bus.library.gyro_status(bus.handle, 0x08, 0) & 0xFF == OFF


def test_battery_is_smoothed_and_scaled(library: Any) -> None:
    readings = [678] * 3 + [0] + [678] * 400 + [1023] * 400
    out = (ctypes.c_uint16 * len(readings))()
    library.battery_of((ctypes.c_uint16 * len(readings))(*readings), len(readings), 12100, out)
    full = 678 / 1024 * 12100
    assert out[0] == pytest.approx(full, abs=2)
    assert out[3] == pytest.approx(full * 15 / 16, abs=15)  # one reading moves a sixteenth
    assert out[402] == pytest.approx(full, rel=0.003)
    assert out[802] == pytest.approx(1023 / 1024 * 12100, rel=0.003)


def test_wheel(library: Any) -> None:
    assert library.wheel_step(ctypes.c_bool(True)) == 1
    assert library.wheel_step(ctypes.c_bool(False)) == -1
