"""The compiled moments of a believed lane against the matrices that say the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from automodel.geometry.lane_path import OFFSET, PITCH, ROAD, THETA, WIDTH
from automodel.tracking.belief import STATION, STATIONS, LaneBelief
from automodel.tracking.lane_motion import Part, arc, beside_car, lateral_variance, line_beside, merged
from automodel.types import FloatArray
from tests.support.sighted_lines import ROAD_MODEL

SIZE = ROAD + STATIONS
SPACING_M = STATION * ROAD_MODEL.lane_width_m
STARTS_M = [0.0, 0.3 * SPACING_M, 0.999 * SPACING_M, -0.2 * SPACING_M, 4.4 * SPACING_M]


def drawn(seed: int) -> tuple[FloatArray, FloatArray]:
    """A state and a covariance, all of whose numbers matter."""
    random = np.random.default_rng(seed)
    root = random.normal(0.0, 0.05, (SIZE, SIZE))
    return random.normal(0.0, 0.1, SIZE), root @ root.T


def weights(s_m: FloatArray, start_m: float) -> FloatArray:
    """Shares (n, stations) of the stations' curvatures in that at arc lengths (n,)."""
    at = np.clip((s_m + start_m) / SPACING_M, 0.0, STATIONS - 1.0)
    return np.maximum(1.0 - np.abs(at[:, None] - np.arange(STATIONS)), 0.0)


def test_an_arc_has_one_curvature_that_gets_uncertain_ahead() -> None:
    random = np.random.default_rng(3)
    root = random.normal(0.0, 1.0, (4, 4))
    mean, covariance, walk = random.normal(0.0, 1.0, 4), root @ root.T, 0.07
    spread = np.zeros((SIZE, 4))
    spread[OFFSET, Part.OFFSET] = spread[THETA, Part.THETA] = spread[WIDTH, Part.WIDTH] = 1.0
    spread[ROAD:, Part.KAPPA] = 1.0
    expected = spread @ covariance @ spread.T
    expected[PITCH, PITCH] = 1.0
    steps = np.arange(STATIONS)
    expected[ROAD:, ROAD:] += walk * np.minimum(steps[:, None], steps)
    state, grown = arc(mean, covariance, STATIONS, walk)
    assert state == pytest.approx(spread @ mean, abs=1e-15)
    assert grown == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize("start_m", STARTS_M)
def test_what_lies_beside_the_car_is_linear_in_the_state(start_m: float) -> None:
    state, covariance = drawn(1)
    rows = np.zeros((4, SIZE))
    rows[Part.OFFSET, OFFSET] = rows[Part.THETA, THETA] = rows[Part.WIDTH, WIDTH] = 1.0
    rows[Part.KAPPA, ROAD:] = weights(np.zeros(1), start_m)[0]
    mean, spread = beside_car(state, covariance, start_m, SPACING_M)
    assert mean == pytest.approx(rows @ state, abs=1e-15)
    assert spread == pytest.approx(rows @ covariance @ rows.T, abs=1e-15)


@pytest.mark.parametrize("start_m", STARTS_M)
@pytest.mark.parametrize("others", [0.0, 0.3, 1.0])
def test_merged_beliefs_have_the_moments_of_the_mixture(start_m: float, others: float) -> None:
    (state, covariance), (other_state, other_covariance), other_start_m = drawn(1), drawn(2), 0.6 * SPACING_M
    turn = np.eye(SIZE)
    turn[ROAD:, ROAD:] = weights(SPACING_M * np.arange(STATIONS, dtype=np.float64) - start_m, other_start_m)
    away = turn @ other_state - state
    both = (1.0 - others) * covariance + others * turn @ other_covariance @ turn.T
    both += others * (1.0 - others) * np.outer(away, away)
    got = merged(state, covariance, start_m, other_state, other_covariance, other_start_m, SPACING_M, others)
    assert got[0] == pytest.approx(state + others * away, abs=1e-15)
    assert got[1] == pytest.approx(both, abs=1e-15)


@pytest.mark.parametrize("start_m", STARTS_M)
def test_the_place_ahead_is_as_uncertain_as_the_line_through_it(start_m: float) -> None:
    state, covariance = drawn(4)
    here = state, covariance, start_m, SPACING_M, 0.13
    sigma = line_beside(*here, 0.0, np.array((0.4,)))[2]
    assert lateral_variance(*here, 0.4) == pytest.approx(float(sigma[0]) ** 2, rel=1e-12)


def test_a_belief_on_another_road_is_the_same_lane() -> None:
    before, winding = LaneBelief(*drawn(5), 0.1, ROAD_MODEL, 0.13), replace(ROAD_MODEL, bend_walk=0.1)
    after = before.on(winding)
    assert after.road is winding
    assert np.array_equal(after.mean, before.mean)
    assert np.array_equal(after.spread, before.spread)
