"""The centerline from its lines: arc lengths against concentric arcs and integrals, and the place between two lines."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.estimation.theta.centerline_fusion import CenterlineFusion, to_centerline
from automodel.estimation.theta.line_spline import smooth
from automodel.estimation.theta.theta_rls import ThetaRls
from automodel.geometry import SE2
from tests.support.measured_lanes import REFERENCE_M, RLS, UNIT
from tests.support.world_lanes import WorldLane, arc

KNOWN, UNKNOWN = 1e-6, 0.1**2  # variance of the width [m^2]


@pytest.mark.parametrize("radius_m", [0.8, -0.8, 5.0])
@pytest.mark.parametrize("d", [0.2, -0.2])
def test_three_concentric_arcs(radius_m: float, d: float) -> None:
    """Over the same angle each arc is as long as its own radius."""
    angle = np.linspace(-0.5, 1.5, 21) * math.copysign(1.0, radius_m)
    s_line, s_centre = (radius_m - d) * angle, radius_m * angle
    found = to_centerline(s_line, 0.3 + angle, 0.3, d)
    np.testing.assert_allclose(found, s_centre, atol=1e-12)
    # the paper's eq. (17) multiplies by the ratio ds_line / ds_centre, and goes the wrong way
    ratio = 1.0 - d / radius_m
    assert np.abs(s_line * ratio - s_centre).max() > 0.05
    np.testing.assert_allclose(found, s_line / ratio, atol=1e-12)


def test_on_the_straight_nothing_is_stretched() -> None:
    s = np.linspace(-1.0, 3.0, 9)
    np.testing.assert_array_equal(to_centerline(s, np.full(9, 0.7), 0.7, 0.2), s)


@pytest.mark.parametrize("d", [0.2, -0.35])
def test_on_a_clothoid_it_is_the_integral_of_the_ratio(d: float) -> None:
    s_centre = np.linspace(0.0, 2.0, 20_001)
    kappa = 0.2 + 0.6 * s_centre - 0.3 * np.sin(3.0 * s_centre)
    ratio = 1.0 - kappa * d
    step = s_centre[1] - s_centre[0]
    s_line = np.concatenate(([0.0], np.cumsum(0.5 * (ratio[1:] + ratio[:-1]) * step)))
    theta = np.concatenate(([0.0], np.cumsum(0.5 * (kappa[1:] + kappa[:-1]) * step)))
    np.testing.assert_allclose(to_centerline(s_line, theta, 0.0, d), s_centre, atol=1e-9)


def test_a_line_about_its_own_centre_of_curvature_is_no_trouble() -> None:
    for radius in (0.0, 1e-9, -0.05):  # the inner line shrinks to a point, and past it
        angle = np.linspace(0.0, 1.0, 5)
        found = to_centerline(radius * angle, angle, 0.0, 0.2)
        assert np.isfinite(found).all()
        np.testing.assert_allclose(found, (radius + 0.2) * angle, atol=1e-12)


def tracked(points: np.ndarray, frames: int = 1) -> ThetaRls:
    rls = ThetaRls(RLS)
    sampled = smooth(points, np.full(len(points), 0.002), 0.032, 0.24, 0.6 / UNIT**2)
    assert sampled is not None
    for _ in range(frames):
        rls.take(sampled)
    return rls


def both(lane: WorldLane, car: SE2, s_m: float, from_m: float = -0.4) -> tuple[ThetaRls, ThetaRls]:
    s = np.linspace(s_m + from_m, s_m + 1.4, 60)
    left, right = (tracked(lane.seen_from(car, s, side), 3) for side in (1, -1))
    return left, right


LANES = {
    "straight": arc(0.0),
    "left": arc(0.8),
    "right": arc(-0.8),
    "tight": arc(1.25),
    "clothoid": WorldLane(lambda s: 0.5 * (s - 3.0), 10.0, UNIT),
}


@pytest.mark.parametrize("name", LANES)
@pytest.mark.parametrize(("offset_m", "heading_deg"), [(0.0, 0.0), (0.07, -20.0), (-0.1, 40.0)])
@pytest.mark.parametrize("seen", ["both", "left", "right"])
def test_the_centerline_lies_in_the_middle(name: str, offset_m: float, heading_deg: float, seen: str) -> None:
    lane, heading = LANES[name], math.radians(heading_deg)
    car = lane.car(3.0, offset_m, heading, REFERENCE_M)
    left, right = both(lane, car, 3.0)
    centre = CenterlineFusion(RLS)
    lines = (None if seen == "right" else left, None if seen == "left" else right)
    for _ in range(4):
        centre.update(*lines, UNIT, KNOWN)
        centre.rls.predict(SE2(), 0.0, 0.01)
    line = centre.rls.line
    assert line is not None
    # eq. (20), (21): Theta is the centerline's direction seen from the car, Delta positive where it lies to the left
    assert line.heading_at(0.0) == pytest.approx(-heading, abs=0.008)
    assert line.lateral_m == pytest.approx(-offset_m, abs=0.001)
    s = np.linspace(-0.3, 1.1, 15)
    np.testing.assert_allclose(line.heading(s), lane.theta(3.0 + s) - car.yaw_rad, atol=0.025)
    np.testing.assert_allclose(line.points(s), car.inverse().apply(lane.beside(3.0 + s, 0.0)), atol=0.006)


def test_nothing_to_see_changes_nothing() -> None:
    centre = CenterlineFusion(RLS)
    centre.update(None, None, UNIT, KNOWN)
    centre.update(ThetaRls(RLS), None, UNIT, KNOWN)
    assert centre.rls.line is None
    left, right = both(LANES["left"], LANES["left"].car(3.0, 0.0, 0.0, REFERENCE_M), 3.0)
    centre.update(left, right, UNIT, KNOWN)
    before = centre.rls.line
    centre.update(None, None, UNIT, KNOWN)
    assert centre.rls.line is before


@pytest.mark.parametrize("skew_deg", [0.0, 4.0, 10.0])
@pytest.mark.parametrize("aside_m", [-0.08, 0.0, 0.08])
def test_it_bisects_lines_that_are_not_parallel(skew_deg: float, aside_m: float) -> None:
    """A wedge about the x axis: its points are as far from the one line as from the other."""
    half = math.radians(0.5 * skew_deg)
    x = np.linspace(-0.3, 1.6, 60)
    car = SE2(0.0, aside_m, 0.15)
    lines = []
    for side in (1.0, -1.0):
        world = np.column_stack((x, side * (0.2 + x * math.tan(half))))
        lines.append(tracked(car.inverse().apply(world), 3))
    centre = CenterlineFusion(RLS)
    for _ in range(4):
        centre.update(lines[0], lines[1], UNIT, UNKNOWN)
        centre.rls.predict(SE2(), 0.0, 0.01)
    line = centre.rls.line
    assert line is not None
    reference_y = aside_m + REFERENCE_M * math.sin(0.15)
    assert line.heading_at(0.0) == pytest.approx(-0.15, abs=0.001 + 0.02 * half)
    assert line.lateral_m == pytest.approx(-reference_y, abs=1.5e-4)
    np.testing.assert_allclose(car.apply(line.points(np.linspace(0.0, 1.0, 5)))[:, 1], 0.0, atol=0.002 + 0.1 * half)


def test_feet_of_opening_lines_lie_behind_the_perpendicular() -> None:
    """Two arcs that open by 10 deg: abreast of the car both have turned on for 0.2 sin(5 deg) since their feet."""
    half, kappa = math.radians(5.0), 0.8
    s = np.linspace(-0.4, 1.2, 40)
    centre, lines = CenterlineFusion(RLS), (ThetaRls(RLS), ThetaRls(RLS))
    for rls, side in zip(lines, (1.0, -1.0), strict=True):
        rls.start(s, side * half + kappa * s, np.full(40, 1e4), side * 0.2, 1e-6)
    centre.update(*lines, UNIT, UNKNOWN)
    assert centre.rls.line is not None
    assert centre.rls.line.lateral_m == pytest.approx(0.0, abs=1e-4)
    assert centre.rls.line.heading_at(0.0) == pytest.approx(kappa * 0.2 * math.sin(half), abs=0.005)


@pytest.mark.parametrize("width_m", [0.28, 0.52])
def test_with_both_lines_the_width_hardly_matters(width_m: float) -> None:
    lane = arc(0.6, width_m=width_m)
    left, right = both(lane, lane.car(3.0, 0.03, 0.1, REFERENCE_M), 3.0)
    centre = CenterlineFusion(RLS)
    centre.update(left, right, UNIT, UNKNOWN)
    assert centre.rls.line is not None
    assert centre.rls.line.lateral_m == pytest.approx(-0.03, abs=0.001)
    assert centre.rls.line.heading_at(0.0) == pytest.approx(-0.1, abs=0.01)


def test_a_line_that_is_known_badly_counts_little() -> None:
    """The right line has been hidden for a while and drifted off; the left one and the width hold the centerline."""
    lane = arc(0.6)
    car = lane.car(3.0, 0.03, 0.1, REFERENCE_M)
    left, _ = both(lane, car, 3.0)
    wrong = lane.car(3.0, 0.11, 0.25, REFERENCE_M)
    _, right = both(lane, wrong, 3.0)
    right.predict(SE2(), 40.0, 0.0)
    assert math.sqrt(right.lateral_variance_m2) > 0.05
    centre = CenterlineFusion(RLS)
    for _ in range(4):
        centre.update(left, right, UNIT, 0.005**2)
    assert centre.rls.line is not None
    assert centre.rls.line.lateral_m == pytest.approx(-0.03, abs=0.004)
    assert centre.rls.line.heading_at(0.0) == pytest.approx(-0.1, abs=0.02)
    assert centre.rls.lateral_variance_m2 < 0.005**2


def test_the_middles_variance_is_that_of_many_draws() -> None:
    """Two distances and a width, all drawn: the least-squares middle has the variance that it claims."""
    rng = np.random.default_rng(2)
    sigmas = (0.004, 0.012, 0.01)
    s, level, weight = np.linspace(-0.4, 1.2, 10), np.zeros(10), np.full(10, 100.0)
    drawn = []
    for _ in range(2000):
        a, b, w = rng.normal(0.0, sigmas)
        left, right, centre = ThetaRls(RLS), ThetaRls(RLS), CenterlineFusion(RLS)
        left.start(s, level, weight, 0.5 * (UNIT + w) + a, sigmas[0] ** 2)
        right.start(s, level, weight, -0.5 * (UNIT + w) + b, sigmas[1] ** 2)
        centre.update(left, right, UNIT, sigmas[2] ** 2)
        assert centre.rls.line is not None
        drawn.append(centre.rls.line.lateral_m)
    variance = centre.rls.lateral_variance_m2
    assert np.mean(drawn) == pytest.approx(0.0, abs=0.0006)
    assert np.std(drawn) == pytest.approx(math.sqrt(variance), rel=0.05)
    # better than the midpoint, and than either line by the width
    assert variance < 0.25 * (sigmas[0] ** 2 + sigmas[1] ** 2)
    assert variance < sigmas[0] ** 2 + 0.25 * sigmas[2] ** 2


def test_the_way_through_a_bend_with_one_line_gone() -> None:
    """Weaving from a straight into a bend and out of it; the right line is hidden for a third of the way."""
    lane = WorldLane(lambda s: 0.8 * np.clip(2.0 * (s - 2.0), 0, 1) - 1.4 * np.clip(2.0 * (s - 3.5), 0, 1), 10.0, UNIT)
    rng = np.random.default_rng(9)
    lines, centre = (ThetaRls(RLS), ThetaRls(RLS)), CenterlineFusion(RLS)
    before, errors = None, []
    for i in range(120):
        s = 1.0 + 0.03 * i
        offset, heading = 0.05 * math.sin(0.1 * i), 0.15 * math.cos(0.1 * i)
        car = lane.car(s, offset, heading, REFERENCE_M)
        if before is not None:
            motion = car.inverse() @ before
            for each in (*lines, centre.rls):
                each.predict(motion, math.hypot(motion.x_m, motion.y_m), 0.033)
        before = car
        seen: list[ThetaRls | None] = []
        for rls, side in zip(lines, (1, -1), strict=True):
            if side < 0 and 50 <= i < 90:
                seen.append(None)
                continue
            points = lane.seen_from(car, np.linspace(s - 0.4, s + 1.2, 55), side)
            sampled = smooth(points + rng.normal(0.0, 0.003, points.shape), np.full(55, 0.003), 0.032, 0.24, 4.0)
            assert sampled is not None
            rls.take(sampled)
            seen.append(rls)
        centre.update(seen[0], seen[1], UNIT, 0.003**2)
        assert centre.rls.line is not None
        line = centre.rls.line
        errors.append((line.heading_at(0.0) + heading, line.lateral_m + offset))
    mean, worst = np.abs(errors).mean(axis=0), np.abs(errors).max(axis=0)
    assert mean[0] < math.radians(0.7)
    assert worst[0] < math.radians(3.0)
    assert mean[1] < 0.0015
    assert worst[1] < 0.006
