"""Floors and the noise they are made of: repeatable, tileable, varied."""

import numpy as np
import pytest

from automodel.training import noise
from automodel.training.textures import Tile, floor_tile, roadside_tile

LAYERS = {
    "band": lambda: noise.band(16.0),
    "band drawn out": lambda: noise.band(64.0, 20.0),
    "fractal": lambda: noise.fractal(1.4),
    "stains": lambda: noise.stains(),
    "leaves": lambda: noise.leaves(),
    "specks": lambda: noise.specks(8.0),
    "cracks": lambda: noise.cracks(24, 1, 0.4),
    "scratches": lambda: noise.cracks(14, 2, 0.03),
}


def steps(image):
    """RMS grey step between each row and the next, the last one back to the first: (512,)."""
    grey = image.astype(np.float64)
    return np.sqrt(((np.roll(grey, -1, axis=0) - grey) ** 2).mean(axis=1))


@pytest.mark.parametrize("make", LAYERS.values(), ids=LAYERS.keys())
def test_noise_runs_on_over_its_edges(make):
    layer = make()
    assert layer.shape == (1024, 1024)
    tile = layer[:512, :512]
    np.testing.assert_array_equal(layer[512:, 512:], tile)
    for image in (tile, tile.T):
        rise = steps(image)
        assert rise[-1] <= 1.5 * np.percentile(rise[:-1], 98) + 0.5
        assert rise[-1] >= 0.3 * np.percentile(rise[:-1], 2) - 0.5  # nor are its edges flat


def test_signed_noise_has_the_named_mean_and_spread():
    for layer in (noise.band(64.0), noise.fractal(1.4), noise.band(128.0, 20.0, 1)):
        assert layer[:512, :512].mean() == pytest.approx(noise.MIDDLE, abs=1.0)
        assert layer[:512, :512].std() == pytest.approx(noise.SPREAD, rel=0.05)


def test_adding_noise_gives_the_spread_asked_for():
    image = np.full((512, 512), 120, dtype=np.uint8)
    noise.add(image, noise.band(64.0), 12.0, np.random.default_rng(1))
    assert image.std() == pytest.approx(12.0, rel=0.05)
    assert image.mean() == pytest.approx(120.0, abs=1.0)


def test_band_noise_has_the_wavelength_asked_for():
    tile = noise.band(32.0)[:512, :512].astype(np.float64) - 128.0
    power = np.abs(np.fft.rfft2(tile)) ** 2
    radius = np.hypot(np.fft.fftfreq(512, 1 / 512)[:, None], np.fft.rfftfreq(512, 1 / 512)[None, :])
    assert (power * radius).sum() / power.sum() == pytest.approx(32.0, rel=0.5)


def test_drawn_out_noise_runs_along_the_rows():
    tile = noise.band(64.0, 20.0)[:512, :512]
    assert steps(tile).mean() > 5.0 * steps(tile.T).mean()


def test_a_crop_larger_than_the_bank_is_enlarged():
    assert noise.crop(noise.fractal(), np.random.default_rng(0), 700, 1300).shape == (700, 1300)


@pytest.mark.parametrize("make", [floor_tile, roadside_tile])
def test_tiles_are_square_grey_and_repeat_for_one_seed(make):
    for seed in range(40):
        tile, again = make(np.random.default_rng(seed)), make(np.random.default_rng(seed))
        assert isinstance(tile, Tile)
        assert tile.image.shape == (512, 512)
        assert tile.image.dtype == np.uint8
        np.testing.assert_array_equal(tile.image, again.image)
        assert tile.size_lanes == again.size_lanes
        assert 0.1 < tile.size_lanes < 12.0


@pytest.mark.parametrize("make", [floor_tile, roadside_tile])
def test_tiles_have_no_seam_that_their_inside_has_not(make):
    for seed in range(80):
        image = make(np.random.default_rng(seed)).image
        for turned in (image, image.T):
            rise = steps(turned)
            assert rise[-1] <= 3.0 * rise[:-1].max() + 1.0, seed


def test_smooth_tiles_show_no_step_at_all_at_the_seam():
    smooth = 0
    for seed in range(120):
        rise = steps(floor_tile(np.random.default_rng(seed)).image)
        if rise[:-1].max() < 2.0 * np.median(rise):  # no joint, no patch
            smooth += 1
            assert rise[-1] <= 2.0 * np.median(rise) + 0.5, seed
    assert smooth >= 20


def test_floors_differ_in_tone_and_roughness():
    images = [floor_tile(np.random.default_rng(seed)).image.astype(np.float64) for seed in range(80)]
    means, spreads = np.array([i.mean() for i in images]), np.array([i.std() for i in images])
    assert means.min() < 30 < 160 < means.max()
    assert spreads.min() < 4 < 20 < spreads.max()
    assert np.histogram(means, bins=np.arange(0, 256, 32))[0].max() < 40
