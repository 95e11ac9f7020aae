"""The filter of one line over time: a car that weaves along lanes, lines that start, end and hide."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from automodel.estimation.theta.line_spline import smooth
from automodel.estimation.theta.theta_rls import ThetaRls, project_foot
from automodel.geometry import SE2
from tests.support.measured_lanes import REFERENCE_M, RLS, UNIT, drive, see
from tests.support.world_lanes import WorldLane, arc

STILL = SE2()


@pytest.mark.parametrize("bend", [0.0, 0.8, -1.25])
@pytest.mark.parametrize("side", [1, -1])
def test_on_an_arc_it_settles_on_the_arc(bend: float, side: int) -> None:
    rls, lane = ThetaRls(RLS), arc(bend)
    rng = np.random.default_rng(4)
    errors = []
    for i, (_, _, offset, heading) in enumerate(drive(rls, lane, 90, rng, side)):
        assert rls.line is not None
        if i >= 30:
            kappa = bend / (1.0 - bend * side * 0.2)
            errors.append(
                (
                    rls.line.heading_at(0.0) + heading,
                    rls.line.lateral_m - (side * 0.2 - offset),
                    rls.line.curvature_at(0.0) - kappa,
                    rls.line.heading_at(0.6) + heading - 0.6 * kappa,
                )
            )
    heading, lateral, kappa, ahead = np.abs(errors).mean(axis=0)
    assert heading < math.radians(0.35)
    assert lateral < 0.0015
    assert kappa < 0.04
    assert ahead < math.radians(1.2)
    assert np.abs(np.mean(errors, axis=0))[1] < 0.001


def test_a_highway_is_a_scale_track_nine_times_as_large() -> None:
    """Everything is in lane widths: the same drive, enlarged, gives the same directions."""
    small, large = ThetaRls(RLS), ThetaRls(replace(RLS, lane_width_m=9 * UNIT, reference_x_m=9 * REFERENCE_M))
    lane = WorldLane(lambda s: 0.6 * np.sin(1.5 * s), 10.0, UNIT)
    before = SE2()
    for i in range(40):
        s = 1.0 + 0.03 * i
        car = lane.car(s, 0.02, 0.1, REFERENCE_M)
        points = lane.seen_from(car, np.linspace(s - 0.3, s + 1.2, 50), 1)
        for rls, size in ((small, 1.0), (large, 9.0)):
            if i:
                motion = car.inverse() @ before
                distance = size * math.hypot(motion.x_m, motion.y_m)
                rls.predict(SE2(size * motion.x_m, size * motion.y_m, motion.yaw_rad), distance, 0.03)
            unit = size * UNIT
            sampled = smooth(size * points, np.full(50, size * 0.003), 0.08 * unit, 0.6 * unit, 0.6 / unit**2)
            assert sampled is not None
            rls.take(sampled)
        before = car
    assert small.line is not None
    assert large.line is not None
    np.testing.assert_allclose(large.line.coefficients_rad, small.line.coefficients_rad, atol=1e-6)
    assert large.line.lateral_m == pytest.approx(9.0 * small.line.lateral_m, rel=1e-6)
    assert large.lateral_variance_m2 == pytest.approx(81.0 * small.lateral_variance_m2, rel=1e-6)


def test_the_variances_are_about_right() -> None:
    rls, lane = ThetaRls(RLS), arc(0.6)
    rng = np.random.default_rng(5)
    heading, lateral = [], []
    for i, (_, _, offset, angle) in enumerate(drive(rls, lane, 120, rng)):
        assert rls.line is not None
        if i >= 20:
            heading.append((rls.line.heading_at(0.0) + angle) / math.sqrt(rls.heading_variance_here()))
            lateral.append((rls.line.lateral_m - (0.2 - offset)) / math.sqrt(rls.lateral_variance_m2))
    # the heading's variance allows for roads that are no cubics; this one is
    assert 0.1 < np.std(heading) < 1.0
    assert 0.4 < np.std(lateral) < 2.0


def test_forgetting_follows_a_bend_that_begins() -> None:
    lane = WorldLane(lambda s: np.where(s < 2.0, 0.0, 0.8), 10.0, UNIT)
    quick, slow = ThetaRls(RLS), ThetaRls(replace(RLS, memory_lanes=50.0))
    results = []
    for rls in (quick, slow):
        *_, (s, _, _, heading) = drive(rls, lane, 50)
        assert s > 2.4
        assert rls.line is not None
        results.append((abs(rls.line.curvature_at(0.0) - 0.8 / (1.0 - 0.16)), abs(rls.line.heading_at(0.0) + heading)))
    (kappa, error), (slow_kappa, slow_error) = results
    assert kappa < 0.06
    assert error < math.radians(0.7)
    assert slow_kappa > 3.0 * kappa
    assert slow_error > 1.5 * error


def test_a_line_hidden_for_a_while_is_carried_along() -> None:
    lane, rls = arc(0.7), ThetaRls(RLS)
    *_, (s, car, _, _) = drive(rls, lane, 40)
    variance = rls.lateral_variance_m2
    for i in range(20):  # 0.6 m
        after = lane.car(s + 0.03 * (i + 1), 0.02, -0.1, REFERENCE_M)
        motion = after.inverse() @ car
        rls.predict(motion, math.hypot(motion.x_m, motion.y_m), 0.033)
        car = after
    assert rls.line is not None
    assert rls.line.lateral_m == pytest.approx(0.2 - 0.02, abs=0.004)
    assert rls.line.heading_at(0.0) == pytest.approx(0.1, abs=0.02)
    assert rls.lateral_variance_m2 > 2.0 * variance


@pytest.mark.parametrize("bend", [0.0, 0.7, -0.7])
def test_a_line_that_begins_ahead_is_placed_through_its_shape(bend: float) -> None:
    lane = arc(bend)
    car = lane.car(2.0, 0.04, 0.1, REFERENCE_M)
    fresh = ThetaRls(RLS)
    fresh.take(see(lane, car, 2.0, -1, from_m=0.3))
    assert fresh.line is not None
    assert fresh.line.lateral_m == pytest.approx(-0.24, abs=0.004)
    assert fresh.line.heading_at(0.0) == pytest.approx(-0.1, abs=0.02)
    assert fresh.line.s_min_m == pytest.approx(0.3 * (1.0 + bend * 0.2), abs=0.03)
    known = ThetaRls(RLS)
    known.take(see(lane, car, 2.0, -1))
    variance = known.lateral_variance_m2
    known.take(see(lane, car, 2.0, -1, from_m=0.3))
    assert known.line is not None
    assert known.line.lateral_m == pytest.approx(-0.24, abs=0.002)
    assert fresh.lateral_variance_m2 > 4.0 * variance


@pytest.mark.parametrize("from_m", [-0.3, -0.03, 0.03, 0.25])
@pytest.mark.parametrize("bend", [0.0, 0.9])
def test_samples_are_counted_from_the_foot(bend: float, from_m: float) -> None:
    lane = arc(bend)
    car = lane.car(2.0, -0.05, 0.2, REFERENCE_M)
    place = project_foot(see(lane, car, 2.0, 1, from_m=from_m), (REFERENCE_M, 0.0), None)
    ratio = 1.0 - 0.2 * bend  # of arc lengths, line to centre
    assert place.s_m[0] == pytest.approx(from_m * ratio, abs=0.006)
    assert place.s_m[-1] == pytest.approx(1.2 * ratio, abs=0.006)
    assert place.lateral_m == pytest.approx(0.25, abs=0.003)
    assert place.beside == (from_m < 0.0)


def test_a_line_behind_the_car_is_placed_too() -> None:
    lane = arc(0.6)
    sampled = see(lane, lane.car(2.0, 0.0, 0.0, REFERENCE_M), 2.0, 1)
    place = project_foot(sampled, (2.5, 0.9), None)
    assert not place.beside
    assert place.s_m[-1] < 0.0
    rls = ThetaRls(RLS)
    rls.take(sampled)
    for _ in range(60):
        rls.predict(SE2.arc(0.03, 0.018).inverse(), 0.03, 0.033)
        rls.take(sampled)  # nonsense, as the points do not move along
    assert rls.line is not None
    assert np.isfinite(rls.line.coefficients_rad).all()
