"""Projected lines against the camera's own projection, point by point and by differences."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from automodel.config import Extrinsics, Intrinsics
from automodel.geometry import CameraModel, GroundCamera
from automodel.geometry.line_projection import LineProjection
from automodel.types import FloatArray

LENSES = {
    "none": (0.0, 0.0, 0.0, 0.0, 0.0),
    "barrel": (-0.28, 0.07, 0.0, 0.0, 0.0),
    "tangential": (0.0, 0.0, 0.004, -0.006, 0.0),
    "folding": (-0.3, 0.0, 0.0, 0.0, 0.0),
    "all": (-0.25, 0.08, 0.003, -0.002, -0.01),
}
ASIDE, STEP = 0.21, 1e-5
PLACE = np.array([0.55 + 0.05j, 0.8 - 0.03j, 1.2 + 0.2j, 2.5 - 0.4j])
ALONG = np.exp(1j * np.array([0.0, -0.3, 0.25, 0.6]))


def camera(lens: str) -> GroundCamera:
    intrinsics = Intrinsics(fx_px=470.0, fy_px=495.0, cx_px=311.0, cy_px=188.0, distortion=LENSES[lens])
    mounted = Extrinsics(x_m=0.21, y_m=0.02, z_m=0.19, pitch_rad=0.24, yaw_rad=0.05, roll_rad=-0.04)
    return GroundCamera(CameraModel(intrinsics, 640, 360), mounted)


def pixels(ground: GroundCamera, points: NDArray[np.complex128]) -> FloatArray:
    """Ground points (n,) as complex numbers -> pixels (2, n)."""
    return ground.ground_to_px(np.stack((points.real, points.imag), axis=-1)).T


def both_lines() -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Points (2 n,) of the left and the right line, and their tangents."""
    points = np.concatenate((PLACE + ASIDE * 1j * ALONG, PLACE - ASIDE * 1j * ALONG))
    return points, np.concatenate((ALONG, ALONG))


@pytest.mark.parametrize("lens", LENSES)
def test_points_lie_where_the_camera_sees_them(lens: str) -> None:
    ground = camera(lens)
    line = LineProjection(ground).project(PLACE, ALONG, ASIDE)
    assert line.place == pytest.approx(pixels(ground, both_lines()[0]), abs=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_tangents_and_areas_are_the_differences_of_pixels(lens: str) -> None:
    ground = camera(lens)
    line = LineProjection(ground).project(PLACE, ALONG, ASIDE)
    points, along = both_lines()

    def slope(direction: NDArray[np.complex128]) -> FloatArray:
        return (pixels(ground, points + STEP * direction) - pixels(ground, points - STEP * direction)) / (2.0 * STEP)

    assert line.along == pytest.approx(slope(along), rel=1e-6, abs=1e-4)
    ahead, left = slope(np.ones_like(along)), slope(1j * np.ones_like(along))
    assert line.area == pytest.approx(ahead[0] * left[1] - ahead[1] * left[0], rel=1e-6)
    assert (line.area < 0.0).all()


@pytest.mark.parametrize("lens", LENSES)
def test_a_shift_to_the_left_moves_the_line_along_its_row_as_stated(lens: str) -> None:
    ground, delta = camera(lens), 1e-5
    line = LineProjection(ground).project(PLACE, ALONG, ASIDE)
    points, along = both_lines()
    # The shifted line's crossing of the node's row, found on the line itself by bisection.
    low, high = np.full(len(points), -0.05), np.full(len(points), 0.05)
    for _ in range(50):
        middle = 0.5 * (low + high)
        below = pixels(ground, points + delta * 1j * along + middle * along)[1] > line.place[1]
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    moved = pixels(ground, points + delta * 1j * along + low * along)[0] - line.place[0]
    assert moved / delta == pytest.approx(-line.area / line.along[1], rel=1e-3)
    assert (moved < 0.0).all()  # left in the world is left in the image


def test_beyond_the_fold_of_the_lens_points_lie_far_outside_the_picture() -> None:
    ground = camera("folding")
    place = np.array([0.6 + 0j, 0.6 + 0.6j, 0.6 - 0.6j])  # the lens model folds the last two back into view
    along = np.ones(3, complex)
    seen = np.isfinite(pixels(ground, place)[0])
    assert seen.tolist() == [True, False, False]  # as the camera says
    u, v = LineProjection(ground).project(place, along, 0.0).place
    inside = (u > -1e3) & (u < 1640) & (v > -1e3) & (v < 1360)
    assert inside.tolist() == [True, False, False] * 2


@pytest.mark.parametrize("lens", LENSES)
def test_what_lies_behind_or_under_the_camera_stays_finite(lens: str) -> None:
    place = np.array([-1.0 + 0.1j, 0.21 + 0.02j, 0.0 + 0j])
    line = LineProjection(camera(lens)).project(place, np.ones(3, complex), ASIDE)
    assert np.isfinite(line.values).all()


def test_single_precision_is_kept_and_good_to_a_hundredth_of_a_pixel() -> None:
    ground = camera("all")
    narrow = LineProjection(ground, np.float32).project(PLACE.astype(np.complex64), ALONG.astype(np.complex64), ASIDE)
    wide = LineProjection(ground).project(PLACE, ALONG, ASIDE)
    assert narrow.values.dtype == np.float32
    assert narrow.place == pytest.approx(wide.place, abs=0.01)
