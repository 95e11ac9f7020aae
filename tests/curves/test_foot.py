"""Feet of perpendiculars: circles against their centres, the iteration against the closed form."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest

from automodel.curves.foot import (
    Place,
    Search,
    foot_on_circle,
    nearest_samples,
    newton_foot,
    newton_step,
    newton_steps,
)
from automodel.geometry import SE2


@pytest.mark.parametrize("curvature", [1.6, 0.4, -0.4, -1.6])
@pytest.mark.parametrize(("s", "left"), [(0.7, 0.2), (0.7, -0.3), (-0.5, 0.1), (0.0, 0.25), (1.5, 0.0)])
def test_a_point_beside_an_arc_gets_its_foot_back(curvature: float, s: float, left: float) -> None:
    centre = 1j / curvature
    on_arc = centre + (0j - centre) * cmath.exp(1j * curvature * s)  # the start, turned about the centre
    point = on_arc + left * 1j * cmath.exp(1j * curvature * s)
    assert foot_on_circle(point.real, point.imag, curvature) == pytest.approx((s, left), abs=1e-12)


@pytest.mark.parametrize("curvature", [0.0, 1e-12, -1e-12, 1e-8, -1e-8])
def test_the_foot_on_an_all_but_straight_arc_is_that_on_the_line(curvature: float) -> None:
    assert foot_on_circle(0.8, -0.3, curvature) == pytest.approx((0.8, -0.3), abs=1e-7)


def test_the_foot_is_finite_at_the_centre_of_the_circle() -> None:
    s, left = foot_on_circle(0.0, 0.5, 2.0)
    assert math.isfinite(s)
    assert left == pytest.approx(0.5)


def on_circle(curvature: float) -> Place:
    """A circle from the origin along x."""

    def place(s: float) -> tuple[float, float, float, float, float]:
        pose = SE2.arc(s, curvature * s)
        return pose.x_m, pose.y_m, math.cos(pose.yaw_rad), math.sin(pose.yaw_rad), curvature

    return place


@pytest.mark.parametrize("curvature", [1.6, -0.7, 1e-10, 0.0])
@pytest.mark.parametrize("point", [(0.3, 0.1), (-0.2, -0.4), (0.5, 0.3)])
def test_newtons_foot_is_that_in_closed_form(curvature: float, point: tuple[float, float]) -> None:
    found = newton_foot(on_circle(curvature), point, 0.0, Search(step_m=1e-13, rounds=30))
    assert found == pytest.approx(foot_on_circle(*point, curvature), abs=1e-10)


def test_the_foot_stays_within_the_bounds() -> None:
    s, left = newton_foot(on_circle(0.5), (2.0, 0.4), 0.1, Search(step_m=1e-12, rounds=60), (0.0, 0.3))
    end = SE2.arc(0.3, 0.15).inverse().apply((2.0, 0.4))
    assert (s, left) == pytest.approx((0.3, end[1]), abs=1e-9)


@pytest.mark.parametrize("point", [(0.0, 0.625), (0.01, 0.7), (0.0, 30.0), (1e6, -1e6)])
@pytest.mark.parametrize("bounds", [(-math.inf, math.inf), (-1.0, 1.0)])
def test_the_foot_is_finite_beyond_the_centre_of_curvature(
    point: tuple[float, float], bounds: tuple[float, float]
) -> None:
    s, left = newton_foot(on_circle(1.6), point, 0.2, Search(reach_m=0.5), bounds)
    assert math.isfinite(s + left)
    assert bounds[0] <= s <= bounds[1]


def test_a_noisy_curve_does_not_throw_the_search_off() -> None:
    def place(s: float) -> tuple[float, float, float, float, float]:  # the curvature is wrong: steps are far too long
        return s, 0.0, 1.0, 0.0, 4.0

    assert newton_foot(place, (0.3, 0.24), 0.0, Search(step_m=1e-9, rounds=60)) == pytest.approx((0.3, 0.24), abs=1e-7)


def test_steps_of_many_points_are_those_of_each() -> None:
    rng = np.random.default_rng(3)
    away, heading, kappa = rng.normal(0.0, 0.3, (20, 2)), rng.uniform(-3.0, 3.0, 20), rng.normal(0.0, 2.0, 20)
    steps, left = newton_steps(away, heading, kappa)
    for k, ((dx, dy), theta) in enumerate(zip(away.tolist(), heading.tolist(), strict=True)):
        step, _, beside = newton_step(dx, dy, math.cos(theta), math.sin(theta), float(kappa[k]))
        assert (steps[k], left[k]) == pytest.approx((step, beside), rel=1e-12)


def test_the_nearest_sample() -> None:
    samples = np.column_stack((np.arange(5.0), np.zeros(5)))
    found = nearest_samples(samples, np.array([(1.4, 3.0), (-7.0, 0.0), (3.6, -1.0)]))
    np.testing.assert_array_equal(found, [1, 0, 4])
