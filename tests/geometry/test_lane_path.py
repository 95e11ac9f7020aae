"""The lane's step to its neighbour, against draws of lanes."""

from __future__ import annotations

import numpy as np
import pytest

from automodel.geometry.lane_path import OFFSET, ROAD, WIDTH, next_lane


@pytest.mark.parametrize("side", [1, -1])
def test_the_next_lane_lies_half_of_each_width_away(side: int) -> None:
    """The neighbours' widths differ from the lanes' own."""
    rng, width_sigma, size = np.random.default_rng(2), 0.4, ROAD + 3
    root = rng.normal(0.0, 0.1, (size, size))
    mean = rng.normal(0.0, 0.1, size) + 3.5 * (np.arange(size) == WIDTH)
    drawn = mean + rng.normal(size=(200_000, size)) @ root.T
    after = drawn.copy()
    after[:, WIDTH] += rng.normal(0.0, width_sigma, len(drawn))
    after[:, OFFSET] -= side * 0.5 * (drawn[:, WIDTH] + after[:, WIDTH])
    state, covariance = next_lane(mean, root @ root.T, side, width_sigma)
    np.testing.assert_allclose(state, after.mean(axis=0), atol=0.01)
    np.testing.assert_allclose(covariance, np.cov(after.T), atol=0.01)
