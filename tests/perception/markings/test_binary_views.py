"""Binary views of an image seen from above: thresholds, feature points of masks of any size, paint that stays."""

from __future__ import annotations

import functools
from dataclasses import replace

import cv2
import numpy as np
import pytest

from automodel.config import CameraConfig, CarConfig, Extrinsics, Intrinsics
from automodel.geometry import BirdsEye, GroundCamera, View
from automodel.perception.markings.binary_views import (
    FeaturePoints,
    adaptive_threshold,
    resized_camera,
    share_above,
)
from tests.support.drawn_roads import MARKING_M, Road
from tests.support.drawn_views import Shape, disc, share

CAMERA = CarConfig().camera
VIEW = View(x_near_m=0.36, x_far_m=1.96, half_width_m=0.64, m_per_px=0.008)
LONG_ROWS = replace(VIEW, m_per_row=0.012)
FISHEYE = CameraConfig(
    width_px=640,
    height_px=480,
    intrinsics=Intrinsics(fx_px=330.0, fy_px=330.0, cx_px=319.5, cy_px=239.5, distortion=(-0.15, 0.01, 0.0, 0.0, 0.0)),
    extrinsics=Extrinsics(z_m=0.2, pitch_rad=0.35),
)
NETWORK = (512, 256)
SIZES = [(640, 360), NETWORK, (256, 128)]


@functools.lru_cache
def ground_under(camera: CameraConfig, size_px: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Body x and y (4, h, w) under four points of each pixel of a mask: pixels cut the image into equal parts."""
    seen, (width, height) = GroundCamera.from_config(camera), size_px
    v, u = np.mgrid[0:height, 0:width]
    parts = [(u + a, v + b) for a in (0.25, 0.75) for b in (0.25, 0.75)]
    scale = np.array([camera.width_px / width, camera.height_px / height])
    ground = seen.px_to_ground(np.stack([np.stack(part, axis=-1) for part in parts]) * scale - 0.5)
    ground = np.nan_to_num(ground, nan=-9.0)
    return ground[..., 0], ground[..., 1]


def mask_of(camera: CameraConfig, size_px: tuple[int, int], *shapes: Shape) -> np.ndarray:
    """The mask of painted ground at a size."""
    painted = np.any([shape(*ground_under(camera, size_px)) for shape in shapes], axis=0)
    return np.round(255.0 * painted.mean(axis=0)).astype(np.uint8)


def centred(features: np.ndarray, view: View, road: Road, d_m: float) -> np.ndarray:
    """How far the middle of each row of a line's pixels lies beside the line [m], for rows with few pixels missing."""
    errors = []
    for row, line in enumerate(features):
        columns = np.flatnonzero(line)
        if len(columns) == 0 or columns[0] == 0 or columns[-1] == len(line) - 1:
            continue
        x, y = view.to_body(np.array([columns.mean(), row]))
        errors.append(float(road.beside(np.array([x]), np.array([y]))[0]) - d_m)
    return np.array(errors)


def test_pictures_resized_are_those_of_the_resized_camera() -> None:
    ground = np.array([[0.5, 0.1], [1.0, -0.3], [2.0, 0.6]])
    for camera in (CAMERA, FISHEYE):
        u, v = GroundCamera.from_config(camera).ground_to_px(ground).T
        for width, height in SIZES:
            small = GroundCamera.from_config(resized_camera(camera, width, height)).ground_to_px(ground)
            np.testing.assert_allclose(small[:, 0], (u + 0.5) * width / camera.width_px - 0.5, atol=1e-9)
            np.testing.assert_allclose(small[:, 1], (v + 0.5) * height / camera.height_px - 0.5, atol=1e-9)


def test_cv2_resizes_about_the_same_points() -> None:
    """A blob's middle in an image that OpenCV makes smaller lies where the resized camera has it."""
    picture = np.zeros((360, 640), np.float32)
    cv2.circle(picture, (413, 207), 20, 1.0, -1)
    for width, height in (NETWORK, (256, 128), (320, 180)):
        small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
        v, u = np.mgrid[0:height, 0:width]
        assert float((u * small).sum() / small.sum()) == pytest.approx((413 + 0.5) * width / 640 - 0.5, abs=0.05)
        assert float((v * small).sum() / small.sum()) == pytest.approx((207 + 0.5) * height / 360 - 0.5, abs=0.05)


@pytest.mark.parametrize("view", [VIEW, LONG_ROWS], ids=["square", "long rows"])
@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=["default", "fisheye"])
@pytest.mark.parametrize("size_px", SIZES)
def test_a_line_lies_where_it_is_whatever_the_masks_size(
    view: View, camera: CameraConfig, size_px: tuple[int, int]
) -> None:
    road, d = Road(heading_rad=0.1), 0.07
    features = FeaturePoints(camera, view, MARKING_M).step(mask_of(camera, size_px, road.line(d)))
    assert set(np.unique(features)) == {0, 255}
    near = features[view.height_px // 3 :]  # further out a pixel of a small mask is as long as a step of the line
    near = np.vstack((np.zeros_like(features[: view.height_px // 3]), near))
    error = centred(near, view, road, d)
    assert len(error) > 0.4 * view.height_px
    assert abs(error.mean()) < 0.1 * view.m_per_px
    assert np.abs(error).max() < 1.1 * view.m_per_px


def test_a_lines_width_is_kept() -> None:
    features = FeaturePoints(CAMERA, VIEW, MARKING_M).step(mask_of(CAMERA, NETWORK, Road().line(0.0)))
    wide = (features > 0).sum(axis=1)[60:]
    assert wide.mean() == pytest.approx(MARKING_M / VIEW.m_per_px, abs=0.6)


def test_only_what_the_camera_sees_counts() -> None:
    points = FeaturePoints(CAMERA, VIEW, MARKING_M)
    np.testing.assert_array_equal(points.visible, BirdsEye(GroundCamera.from_config(CAMERA), VIEW).mask)
    full = points.step(np.full((256, 512), 255, np.uint8))
    assert (full[points.visible == 0] > 0).mean() < 0.01  # the edge itself, at another size
    assert (full[points.visible > 0] > 0).mean() > 0.99
    assert not points.step(np.zeros((256, 512), np.uint8)).any()


def turned(**angles: float) -> CameraConfig:
    return replace(CAMERA, extrinsics=replace(CAMERA.extrinsics, **angles))


@pytest.mark.parametrize(
    ("camera", "least"),
    [
        (CAMERA, 0.2),
        (FISHEYE, 0.1),
        (turned(pitch_rad=0.1), 0.4),
        (turned(roll_rad=0.1), 0.15),
        (turned(yaw_rad=0.3), 0.2),
        (turned(pitch_rad=0.7), 0.0),
    ],
    ids=["default", "fisheye", "looks far", "rolled", "looks left", "looks down"],
)
def test_what_lies_above_the_views_ground_is_not_needed(camera: CameraConfig, least: float) -> None:
    """A mask without the rows above gives the same features; without some more rows it does not."""
    above = share_above(GroundCamera.from_config(camera), VIEW)
    assert above >= least
    rng, points = np.random.default_rng(3), FeaturePoints(camera, VIEW, MARKING_M)
    for width, height in SIZES[1:]:  # the networks'
        noise = cv2.GaussianBlur(rng.integers(0, 256, (height, width), dtype=np.uint8), (5, 5), 0).astype(np.float64)
        mask = np.clip(4.0 * (noise - 127.0) + 127.0, 0.0, 255.0).astype(np.uint8)
        whole = points.step(adaptive_threshold(mask))
        assert whole.any()
        cut, more = mask.copy(), mask.copy()
        cut[: int(above * height)] = 0
        more[: int(above * height + 0.12 * height)] = 0
        np.testing.assert_array_equal(points.step(adaptive_threshold(cut)), whole)
        assert (points.step(adaptive_threshold(more)) != whole).any()


@pytest.mark.parametrize("marking_px", [3.0, 3.75, 5.0, 6.0, 7.5, 10.0])
def test_cleaning_shifts_nothing(marking_px: float) -> None:
    view = replace(VIEW, m_per_px=MARKING_M / marking_px, m_per_row=MARKING_M / marking_px)
    points = FeaturePoints(CAMERA, view, MARKING_M)
    road = Road(heading_rad=0.2)
    below = replace(view, x_far_m=view.x_far_m - view.height_px // 2 * view.m_per_row)
    error = centred(points.step(mask_of(CAMERA, (640, 360), road.line(0.0)))[view.height_px // 2 :], below, road, 0.0)
    assert abs(error.mean()) < 0.15 * view.m_per_px


def test_specks_go_and_holes_are_filled() -> None:
    view = replace(VIEW, m_per_px=0.005, m_per_row=0.005)
    points = FeaturePoints(CAMERA, view, MARKING_M)
    clean = mask_of(CAMERA, (640, 360), Road().line(0.0))
    specks = [disc(0.5 + 0.08 * k, 0.1 * (-1) ** k, 0.006) for k in range(6)]
    holes = [disc(0.5 + 0.08 * k, 0.0, 0.006) for k in range(6)]
    spoilt = cv2.subtract(clean, mask_of(CAMERA, (640, 360), *holes))
    spoilt = cv2.add(spoilt, mask_of(CAMERA, (640, 360), *specks))
    wanted, got = points.step(clean) > 0, points.step(np.asarray(spoilt, dtype=np.uint8)) > 0
    at_holes, at_specks = (share(view, *shapes) > 0.5 for shapes in (holes, specks))
    assert got[at_holes].mean() > 0.9
    assert got[at_specks].mean() < 0.1
    assert (got == wanted).mean() > 0.998


def test_the_threshold_is_a_probability() -> None:
    faint = np.minimum(mask_of(CAMERA, NETWORK, Road().line(0.0)), 100)
    assert FeaturePoints(CAMERA, VIEW, MARKING_M, threshold=0.3).step(faint).any()
    assert not FeaturePoints(CAMERA, VIEW, MARKING_M, threshold=0.5).step(faint).any()
    for threshold in (0.0, 1.0, 128.0):
        with pytest.raises(ValueError, match="threshold"):
            FeaturePoints(CAMERA, VIEW, MARKING_M, threshold=threshold)


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
    probability[20:120, 60:63] = 30
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
