"""The placed cubic against integrals added up by brute force, and feet against a search."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.curves import ThetaCurve
from automodel.estimation.theta.heading_polynomial import HeadingPolynomial, shift_matrix
from automodel.geometry import SE2

REFERENCE = (0.13, 0.0)
FINE = 20_001


def theta_line(
    *coefficients: float,
    lateral_m: float = 0.2,
    s_min_m: float = -0.5,
    s_max_m: float = 1.3,
    arc_ahead_m: float = math.inf,
) -> HeadingPolynomial:
    w = (*coefficients, 0.0, 0.0, 0.0, 0.0)[:4]
    return HeadingPolynomial(
        coefficients_rad=(w[0], w[1], w[2], w[3]),
        scale_m=0.8,
        reference_m=REFERENCE,
        lateral_m=lateral_m,
        s_min_m=s_min_m,
        s_max_m=s_max_m,
        max_curvature_per_m=2.0,
        arc_ahead_m=arc_ahead_m,
    )


LINES = {
    "straight": theta_line(0.3),
    "arc": theta_line(-0.2, 0.8),
    "tight arc": theta_line(0.1, -1.0, lateral_m=-0.2),
    "clothoid": theta_line(0.2, -0.1, 0.35),
    "clothoid through straight": theta_line(-0.6, 0.0, -0.4, lateral_m=-0.2),
    "cubic": theta_line(0.1, 0.5, -0.6, 0.25),
    "straight after its end": theta_line(0.1, 0.6, 0.1, arc_ahead_m=0.25),
}


def brute(line: HeadingPolynomial, low: float, high: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """s, theta and points of the definition: the cubic within its range, arcs beyond, summed up in small steps."""
    s = np.linspace(low, high, FINE)
    u = np.clip(s, line.s_min_m, line.s_max_m) / line.scale_m
    theta = np.polynomial.polynomial.polyval(u, line.coefficients_rad)
    span = 0.25 * line.scale_m
    for end, inner in ((line.s_min_m, line.s_min_m + span), (line.s_max_m, line.s_max_m - span)):
        rise = np.diff(np.polynomial.polynomial.polyval(np.array((inner, end)) / 0.8, line.coefficients_rad))[0]
        kappa = float(np.clip(rise / (end - inner), -2.0, 2.0))
        beyond = s > end if end == line.s_max_m else s < end
        theta = np.where(beyond, theta + kappa * np.minimum(s - end, line.arc_ahead_m), theta)
    step = s[1] - s[0]
    middle = 0.5 * (theta[1:] + theta[:-1])
    x, y = (np.concatenate(([0.0], np.cumsum(f(middle) * step))) for f in (np.cos, np.sin))
    zero = np.interp(0.0, s, theta)
    x += REFERENCE[0] - line.lateral_m * math.sin(zero) - np.interp(0.0, s, x)
    y += REFERENCE[1] + line.lateral_m * math.cos(zero) - np.interp(0.0, s, y)
    return s, theta, np.column_stack((x, y))


@pytest.mark.parametrize("name", LINES)
def test_points_are_the_integral_of_the_direction(name: str) -> None:
    line = LINES[name]
    s, theta, points = brute(line, -0.9, 1.9)
    at = np.arange(0, FINE, 400)
    np.testing.assert_allclose(line.points(s[at]), points[at], atol=3e-5)
    np.testing.assert_allclose(line.heading(s[at]), theta[at], atol=1e-9)
    for i in at[::7]:
        assert line.point_at(s[i]) == pytest.approx(tuple(points[i]), abs=1e-5)
        assert line.heading_at(s[i]) == pytest.approx(theta[i], abs=1e-9)
    slope = np.gradient(theta, s)
    ends = np.array((line.s_min_m, line.s_max_m, line.s_max_m + line.arc_ahead_m))
    smooth = at[(np.abs(s[at][:, None] - ends) > 1e-3).all(axis=1)]
    np.testing.assert_allclose(line.curvature(s[smooth])[1:-1], slope[smooth][1:-1], atol=1e-3)
    for i in smooth[1:-1:9]:
        assert line.curvature_at(s[i]) == pytest.approx(slope[i], abs=1e-3)


@pytest.mark.parametrize("name", LINES)
def test_the_reference_points_foot_is_the_origin(name: str) -> None:
    line = LINES[name]
    assert line.foot(REFERENCE, near_s_m=0.3) == pytest.approx((0.0, line.lateral_m), abs=1e-7)


@pytest.mark.parametrize("name", LINES)
def test_feet_are_the_nearest_points(name: str) -> None:
    """Eq. (18)-(21) by search: Delta is positive where the line lies to the left."""
    line = LINES[name]
    s, theta, points = brute(line, -0.9, 1.9)
    for along in (-0.3, 0.1, 0.45, 1.0, 1.6):
        for d in (-0.3, -0.02, 0.05, 0.25):
            i = int(np.argmin(np.abs(s - along)))
            point = points[i] + d * np.array((-math.sin(theta[i]), math.cos(theta[i])))
            nearest = int(np.argmin(np.hypot(*(points - point).T)))
            found_s, lateral = line.foot((float(point[0]), float(point[1])), near_s_m=along + 0.1)
            assert found_s == pytest.approx(s[nearest], abs=3e-4)
            away = points[nearest] - point
            side = np.sign(away[1] * math.cos(theta[nearest]) - away[0] * math.sin(theta[nearest]))
            assert lateral == pytest.approx(side * np.hypot(*away), abs=1e-5)
            # the line lies to the left of a point that lies to the right of it
            assert np.sign(lateral) == -np.sign(d)


def test_feet_agree_with_the_curves() -> None:
    line = LINES["cubic"]
    w = shift_matrix(-0.5 / line.scale_m) @ line.coefficients_rad
    curve = ThetaCurve(*line.point_at(-0.5), w / line.scale_m ** np.arange(4), 1.8)
    for point in ((0.2, 0.1), (0.9, 0.5), (0.5, -0.1)):
        s, d = curve.project(point)
        found_s, lateral = line.foot(point)
        assert found_s == pytest.approx(s - 0.5, abs=1e-6)
        assert lateral == pytest.approx(-d, abs=1e-9)


@pytest.mark.parametrize("name", LINES)
@pytest.mark.parametrize("direction_rad", [-0.5, 0.0, 0.3])
def test_the_crossing_lies_on_both(name: str, direction_rad: float) -> None:
    line = LINES[name]
    s, distance = line.crossing(direction_rad)
    on_perpendicular = np.array(REFERENCE) + distance * np.array((-math.sin(direction_rad), math.cos(direction_rad)))
    assert line.point_at(s) == pytest.approx(tuple(on_perpendicular), abs=1e-7)
    if direction_rad == line.coefficients_rad[0]:
        assert distance == pytest.approx(line.lateral_m, abs=1e-9)


MOTIONS = [SE2.arc(0.03, 0.0), SE2.arc(0.2, 0.25), SE2.arc(0.3, -0.5), SE2.arc(-0.1, 0.1), SE2.arc(0.0, 0.3), SE2()]


@pytest.mark.parametrize("name", LINES)
@pytest.mark.parametrize("before_from_after", MOTIONS)
def test_a_moved_line_stays_where_it_is(name: str, before_from_after: SE2) -> None:
    line = LINES[name]
    after, advance = line.moved(before_from_after.inverse())
    s = np.linspace(-0.8, 1.8, 40)
    np.testing.assert_allclose(before_from_after.apply(after.points(s - advance)), line.points(s), atol=1e-5)
    np.testing.assert_allclose(after.heading(s - advance), line.heading(s) - before_from_after.yaw_rad, atol=1e-9)
    np.testing.assert_allclose(after.curvature(s - advance), line.curvature(s), atol=1e-9)
    assert after.s_max_m == pytest.approx(line.s_max_m - advance)
    assert after.foot(REFERENCE)[0] == pytest.approx(0.0, abs=1e-7)


def test_many_small_motions_do_not_drift() -> None:
    line = LINES["clothoid"]
    motion, pose = SE2.arc(0.004, 0.003), SE2()
    moved, driven_m = line, 0.0
    for _ in range(250):
        moved, advance = moved.moved(motion.inverse())
        pose, driven_m = pose @ motion, driven_m + advance
    s = np.linspace(-0.2, 1.2, 20)
    np.testing.assert_allclose(pose.apply(moved.points(s - driven_m)), line.points(s), atol=2e-6)


def test_the_shift_is_that_of_the_argument() -> None:
    rng = np.random.default_rng(2)
    u = np.linspace(-2.0, 2.0, 9)
    for shift in (-0.7, 0.0, 0.3, 1.9):
        w = rng.normal(size=4)
        shifted = np.polynomial.polynomial.polyval(u, shift_matrix(shift) @ w)
        np.testing.assert_allclose(shifted, np.polynomial.polynomial.polyval(u + shift, w), atol=1e-12)


@pytest.mark.parametrize("name", LINES)
@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-0.8, 1.9), (-0.9, -0.6), (1.4, 1.9), (-0.2, 1.6)])
def test_curves_are_the_line(name: str, low: float, high: float) -> None:
    line = LINES[name]
    curve = line.curve(low, high)
    assert curve.length_m == pytest.approx(high - low)
    s = np.linspace(low, high, 200)
    np.testing.assert_allclose(curve.position(s - low), line.points(s), atol=2e-4)
    beside = line.curve(low, high, lateral_m=0.1)
    theta = line.heading_at(high)
    end = line.points(s[-1:])[0] + 0.1 * np.array((-math.sin(theta), math.cos(theta)))
    assert beside.position(beside.length_m) == pytest.approx(end, abs=1e-4)


def test_no_bend_beyond_the_points_is_tighter_than_allowed() -> None:
    wild = theta_line(0.0, 1.0, 3.0, 4.0)
    far = np.linspace(1.4, 5.0, 20)
    assert np.abs(wild.curvature(far)).max() <= 2.0
    assert np.abs(wild.curvature(-far)).max() <= 2.0
    assert wild.heading(np.array(5.0)) - wild.heading(np.array(1.3)) == pytest.approx(2.0 * 3.7)


def test_a_range_of_one_point_is_an_arc() -> None:
    line = theta_line(0.1, 0.4, s_min_m=0.3, s_max_m=0.3)
    s = np.linspace(-1.0, 1.0, 9)
    np.testing.assert_allclose(line.curvature(s), 0.5)
    np.testing.assert_allclose(line.heading(s), 0.1 + 0.5 * s, atol=1e-12)


def test_feet_beyond_the_centre_of_curvature_are_finite() -> None:
    line = theta_line(0.0, 1.6, lateral_m=0.0)
    for y in (0.5, 0.51, 2.0, -30.0):
        assert math.isfinite(sum(line.foot((0.13, y), near_s_m=0.4)))
