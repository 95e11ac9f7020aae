from __future__ import annotations

import dataclasses
import math

import pytest

from automodel.config import CarConfig
from automodel.control.manual import FRESH_NS, ManualDriver
from automodel.signals import DriverInput

MS = 1_000_000
CAR = CarConfig()
CAR = dataclasses.replace(CAR, control=dataclasses.replace(CAR.control, speed_mps=1.2, accel_mps2=2.0))


def wanted(t_ms: float, steering: float = 0.0, speed: float = 1.0) -> DriverInput:
    return DriverInput(t_ns=round(t_ms * MS), steering=steering, speed=speed)


def speeds(share: float, turns: int, driver: ManualDriver | None = None, first_ms: int = 0) -> list[float]:
    driver = driver or ManualDriver(CAR)
    times = [first_ms + 20 * turn for turn in range(turns)]
    return [driver.step(wanted(t_ms, speed=share), t_ms * MS).speed_mps for t_ms in times]


def test_the_full_stick_is_the_greatest_angle() -> None:
    command = ManualDriver(CAR).step(wanted(7, steering=-1.0), 7 * MS)
    assert command.steering_rad == -CAR.safety.steering_max_rad
    assert command.valid_until_ns == 7 * MS + 100 * MS


@pytest.mark.parametrize(("share", "greatest_mps"), [(1.0, 1.2), (0.5, 0.6), (-1.0, -0.6)])
def test_the_speed_rises_at_the_cars_acceleration_to_the_share(share: float, greatest_mps: float) -> None:
    got = speeds(share, 60)
    sign = math.copysign(1.0, share)
    assert got[:4] == pytest.approx([0.0, 0.04 * sign, 0.08 * sign, 0.12 * sign])  # 2 m/s^2, 20 ms
    assert got[-1] == pytest.approx(greatest_mps)


def test_letting_go_of_the_throttle_is_at_once_and_so_is_the_way_to_reverse() -> None:
    for share in (0.0, -1.0):
        driver = ManualDriver(CAR)
        assert speeds(1.0, 60, driver)[-1] == pytest.approx(1.2)
        assert abs(driver.step(wanted(1200, speed=share), 1200 * MS).speed_mps) <= 0.04 + 1e-9


def test_what_was_wanted_too_long_ago_steers_without_throttle() -> None:
    driver = ManualDriver(CAR)
    speeds(1.0, 60, driver)
    old = wanted(1180, steering=0.5)
    assert driver.step(old, old.t_ns + FRESH_NS - 1).speed_mps > 1.0
    stale = driver.step(old, old.t_ns + FRESH_NS)
    assert stale.speed_mps == 0.0
    assert stale.steering_rad == pytest.approx(0.5 * CAR.safety.steering_max_rad)


def test_a_reset_starts_from_a_standstill() -> None:
    driver = ManualDriver(CAR)
    speeds(1.0, 60, driver)
    driver.reset()
    assert driver.step(wanted(1200), 1200 * MS).speed_mps == 0.0


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1.01, -1.01])
@pytest.mark.parametrize("name", ["steering", "speed"])
def test_what_is_no_share_is_refused(name: str, bad: float) -> None:
    with pytest.raises(ValueError, match=name):
        DriverInput(**{"t_ns": 0, "steering": 0.0, "speed": 0.0, name: bad})  # type: ignore[arg-type]
