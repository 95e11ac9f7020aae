"""The car's motion from the floor before its camera."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from automodel.config import CarConfig
from automodel.geometry import GroundCamera
from automodel.geometry.se2 import SE2
from automodel.sim.appearance import Appearance
from automodel.sim.renderer import Renderer
from calibration import visual_odometry
from calibration.visual_odometry import FloorError, floor_view, motion_of

CAMERA = GroundCamera.from_config(CarConfig().camera)
LOOK = dataclasses.replace(
    Appearance.random(1, style="competition"),
    floor_texture="tiles",
    floor_contrast=1.0,
    floor_grey=90.0,
    lamps=(),
    shine=0.0,
)
PERIOD_NS = 50_000_000
SPEED_MPS = 0.5


def drive(look: Appearance, curvature_per_m: float, count: int) -> tuple[list[np.ndarray], list[int]]:
    """Views of the floor from a car on a circle."""
    renderer = Renderer((), (-20.0, -20.0, 20.0, 20.0), (), CAMERA, look)
    floor = floor_view(CAMERA)
    pose, views = SE2(1.0, 2.0, 0.3), []
    way = SPEED_MPS * PERIOD_NS * 1e-9
    for index in range(count):
        picture = renderer.render(pose.x_m, pose.y_m, pose.yaw_rad, SPEED_MPS, SPEED_MPS * curvature_per_m, index)
        views.append(floor.warp(picture))
        pose = pose @ SE2.arc(way, way * curvature_per_m)
    return views, [i * PERIOD_NS for i in range(count)]


@pytest.mark.parametrize("curvature_per_m", [0.0, 1.5, -1.5])
def test_the_motion_on_a_tiled_floor(curvature_per_m: float) -> None:
    views, t_ns = drive(LOOK, curvature_per_m, 24)
    found = motion_of(views, t_ns, floor_view(CAMERA))
    assert len(found.t_ns) >= 20
    assert float(np.median(found.speed_mps)) == pytest.approx(SPEED_MPS, rel=0.01)
    assert float(np.median(found.yaw_rate_radps)) == pytest.approx(SPEED_MPS * curvature_per_m, abs=0.01)
    assert found.t_ns[0] == PERIOD_NS // 2


def test_a_light_that_moves_with_the_car_is_no_floor() -> None:
    views, t_ns = drive(LOOK, 0.0, 24)
    rows, columns = np.indices(views[0].shape)
    spot = 60.0 * np.exp(-(((rows - 80) / 9.0) ** 2) - ((columns - 120) / 9.0) ** 2)
    lit = [np.clip(view + spot, 0, 255).astype(np.uint8) for view in views]
    found = motion_of(lit, t_ns, floor_view(CAMERA))
    assert float(np.median(found.speed_mps)) == pytest.approx(SPEED_MPS, rel=0.02)


def test_a_floor_without_a_pattern_is_refused() -> None:
    rng = np.random.default_rng(0)
    views = [rng.normal(60.0, 3.0, floor_view(CAMERA).mask.shape).astype(np.uint8) for _ in range(8)]
    with pytest.raises(FloorError, match="too plain or too dark; spread newspapers"):
        motion_of(views, [i * PERIOD_NS for i in range(8)], floor_view(CAMERA))


def test_no_pictures_are_refused() -> None:
    with pytest.raises(FloorError, match="does the camera work"):
        motion_of([], [], floor_view(CAMERA))


@pytest.mark.parametrize(("way_m", "turn_rad"), [(0.03, 0.0), (0.03, 0.08), (-0.02, -0.05), (0.0, 0.1)])
def test_a_warp_carries_the_floor_as_the_motion_does(way_m: float, turn_rad: float) -> None:
    view = floor_view(CAMERA).view
    warp = visual_odometry._warp_of(way_m, turn_rad, view)
    point = np.array([0.7, 0.1])
    after = SE2.arc(way_m, turn_rad).inverse().apply(point)
    column, row = view.to_px(point)
    assert warp @ (column, row, 1.0) == pytest.approx(view.to_px(after), abs=1e-3)
    assert visual_odometry._motion_of_warp(warp, view) == pytest.approx((way_m, turn_rad), abs=2e-6)
