"""Bird's-eye views for training."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.config import Extrinsics, Intrinsics
from automodel.geometry import GroundCamera
from automodel.perception.markings.unet import BIRDSEYE, SIZES
from automodel.training import views
from automodel.training.cameras import WideLens
from automodel.training.scenes import Sample
from automodel.training.shapes import UNKNOWN
from automodel.training.views import AHEAD_LANES, HALF_LANES, from_above, make_view

WIDTH, HEIGHT = SIZES[BIRDSEYE]


def camera() -> GroundCamera:
    """Half a lane above the ground, looking ahead and down."""
    lens = WideLens(Intrinsics(fx_px=320.0, fy_px=320.0, cx_px=319.5, cy_px=179.5), 640, 360)
    return GroundCamera(lens, Extrinsics(x_m=0.0, z_m=0.5, pitch_rad=math.radians(25.0)))


def straight(seen_by: GroundCamera) -> Sample:
    """The picture of lines half a lane to the left and the right; what is right of the middle is unknown."""
    image, mask = np.full((360, 640), 90, np.uint8), np.zeros((360, 640), np.uint8)
    rows, columns = np.mgrid[0:360, 0:640]
    ground = seen_by.px_to_ground(np.stack((columns, rows), axis=-1))
    with np.errstate(invalid="ignore"):
        on_line = np.abs(np.abs(ground[..., 1]) - 0.5) < 0.03
        mask[on_line] = 255
        mask[on_line & (ground[..., 1] < 0.0)] = UNKNOWN
    image[on_line] = 220
    return Sample(image=image, mask=mask)


def test_a_sample_follows_from_its_seed() -> None:
    first, again, other = make_view(7), make_view(7), make_view(8)
    assert first.image.shape == first.mask.shape == (HEIGHT, WIDTH)
    assert first.image.dtype == first.mask.dtype == np.uint8
    assert np.array_equal(first.image, again.image)
    assert np.array_equal(first.mask, again.mask)
    assert not np.array_equal(first.image, other.image)


def test_many_samples_hold_lines_and_ground_without_any() -> None:
    shares = np.array([np.mean(make_view(seed).mask >= 128) for seed in range(40)])
    assert np.mean(shares > 0.005) > 0.6
    assert np.mean(shares == 0.0) > 0.02
    assert shares.max() < 0.3


def test_lines_lie_in_the_view_as_on_the_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SCALE", "PITCH_RAD", "HEIGHT"):
        monkeypatch.setattr(views, name, 0.0)
    seen = from_above(np.random.default_rng(0), camera(), straight(camera()))
    left = 0.5 * WIDTH - 0.5 - 0.5 * WIDTH / (2.0 * HALF_LANES)
    for row in range(0, HEIGHT - 30, 10):
        marked = np.flatnonzero(seen.mask[row] >= 128)
        assert marked.mean() == pytest.approx(left, abs=0.7)
        assert np.ptp(marked) + 1 == pytest.approx(0.06 * WIDTH / (2.0 * HALF_LANES), abs=1.5)
        assert (seen.image[row, marked] > 150).all()
        assert (seen.mask[row, WIDTH - 1 - marked] == UNKNOWN).any()  # the line that is not visible
    assert (seen.mask[-1, :20] == UNKNOWN).all()  # beside the picture


def test_the_camera_is_not_quite_set_as_believed() -> None:
    bottoms = []
    for seed in range(12):
        seen = from_above(np.random.default_rng(seed), camera(), straight(camera()))
        top, bottom = (float(np.flatnonzero(seen.mask[row] >= 128).mean()) for row in (5, HEIGHT - 40))
        bottoms.append(bottom)
        assert abs(top - bottom) < 30.0
    assert 2.0 < np.std(bottoms) < 8.0
    assert pytest.approx(2.0 * HALF_LANES / WIDTH) == AHEAD_LANES / HEIGHT  # square pixels, about
