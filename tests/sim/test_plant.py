from __future__ import annotations

import math
import random
import statistics

import pytest

from automodel.config import MotorConfig, ServoConfig
from automodel.geometry.se2 import SE2
from automodel.sim.plant import Plant, PlantConfig, Slip, interpolate, lagged, through_play

MS = 1_000_000
STIFF = PlantConfig(servo_play_rad=0.0)
STEEP = 1200.0  # 0.3 rad to the left by the default table
FAST = 1600.0  # 1 m/s by the default table


def test_constant_steering_drives_the_circle_of_the_bicycle_model() -> None:
    plant = Plant(STIFF, SE2(1.0, -2.0, 0.5), start_ns=0)
    plant.set_pulses(0, STEEP, 0.0)
    plant.set_pulses(1000 * MS, STEEP, FAST)  # the wheels stand at their angle before the car moves
    radius = STIFF.wheelbase_m / math.tan(0.3)
    centre = (1.0 - radius * math.sin(0.5), -2.0 + radius * math.cos(0.5))
    for t in range(1100, 9000, 100):
        plant.advance(t * MS)
        car = plant.state
        assert math.hypot(car.x_m - centre[0], car.y_m - centre[1]) == pytest.approx(radius, abs=1e-9)
        assert car.yaw_rad - 0.5 == pytest.approx(car.distance_m / radius, abs=1e-9)
        assert car.yaw_rate_radps == pytest.approx(car.speed_mps / radius, abs=1e-9)
        assert car.steering_rad == pytest.approx(0.3, abs=1e-12)


def test_a_lap_of_the_circle_comes_back() -> None:
    plant = Plant(STIFF, start_ns=0)
    plant.set_pulses(0, STEEP, 0.0)
    plant.set_pulses(1000 * MS, STEEP, FAST)
    lap_m = 2 * math.pi * STIFF.wheelbase_m / math.tan(0.3)
    low, high = 6000 * MS, 7000 * MS
    plant.advance(7000 * MS)
    while high - low > 1:  # the time of the lap's end
        middle = (low + high) // 2
        if plant.predicted(middle).distance_m < lap_m:
            low = middle
        else:
            high = middle
    car = plant.predicted(high)
    assert (car.x_m, car.y_m) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert car.yaw_rad == pytest.approx(2 * math.pi, abs=1e-6)


def test_straight_and_backwards() -> None:
    plant = Plant(STIFF, start_ns=0)
    plant.set_pulses(0, 1500.0, 1400.0)
    plant.advance(2000 * MS)
    car = plant.state
    assert car.y_m == 0.0
    # first-order lag from rest to -1 m/s: x = -(T - tau (1 - exp(-T / tau))) after the dead time
    expected = -(1.98 - 0.12 * (1 - math.exp(-1.98 / 0.12)))
    assert car.x_m == pytest.approx(expected, abs=2e-6)
    assert plant.read_sensors(2003 * MS).wheel_ticks == math.floor((expected - 0.003) * 200)


def test_servo_step_response_is_dead_time_then_lag() -> None:
    plant = Plant(STIFF, start_ns=0)
    plant.set_pulses(0, 1460.0, 0.0)  # 0.04 rad, slow enough for the rate limit
    for t_us in range(0, 200_000, 130):
        t = max(t_us * 1e-6 - STIFF.servo_dead_s, 0.0)
        expected = 0.04 * (1.0 - math.exp(-t / STIFF.servo_lag_s))
        assert plant.predicted(t_us * 1000).steering_rad == pytest.approx(expected, abs=1e-4 if t_us % 1000 else 1e-12)


def test_motor_step_response_is_dead_time_then_lag() -> None:
    config = PlantConfig(motor_dead_s=0.05, motor_lag_s=0.2)
    plant = Plant(config, start_ns=0)
    plant.set_pulses(7 * MS, 1500.0, FAST)
    plant.advance(57 * MS)
    assert plant.state.speed_mps == 0.0
    for t in range(58, 700, 7):
        plant.advance(t * MS)
        assert plant.state.speed_mps == pytest.approx(1.0 - math.exp(-(t - 57) * 1e-3 / 0.2), abs=1e-12)


def test_pulses_between_grid_points_take_hold_at_the_next() -> None:
    plant = Plant(STIFF, start_ns=0)
    plant.set_pulses(300_000, STEEP, 0.0)
    assert plant.predicted(21 * MS).steering_rad == 0.0
    assert plant.predicted(22 * MS).steering_rad > 0.0


def test_rate_limit_makes_a_ramp() -> None:
    config = PlantConfig(servo_play_rad=0.0, servo_lag_s=0.0, servo_rate_max_radps=2.0)
    plant = Plant(config, start_ns=0)
    plant.set_pulses(0, STEEP, 0.0)
    for t in (20, 40, 100, 169):
        plant.advance(t * MS)
        assert plant.state.steering_rad == pytest.approx(2.0 * (t - 20) * 1e-3, abs=1e-12)
    plant.advance(171 * MS)
    assert plant.state.steering_rad == pytest.approx(0.3, abs=1e-12)


def test_play_leaves_a_gap_on_either_side() -> None:
    plant = Plant(PlantConfig(servo_play_rad=0.04), start_ns=0)
    plant.set_pulses(0, STEEP, 0.0)
    plant.advance(1000 * MS)
    assert plant.state.steering_rad == pytest.approx(0.28)
    plant.set_pulses(1000 * MS, 1230.0, 0.0)  # 0.27 rad: back by 0.03, inside the gap
    plant.advance(2000 * MS)
    assert plant.state.steering_rad == pytest.approx(0.28)
    plant.set_pulses(2000 * MS, 1500.0, 0.0)
    plant.advance(3000 * MS)
    assert plant.state.steering_rad == pytest.approx(0.02)


def test_bias_turns_a_car_that_is_told_to_go_straight() -> None:
    plant = Plant(PlantConfig(servo_play_rad=0.0, servo_bias_rad=0.1), start_ns=0)
    plant.set_pulses(0, 1500.0, FAST)
    plant.advance(3000 * MS)
    car = plant.state
    assert car.yaw_rad == pytest.approx(car.distance_m * math.tan(0.1) / 0.26)


def test_true_tables_differ_from_what_is_believed() -> None:
    config = PlantConfig(
        servo=ServoConfig(pulse_us=(1000.0, 1520.0, 2000.0), steering_rad=(0.5, 0.0, -0.4)),
        motor=MotorConfig(pulse_us=(1000.0, 1500.0, 2000.0), speed_mps=(-2.0, 0.0, 6.0)),
        servo_play_rad=0.0,
    )
    plant = Plant(config, start_ns=0)
    plant.set_pulses(0, 1760.0, 1750.0)
    plant.advance(5000 * MS)
    assert plant.state.steering_rad == pytest.approx(-0.2)
    assert plant.state.speed_mps == pytest.approx(3.0)
    plant.set_pulses(5000 * MS, 700.0, 2400.0)  # beyond the tables
    plant.advance(9000 * MS)
    assert plant.state.steering_rad == pytest.approx(0.5)
    assert plant.state.speed_mps == pytest.approx(6.0)


def test_without_pulses_the_servo_stays_and_the_motor_stops() -> None:
    plant = Plant(STIFF, start_ns=0)
    plant.set_pulses(0, STEEP, FAST)
    plant.advance(1000 * MS)
    plant.set_pulses(1000 * MS, 0.0, 0.0)
    plant.advance(3000 * MS)
    assert plant.state.steering_rad == pytest.approx(0.3)
    assert plant.state.speed_mps == 0.0


@pytest.mark.parametrize("config", [PlantConfig(), PlantConfig(servo_dead_s=0.035, motor_dead_s=0.0125, seed=3)])
def test_what_is_predicted_within_the_dead_time_comes_true_whatever_pulses_come(config: PlantConfig) -> None:
    dice = random.Random(5)
    plant = Plant(config, SE2(0.3, 0.2, -1.0), start_ns=12_345_678_901)
    t = plant.now_ns
    promised = []
    for _ in range(600):
        t += dice.randrange(1, 6 * MS)
        plant.set_pulses(t, dice.uniform(1000, 2000), dice.uniform(1300, 1700))
        ahead = t + dice.choice([config.dead_time_ns, dice.randrange(config.dead_time_ns + 1)])
        promised.append((ahead, plant.predicted(ahead)))
    for ahead, car in promised:
        if ahead > t - 1000 * MS:  # still remembered
            assert plant.predicted(ahead) == car
    plant.advance(t + 50 * MS)
    ahead, car = promised[-1]
    assert plant.predicted(ahead) == car


def test_prediction_equals_the_state_after_advancing() -> None:
    dice = random.Random(6)
    plant = Plant(PlantConfig(), start_ns=0)
    t = 0
    for _ in range(300):
        t += dice.randrange(1, 9 * MS)
        plant.set_pulses(t, dice.uniform(1000, 2000), dice.uniform(1400, 1700))
        ahead = t + dice.randrange(1, plant.config.dead_time_ns + 1)
        car = plant.predicted(ahead)
        plant.set_pulses((t + ahead) // 2, dice.uniform(1000, 2000), dice.uniform(1400, 1700))
        plant.advance(ahead)
        t = ahead
        assert plant.state == car


def test_the_state_does_not_depend_on_how_often_it_is_asked_for() -> None:
    one, many = Plant(PlantConfig(), start_ns=0), Plant(PlantConfig(), start_ns=0)
    for plant in (one, many):
        plant.set_pulses(0, 1420.0, FAST)
    one.advance(777_777_777)
    for t in range(0, 777_777_777, 333_333):
        many.advance(t)
        many.predicted(t + 5 * MS)
    many.advance(777_777_777)
    assert one.state == many.state


def test_the_past_is_kept_for_a_second_and_no_longer() -> None:
    plant = Plant(PlantConfig(), start_ns=0)
    plant.set_pulses(0, STEEP, FAST)
    plant.advance(600_400_000)
    then = plant.state
    plant.set_pulses(700 * MS, 1700.0, 1500.0)
    plant.advance(1500 * MS)
    assert plant.predicted(600_400_000) == then
    with pytest.raises(ValueError, match="kept for a second"):
        plant.predicted(400 * MS)


def test_time_starts_with_the_first_that_is_told() -> None:
    plant = Plant(PlantConfig())
    plant.set_pulses(10**15, 1500.0, FAST)
    plant.advance(10**15 + 500 * MS)
    twin = Plant(PlantConfig(), start_ns=0)
    twin.set_pulses(0, 1500.0, FAST)
    twin.advance(500 * MS)
    assert plant.state == twin.state


def test_a_time_that_has_passed_changes_nothing() -> None:
    plant = Plant(PlantConfig(), start_ns=0)
    plant.set_pulses(0, 1500.0, FAST)
    plant.advance(500 * MS)
    car = plant.state
    plant.advance(400 * MS)
    assert plant.state == car
    assert plant.now_ns == 500 * MS


def test_gyro_reads_yaw_rate_and_bias_and_noise_of_the_seed() -> None:
    config = PlantConfig(gyro_bias_radps=0.05, gyro_noise_radps=0.02, seed=7)

    def readings(seed: int) -> list[float]:
        plant = Plant(PlantConfig(gyro_bias_radps=0.05, gyro_noise_radps=0.02, seed=seed), start_ns=0)
        rates = [plant.read_sensors(k * 10 * MS).yaw_rate_radps for k in range(2000)]
        return [rate for rate in rates if rate is not None]

    still = readings(config.seed)
    assert statistics.mean(still) == pytest.approx(0.05, abs=4 * 0.02 / math.sqrt(2000))
    assert statistics.stdev(still) == pytest.approx(0.02, rel=0.1)
    assert still == readings(7)
    assert still != readings(8)
    turning = Plant(PlantConfig(gyro_bias_radps=0.05, gyro_noise_radps=0.0), start_ns=0)
    turning.set_pulses(0, STEEP, FAST)
    rate = turning.read_sensors(3000 * MS).yaw_rate_radps
    assert rate == pytest.approx(turning.state.yaw_rate_radps + 0.05)


def test_sensors_tell_ticks_battery_ranges_and_a_missing_gyro() -> None:
    config = PlantConfig(gyro=False, ticks_per_m=50.0, battery_v=7.1)
    plant = Plant(config, ranges=lambda car: (None, car.distance_m, 2.0), start_ns=0)
    plant.set_pulses(0, 1500.0, FAST)
    sensors = plant.read_sensors(2345 * MS)
    way = plant.state.distance_m
    assert sensors.wheel_ticks == math.floor(50 * way)
    assert sensors.wheel_ticks > 90
    assert sensors.battery_v == 7.1
    assert sensors.yaw_rate_radps is None
    assert sensors.ranges_m == (None, way, 2.0)


def test_impossible_configurations_are_refused() -> None:
    with pytest.raises(ValueError, match="wheelbase_m"):
        PlantConfig(wheelbase_m=0.0)
    with pytest.raises(ValueError, match="motor_lag_s"):
        PlantConfig(motor_lag_s=-1.0)
    with pytest.raises(ValueError, match="servo_bias_rad"):
        PlantConfig(servo_bias_rad=math.nan)
    with pytest.raises(ValueError, match="servo_play_rad"):
        PlantConfig(servo_play_rad=math.nan)


def test_servo_parts() -> None:
    assert interpolate(1250.0, (1000.0, 1500.0, 2000.0), (1.0, 0.0, -3.0)) == 0.5
    assert interpolate(1500.0, (1000.0, 1500.0, 2000.0), (1.0, 0.0, -3.0)) == 0.0
    assert interpolate(900.0, (1000.0, 1500.0), (1.0, 0.0)) == 1.0
    assert lagged(1.0, 3.0, 0.25, 10.0) == 1.5
    assert lagged(1.0, -3.0, 0.25, 0.1) == 0.9
    assert through_play(0.0, 0.04, 0.1) == 0.0
    assert through_play(0.0, 0.08, 0.1) == pytest.approx(0.03)
    assert through_play(0.0, -0.08, 0.1) == pytest.approx(-0.03)


@pytest.mark.parametrize("coast_mps2", [0.5, 2.0])
def test_without_drive_a_car_that_freewheels_rolls_by_its_deceleration(coast_mps2: float) -> None:
    plant = Plant(PlantConfig(coast_mps2=coast_mps2, motor_dead_s=0.0, servo_dead_s=0.0))
    plant.set_pulses(0, 1500.0, 1900.0)
    plant.advance(2_000_000_000)
    speed_mps, from_m = plant.state.speed_mps, plant.state.distance_m
    plant.set_pulses(2_000_000_000, 1500.0, 1500.0)
    stands_s = speed_mps / coast_mps2
    plant.advance(2_000_000_000 + round(0.9 * stands_s * 1e9))
    assert plant.state.speed_mps == pytest.approx(0.1 * speed_mps, rel=0.05)
    plant.advance(2_000_000_000 + round(1.1 * stands_s * 1e9))
    assert plant.state.speed_mps == 0.0
    assert plant.state.distance_m - from_m == pytest.approx(0.5 * speed_mps * stands_s, rel=0.02)


def driven_arc(slip: Slip | None, seconds: float = 2.0) -> Plant:
    """Wheels to the left, the motor at 1 m/s, for so long."""
    plant = Plant(PlantConfig(slip=slip), start_ns=0)
    plant.set_pulses(0, STEEP, FAST)
    plant.advance(round(seconds * 1e9))
    return plant


def test_a_car_that_slips_turns_by_the_share_and_by_no_more_than_the_tyres_hold() -> None:
    dry = driven_arc(None).state
    wet = driven_arc(Slip(start_s=0.0, end_s=9.0, share=0.8)).state
    assert wet.yaw_rate_radps == pytest.approx(0.8 * dry.yaw_rate_radps)
    assert wet.yaw_rad == pytest.approx(0.8 * dry.yaw_rad, rel=1e-6)
    assert (wet.steering_rad, wet.distance_m) == (dry.steering_rad, dry.distance_m)
    ice = driven_arc(Slip(start_s=0.0, end_s=9.0, lateral_max_mps2=0.3)).state
    assert abs(ice.speed_mps * ice.yaw_rate_radps) == pytest.approx(0.3)
    assert abs(dry.speed_mps * dry.yaw_rate_radps) > 0.5


def test_a_car_slips_only_there_and_what_is_predicted_comes() -> None:
    slip = Slip(start_s=1.0, end_s=1.5, share=0.5)
    assert driven_arc(slip, 0.9).state == driven_arc(None, 0.9).state
    plant = driven_arc(slip, 0.99)
    ahead = plant.predicted(1_005_000_000)
    plant.advance(1_005_000_000)
    assert plant.state == ahead
    plant.advance(1_600_000_000)
    assert plant.state.yaw_rate_radps == pytest.approx(driven_arc(None, 1.6).state.yaw_rate_radps)


@pytest.mark.parametrize("bad", [{"start_s": 2.0}, {"share": 0.0}, {"lateral_max_mps2": 0.0}])
def test_a_slip_that_cannot_be_is_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        Slip(**({"start_s": 0.0, "end_s": 1.0} | bad))
