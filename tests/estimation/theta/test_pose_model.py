"""The lane pose's model against brute force, and its Jacobians against differences."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.estimation.theta.pose_filter import LinePoint, predicted_measurement, predicted_state
from automodel.geometry import SE2
from tests.support.measured_lanes import REFERENCE_M, UNIT, pose_state
from tests.support.world_lanes import arc

STATES = [(0.0, 0.0, 0.4), (0.3, -0.5, 0.35), (-0.7, 0.8, 0.5), (0.5, 1.2, 0.4)]


@pytest.mark.parametrize("bend", [0.0, 0.8, -1.25])
@pytest.mark.parametrize(("speed", "yaw_rate"), [(1.0, 0.0), (1.0, 1.5), (2.0, -2.0), (0.0, 1.0), (-0.5, 0.3)])
def test_the_motion_on_an_arc_is_exact(bend: float, speed: float, yaw_rate: float) -> None:
    """A car on a circle, beside a lane on a circle: pose by search against the pose carried along."""
    lane, dt = arc(bend), 0.25
    car = lane.car(4.0, 0.07, -0.3, REFERENCE_M)
    motion = SE2.arc(speed * dt, yaw_rate * dt)
    reference = np.array((REFERENCE_M, 0.0))
    shift = motion.apply(reference) - reference
    after, _ = predicted_state(pose_state(0.07, -0.3), (shift[0], shift[1]), motion.yaw_rad, bend)
    _, offset, heading = lane.pose_of(car @ motion, REFERENCE_M)
    assert 0.5 * after[1] * after[2] == pytest.approx(offset, abs=1e-6)
    # the search is on a grid of half a millimetre
    assert math.remainder(-after[0] - heading, math.tau) == pytest.approx(0.0, abs=1e-3)
    assert after[2] == UNIT


def test_the_motion_agrees_with_the_lanes_kinematics() -> None:
    """d' = v sin psi + w l cos psi and psi' = w - kappa s', added up in small steps, signs and all."""
    kappa, speed, yaw_rate, steps = 0.9, 1.2, -0.8, 20_000
    d, psi, dt = 0.05, 0.25, 0.3 / 20_000
    state = pose_state(d, psi)
    for _ in range(steps):
        along = speed * math.cos(psi) - yaw_rate * REFERENCE_M * math.sin(psi)
        across = speed * math.sin(psi) + yaw_rate * REFERENCE_M * math.cos(psi)
        d, psi = d + dt * across, psi + dt * (yaw_rate - kappa * along / (1.0 - kappa * d))
    motion = SE2.arc(0.3 * speed, 0.3 * yaw_rate)
    reference = np.array((REFERENCE_M, 0.0))
    shift = motion.apply(reference) - reference
    after, _ = predicted_state(state, (shift[0], shift[1]), motion.yaw_rad, kappa)
    assert 0.5 * after[1] * after[2] == pytest.approx(d, abs=2e-5)
    assert -after[0] == pytest.approx(psi, abs=5e-5)


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("kappa", [0.0, 1e-9, 0.8, -1.5])
def test_the_motions_jacobian(state: tuple[float, ...], kappa: float) -> None:
    x = np.array(state)
    _, jacobian = predicted_state(x, (0.12, 0.03), 0.15, kappa)
    for i in range(3):
        step = np.zeros(3)
        step[i] = 1e-6
        ahead, behind = (predicted_state(x + sign * step, (0.12, 0.03), 0.15, kappa)[0] for sign in (1, -1))
        np.testing.assert_allclose(jacobian[:, i], (ahead - behind) / 2e-6, atol=1e-7)


@pytest.mark.parametrize("state", STATES)
def test_the_measurement_and_its_jacobian(state: tuple[float, ...]) -> None:
    x = np.array(state)
    theta, rho, width = state
    h, jacobian = predicted_measurement(x, REFERENCE_M)
    # eq. (25) as printed, x_CM = reference, y_CM = 0
    printed = (
        REFERENCE_M - 0.5 * width * (1 - rho) * math.sin(theta),
        0.5 * width * (1 - rho) * math.cos(theta),
        REFERENCE_M + 0.5 * width * (1 + rho) * math.sin(theta),
        -0.5 * width * (1 + rho) * math.cos(theta),
    )
    np.testing.assert_allclose(h[:4], printed, atol=1e-15)
    # and as geometry: the lines' points beside a car with this pose
    lane = arc(0.0, width_m=width)
    car = lane.car(3.0, 0.5 * rho * width, -theta, REFERENCE_M)
    for rows, side in ((h[:2], 1), (h[2:4], -1)):
        np.testing.assert_allclose(rows, lane.seen_from(car, 3.0, side), atol=1e-12)
    assert h[4] == theta
    for i in range(3):
        step = np.zeros(3)
        step[i] = 1e-6
        ahead, behind = (predicted_measurement(x + sign * step, REFERENCE_M)[0] for sign in (1, -1))
        np.testing.assert_allclose(jacobian[:, i], (ahead - behind) / 2e-6, atol=1e-9)


def test_a_line_points_covariance_is_that_of_draws() -> None:
    rng = np.random.default_rng(0)
    distance, theta = rng.normal(-0.23, 0.004, 40_000), rng.normal(0.4, 0.03, 40_000)
    points = np.column_stack((REFERENCE_M - distance * np.sin(theta), distance * np.cos(theta)))
    claimed = LinePoint.beside((REFERENCE_M, 0.0), 0.4, -0.23, 0.004**2, 0.03**2)
    np.testing.assert_allclose(claimed.point_m, points.mean(axis=0), atol=3e-4)
    np.testing.assert_allclose(claimed.covariance_m2, np.cov(points.T), atol=1.5e-6)
