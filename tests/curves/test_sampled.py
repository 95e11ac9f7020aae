"""Curves kept as samples, against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.curves import TabulatedCurve
from tests.support.world_lanes import WorldLane


def circle(radius_m: float, turn_rad: float, count: int) -> TabulatedCurve:
    """Left for a positive radius; from the origin along x."""
    s = np.linspace(0.0, abs(radius_m) * turn_rad, count)
    a = s / radius_m
    points = np.stack((radius_m * np.sin(a), radius_m * (1.0 - np.cos(a))), axis=-1)
    return TabulatedCurve(s, points, a, np.full(count, 1.0 / radius_m))


def exact_circle(radius_m: float, s: np.ndarray) -> np.ndarray:
    a = s / radius_m
    return np.stack((radius_m * np.sin(a), radius_m * (1.0 - np.cos(a))), axis=-1)


@pytest.mark.parametrize("radius_m", [1.2, -0.8])
def test_between_and_beyond_the_samples_lies_the_circle(radius_m: float) -> None:
    curve = circle(radius_m, 1.5, 31)
    inside = np.linspace(0.0, curve.length_m, 517)
    np.testing.assert_allclose(curve.position(inside), exact_circle(radius_m, inside), atol=2e-8)
    beyond = np.array([-0.9, -0.2, curve.length_m + 0.1, curve.length_m + 1.1])
    np.testing.assert_allclose(curve.position(beyond), exact_circle(radius_m, beyond), atol=1e-12)
    for s in (inside, beyond):
        np.testing.assert_allclose(curve.heading(s), s / radius_m, atol=1e-12)
        np.testing.assert_allclose(curve.curvature(s), 1.0 / radius_m, atol=1e-12)


def test_a_clothoid_from_few_samples() -> None:
    lane = WorldLane(lambda s: -0.9 + 1.5 * s, 1.6, 0.4)
    s = np.linspace(0.0, 1.6, 41)
    curve = TabulatedCurve(s, lane.beside(s, 0.0), lane.theta(s), lane.curvature(s))
    fine = np.linspace(0.0, 1.6, 333)
    np.testing.assert_allclose(curve.position(fine), lane.beside(fine, 0.0), atol=3e-7)
    np.testing.assert_allclose(curve.curvature(fine), lane.curvature(fine), atol=1e-12)
    np.testing.assert_allclose(curve.heading(fine), lane.theta(fine), atol=3.1e-4)  # linear between the samples


def test_beyond_a_clothoids_end_goes_its_last_circle() -> None:
    lane = WorldLane(lambda s: 0.5 * s, 2.0, 0.4)
    s = np.linspace(0.0, 2.0, 41)
    curve = TabulatedCurve(s, lane.beside(s, 0.0), lane.theta(s), lane.curvature(s))
    (x0, y0), theta0 = lane.beside(2.0, 0.0), float(lane.theta(2.0))
    along = np.array([0.0, 0.3, 0.9])
    theta = theta0 + along  # its last curvature is 1
    expected = np.stack((x0 + np.sin(theta) - math.sin(theta0), y0 - np.cos(theta) + math.cos(theta0)), axis=-1)
    np.testing.assert_allclose(curve.position(2.0 + along), expected, atol=1e-9)
    np.testing.assert_allclose(curve.heading(2.0 + along), theta, atol=1e-9)
    straight = curve.position(np.array([-0.5, -0.1]))  # before its start it is straight
    np.testing.assert_allclose(straight, [(-0.5, 0.0), (-0.1, 0.0)], atol=1e-12)


def test_straight_lines_are_exact() -> None:
    direction = np.array([math.cos(0.7), math.sin(0.7)])
    s = np.array([0.0, 0.2, 1.1, 1.3])  # not evenly spaced
    curve = TabulatedCurve(s, s[:, None] * direction + (1.0, 2.0), np.full(4, 0.7), np.zeros(4))
    at = np.array([-1.0, 0.0, 0.31, 1.0, 5.0])
    np.testing.assert_allclose(curve.position(at), at[:, None] * direction + (1.0, 2.0), atol=1e-12)
    foot = curve.project((1.0, 2.0) + 0.6 * direction + 0.1 * np.array([-direction[1], direction[0]]))
    assert foot == pytest.approx((0.6, 0.1))


def test_shapes_are_those_of_the_arc_lengths() -> None:
    curve = circle(1.0, 1.0, 11)
    assert curve.position(0.4).shape == (2,)
    assert curve.position(np.zeros((3, 4))).shape == (3, 4, 2)
    assert curve.heading(np.zeros((3, 4))).shape == (3, 4)
    assert curve.curvature(0.4).shape == ()


@pytest.mark.parametrize(
    ("s", "points", "headings", "curvatures"),
    [
        ([0.0], [(0, 0)], [0.0], [0.0]),
        ([0.0, 1.0], [(0, 0)], [0.0, 0.0], [0.0, 0.0]),
        ([0.0, 1.0], [(0, 0), (1, 0)], [0.0], [0.0, 0.0]),
        ([0.0, 1.0], [(0, 0), (1, 0)], [0.0, 0.0], [0.0]),
        ([0.1, 1.0], [(0, 0), (1, 0)], [0.0, 0.0], [0.0, 0.0]),
        ([0.0, 0.0], [(0, 0), (1, 0)], [0.0, 0.0], [0.0, 0.0]),
        ([0.0, float("nan")], [(0, 0), (1, 0)], [0.0, 0.0], [0.0, 0.0]),
    ],
)
def test_samples_that_do_not_fit_are_refused(s: object, points: object, headings: object, curvatures: object) -> None:
    with pytest.raises(ValueError, match=r"points_m|curvatures_per_m|s_m"):
        TabulatedCurve(s, points, headings, curvatures)  # type: ignore[arg-type]


def test_samples_are_copied_and_read_only() -> None:
    s, points = np.array([0.0, 1.0]), np.array([(0.0, 0.0), (1.0, 0.0)])
    curve = TabulatedCurve(s, points, np.zeros(2), np.zeros(2))
    points[1] = 9.0
    assert curve.position(1.0) == pytest.approx((1.0, 0.0))
    with pytest.raises(ValueError, match="read-only"):
        curve.points_m[0] = 1.0
