from __future__ import annotations

import math

import pytest

from automodel.runtime.input_checks import SteeringCheck
from automodel.signals import Motion, MotionSource, VehicleState

MS = 1_000_000
WHEELBASE_M = 0.26


def drive(
    seconds: float,
    told_rad: float | None,
    wheels_rad: float,
    speed_mps: float = 1.0,
    source: MotionSource = MotionSource.MEASURED,
    check: SteeringCheck | None = None,
    from_s: float = 0.0,
) -> list[str | None]:
    """What is said each 16 ms of a car whose wheels stand at `wheels_rad`; the yaw rate is that of its circle."""
    check = check or SteeringCheck(WHEELBASE_M)
    radius_m = math.inf if wheels_rad == 0.0 else WHEELBASE_M / math.tan(wheels_rad)
    said = []
    for t_ms in range(round(from_s * 1000), round((from_s + seconds) * 1000), 16):
        motion = Motion(t_ns=t_ms * MS, speed_mps=speed_mps, yaw_rate_radps=speed_mps / radius_m, source=source)
        said.append(check.step(motion, VehicleState(t_ns=t_ms * MS, steering_rad=told_rad)))
    return said


@pytest.mark.parametrize("told_rad", [-0.4, -0.1, 0.0, 0.2, 0.45])
@pytest.mark.parametrize("off_rad", [-0.05, 0.0, 0.05])
def test_a_car_that_turns_as_steered_is_well_with_a_servo_three_degrees_off(told_rad: float, off_rad: float) -> None:
    assert not any(drive(1.0, told_rad, told_rad + off_rad, speed_mps=1.5))


def test_slipping_tyres_are_no_fault() -> None:
    assert not any(drive(1.0, 0.4, math.atan(0.65 * math.tan(0.4)), speed_mps=1.5))


@pytest.mark.parametrize(("told_rad", "wheels_rad"), [(0.35, 0.0), (-0.35, 0.0), (0.0, 0.2), (0.3, -0.1)])
def test_wheels_that_do_not_follow_are_told_after_a_quarter_of_a_second(told_rad: float, wheels_rad: float) -> None:
    said = drive(0.5, told_rad, wheels_rad)
    first = next(index for index, text in enumerate(said) if text is not None)
    assert first == math.ceil(250 / 16)
    assert said[first] == "the car does not turn as it is steered; look at the servo and its linkage"
    assert all(said[first:])


def test_a_servos_lag_is_no_fault() -> None:
    check = SteeringCheck(WHEELBASE_M)
    for turn in range(10):
        begin_s = 0.4 * turn
        assert not any(drive(0.2, 0.4, -0.4, check=check, from_s=begin_s))
        assert not any(drive(0.2, 0.4, 0.4, check=check, from_s=begin_s + 0.2))


def test_a_car_that_was_slowed_down_for_it_is_not_well_at_once() -> None:
    check = SteeringCheck(WHEELBASE_M)
    drive(0.4, 0.35, 0.0, check=check)
    after = drive(1.0, 0.35, 0.0, speed_mps=0.1, check=check, from_s=0.4)
    assert [text is not None for text in after] == sorted((text is not None for text in after), reverse=True)
    assert 0.3 < 0.016 * sum(text is not None for text in after) <= 0.5  # longer than a car is held


@pytest.mark.parametrize(
    "how",
    [{"speed_mps": 0.3}, {"source": MotionSource.MODEL}, {"source": MotionSource.NONE}, {"told_rad": None}],
)
def test_where_nothing_can_be_said_nothing_is(how: dict[str, object]) -> None:
    assert not any(drive(1.0, **{"told_rad": 0.4, "wheels_rad": -0.4, **how}))  # type: ignore[arg-type]


def test_without_a_state_nothing_is_said() -> None:
    motion = Motion(t_ns=0, speed_mps=1.0, yaw_rate_radps=3.0)
    assert SteeringCheck(WHEELBASE_M).step(motion, None) is None
