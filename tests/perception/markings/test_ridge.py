"""The ridge filter on drawn and rendered images."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest

from automodel.config import CameraConfig, CarConfig, Extrinsics, Intrinsics
from automodel.geometry import GroundCamera
from automodel.perception.markings.ridge import RidgeFilter, apparent_width_px, ridge_image, ridge_sums
from tests.support.drawn_views import Shape, line_at

MARKING_M = 0.03
CAMERA = GroundCamera.from_config(CarConfig().camera)
HD = GroundCamera.from_config(
    CameraConfig(
        width_px=1280,
        height_px=720,
        intrinsics=Intrinsics(fx_px=960.0, fy_px=960.0, cx_px=639.5, cy_px=359.5),
        extrinsics=Extrinsics(),
    )
)


@functools.lru_cache
def ground_of(camera: GroundCamera, dx: float = 0.0, dy: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Body x and y at each pixel; above the horizon far behind the car."""
    v, u = np.mgrid[0 : camera.camera.height_px, 0 : camera.camera.width_px]
    ground = np.nan_to_num(camera.px_to_ground(np.stack((u + dx, v + dy), axis=-1)), nan=-99.0)
    return ground[..., 0], ground[..., 1]


def share(camera: GroundCamera, *shapes: Shape) -> np.ndarray:
    """How much of each pixel is painted."""
    steps = (-0.33, 0.0, 0.33)
    hits = [np.any([s(*ground_of(camera, dx, dy)) for s in shapes], axis=0) for dx in steps for dy in steps]
    return np.mean(hits, axis=0)


def picture(drawn: np.ndarray, floor: float = 50.0, paint: float = 190.0, noise: float = 2.0) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.clip(floor + (paint - floor) * drawn + rng.normal(0.0, noise, drawn.shape), 0, 255).astype(np.uint8)


NEAR = (ground_of(CAMERA)[0] > 0.0) & (ground_of(CAMERA)[0] < 2.0)


def full_size(markings: RidgeFilter) -> bool:
    return markings.size_px == (CAMERA.camera.width_px, CAMERA.camera.height_px)


class Whole(RidgeFilter):
    """At the image's own size, so that evidence and drawing can be compared pixel by pixel."""

    MAX_WIDTH_PX = 4096


def evidence(drawn: np.ndarray, **options: float) -> np.ndarray:
    markings = Whole.of_camera(CAMERA, MARKING_M)
    assert full_size(markings)
    return markings.step(picture(drawn, **options)) >= Whole.LEVEL


def test_the_apparent_width_is_the_markings_width_over_its_depth() -> None:
    width = apparent_width_px(CAMERA, MARKING_M)
    extrinsics, intrinsics = CarConfig().camera.extrinsics, CarConfig().camera.intrinsics
    for v in (100, 180, 250, 359):
        below = math.atan2(v - intrinsics.cy_px, intrinsics.fy_px) + extrinsics.pitch_rad  # angle under the horizon
        depth = extrinsics.z_m / math.sin(below) * math.cos(below - extrinsics.pitch_rad)
        assert width[v] == pytest.approx(MARKING_M * intrinsics.fx_px / depth, rel=1e-6)
    horizon = intrinsics.cy_px - intrinsics.fy_px * math.tan(extrinsics.pitch_rad)
    assert (width[: int(horizon)] == 0.0).all()
    assert (np.diff(width[int(horizon) + 2 :]) > 0.0).all()


@pytest.mark.parametrize("slope", [0.0, 0.3, -0.3, 0.7])
def test_lines_are_found_whole_and_nothing_else_is(slope: float) -> None:
    drawn, about = (share(CAMERA, *(line_at(y, w * MARKING_M, slope) for y in (0.15, -0.2))) for w in (1.0, 1.5))
    found = evidence(drawn)
    u = np.arange(drawn.shape[1])
    inside = NEAR & (u > 100) & (u < 540)  # a line that the image's edge cuts has one side only
    assert found[inside & (drawn > 0.9)].mean() > (0.93 if abs(slope) < 0.5 else 0.75)  # an oblique one looks broader
    assert found[inside & (about == 0.0)].mean() < 1e-4


def test_the_evidence_is_as_wide_as_the_line_and_on_it() -> None:
    drawn = share(CAMERA, line_at(0.0))
    found = evidence(drawn)
    u = np.arange(drawn.shape[1])
    for row in (150, 200, 250, 300, 350):
        true, got = drawn[row], found[row]
        assert got.sum() == pytest.approx(true.sum(), rel=0.2, abs=1.5)
        assert (got * u).sum() / got.sum() == pytest.approx((true * u).sum() / true.sum(), abs=0.5)


def test_nothing_above_the_horizon() -> None:
    striped = np.tile(np.where(np.arange(640) % 40 < 6, 255, 20).astype(np.uint8), (360, 1))
    found = Whole.of_camera(CAMERA, MARKING_M).step(striped)
    horizon = int(np.flatnonzero(apparent_width_px(CAMERA, MARKING_M) > 0)[0])
    assert not found[:horizon].any()
    assert found[horizon:].any()


def test_wide_areas_and_their_rims_have_no_evidence() -> None:
    area = share(CAMERA, line_at(0.1, 0.2))
    assert evidence(area)[NEAR].mean() < 0.003
    edge = share(CAMERA, lambda x, y: (y > 0.0) & (x > 0.0))
    assert evidence(edge)[NEAR].mean() < 0.003


def test_light_that_changes_slowly_has_no_say() -> None:
    drawn, about = share(CAMERA, line_at(0.0)), share(CAMERA, line_at(0.0, 1.5 * MARKING_M))
    light = np.linspace(0.4, 1.2, drawn.shape[1])
    grey = np.clip((50.0 + 140.0 * drawn) * light, 0, 255).astype(np.uint8)
    found = Whole.of_camera(CAMERA, MARKING_M).step(grey) >= Whole.LEVEL
    assert found[NEAR & (drawn > 0.9)].mean() > 0.9
    assert not found[NEAR & (about == 0.0)].any()


def test_dark_markings_are_bright_ones_of_the_negative() -> None:
    grey = picture(share(CAMERA, line_at(0.0)))
    bright = RidgeFilter.of_camera(CAMERA, MARKING_M).step(grey)
    dark = RidgeFilter.of_camera(CAMERA, MARKING_M, markings="dark").step(255 - grey)
    assert (np.abs(bright.astype(int) - dark) <= 16).mean() > 0.99  # rounding
    assert bright.max() == dark.max() == 255
    assert not (RidgeFilter.of_camera(CAMERA, MARKING_M, markings="dark").step(grey) >= 128)[200:, 300:340].any()
    both = RidgeFilter.of_camera(CAMERA, MARKING_M, markings="both")
    for image in (grey, 255 - grey):
        assert ((both.step(image) >= 128) == (bright >= 128)).mean() > 0.99


class TestLevel:
    def test_it_lies_between_two_classes(self) -> None:
        """Texture of 20 grey levels beside markings of 140: the image sets the level, not the contrast."""
        markings = Whole.of_camera(CAMERA, MARKING_M)
        texture = share(CAMERA, *(line_at(y) for y in (-0.45, -0.3, 0.3, 0.45)))
        paint = share(CAMERA, line_at(0.0), line_at(0.15), line_at(-0.15))
        grey = np.round(50.0 + 25.0 * texture + 140.0 * paint).astype(np.uint8)
        found = markings.step(grey) >= Whole.LEVEL
        assert found[NEAR & (paint > 0.9)].mean() > 0.9
        assert found[NEAR & (texture > 0.9)].mean() < 0.05
        alone = markings.step(np.round(50.0 + 25.0 * texture).astype(np.uint8)) >= Whole.LEVEL
        assert alone[NEAR & (texture > 0.9)].mean() > 0.8

    @pytest.mark.parametrize("grey", [0, 128, 255])
    def test_bare_pictures_have_no_evidence(self, grey: int) -> None:
        assert not RidgeFilter.of_camera(CAMERA, MARKING_M).step(np.full((360, 640), grey, np.uint8)).any()

    @pytest.mark.parametrize("noise", [2.0, 4.0, 20.0])
    def test_noise_is_no_marking_and_a_line_of_three_noises_is_one(self, noise: float) -> None:
        grain = np.random.default_rng(1).normal(0.0, noise, (360, 640))
        markings = RidgeFilter.of_camera(CAMERA, MARKING_M)
        bare = np.clip(120.0 + grain, 0, 255).astype(np.uint8)
        assert (markings.step(bare) >= RidgeFilter.LEVEL).mean() < 2e-3
        drawn = share(CAMERA, line_at(0.0))
        found = Whole.of_camera(CAMERA, MARKING_M).step(np.clip(bare + 3.0 * noise * drawn, 0, 255).astype(np.uint8))
        assert (found >= Whole.LEVEL)[NEAR & (drawn > 0.9)].mean() > 0.65

    @pytest.mark.parametrize(("window", "apart"), [(1, 8), (5, 6), (9, 12)])
    def test_images_and_rows_have_the_same_filter(self, window: int, apart: int) -> None:
        grey = np.random.default_rng(2).integers(0, 256, (4, 90)).astype(np.uint8)
        sums = np.cumsum(np.pad(grey.astype(np.int32), ((0, 0), (1, 0))), axis=1)
        rows = ridge_sums(sums, window, apart) / window
        margin = apart + window // 2
        image = ridge_image(grey, window, window, apart)[:, margin : 90 - margin]
        assert image == pytest.approx(np.maximum(rows, 0.0), abs=1.0)  # rounding
        direct = grey[:, margin].astype(float) - np.maximum(grey[:, margin - apart], grey[:, margin + apart])
        assert window > 1 or (rows[:, 0] == direct).all()

    def test_faint_lines_count_from_the_contrast_on(self) -> None:
        drawn = share(CAMERA, line_at(0.0))
        for rise, seen in ((9.0, False), (16.0, True)):
            grey = picture(drawn, 60.0, 60.0 + rise, noise=0.5)
            found = Whole.of_camera(CAMERA, MARKING_M, contrast=12.0).step(grey) >= Whole.LEVEL
            assert (found[NEAR & (drawn > 0.9)].mean() > 0.75) == seen


class TestSizes:
    def test_a_broad_picture_is_reduced_and_lines_stay_where_they_are(self) -> None:
        markings = RidgeFilter.of_camera(HD, MARKING_M)
        assert markings.size_px == (512, 288)
        drawn = share(HD, line_at(0.1))
        found = markings.step(picture(drawn)) >= RidgeFilter.LEVEL
        u, u_small = np.arange(1280), np.arange(512)
        for row in (120, 180, 240, 280):
            big = int((row + 0.5) * 2.5)
            true = (drawn[big] * u).sum() / drawn[big].sum()
            got = (found[row] * u_small).sum() / found[row].sum()
            assert got == pytest.approx((true + 0.5) * 0.4 - 0.5, abs=0.5)

    def test_a_picture_without_calibration_needs_the_widths_only(self) -> None:
        width = np.maximum(np.arange(120) - 40.0, 0.0) * 0.1
        markings = RidgeFilter(width, 160, contrast=8.0)
        assert markings.size_px == (160, 120)
        grey = np.full((120, 160), 70, np.uint8)
        for v in range(48, 120):
            grey[v, 80 - round(0.5 * width[v]) : 80 + round(0.5 * width[v]) + 1] = 200
        found = markings.step(grey) >= RidgeFilter.LEVEL
        assert found[50:, 80].mean() > 0.95
        assert not found[:, :60].any()
        assert not found[:40].any()

    def test_a_camera_that_sees_no_ground_gives_nothing(self) -> None:
        markings = RidgeFilter(np.zeros(48), 64)
        assert not markings.step(np.full((48, 64), 200, np.uint8)).any()

    def test_wrong_sizes_and_widths_are_refused(self) -> None:
        with pytest.raises(ValueError, match="image"):
            RidgeFilter.of_camera(CAMERA, MARKING_M).step(np.zeros((256, 512), np.uint8))
        for width in (np.array([[1.0]]), np.array([np.nan, 1.0])):
            with pytest.raises(ValueError, match="widths"):
                RidgeFilter(width, 64)
        with pytest.raises(ValueError, match="contrast"):
            RidgeFilter(np.ones(48), 64, contrast=-1.0)
