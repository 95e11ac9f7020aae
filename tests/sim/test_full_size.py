"""The full-size car's dynamics against closed solutions: steady bends, understeer, saturation, standstill."""

from __future__ import annotations

import math

import pytest

from automodel.geometry.se2 import SE2
from automodel.sim.full_size import GRAVITY_MPS2, FullSizeConfig, FullSizePlant, tyre_force_n

MS = 1_000_000
TRUE = FullSizeConfig()


def driven(speed_mps: float, steering_rad: float, seconds: float, accel_mps2: float = 0.0) -> FullSizePlant:
    plant = FullSizePlant(TRUE, SE2(0.0, 0.0, 0.0), speed_mps)
    plant.demand(0, steering_rad, accel_mps2)
    plant.advance(round(seconds * 1e9))
    return plant


@pytest.mark.parametrize("speed_mps", [5.0, 10.0, 15.0, 25.0, 30.0])
@pytest.mark.parametrize("side", [-1, 1])
def test_a_steady_bend_has_the_yaw_rate_of_the_understeer_gradient(speed_mps: float, side: int) -> None:
    """r = v delta / (L + K v^2) for small slip angles (Rajamani 2012, section 3.3)."""
    steering = side * 0.5 * TRUE.wheelbase_m / speed_mps**2  # 0.5 m/s^2: the tyres are linear
    car = driven(speed_mps, steering, 4.0).predicted(4_000 * MS)
    expected = speed_mps * steering / (TRUE.wheelbase_m + TRUE.understeer_s2pm * speed_mps**2)
    assert car.yaw_rate_radps == pytest.approx(expected, rel=0.01)
    assert car.speed_mps == pytest.approx(speed_mps)


@pytest.mark.parametrize(("speed_mps", "curvature_per_m"), [(5.0, 0.02), (15.0, 1 / 150), (25.0, -1 / 500)])
def test_a_car_that_starts_in_a_bend_stays_on_its_circle(speed_mps: float, curvature_per_m: float) -> None:
    plant = FullSizePlant(TRUE, SE2(), speed_mps, curvature_per_m)
    centre_y_m = 1.0 / curvature_per_m
    for t_ms in (500, 1000, 2000):
        plant.advance(t_ms * MS)
        car = plant.predicted(t_ms * MS)
        assert math.hypot(car.x_m, car.y_m - centre_y_m) == pytest.approx(abs(centre_y_m), abs=0.4)  # its rear slips
        assert car.yaw_rate_radps == pytest.approx(speed_mps * curvature_per_m, rel=0.02)


def test_it_understeers() -> None:
    assert 0.001 < TRUE.understeer_s2pm / 1.0 < 0.01


def test_the_path_turns_as_the_yaw_rate_and_the_speed_say() -> None:
    plant = driven(10.0, 0.02, 4.0)
    before, after = plant.predicted(4_000 * MS), plant.predicted(4_010 * MS)
    moved = math.hypot(after.x_m - before.x_m, after.y_m - before.y_m)
    assert moved == pytest.approx(0.1, rel=1e-3)
    assert after.yaw_rad - before.yaw_rad == pytest.approx(before.yaw_rate_radps * 0.01, rel=1e-3)
    assert after.distance_m - before.distance_m == pytest.approx(moved, rel=1e-3)


def test_tyres_saturate() -> None:
    assert tyre_force_n(0.001, 1e5, 5e3, 0.9) == pytest.approx(100.0, rel=1e-3)
    assert tyre_force_n(1.0, 1e5, 5e3, 0.9) == pytest.approx(4500.0, rel=1e-3)
    plant = driven(25.0, 0.4, 6.0)
    early = plant.predicted(6_000 * MS)
    plant.advance(10_000 * MS)
    turned_rad = plant.predicted(10_000 * MS).yaw_rad - early.yaw_rad
    assert 0.9 < turned_rad / 4.0 * 25.0 / (TRUE.friction * GRAVITY_MPS2) < 1.03


def test_a_slow_car_rolls_without_slip() -> None:
    car = driven(2.0, 0.3, 3.0).predicted(3_000 * MS)
    assert car.yaw_rate_radps == pytest.approx(2.0 * math.tan(0.3) / TRUE.wheelbase_m, rel=1e-6)


def test_it_brakes_to_a_stop_and_stays() -> None:
    plant = driven(10.0, 0.0, 10.0, accel_mps2=-3.5)
    car = plant.predicted(10_000 * MS)
    assert car.speed_mps == 0.0
    assert car.x_m == pytest.approx(10.0**2 / 2 / 3.5 + 10.0 * (TRUE.drive_lag_s + TRUE.dead_s), rel=0.03)
    assert plant.predicted(10_000 * MS).x_m == car.x_m


def test_the_future_is_determined_for_the_dead_time_and_does_not_depend_on_the_calls() -> None:
    plant = driven(15.0, 0.01, 1.0)
    foreseen = plant.predicted(1_000 * MS + plant.dead_time_ns)
    plant.demand(1_000 * MS, -0.3, -3.0)
    for t_ms in range(1000, 1031):
        plant.advance(t_ms * MS)
    assert plant.predicted(1_000 * MS + plant.dead_time_ns) == foreseen
    assert plant.dead_time_ns == 30 * MS


def test_without_a_demand_the_wheels_stay() -> None:
    plant = driven(10.0, 0.05, 2.0)
    plant.demand(2_000 * MS, None, -3.5)
    plant.advance(3_000 * MS)
    assert plant.predicted(3_000 * MS).steering_rad == pytest.approx(0.05, abs=1e-6)


def test_wrong_parameters_are_refused() -> None:
    with pytest.raises(ValueError, match="cg_to_front_m"):
        FullSizeConfig(cg_to_front_m=3.0)
    with pytest.raises(ValueError, match="dead_s"):
        FullSizeConfig(dead_s=-0.1)
