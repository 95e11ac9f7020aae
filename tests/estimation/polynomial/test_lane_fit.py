"""The lane's fit against lanes that were added up by brute force."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from automodel.estimation.polynomial.lane_fit import LineSamples
from automodel.geometry import SE2
from tests.support.fitted_lanes import FIT, LANES, REFERENCE_M, S0, WIDTH_M, loose_prior, samples_of, true_parameters
from tests.support.world_lanes import arc


@pytest.mark.parametrize("name", LANES)
@pytest.mark.parametrize(("offset_m", "heading_deg"), [(0.0, 0.0), (0.07, -15.0), (-0.05, 30.0)])
def test_exact_points_give_the_lane_back(name: str, offset_m: float, heading_deg: float) -> None:
    lane, heading = LANES[name], math.radians(heading_deg)
    samples = samples_of(lane, lane.car(S0, offset_m, heading, REFERENCE_M))
    guess = FIT.start(0.0, -heading + 0.1, 0.5 * float(lane.theta(S0 + 1.0) - lane.theta(S0)), WIDTH_M)
    found = FIT.solve(samples, loose_prior(FIT, guess), rounds=8)
    assert found.inliers.mean() >= 0.9
    assert found.offset_m == pytest.approx(offset_m, abs=0.0015)
    assert found.heading_rad == pytest.approx(heading, abs=math.radians(0.5))
    assert found.width_m == pytest.approx(WIDTH_M, abs=0.001)
    bend = float(lane.curvature(np.array(S0)))
    assert FIT.curvature(found.parameters) == pytest.approx(bend, abs=0.12)
    shape = FIT.shape(found.parameters)
    assert np.abs(np.interp(0.8, shape.s_m, shape.theta_rad) + heading - lane.theta(S0 + 0.8) + lane.theta(S0)) < 0.02


@pytest.mark.parametrize("width_m", [0.34, 0.46])
def test_the_width_comes_from_the_points(width_m: float) -> None:
    lane = arc(-0.6, width_m=width_m)
    samples = samples_of(lane, lane.car(S0, 0.03, 0.1, REFERENCE_M))
    found = FIT.solve(samples, loose_prior(FIT, FIT.start(0.0, 0.0, 0.0, WIDTH_M)), rounds=8)
    assert found.width_m == pytest.approx(width_m, abs=0.0015)
    assert found.offset_m == pytest.approx(0.03, abs=0.0015)


@pytest.mark.parametrize("side", [+1, -1])
def test_one_line_places_the_lane_by_its_known_width(side: int) -> None:
    lane = arc(0.7)
    both = samples_of(lane, lane.car(S0, -0.04, 0.1, REFERENCE_M))
    one = both.side == side
    samples = LineSamples(points_m=both.points_m[one], side=both.side[one], sigma_m=both.sigma_m[one])
    prior = loose_prior(FIT, FIT.start(0.0, 0.0, 0.0, WIDTH_M))
    prior = replace(prior, sigma=np.concatenate((prior.sigma[:-2], [0.001, 0.001])))
    found = FIT.solve(samples, prior, rounds=8)
    assert found.offset_m == pytest.approx(-0.04, abs=0.002)
    assert found.heading_rad == pytest.approx(0.1, abs=math.radians(0.5))


def test_the_shape_is_the_integral_of_its_curvature() -> None:
    parameters = np.random.default_rng(3).normal(0.0, 0.6, FIT.size)
    parameters[[0, 1, -2, -1]] = 0.05, -0.4, WIDTH_M, 0.0
    shape = FIT.shape(parameters)
    s = np.linspace(shape.s_m[0], shape.s_m[-1], 43_201)  # a multiple of the step is 0
    kappa = np.interp(s, FIT.nodes_m, parameters[2:-2])
    step = s[1] - s[0]
    zero = int(np.argmin(np.abs(s)))
    theta = np.concatenate(([0.0], np.cumsum(0.5 * (kappa[1:] + kappa[:-1]) * step)))
    theta += parameters[1] - theta[zero]
    middle = 0.5 * (theta[1:] + theta[:-1])
    x, y = (np.concatenate(([0.0], np.cumsum(f(middle) * step))) for f in (np.cos, np.sin))
    # the car's reference point is 0.05 to the left of the foot at s = 0
    x += REFERENCE_M - 0.05 * -math.sin(-0.4) - x[zero]
    y += -0.05 * math.cos(-0.4) - y[zero]
    np.testing.assert_allclose(shape.theta_rad, np.interp(shape.s_m, s, theta), atol=1e-6)
    np.testing.assert_allclose(shape.kappa_per_m, np.interp(shape.s_m, FIT.nodes_m, parameters[2:-2]), atol=1e-12)
    np.testing.assert_allclose(shape.points_m[:, 0], np.interp(shape.s_m, s, x), atol=3e-4)
    np.testing.assert_allclose(shape.points_m[:, 1], np.interp(shape.s_m, s, y), atol=3e-4)
    for at in (-0.3, 0.0, 0.77):
        assert FIT.direction(parameters, at) == pytest.approx(float(np.interp(at, s, theta)), abs=1e-6)
        assert FIT.curvature(parameters, at) == pytest.approx(float(np.interp(at, s, kappa)), abs=1e-3)


@pytest.mark.parametrize("taper", [-0.08, 0.06])
def test_a_lane_that_narrows_or_widens_is_fitted_with_both_its_lines(taper: float) -> None:
    lane = LANES["left"]
    car, s = lane.car(S0, -0.04, 0.1, REFERENCE_M), np.linspace(S0, S0 + 1.2, 20)
    half = 0.5 * (WIDTH_M + taper * (s - S0))
    points = [
        car.inverse().apply(
            np.concatenate([lane.beside(np.array([at]), side * h) for at, h in zip(s, half, strict=True)])
        )
        for side in (1.0, -1.0)
    ]
    samples = LineSamples(
        points_m=np.concatenate(points), side=np.repeat((1.0, -1.0), len(s)), sigma_m=np.full(2 * len(s), 0.002)
    )
    prior = loose_prior(FIT, FIT.start(0.0, 0.0, 0.0, WIDTH_M))
    found = FIT.solve(samples, replace(prior, sigma=np.concatenate((prior.sigma[:-1], [0.1]))), rounds=8)
    assert found.parameters[-1] == pytest.approx(taper, abs=0.005)
    assert found.offset_m == pytest.approx(-0.04, abs=0.002)
    assert found.width_m == pytest.approx(WIDTH_M, abs=0.002)
    assert found.inliers.all()
    shape = FIT.shape(found.parameters)
    ahead = int(np.argmin(np.abs(shape.s_m - 1.0)))
    assert float(np.hypot(*(shape.line(+1) - shape.line(-1))[ahead])) == pytest.approx(WIDTH_M + taper, abs=0.008)
    moved = FIT.moved(found.parameters, shape, SE2.arc(0.3, 0.0).inverse())
    assert moved[-2] == pytest.approx(WIDTH_M + 0.3 * taper, abs=0.003)


def test_the_jacobian_is_the_residuals_slope() -> None:
    rng = np.random.default_rng(5)
    for name, lane in LANES.items():
        offset, heading = 0.04, -0.2
        clean = samples_of(lane, lane.car(S0, offset, heading, REFERENCE_M))
        samples = clean._replace(points_m=clean.points_m + rng.normal(0.0, 0.001, clean.points_m.shape))
        parameters = true_parameters(FIT, lane, S0, offset, heading)
        parameters[-1] = 0.03
        jacobian = FIT.residuals(parameters, samples)[1]
        for i in range(FIT.size):
            step = np.zeros(FIT.size)
            step[i] = 1e-6
            ahead, behind = (FIT.residuals(parameters + sign * step, samples)[0] for sign in (1, -1))
            numeric = (ahead - behind) / 2e-6
            # where two grid points are about as near, the foot changes sides: third-order differences
            off = np.sort(np.abs(jacobian[:, i] - numeric))
            scale = max(float(np.abs(numeric).max()), 0.05)
            assert off[int(0.9 * len(off))] < 0.02 * scale, (name, i)


@pytest.mark.parametrize("name", ["straight", "left", "right", "clothoid"])  # these the nodes can follow exactly
def test_residuals_are_distances_from_the_line(name: str) -> None:
    lane = LANES[name]
    car = lane.car(S0, -0.06, 0.3, REFERENCE_M)
    parameters = true_parameters(FIT, lane, S0, -0.06, 0.3)
    s = np.linspace(S0 - 0.3, S0 + 1.2, 31)
    for side in (+1.0, -1.0):
        for off in (-0.02, 0.0, 0.015):
            points = car.inverse().apply(lane.beside(s, side * 0.2 + off))
            samples = LineSamples(points_m=points, side=np.full(len(s), side), sigma_m=np.full(len(s), 0.002))
            residual = FIT.residuals(parameters, samples)[0]
            np.testing.assert_allclose(residual, off, atol=1.5e-4)


MOTIONS = [SE2.arc(0.03, 0.0), SE2.arc(0.2, 0.25), SE2.arc(0.15, -0.5), SE2.arc(-0.1, 0.1), SE2.arc(0.0, 0.3)]


@pytest.mark.parametrize("name", ["straight", "left", "right", "clothoid"])
@pytest.mark.parametrize("before_from_after", MOTIONS)
@pytest.mark.parametrize("heading_deg", [-40.0, 0.0, 25.0, 40.0])
def test_a_moved_lane_is_the_lane_seen_from_the_moved_car(
    name: str, before_from_after: SE2, heading_deg: float
) -> None:
    lane, heading = LANES[name], math.radians(heading_deg)
    before = lane.car(S0, 0.05, heading, REFERENCE_M)
    parameters = true_parameters(FIT, lane, S0, 0.05, heading)
    moved = FIT.moved(parameters, FIT.shape(parameters), before_from_after.inverse())
    s, offset, new_heading = lane.pose_of(before @ before_from_after, REFERENCE_M)
    assert moved[0] == pytest.approx(offset, abs=3e-4)
    assert moved[1] == pytest.approx(-new_heading, abs=2e-3)
    assert moved[-2] == lane.width_m
    inside = (FIT.nodes_m + s - S0 > FIT.nodes_m[0]) & (FIT.nodes_m + s - S0 < FIT.nodes_m[-1])
    np.testing.assert_allclose(moved[2:-2][inside], lane.curvature(s + FIT.nodes_m)[inside], atol=2e-3)


def test_a_moved_lane_agrees_with_a_new_fit() -> None:
    lane = LANES["s-bend"]
    before = lane.car(S0, -0.03, 0.3, REFERENCE_M)
    motion = SE2.arc(0.12, -0.2)
    guess = loose_prior(FIT, FIT.start(0.0, -0.3, 0.0, WIDTH_M))
    first = FIT.solve(samples_of(lane, before), guess, rounds=8)
    moved = FIT.moved(first.parameters, FIT.shape(first.parameters), motion.inverse())
    again = FIT.solve(samples_of(lane, before @ motion), guess, rounds=8)
    assert moved[0] == pytest.approx(again.offset_m, abs=0.002)
    assert -moved[1] == pytest.approx(again.heading_rad, abs=math.radians(0.5))


def test_motions_in_small_steps_add_up() -> None:
    lane = LANES["left"]
    car, parameters = lane.car(S0, 0.04, 0.2, REFERENCE_M), true_parameters(FIT, lane, S0, 0.04, 0.2)
    step = SE2.arc(0.0167, 0.008)
    for _ in range(60):
        parameters = FIT.moved(parameters, FIT.shape(parameters), step.inverse())
        car = car @ step
    _, offset, heading = lane.pose_of(car, REFERENCE_M)
    assert parameters[0] == pytest.approx(offset, abs=0.001)
    assert -parameters[1] == pytest.approx(heading, abs=math.radians(0.2))


def test_the_shape_gives_curves_of_its_lines() -> None:
    lane = LANES["left"]
    car = lane.car(S0, 0.05, 0.2, REFERENCE_M)
    shape = FIT.shape(true_parameters(FIT, lane, S0, 0.05, 0.2))
    for lateral in (0.0, 0.2, -0.2):
        curve = shape.curve(lateral)
        along = np.array([0.1, 0.7, 1.3])
        radius = 1.0 / 0.8 - lateral
        assert curve.curvature(along) == pytest.approx(1.0 / radius, rel=1e-3)
        s = S0 + shape.s_m[0] + along / (1.0 - 0.8 * lateral)
        np.testing.assert_allclose(curve.position(along), car.inverse().apply(lane.beside(s, lateral)), atol=5e-4)
        np.testing.assert_allclose(curve.heading(along), lane.theta(s) - car.yaw_rad, atol=1e-3)
    np.testing.assert_allclose(shape.beside(0.2), car.inverse().apply(lane.beside(S0 + shape.s_m, 0.2)), atol=5e-4)


def test_nearest_s_is_the_foots_grid_point() -> None:
    lane = LANES["right"]
    car = lane.car(S0, 0.05, 0.2, REFERENCE_M)
    shape = FIT.shape(true_parameters(FIT, lane, S0, 0.05, 0.2))
    s = np.array([0.0, 0.31, 0.9, 1.4])
    found = shape.nearest_s(lane.seen_from(car, S0 + s, +1))
    assert (np.abs(found - s) <= 0.51 * (shape.s_m[1] - shape.s_m[0])).all()
