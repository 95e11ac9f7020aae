"""What the firmware on the simulated chip says of the sensors at its pins."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from firmware_link import messages
from firmware_link.messages import Fault, Odometry, Ranges, Status

MS = 1_000_000


class Said:
    """The newest messages of a board that is run on."""

    def __init__(self, board: Any) -> None:
        self.board, self.t_ns = board, 0

    def after(self, ms: int, **sensors: Any) -> tuple[Status, Odometry, Ranges]:
        peripherals = self.board._peripherals
        peripherals.sensors = dataclasses.replace(peripherals.sensors, **sensors)
        for _ in range(ms // 5):
            self.t_ns += 5 * MS
            self.board.advance(self.t_ns)
            self.board.transmit(self.t_ns)
        newest: dict[type, Any] = {type(message): message for message in self.board.said}
        return newest[Status], newest[Odometry], newest[Ranges]


@pytest.fixture
def said(avr: Any) -> Said:
    return Said(avr)


@pytest.mark.parametrize("metres", [0.02, 0.3, 1.0, 2.5, 3.99])
def test_ranges(said: Said, metres: float) -> None:
    _, _, ranges = said.after(200, ranges_m=(metres, None, 0.5))
    assert ranges.left_m == pytest.approx(metres, abs=0.003)
    assert ranges.centre_m is None
    assert ranges.right_m == pytest.approx(0.5, abs=0.003)


def test_a_sensor_without_echo_stuck_or_gone_gives_no_range_and_the_others_go_on(said: Said) -> None:
    near = (0.4, 0.5, 0.6)
    _, _, ranges = said.after(200, ranges_m=near)
    assert None not in (ranges.left_m, ranges.centre_m, ranges.right_m)
    for sensor, name in enumerate(("left_m", "centre_m", "right_m")):
        for fault in ("echoes_stuck", "sonars_gone"):
            setattr(said.board.faults, fault, 1 << sensor)
            status, _, ranges = said.after(250)
            values = (ranges.left_m, ranges.centre_m, ranges.right_m)
            assert [value is None for value in values] == [i == sensor for i in range(3)], (name, fault)
            setattr(said.board.faults, fault, 0)
            assert status.faults == 0
            _, _, ranges = said.after(250)
            assert getattr(ranges, name) == pytest.approx(near[sensor], abs=0.003)


@pytest.mark.parametrize("rate_radps", [0.0, 0.7, -0.7, 6.5, -6.5])
def test_yaw_rate(said: Said, rate_radps: float) -> None:
    _, odometry, _ = said.after(100, yaw_rate_radps=rate_radps)
    assert odometry.yaw_rate_radps == pytest.approx(rate_radps, abs=3e-4)


def test_no_gyro_is_no_fault(said: Said) -> None:
    status, odometry, _ = said.after(1500, yaw_rate_radps=None)
    assert (status.faults, odometry.yaw_rate_radps) == (0, None)


@pytest.mark.parametrize("fault", ["gone", "asleep"])
def test_a_gyro_that_fails_is_a_fault_until_it_is_back(said: Said, fault: str) -> None:
    status, odometry, _ = said.after(100, yaw_rate_radps=0.5)
    assert status.faults == 0
    said.board.faults.gyro = fault
    seen = set()
    for _ in range(20):
        status, odometry, _ = said.after(20)
        seen.add((bool(status.faults & Fault.GYRO_FAILED), odometry.yaw_rate_radps is None))
    assert (True, True) in seen
    said.board.faults.gyro = ""
    status, odometry, _ = said.after(300)
    assert status.faults == 0
    assert odometry.yaw_rate_radps == pytest.approx(0.5, abs=3e-4)


def test_wheel_ticks_count_up_and_down(said: Said) -> None:
    said.after(50)
    assert said.after(100, wheel_ticks=40)[1].wheel_ticks == 40
    assert said.after(100, wheel_ticks=25)[1].wheel_ticks == 25
    assert said.after(100, wheel_ticks=-60)[1].wheel_ticks == -60
    said.board.brown_out(said.t_ns)
    assert said.after(100)[1].wheel_ticks == 0


def test_no_tick_is_lost_at_two_thousand_a_second(said: Said) -> None:
    said.after(50)
    for index in range(100):
        _, odometry, _ = said.after(20, wheel_ticks=40 * (index + 1))
    assert said.after(40)[1].wheel_ticks == 4000
    assert odometry.time_us > 1_900_000


@pytest.mark.parametrize("volts", [0.0, 5.0, 7.4, 12.0])
def test_battery(said: Said, volts: float) -> None:
    assert said.after(250, battery_v=volts)[2].battery_v == pytest.approx(volts, abs=0.03)


def test_sensors_are_there_from_the_first_report_on(said: Said) -> None:
    said.after(60, yaw_rate_radps=0.2, battery_v=7.4)
    odometry = next(message for message in said.board.said if isinstance(message, Odometry))
    ranges = next(message for message in said.board.said if isinstance(message, messages.Ranges))
    assert odometry.time_us == ranges.time_us == 11_000
    assert ranges.battery_v == pytest.approx(7.4, abs=0.1)
    assert odometry.yaw_rate_radps == pytest.approx(0.2, abs=3e-4)
