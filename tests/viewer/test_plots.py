from __future__ import annotations

import numpy as np
import pytest

from automodel.viewer.plots import binned


def test_a_bound_that_holds_lies_above_its_curve() -> None:
    bounds = np.geomspace(0.01, 1.0, 1000)
    x, y = binned(bounds, 0.5 * bounds)
    assert len(x) == 10
    assert y == pytest.approx(np.repeat(0.5 * x[:, None], 3, axis=1))
    errors = 0.5 * bounds
    errors[-1] = 3.0  # beyond its bound: above the diagonal in the last bin, and there alone
    x, y = binned(bounds, errors)
    assert (y[:, 2] > x).tolist() == 9 * [False] + [True]


def test_too_few_frames_give_no_curve() -> None:
    x, y = binned(np.ones(20), np.ones(20))
    assert (len(x), len(y)) == (0, 0)
