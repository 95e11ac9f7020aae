"""What stands above the horizon."""

import numpy as np
import pytest

from automodel.training.backdrops import backdrop


@pytest.mark.parametrize(("width", "height"), [(512, 256), (256, 128), (1280, 720)])
@pytest.mark.parametrize("share", [-0.5, 0.0, 0.01, 0.4, 1.0, 1.7])
def test_any_size_and_any_horizon(width, height, share):
    for seed in range(12):
        image = backdrop(np.random.default_rng(seed), width, height, share * height)
        assert image.shape == (height, width)
        assert image.dtype == np.uint8


def test_one_seed_gives_one_picture():
    for seed in range(20):
        first, second = (backdrop(np.random.default_rng(seed), 512, 256, 90.0) for _ in range(2))
        np.testing.assert_array_equal(first, second)


def test_bright_thin_bars_stand_above_the_horizon_in_many():
    """A bar is a pixel far brighter than what lies 6 px to either side of it, along a row or a column."""
    found = []
    for seed in range(80):
        grey = backdrop(np.random.default_rng(seed), 512, 256, 120.0)[:118].astype(float)
        upright = np.minimum(grey[:, 6:-6] - grey[:, :-12], grey[:, 6:-6] - grey[:, 12:])
        level = np.minimum(grey[6:-6] - grey[:-12], grey[6:-6] - grey[12:])
        found.append(max((upright > 40).mean(), (level > 40).mean()))
    assert np.mean(np.array(found) > 0.005) > 0.4


def test_backdrops_differ():
    images = [backdrop(np.random.default_rng(seed), 512, 256, 120.0)[:120] for seed in range(60)]
    means = np.array([p.mean() for p in images])
    assert means.min() < 50 < 180 < means.max()
    assert np.median([p.std() for p in images]) > 25
