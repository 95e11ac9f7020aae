"""The bicycle model, the sampled path and the delay's prediction."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.control.controller import SteeringInFlight
from automodel.control.path import LanePath
from automodel.control.vehicle_model import arc_motion, curvature_per_m, rear_offset_m, steering_rad, yaw_rate_radps
from automodel.curves import GraphCurve, JoinedCurve, arc, clothoid, line
from automodel.geometry.se2 import SE2

L = 0.26
MS = 1_000_000


@pytest.mark.parametrize("delta", [-0.4, -0.01, 0.0, 1e-9, 0.2, 0.45])
def test_both_axles_turn_about_one_centre(delta: float) -> None:
    kappa = curvature_per_m(delta, L)
    assert steering_rad(kappa, L) == pytest.approx(delta)
    if kappa:
        # the front axle at (L, 0) moves square to its radius from the centre (0, 1 / kappa)
        radius = np.array((L, -1.0 / kappa))
        assert float(radius @ (math.cos(delta), math.sin(delta))) == pytest.approx(0.0, abs=1e-6 / abs(kappa))
    assert yaw_rate_radps(2.0, delta, L) == pytest.approx(2.0 * kappa)


@pytest.mark.parametrize(("speed", "delta"), [(1.0, 0.3), (-0.7, 0.2), (2.0, 0.0), (0.0, 0.4), (1.5, -0.45)])
def test_driven_against_small_steps(speed: float, delta: float) -> None:
    x = y = yaw = 0.0
    dt = 1e-5
    for _ in range(20_000):
        x, y = x + speed * math.cos(yaw) * dt, y + speed * math.sin(yaw) * dt
        yaw += speed * math.tan(delta) / L * dt
    pose = arc_motion(speed, delta, L, 0.2)
    assert (pose.x_m, pose.y_m, pose.yaw_rad) == pytest.approx((x, y, yaw), abs=1e-5)


@pytest.mark.parametrize("radius", [0.6, 1.2, -0.9, 1e6])
def test_rear_offset_puts_the_reference_on_the_circle(radius: float) -> None:
    offset = rear_offset_m(1.0 / radius, 0.13)
    # the rear axle stands at (0, offset) beside the curve, heading along x; centre (0, radius)
    assert math.hypot(0.13, radius - offset) == pytest.approx(abs(radius), rel=1e-12)
    assert rear_offset_m(0.0, 0.13) == 0.0
    assert math.isfinite(rear_offset_m(100.0, 0.13))


def test_path_follows_the_curve_that_it_was_made_from() -> None:
    curve = clothoid(0.1, -0.2, 0.3, -0.8, 1.2, 1.7)
    path = LanePath(curve)
    for s in np.linspace(0.0, 1.7, 57):
        assert path.position(float(s)) == pytest.approx(tuple(curve.position(s)), abs=2e-4)
        assert path.heading(float(s)) == pytest.approx(float(curve.heading(s)), abs=1e-3)
    turn = float(curve.heading(1.1) - curve.heading(0.4))
    assert path.mean_curvature(0.4, 1.1) == pytest.approx(turn / 0.7, abs=2e-3)


def test_path_goes_on_as_an_arc_beyond_both_ends() -> None:
    whole = arc(0.0, 0.0, 0.0, 0.8, 3.0)
    x, y = whole.position(1.0)
    path = LanePath(arc(float(x), float(y), 0.8, 0.8, 0.5))  # the stretch 1.0 .. 1.5 of it
    for s in (-1.0, -0.3, 0.2, 0.5, 0.9, 1.5):
        assert path.position(s) == pytest.approx(tuple(whole.position(1.0 + s)), abs=1e-12)
        assert path.heading(s) == pytest.approx(0.8 * (1.0 + s))


def test_a_straight_that_begins_ahead_of_the_car() -> None:
    path = LanePath(line(0.3, 0.05, 0.1, 1.0))
    s, d = path.foot(0.0, 0.0)
    assert s == pytest.approx(-0.3 * math.cos(0.1) - 0.05 * math.sin(0.1))
    assert d == pytest.approx(0.3 * math.sin(0.1) - 0.05 * math.cos(0.1))


@pytest.mark.parametrize("s_true", [-0.4, 0.0, 0.33, 0.9, 1.2, 1.6])
@pytest.mark.parametrize("d_true", [-0.2, 0.0, 0.15])
def test_foot_recovers_what_was_constructed(s_true: float, d_true: float) -> None:
    curve = arc(0.3, -0.1, -0.2, -1.1, 1.2)
    point = curve.offset_position(s_true, d_true)
    assert LanePath(curve).foot(float(point[0]), float(point[1])) == pytest.approx((s_true, d_true), abs=1e-7)


def test_path_of_a_polynomial_and_of_joined_pieces() -> None:
    graph = GraphCurve((0.02, 0.1, 0.4), 0.25, 1.4)
    s, d = LanePath(graph).foot(0.8, float(np.polyval((0.4, 0.1, 0.02), 0.8)))
    assert d == pytest.approx(0.0, abs=2e-4)
    assert s == pytest.approx(float(graph.project((0.8, 0.356))[0]), abs=1e-3)
    joined = JoinedCurve((line(0.0, 0.0, 0.0, 0.5), arc(0.5, 0.0, 0.0, 1.0, 0.5)))
    assert LanePath(joined).position(0.75) == pytest.approx(tuple(joined.position(0.75)), abs=1e-3)


def test_prediction_is_the_drive_that_the_commands_in_flight_make() -> None:
    flight = SteeringInFlight(0.06, L)
    for t, steering in ((0, 0.1), (20, 0.2), (40, 0.3), (60, 0.4)):
        flight.add(t * MS, t * MS, steering)
    # from 80 ms to 140 ms the wheels do what was commanded for 20 .. 80 ms
    expected = arc_motion(1.5, 0.2, L, 0.02) @ arc_motion(1.5, 0.3, L, 0.02) @ arc_motion(1.5, 0.4, L, 0.02)
    got = flight.predict(80 * MS, 80 * MS, 1.5, -9.0)
    assert (got.x_m, got.y_m, got.yaw_rad) == pytest.approx((expected.x_m, expected.y_m, expected.yaw_rad), abs=1e-12)


def test_prediction_reaches_to_when_a_late_command_acts() -> None:
    flight = SteeringInFlight(0.06, L)
    flight.add(0, 10 * MS, 0.1)
    flight.add(20 * MS, 60 * MS, 0.2)  # the machine took 40 ms
    expected = arc_motion(1.5, 0.0, L, 0.03) @ arc_motion(1.5, 0.1, L, 0.05) @ arc_motion(1.5, 0.2, L, 0.02)
    got = flight.predict(40 * MS, 80 * MS, 1.5, 0.0)  # the first acts from 70 ms on, the second from 120
    assert (got.x_m, got.y_m, got.yaw_rad) == pytest.approx((expected.x_m, expected.y_m, expected.yaw_rad), abs=1e-12)


def test_a_command_that_acts_earlier_than_the_one_before_takes_its_place() -> None:
    flight = SteeringInFlight(0.06, L)
    flight.add(0, 50 * MS, 0.1)
    flight.add(20 * MS, 25 * MS, 0.2)
    got, expected = flight.predict(40 * MS, 45 * MS, 1.0, 0.0), arc_motion(1.0, 0.0, L, 0.045)
    expected = expected @ arc_motion(1.0, 0.2, L, 0.02)
    assert (got.x_m, got.y_m, got.yaw_rad) == pytest.approx((expected.x_m, expected.y_m, expected.yaw_rad), abs=1e-12)


def test_prediction_begins_with_the_steering_from_before() -> None:
    flight = SteeringInFlight(0.06, L)
    got, expected = flight.predict(100 * MS, 100 * MS, 1.0, 0.25), arc_motion(1.0, 0.25, L, 0.06)
    assert (got.x_m, got.y_m, got.yaw_rad) == pytest.approx((expected.x_m, expected.y_m, expected.yaw_rad), abs=1e-12)
    flight.add(100 * MS, 100 * MS, -0.3)
    got = flight.predict(120 * MS, 120 * MS, 1.0, 0.25)
    expected = arc_motion(1.0, 0.25, L, 0.04) @ arc_motion(1.0, -0.3, L, 0.02)
    assert (got.x_m, got.y_m, got.yaw_rad) == pytest.approx((expected.x_m, expected.y_m, expected.yaw_rad), abs=1e-12)


def test_prediction_forgets_over_a_gap_and_on_reset() -> None:
    flight = SteeringInFlight(0.06, L)
    flight.add(0, 0, 0.4)
    flight.add(1000 * MS, 1000 * MS, 0.1)
    assert flight.predict(1000 * MS, 1000 * MS, 1.0, 0.0).yaw_rad == pytest.approx(0.0)
    flight.add(1010 * MS, 1010 * MS, 0.1)
    flight.reset()
    assert flight.predict(1020 * MS, 1020 * MS, 1.0, 0.0).x_m == pytest.approx(0.06)
    assert flight.predict(1020 * MS, 1020 * MS, 1.0, 0.0).yaw_rad == 0.0
    assert SteeringInFlight(0.0, L).predict(5, 5, 1.0, 0.4) == SE2()
    with pytest.raises(ValueError, match="delay_s"):
        SteeringInFlight(-0.1, L)
