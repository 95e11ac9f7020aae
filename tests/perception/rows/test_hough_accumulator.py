"""The loops of a start against the same said with whole arrays."""

from __future__ import annotations

import numpy as np
import pytest

from automodel.perception.rows.row_hough import accumulate, best_pair, best_single, row_peaks, row_votes

LATERAL = np.linspace(-1.0, 1.0, 21)
FEWEST, OFF, UNIT = 6, 3.0, 0.8


def table(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Votes for lines (4, 5, 21), and what each curvature and heading loses, and where the car is on its axis."""
    rng = np.random.default_rng(seed)
    lines = rng.integers(0, 12, (4, 5, len(LATERAL))).astype(np.int32)
    return lines, rng.uniform(0.0, 4.0, (4, 5)), rng.uniform(-0.2, 0.2, (4, 5))


def test_peaks_are_the_highest_around_them_and_above_the_least() -> None:
    height = np.array([[0, 5, 9, 5, 0, 0, 7, 7, 0], [3, 0, 0, 0, 8, 0, 0, 0, 2]], np.int32)
    within = np.ones(height.shape, bool)
    row, column = row_peaks(height, within, 2.5, 3)
    assert list(zip(row.tolist(), column.tolist(), strict=True)) == [(0, 2), (0, 6), (0, 7), (1, 0), (1, 4)]
    within[1, 4] = False
    assert len(row_peaks(height, within, 2.5, 3)[0]) == 4
    assert len(row_peaks(height, within, 9.0, 3)[0]) == 0


def test_ridges_vote_about_their_place_and_nowhere_else() -> None:
    said = row_votes(np.array([0, 1]), np.array([4.4, 9.0]), np.array([2, 3]), 2, 10, 5)
    assert said[:10].tolist() == [0, 0, 1, 5, 5, 5, 1, 0, 0, 0]
    assert said[10:].tolist() == [0, 0, 0, 0, 0, 0, 1, 1, 5, 5, 0]


def test_lines_sum_what_their_rows_say() -> None:
    rng = np.random.default_rng(1)
    said = rng.integers(0, 3, 41).astype(np.int32)
    places = rng.integers(0, 41, (4, 2, 3, 5)).astype(np.int32)
    assert (accumulate(said, places) == said[places].sum(axis=0)).all()


@pytest.mark.parametrize("seed", range(5))
def test_the_best_pair_is_the_best_of_all(seed: int) -> None:
    lines, loss, aside = table(seed)
    apart, width_loss = np.array([6, 8, 10]), np.array([1.0, 0.0, 1.5])
    totals = {}
    for c, h, a, w in np.ndindex(*lines.shape, len(apart)):
        left = a + int(apart[w])
        if left < len(LATERAL) and min(lines[c, h, a], lines[c, h, left]) >= FEWEST:
            middle = 0.5 * (LATERAL[a] + LATERAL[left])
            if abs(aside[c, h] - middle) <= 0.5 * (LATERAL[left] - LATERAL[a]):
                lost = loss[c, h] + OFF * (aside[c, h] - middle) ** 2 + width_loss[w]
                totals[c, h, a, w] = float(lines[c, h, a] + lines[c, h, left] - lost)
    score, c, h, a, w = best_pair(lines, FEWEST, loss, aside, LATERAL, apart, width_loss, OFF)
    assert (c, h, a, w) == max(totals, key=totals.__getitem__)
    assert score == pytest.approx(totals[c, h, a, w])
    assert best_pair(lines, 99, loss, aside, LATERAL, apart, width_loss, OFF)[0] == -np.inf


@pytest.mark.parametrize("seed", range(5))
def test_the_best_single_line_is_the_best_of_all(seed: int) -> None:
    lines, loss, aside = table(seed)
    distance = LATERAL - aside[..., None]
    offset = np.where(distance > 0.0, 0.5 * UNIT - distance, -0.5 * UNIT - distance)
    total = np.where(
        (lines >= FEWEST) & (np.abs(offset) <= 0.45 * UNIT), lines - loss[..., None] - OFF * offset**2, -np.inf
    )
    score, c, h, a, side = best_single(lines, FEWEST, loss, aside, LATERAL, 0.5 * UNIT, 0.45 * UNIT, OFF)
    assert total[c, h, a] == total.max()
    assert score == pytest.approx(float(total.max()))
    assert side == (1 if distance[c, h, a] > 0.0 else -1)
    assert best_single(lines, 99, loss, aside, LATERAL, 0.5 * UNIT, 0.45 * UNIT, OFF)[0] == -np.inf
