"""Arcs of circles against their centres, and against arcs added up from small straight steps."""

from __future__ import annotations

import cmath
import math

import pytest

from automodel.curves.arcs import arc_from, foot_on_circle


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
    way, left = foot_on_circle(0.0, 0.5, 2.0)
    assert math.isfinite(way)
    assert left == pytest.approx(0.5)


@pytest.mark.parametrize("curvature", [1.6, -0.7, 1e-10, 0.0])
@pytest.mark.parametrize("s", [1.2, -0.4, 0.0])
def test_an_arc_is_the_sum_of_many_small_steps(curvature: float, s: float) -> None:
    left, heading, count = 0.15, -0.4, 4000
    place = -left * 1j * cmath.exp(1j * heading)
    for k in range(count):
        place += s / count * cmath.exp(1j * (heading + curvature * s * (k + 0.5) / count))
    found, along = arc_from(left, heading, curvature, s)
    assert found == pytest.approx(place, abs=1e-6)
    assert along == pytest.approx(cmath.exp(1j * (heading + curvature * s)), abs=1e-12)
