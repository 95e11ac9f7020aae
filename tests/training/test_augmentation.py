"""Light on the ground and the camera's damage: within bounds, repeatable, and never so strong that nothing is left."""

import numpy as np
import pytest

from automodel.config import Extrinsics, Intrinsics
from automodel.geometry import CameraModel, GroundCamera
from automodel.training.augmentation import augment
from automodel.training.lighting import light


def camera(width=512, height=256, k1=0.0):
    lens = Intrinsics(
        fx_px=0.75 * width, fy_px=1.1 * height, cx_px=width / 2, cy_px=height / 2, distortion=(k1, 0.0, 0.0, 0.0, 0.0)
    )
    return GroundCamera(CameraModel(lens, width, height), Extrinsics(x_m=0.0, z_m=0.45, pitch_rad=0.2))


def road(width=512, height=256, floor=90, paint=190):
    """A grey ground with two upright bands of paint, and where they are."""
    image = np.full((height, width), floor, dtype=np.uint8)
    where = np.zeros(image.shape, dtype=bool)
    for u in (0.25, 0.7):
        where[:, int(u * width) : int((u + 0.04) * width)] = True
    image[where] = paint
    return image, where


@pytest.mark.parametrize("size", [(512, 256), (256, 128), (672, 376)])
def test_augmentation_keeps_the_form_and_leaves_its_input_alone(size):
    image, _ = road(*size)
    before = image.copy()
    for seed in range(40):
        out = augment(image, np.random.default_rng(seed))
        assert out.shape == before.shape
        assert out.dtype == np.uint8
        np.testing.assert_array_equal(image, before)


def test_augmentation_repeats_for_one_seed_and_differs_between_seeds():
    image, _ = road()
    outs = [augment(image, np.random.default_rng(seed)) for seed in range(20)]
    for seed, out in enumerate(outs):
        np.testing.assert_array_equal(out, augment(image, np.random.default_rng(seed)))
    assert len({out.tobytes() for out in outs}) == 20


def test_some_images_stay_almost_clean_and_most_do_not():
    image, _ = road()
    change = [np.abs(augment(image, np.random.default_rng(seed)).astype(float) - image).mean() for seed in range(200)]
    clean = np.mean(np.array(change) < 3.0)
    assert 0.08 <= clean <= 0.35


@pytest.mark.parametrize(("floor", "paint"), [(90, 190), (20, 120), (170, 250), (60, 100)])
def test_paint_stays_brighter_than_the_ground_in_nearly_every_picture(floor, paint):
    image, where = road(floor=floor, paint=paint)
    left = []
    for seed in range(120):
        out = augment(image, np.random.default_rng(seed)).astype(float)
        left.append((out[where].mean() - out[~where].mean()) / (paint - floor))
    assert np.mean(np.array(left) > 0.12) >= 0.97
    assert np.median(left) > 0.6


def test_two_versions_of_a_scene_share_their_tones_when_metered_alike():
    """Where they are the same and far from where they differ, they stay the same; metered apart, they do not."""
    painted, _ = road()
    bare = np.full_like(painted, 90)
    bare[:, 200:] = 170  # moves the median
    painted[:, 200:] = 90
    alike, own = [], []
    for seed in range(60):
        rngs = [np.random.default_rng(seed) for _ in range(4)]
        shared = [augment(p, r, bare)[:, :60].mean() for p, r in zip((bare, painted), rngs[:2], strict=True)]
        single = [augment(p, r)[:, :60].mean() for p, r in zip((bare, painted), rngs[2:], strict=True)]
        alike.append(abs(shared[0] - shared[1]))
        own.append(abs(single[0] - single[1]))
    assert np.percentile(alike, 80) < 1.5
    assert np.percentile(own, 80) > 10.0


@pytest.mark.parametrize("grey", [0, 255])
def test_augmentation_takes_a_black_or_white_picture(grey):
    flat = np.full((256, 512), grey, dtype=np.uint8)
    for seed in range(60):
        assert augment(flat, np.random.default_rng(seed)).shape == flat.shape


def test_augmentation_blurs_some_images_and_roughens_others():
    image, _ = road()
    edge = np.abs(np.diff(image.astype(float), axis=1)).max()
    outs = [augment(image, np.random.default_rng(seed)).astype(float) for seed in range(150)]
    sharpness = np.array([np.abs(np.diff(out, axis=1)).max(axis=1).mean() / np.ptp(out) for out in outs])
    roughness = np.array([np.abs(np.diff(out[:, 20:100], axis=0)).mean() for out in outs])
    assert edge == 100
    assert np.mean(sharpness < 0.3) > 0.1
    assert np.mean(sharpness > 0.8) > 0.1
    assert np.mean(roughness > 4.0) > 0.05
    assert np.mean(roughness < 1.5) > 0.1


@pytest.mark.parametrize("k1", [0.0, -0.3])
def test_light_stays_within_the_grey_scale_and_repeats(k1):
    view = camera(k1=k1)
    for seed in range(80):
        first, second = (road()[0].astype(np.float32) for _ in range(2))
        light(first, view, np.random.default_rng(seed))
        light(second, view, np.random.default_rng(seed))
        assert np.isfinite(first).all()
        assert first.min() >= 0.0
        assert first.max() <= 255.0
        np.testing.assert_array_equal(first, second)


def test_light_brightens_darkens_and_sometimes_does_nothing():
    view = camera()
    change = []
    for seed in range(200):
        image = np.full((256, 512), 100.0, dtype=np.float32)
        light(image, view, np.random.default_rng(seed))
        change.append(image - 100.0)
    untouched = np.mean([not c.any() for c in change])
    assert 0.05 < untouched < 0.6
    assert np.mean([(c > 60).mean() > 0.002 for c in change]) > 0.1
    assert np.mean([(c < -30).mean() > 0.01 for c in change]) > 0.1


def test_light_takes_any_camera():
    for lens, attitude in (
        (Intrinsics(fx_px=150.0, fy_px=90.0, cx_px=128.0, cy_px=64.0), Extrinsics(z_m=0.3, pitch_rad=1.2)),
        (Intrinsics(fx_px=400.0, fy_px=300.0, cx_px=128.0, cy_px=64.0), Extrinsics(z_m=0.6, pitch_rad=-0.1)),
    ):
        view = GroundCamera(CameraModel(lens, 256, 128), attitude)
        for seed in range(60):
            image = np.full((128, 256), 100.0, dtype=np.float32)
            light(image, view, np.random.default_rng(seed))
            assert np.isfinite(image).all()
