from __future__ import annotations

from firmware_link.arduino import BatteryMeter

MS = 1_000_000


def low(*spans: tuple[float, int], low_v: float = 6.4) -> list[bool]:
    """Whether the battery is low each 20 ms; spans are (voltage, milliseconds)."""
    meter, said, t_ms = BatteryMeter(low_v), [], 0
    for voltage, duration_ms in spans:
        for _ in range(0, duration_ms, 20):
            said.append(meter.step(voltage, t_ms * MS))
            t_ms += 20
    return said


def test_a_battery_is_low_after_a_second() -> None:
    said = low((7.4, 500), (6.3, 2000))
    assert said.index(True) == (500 + 1000) // 20
    assert all(said[75:])


def test_a_dip_is_not_low_and_a_recovery_not_full() -> None:
    assert not any(low((7.4, 500), (5.0, 980), (7.4, 20), (5.0, 980)))
    said = low((6.0, 2000), (7.4, 980), (6.0, 100))
    assert all(said[50:])


def test_it_is_well_again_after_a_second() -> None:
    assert low((6.0, 1200), (7.4, 1200))[-1] is False


def test_a_board_without_a_battery_input_and_a_car_that_does_not_care() -> None:
    assert not any(low((0.1, 3000)))
    assert not any(low((3.0, 3000), low_v=0.0))


def test_the_voltage_is_the_last_one() -> None:
    meter = BatteryMeter(6.4)
    assert meter.voltage_v is None
    meter.step(7.1, 0)
    assert meter.voltage_v == 7.1
    meter.reset()
    assert (meter.voltage_v, meter.low) == (None, False)
