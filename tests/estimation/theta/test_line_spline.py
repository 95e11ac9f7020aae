"""The smoothing spline against exact curves, against the same minimisation by scipy, and against bad points."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import BSpline

from automodel.estimation.theta.line_spline import SampledLine, smooth
from tests.support.world_lanes import WorldLane

UNIT = 0.4  # lane width
STEP, KNOT, RATE = 0.08 * UNIT, 0.6 * UNIT, 0.6 / UNIT**2

CURVATURES = {
    "straight": lambda s: 0.0 * s,
    "left": lambda s: np.full(np.shape(s), 1.0 / (2.0 * UNIT)),
    "right": lambda s: np.full(np.shape(s), -1.0 / (2.0 * UNIT)),
    "clothoid": lambda s: 0.8 * (s - 0.8),
}


def line_points(name: str, count: int, length_m: float = 1.6) -> tuple[WorldLane, np.ndarray, np.ndarray]:
    lane = WorldLane(CURVATURES[name], length_m, UNIT)
    s = np.linspace(0.0, length_m, count)
    return lane, s, lane.beside(s, 0.0)


def run(points: np.ndarray, sigma_m: float = 0.003) -> SampledLine | None:
    return smooth(points, np.full(len(points), sigma_m), STEP, KNOT, RATE)


def sampled(points: np.ndarray, sigma_m: float = 0.003) -> SampledLine:
    line = run(points, sigma_m)
    assert line is not None
    return line


@pytest.mark.parametrize("name", CURVATURES)
@pytest.mark.parametrize("count", [5, 8, 40, 120])
def test_exact_points_give_length_and_direction(name: str, count: int) -> None:
    lane, _, points = line_points(name, count)
    line = sampled(points)
    # a spline by chord lengths: with few points in a bend its parameter runs unevenly
    loose = 1.0 if count >= 40 else 8.0
    assert line.length_m == pytest.approx(1.6, abs=1e-3 * loose)
    np.testing.assert_allclose(line.theta_rad, lane.theta(line.s_m), atol=0.007 * loose)
    np.testing.assert_allclose(line.points_m, lane.beside(line.s_m, 0.0), atol=1e-3 * loose)


@pytest.mark.parametrize("name", CURVATURES)
def test_samples_are_close_and_even(name: str) -> None:
    line = sampled(line_points(name, 50)[2])
    steps = np.diff(line.s_m)
    assert line.s_m[0] == 0.0
    assert steps.max() <= 1.02 * STEP
    assert steps.min() >= 0.5 * STEP
    assert np.ptp(steps) < 0.03 * STEP
    # eq. (1): the length is the sum of the distances, and the direction that of the segments
    chords = np.hypot(*np.diff(line.points_m, axis=0).T)
    np.testing.assert_allclose(steps, chords, rtol=2e-3)
    segments = np.unwrap(np.arctan2(*np.diff(line.points_m, axis=0).T[::-1]))
    np.testing.assert_allclose(segments, 0.5 * (line.theta_rad[1:] + line.theta_rad[:-1]), atol=1e-3)


def test_coarse_samples_still_have_their_arc_lengths() -> None:
    """Steps of 0.3 rad: the chords are half a percent too short."""
    lane, _, points = line_points("left", 80)
    line = smooth(points, np.full(80, 0.003), 0.24, 0.24, RATE)
    assert line is not None
    assert len(line.s_m) < 10
    assert float(np.hypot(*np.diff(line.points_m, axis=0).T).sum()) < 1.596
    assert line.length_m == pytest.approx(1.6, abs=1e-3)
    np.testing.assert_allclose(line.theta_rad, lane.theta(line.s_m), atol=0.005)


def test_it_is_the_minimum_that_it_claims_to_be() -> None:
    """The same sum of squares, put together from scipy's splines and solved by singular values."""
    rng = np.random.default_rng(3)
    x = np.cumsum(rng.uniform(0.1, 0.3, 7))
    points = np.column_stack((x, 0.1 * np.sin(3.0 * x)))  # so few that each step is counted by itself
    sigma = rng.uniform(0.002, 0.004, 7)
    t = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
    intervals = int(np.ceil(t[-1] / KNOT))
    spacing = t[-1] / intervals
    knots = spacing * np.arange(-3, intervals + 4)
    size = intervals + 3
    data = BSpline.design_matrix(t, knots, 3).toarray() / sigma[:, None]
    third = BSpline(knots, np.eye(size), 3).derivative(3)(spacing * (np.arange(intervals) + 0.5)) / RATE
    wanted = np.vstack((points / sigma[:, None], np.zeros((intervals, 2))))
    control = np.linalg.lstsq(np.vstack((data, third)), wanted, rcond=None)[0]
    line = smooth(points, sigma, STEP, KNOT, RATE)
    assert line is not None
    at = np.linspace(0.0, t[-1], len(line.s_m))
    spline = BSpline(knots, control, 3)
    np.testing.assert_allclose(line.points_m, spline(at), atol=1e-8)
    rate = spline.derivative()(at)
    np.testing.assert_allclose(line.theta_rad, np.unwrap(np.arctan2(rate[:, 1], rate[:, 0])), atol=1e-7)
    full = np.vstack((data, third))
    spread = np.linalg.pinv(full.T @ full)
    basis = BSpline.design_matrix(at, knots, 3).toarray()
    np.testing.assert_allclose(line.lateral_sigma_m, np.sqrt(np.diag(basis @ spread @ basis.T)), rtol=1e-6)


@pytest.mark.parametrize("name", CURVATURES)
def test_the_standard_deviations_are_those_of_many_draws(name: str) -> None:
    rng = np.random.default_rng(7)
    lane, _, clean = line_points(name, 60)
    errors, lateral, lines = [], [], []
    for _ in range(150):
        line = sampled(clean + rng.normal(0.0, 0.003, clean.shape))
        along = line.s_m * (1.6 / line.length_m)
        errors.append(line.theta_rad - lane.theta(along))
        away = line.points_m - lane.beside(along, 0.0)
        lateral.append(away[:, 1] * np.cos(line.theta_rad) - away[:, 0] * np.sin(line.theta_rad))
        lines.append(line)
    assert len({len(line.s_m) for line in lines}) == 1
    spread, claimed = np.std(errors, axis=0), np.mean([line.theta_sigma_rad for line in lines], axis=0)
    # the prior allows for sharper bends than these, so the claim is on the safe side
    assert (spread / claimed > 0.6).all()
    assert (spread / claimed < 1.3).all()
    np.testing.assert_allclose(np.std(lateral, axis=0), lines[0].lateral_sigma_m, rtol=0.45)
    middle = slice(10, -10)
    assert np.abs(np.mean(errors, axis=0)[middle]).max() < 0.005
    assert spread[middle].max() < 0.02  # the raw steps of 27 mm turn by 0.16 rad of noise
    assert 0.05 < lines[0].independence < 0.5


def test_noise_across_the_line_does_not_lengthen_it() -> None:
    rng = np.random.default_rng(5)
    x = np.linspace(0.0, 1.6, 120)
    points = np.column_stack((x + rng.normal(0.0, 0.004, 120), rng.normal(0.0, 0.006, 120)))
    chords = float(np.hypot(*np.diff(points, axis=0).T).sum())
    line = sampled(points, 0.006)
    assert chords > 1.75  # what a sum over the raw points would make of it
    assert line.length_m == pytest.approx(1.6, abs=0.02)


def test_sure_points_count_more() -> None:
    x = np.linspace(0.0, 1.0, 40)
    points = np.column_stack((x, np.where(np.arange(40) % 2, 0.002, -0.002)))
    sigma = np.where(np.arange(40) % 2, 0.001, 0.02)
    line = smooth(points, sigma, STEP, KNOT, RATE)
    assert line is not None
    np.testing.assert_allclose(line.points_m[:, 1], 0.002, atol=2e-4)


def test_directions_run_on_past_half_a_turn() -> None:
    lane = WorldLane(lambda s: np.full(np.shape(s), 1.25), 3.2, UNIT)
    line = sampled(lane.beside(np.linspace(0.0, 3.2, 90), 0.0))
    assert line.theta_rad[-1] == pytest.approx(4.0, abs=0.02)
    assert (np.diff(line.theta_rad) > 0.0).all()


STRAIGHT = np.column_stack((np.linspace(0.0, 1.2, 30), np.zeros(30)))
BAD = {
    "nothing": np.empty((0, 2)),
    "three points": STRAIGHT[:3],
    "one place": np.zeros((20, 2)),
    "two places": np.repeat(STRAIGHT[[0, 20]], 10, axis=0),
    "shorter than a step": STRAIGHT * 0.02,
    "nothing finite": np.full((20, 2), np.nan),
    "infinite": np.full((20, 2), np.inf),
}


@pytest.mark.parametrize("name", BAD)
def test_no_line_in_bad_points(name: str) -> None:
    assert run(BAD[name]) is None


def test_no_line_in_bad_sigmas() -> None:
    for bad in (0.0, -1.0, np.nan, np.inf):
        assert smooth(STRAIGHT, np.full(30, bad), STEP, KNOT, RATE) is None


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_points_that_are_not_finite_are_left_out(bad: float) -> None:
    points = np.insert(STRAIGHT, [4, 4, 17], bad, axis=0)
    np.testing.assert_allclose(sampled(points).points_m, sampled(STRAIGHT).points_m, atol=1e-9)


def test_doubled_points_are_no_trouble() -> None:
    line = sampled(np.repeat(STRAIGHT, 3, axis=0))
    assert line.length_m == pytest.approx(1.2, abs=1e-3)
    np.testing.assert_allclose(line.theta_rad, 0.0, atol=1e-9)


def test_a_line_that_turns_back_ends_there() -> None:
    back = np.concatenate((STRAIGHT, STRAIGHT[::-1] + np.array((0.0, 0.01))))
    line = run(back)
    assert line is not None
    assert 1.0 < line.length_m < 1.3
    near = line.s_m < 0.6
    np.testing.assert_allclose(line.theta_rad[near], 0.0, atol=0.05)


def test_anything_gives_finite_numbers_or_nothing() -> None:
    rng = np.random.default_rng(11)
    lines = 0
    for _ in range(400):
        count = int(rng.integers(0, 60))
        points = rng.normal(0.0, 10.0 ** rng.uniform(-4, 2), (count, 2))
        if rng.random() < 0.5:
            points = np.cumsum(points, axis=0)
        if count and rng.random() < 0.3:
            points[rng.integers(0, count)] = rng.choice((np.nan, 1e12, -1e300))
        line = smooth(points, 10.0 ** rng.uniform(-6, 1, count), STEP, KNOT, RATE)
        if line is None:
            continue
        lines += 1
        arrays = (line.s_m, line.theta_rad, line.points_m, line.theta_sigma_rad, line.lateral_sigma_m)
        assert all(np.isfinite(array).all() for array in arrays)
        assert (np.diff(line.s_m) > 0.0).all()
        assert 0.0 <= line.independence <= 1.0
        assert len(line.s_m) <= 513
    assert lines > 50
