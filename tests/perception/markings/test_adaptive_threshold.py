"""Sure markings and sharp faint ones count, wide faint areas do not."""

from __future__ import annotations

import numpy as np
import pytest

from automodel.perception.markings.binary_views import adaptive_threshold


def mask(width: int = 512) -> np.ndarray:
    return np.zeros((width // 2, width), np.uint8)


@pytest.mark.parametrize("width", [256, 512])
def test_a_faint_thin_line_counts_and_a_faint_area_does_not(width: int) -> None:
    probability = mask(width)
    line, area = np.s_[20:120, 60:63], np.s_[20:120, 120:200]
    probability[line] = probability[area] = 110
    out = adaptive_threshold(probability)
    assert (out[30:110, 61] >= 128).all()
    assert (out[40:100, 140:180] < 128).all()


def test_what_is_sure_counts_however_broad() -> None:
    probability = mask()
    probability[50:150, 100:200] = 200
    out = adaptive_threshold(probability)
    assert (out[50:150, 100:200] == 200).all()


def test_what_is_hardly_seen_never_counts() -> None:
    probability = mask()
    probability[20:120, 60:63] = 70
    assert adaptive_threshold(probability).max() < 128


def test_what_counts_is_raised_to_128_and_nothing_else_is_changed_in_order() -> None:
    probability = np.random.default_rng(0).integers(0, 256, (256, 512)).astype(np.uint8)
    before = probability.copy()
    out = adaptive_threshold(probability)
    assert (probability == before).all()
    counts = out >= 128
    assert (out[counts] == np.maximum(before[counts], 128)).all()
    assert (out[~counts] == np.minimum(before[~counts], 127)).all()
    assert not (adaptive_threshold(mask())).any()
