"""How far noise exceeds its own median, against drawn noise."""

from __future__ import annotations

import numpy as np
import pytest

from automodel.perception.markings.ridge_noise import FALSE_ALARMS, MEDIAN, least_ridge

DRAWN = 400_000


def ridges_of_noise() -> np.ndarray:
    m, left, right = np.random.default_rng(0).standard_normal((3, DRAWN))
    return np.asarray(m - np.maximum(left, right))


def test_the_median() -> None:
    assert np.median(np.abs(ridges_of_noise())) == pytest.approx(MEDIAN, rel=0.01)


@pytest.mark.parametrize("places", [10.0, 100.0, 3000.0])
def test_the_least_ridge_is_exceeded_as_often_as_wanted(places: float) -> None:
    found = float((ridges_of_noise() > least_ridge(places) * MEDIAN).mean())
    assert found == pytest.approx(FALSE_ALARMS / places, rel=0.2)
