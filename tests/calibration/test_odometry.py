"""Ticks a metre, motor table, and speeds from whole ticks."""

from __future__ import annotations

import numpy as np
import pytest

from automodel.config import MotorConfig
from calibration.odometry import (
    MeasuredRun,
    OdometryError,
    SteadySpeed,
    fit_motor,
    fit_ticks,
    speeds,
    steady_speed,
)


def test_ticks_of_several_runs() -> None:
    found = fit_ticks(
        [
            MeasuredRun(ticks=812, distance_m=4.0),
            MeasuredRun(ticks=1005, distance_m=5.0),
            MeasuredRun(ticks=606, distance_m=3.0),
        ]
    )
    assert found.ticks_per_m == pytest.approx((812 + 1005 + 606) / 12.0)
    assert found.scatter_per_m == pytest.approx(np.std([203.0, 201.0, 202.0], ddof=1))
    assert found.runs == 3


def test_the_deviation_of_equal_runs_is_that_of_counting_whole_ticks() -> None:
    rng = np.random.default_rng(0)
    errors, told = [], []
    for _ in range(400):  # from anywhere between two ticks to anywhere between two ticks
        starts = rng.uniform(0.0, 1.0, 2)
        ways = [MeasuredRun(ticks=int(np.floor(s + 4.003 * 200.0) - np.floor(s)), distance_m=4.003) for s in starts]
        found = fit_ticks(ways)
        errors.append(found.ticks_per_m - 200.0)
        told.append(found.sd_per_m)
    assert float(np.std(errors)) < 1.2 * float(np.mean(told))


@pytest.mark.parametrize(
    ("ways", "said"),
    [
        ([], "expected at least one run"),
        ([(10, 0.0)], "above 0 m"),
        ([(0, 4.0), (0, 4.0)], "counted nothing"),
        ([(-800, 4.0)], "count down while the car goes ahead"),
        ([(800, 4.0), (801, 4.0), (640, 4.0)], "run 3 has 160.0 ticks a metre, the others 200.0; measure again"),
    ],
)
def test_runs_that_tell_nothing_are_refused(ways: list[tuple[int, float]], said: str) -> None:
    with pytest.raises(OdometryError, match=said):
        fit_ticks([MeasuredRun(ticks=n, distance_m=d) for n, d in ways])


def steady(*pairs: tuple[float, float]) -> list[SteadySpeed]:
    return [SteadySpeed(pulse_us=p, speed_mps=v) for p, v in pairs]


REVERSE = [(1100.0, -4.0)]


def test_the_motors_table_has_its_band_and_its_line() -> None:
    # 0.008 m/s per us beyond a band of 30 us
    found = fit_motor(steady((1560.0, 0.24), (1600.0, 0.56), (1650.0, 0.96)), 1500.0, REVERSE)
    assert found.band_us == pytest.approx(30.0)
    assert found.rms_mps == pytest.approx(0.0, abs=1e-9)
    at = [1100.0, 1500.0, 1550.0, 1580.0, 1650.0, 1700.0]
    assert np.interp(at, found.pulse_us, found.speed_mps) == pytest.approx([-4.0, 0.0, 0.16, 0.4, 0.96, 1.36], abs=2e-3)
    assert np.interp(1529.0, found.pulse_us, found.speed_mps) < 0.01
    MotorConfig(pulse_us=found.pulse_us, speed_mps=found.speed_mps)


def test_a_motor_that_goes_ahead_with_shorter_pulses() -> None:
    found = fit_motor(steady((1440.0, 0.24), (1400.0, 0.56)), 1500.0, [(1900.0, -4.0)])
    assert found.band_us == pytest.approx(30.0)
    assert np.interp([1360.0, 1900.0], found.pulse_us, found.speed_mps) == pytest.approx([0.88, -4.0], abs=2e-3)
    MotorConfig(pulse_us=found.pulse_us, speed_mps=found.speed_mps)


def test_a_motor_without_a_band() -> None:
    found = fit_motor(steady((1550.0, 0.5), (1600.0, 1.0)), 1500.0, REVERSE)
    assert found.band_us == pytest.approx(0.0, abs=1e-9)
    assert found.pulse_us == (1100.0, 1500.0, 1550.0, 1600.0, 1700.0)


@pytest.mark.parametrize(
    ("pairs", "said"),
    [
        ([(1550.0, 0.5)], "expected at least two motor pulses, got 1"),
        ([(1550.0, 0.5), (1600.0, 0.4)], "more pulse must give more speed"),
        ([(1550.0, 0.0), (1600.0, 0.4)], "more pulse must give more speed"),
        ([(1450.0, 0.5), (1600.0, 0.4)], "both sides of neutral"),
    ],
)
def test_speeds_that_make_no_table_are_refused(pairs: list[tuple[float, float]], said: str) -> None:
    with pytest.raises(OdometryError, match=said):
        fit_motor(steady(*pairs), 1500.0, REVERSE)


def test_speeds_are_slopes_by_least_squares() -> None:
    rng = np.random.default_rng(3)
    t_ns = np.cumsum(rng.integers(15_000_000, 25_000_000, 120))
    way = np.cumsum(rng.uniform(0.0, 0.02, 120))
    got = speeds(t_ns, way, 0.4)
    for i in range(0, 120, 7):
        near = np.abs(t_ns - t_ns[i]) <= 200_000_000
        assert got[i] == pytest.approx(np.polyfit((t_ns[near] - t_ns[i]) * 1e-9, way[near], 1)[0], rel=1e-6)


def test_whole_ticks_give_a_smooth_speed() -> None:
    t_ns = np.arange(300) * 20_000_000
    ticks = np.floor(0.5 * 200.0 * t_ns * 1e-9)
    assert speeds(t_ns, ticks / 200.0)[20:-20] == pytest.approx(0.5, rel=0.02)
    assert speeds([0], [3.0]).tolist() == [0.0]


def test_the_steady_speed_leaves_start_and_stop_out() -> None:
    t_ns = np.arange(400) * 20_000_000
    speed = np.interp(t_ns * 1e-9, [1.0, 2.0, 6.0, 6.2], [0.0, 0.8, 0.8, 0.0])
    ticks = np.floor(np.cumsum(speed * 0.02) * 150.0).astype(int)
    assert steady_speed(t_ns, ticks, 150.0) == pytest.approx(0.8, rel=0.005)


@pytest.mark.parametrize(("ticks", "said"), [([0, 0, 0, 1], "counted nothing"), ([0, 0, 500, 500], "too short")])
def test_a_run_that_tells_no_speed_is_refused(ticks: list[int], said: str) -> None:
    with pytest.raises(OdometryError, match=said):
        steady_speed(np.arange(4) * 20_000_000, ticks, 200.0)
