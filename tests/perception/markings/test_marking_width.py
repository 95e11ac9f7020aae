"""The measured width of markings, on drawn and rendered images."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from automodel.config import CarConfig, LaneConfig
from automodel.geometry import GroundCamera
from automodel.perception.markings.marking_width import PER_MARKING, MarkingWidth, continued, ridge_widths
from automodel.perception.markings.ridge_noise import least_ridge, rounding_noise
from automodel.sim.appearance import Appearance
from automodel.types import Image
from tests.support.masked_drives import line, road
from tests.support.rendered_drives import renderer

CAR = CarConfig()
CAMERA = GroundCamera.from_config(CAR.camera)
TRUE_M = 0.03
NOISES = least_ridge(1000.0), rounding_noise(2)


def rendered(marking_m: float = TRUE_M, yaw_rad: float = 0.0, noise: float = 1.0, **look: float) -> Image:
    eye = renderer(road(line(8.0), marking_m=marking_m), CAR, Appearance(read_noise=noise, **look))  # type: ignore[arg-type]
    return np.asarray(eye.render(1.0, 0.0, yaw_rad, 0.0, 0.0, 0), dtype=np.uint8)


def measured(images: list[Image], start_m: float, markings: str = "light") -> MarkingWidth:
    lane = LaneConfig(width_m=0.4, marking_width_m=start_m, markings=markings)
    width = MarkingWidth(CAMERA, lane, CAR.vehicle.reference_x_m)
    for image in images:
        width.step(image)
    return width


def rows_of(*marks: tuple[float, float], samples: int = 240, noise: float = 0.5) -> np.ndarray:
    """Eight rows of samples with marks (middle, width), on ground with noise."""
    at = np.arange(float(samples))
    row = np.full(samples, 60.0)
    for middle, width in marks:
        row += 100.0 * np.clip(
            np.minimum(at + 0.5, middle + 0.5 * width) - np.maximum(at - 0.5, middle - 0.5 * width), 0, 1
        )
    grain = np.random.default_rng(0).normal(0.0, noise, (8, samples))
    return np.asarray(row + grain, dtype=np.float32)


@pytest.mark.parametrize("width", [3.5, 5.0, 8.0, 12.0, 18.0])
def test_a_ridge_has_its_width_at_any_scale(width: float) -> None:
    values = rows_of((120.3, width))
    row, at, widths, heights = ridge_widths(values, np.ones(values.shape, bool), *NOISES)
    assert row.tolist() == list(range(8))  # one on each row
    assert np.abs(at - 120.3).max() < 1.0 + 0.3 * width
    assert widths == pytest.approx(width, rel=0.08)
    assert (heights > 50.0).all()


def test_bars_side_by_side_edges_and_noise_are_no_markings() -> None:
    for values in (rows_of(*((60.0 + 16.0 * k, 8.0) for k in range(8))), rows_of((180.0, 100.0))):
        assert len(ridge_widths(values, np.ones(values.shape, bool), *NOISES)[0]) == 0
    values = rows_of(noise=20.0)
    ridges = ridge_widths(values, np.ones(values.shape, bool), *NOISES)
    assert len(continued(*ridges, np.arange(8) * 8.0)[0]) <= 2


def test_what_does_not_go_on_in_the_next_row_does_not_count_and_a_slant_is_undone() -> None:
    row, at = np.array([0, 1, 2, 3]), np.array([50, 58, 66, 150])
    widths, ahead = np.full(4, 8.0 * math.sqrt(2.0) * 0.99), np.arange(4) * 8.5
    across, heights = continued(row, at, widths, np.arange(4.0), ahead)
    assert across == pytest.approx([8.0, 8.0], rel=0.05)
    assert heights.tolist() == [0.0, 1.0]


@pytest.mark.parametrize(("on_ray", "counts"), [(True, 0), (False, 3)])
def test_what_points_to_the_camera_does_not_count(on_ray: bool, counts: int) -> None:
    """A streak lies on a ray from the ground below the camera, 40 samples before the nearest row."""
    ahead = np.array((100.0, 80.0, 60.0, 40.0))
    rays, lines = (0.5 * ahead).round().astype(int), np.full(4, 50)
    at = rays if on_ray else lines
    across, _ = continued(np.arange(4), at, np.full(4, 8.0), np.ones(4), ahead, (0.0, 0.0))
    assert len(across) == counts


@pytest.mark.parametrize("factor", [0.5, 0.7, 1.0, 1.5, 2.0])
@pytest.mark.parametrize("yaw_rad", [0.0, 0.35])
def test_the_width_is_found_from_half_of_it_to_twice_of_it(factor: float, yaw_rad: float) -> None:
    width = measured([rendered(yaw_rad=yaw_rad)] * 16, factor * TRUE_M)
    assert width.measured_m == pytest.approx(TRUE_M, rel=0.15)
    assert width.width_m / TRUE_M == pytest.approx(1.0, rel=0.2)
    assert bool(width.warning) == (factor != 1.0)
    assert factor == 1.0 or f"marking_width_m = {factor * TRUE_M:.3g}: the markings are 0.0" in width.warning


def test_noise_and_dark_lines() -> None:
    noisy = [np.clip(rendered() + np.random.default_rng(k).normal(0.0, 20.0, (360, 640)), 0, 255) for k in range(16)]
    assert measured([image.astype(np.uint8) for image in noisy], 2.0 * TRUE_M).width_m == pytest.approx(TRUE_M, rel=0.2)
    for markings in ("dark", "both"):
        width = measured([np.asarray(255 - rendered(), dtype=np.uint8)] * 16, 0.5 * TRUE_M, markings)
        assert width.width_m == pytest.approx(TRUE_M, rel=0.15)


def test_a_bare_floor_changes_nothing() -> None:
    grain = [np.random.default_rng(k).normal(90.0, 12.0, (360, 640)).astype(np.uint8) for k in range(40)]
    width = measured(grain, TRUE_M)
    assert width.width_m == TRUE_M
    assert not width.warning


def test_it_says_once_that_the_width_has_changed_and_starts_again() -> None:
    image = rendered()
    width = measured([], 2.0 * TRUE_M)
    assert [width.step(image) for _ in range(40)].count(True) == 1
    width.reset()
    assert width.width_m == 2.0 * TRUE_M
    assert not width.warning
    assert PER_MARKING == 8


def test_the_right_width_is_left_alone() -> None:
    car = replace(CAR, lane=replace(CAR.lane, marking_width_m=TRUE_M))
    width = MarkingWidth(CAMERA, car.lane, CAR.vehicle.reference_x_m)
    assert not any(width.step(rendered(yaw_rad=yaw)) for yaw in np.linspace(-0.5, 0.5, 21))
