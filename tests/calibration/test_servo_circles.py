"""The table from circles measured with a tape."""

from __future__ import annotations

import math

import pytest

from automodel.config import ServoConfig
from calibration.servo_circles import Circle, CircleError, rear_middle_diameter_m, table_of_circles

L = 0.26


def circle(pulse_us: float, angle_rad: float, *, share: float = 1.0) -> Circle:
    """What a tape says: the line square to the front wheel meets that of the rear axle in the circle's centre."""
    radius = L / math.sin(abs(angle_rad)) * math.cos(angle_rad) if angle_rad else math.inf
    side = "left" if angle_rad > 0 else "right" if angle_rad < 0 else "straight"
    return Circle(pulse_us=pulse_us, diameter_m=2.0 * radius * share, side=side)


def test_circles_give_the_angles_that_drive_them() -> None:
    angles = {1100.0: 0.41, 1300.0: 0.19, 1490.0: 0.0, 1700.0: -0.21, 1900.0: -0.38}
    table = table_of_circles([circle(p, a) for p, a in angles.items()], L)
    assert dict(zip(table.pulse_us, table.steering_rad, strict=True)) == pytest.approx(angles, abs=1e-5)
    assert table.centre_us == 1490.0
    assert table.rms_rad is None
    ServoConfig(pulse_us=table.pulse_us, steering_rad=table.steering_rad)


def test_the_centre_lies_between_the_sides_where_no_pulse_drives_straight() -> None:
    table = table_of_circles([circle(1300.0, -0.2), circle(1800.0, 0.3)], L)  # turns the other way
    assert table.centre_us == pytest.approx(1500.0, abs=0.1)
    assert table.pulse_us == pytest.approx((1300.0, 1500.0, 1800.0), abs=0.1)
    assert table.steering_rad == pytest.approx((-0.2, 0.0, 0.3), abs=1e-5)


def test_repeated_circles_are_averaged_and_tell_their_scatter() -> None:
    table = table_of_circles(
        [circle(1100.0, 0.4, share=1.01), circle(1100.0, 0.4, share=0.99), circle(1500.0, 0.0), circle(1900.0, -0.4)], L
    )
    assert table.steering_rad[0] == pytest.approx(0.4, abs=1e-3)
    # one percent of the diameter is about one percent of the tangent: sin cos at 0.4 rad is 0.36
    assert table.rms_rad == pytest.approx(0.0036, rel=0.05)


def test_the_outer_front_wheel_runs_outside_and_ahead() -> None:
    track, radius = 0.18, 0.7
    wheel = math.dist((0.0, -radius), (L, 0.5 * track))  # centre of the circle on the right; the left front wheel
    assert rear_middle_diameter_m(2.0 * wheel, L, track) == pytest.approx(2.0 * radius)
    with pytest.raises(CircleError, match=r"less than a car of 0\.26 m wheelbase can drive"):
        rear_middle_diameter_m(0.5, L, track)


@pytest.mark.parametrize(
    ("circles", "said"),
    [
        ([(1100, 1.2, "left"), (1300, 1.0, "left"), (1900, 1.3, "right")], "1100 us .* and 1300 us .* contradict"),
        ([(1100, 1.2, "left"), (1700, 1.9, "right"), (1900, 2.3, "right")], "1700 us .1.9 m right. and 1900 us"),
        ([(1100, 1.2, "left"), (1100, 1.6, "left"), (1900, 1.3, "right")], "1100 us: 1.2 m left and 1.6 m left contra"),
        ([(1100, 1.2, "left"), (1100, 1.2, "right"), (1900, 1.3, "right")], "1.2 m left and 1.2 m right contradict"),
        ([(1100, 1.2, "left"), (1300, 1.3, "right"), (1900, 1.3, "left")], "contradict"),
        ([(1100, 1.2, "left"), (1300, 2.0, "left")], "expected circles on both sides"),
        ([], "expected circles on both sides"),
    ],
)
def test_contradictory_circles_are_refused(circles: list[tuple[float, float, str]], said: str) -> None:
    with pytest.raises(CircleError, match=said):
        table_of_circles([Circle(pulse_us=p, diameter_m=d, side=s) for p, d, s in circles], L)


@pytest.mark.parametrize(
    ("pulse_us", "diameter_m", "side", "said"),
    [
        (1500.0, 1.0, "links", "expected one of left, right, straight, got 'links'"),
        (100.0, 1.0, "left", "500 .. 2500"),
        (1200.0, 0.0, "left", "positive"),
        (1200.0, math.nan, "left", "positive"),
    ],
)
def test_impossible_circles_are_refused(pulse_us: float, diameter_m: float, side: str, said: str) -> None:
    with pytest.raises(CircleError, match=said):
        Circle(pulse_us=pulse_us, diameter_m=diameter_m, side=side)
