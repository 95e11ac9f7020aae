"""Pairs of drawn highway pictures, for cameras in the mirrors of a car that pitches, leans and bounces."""

from __future__ import annotations

import numpy as np

from automodel.config import Extrinsics, Intrinsics
from automodel.geometry import CameraModel, GroundCamera
from automodel.geometry.stereo_rig import Plane, StereoRig
from tests.support.highway_pictures import LANE_M, Line, draw

SIZE = (640, 480)


def mirror_cameras(baseline_m: float = 1.9, distortion: float = -0.05) -> StereoRig:
    """Two cameras that are not parallel, do not stand at one height, and have different lenses."""
    width, height = SIZE

    def camera(f_px: float, k1: float, **mount: float) -> GroundCamera:
        lens = Intrinsics(
            fx_px=f_px, fy_px=f_px, cx_px=0.5 * (width - 1), cy_px=0.5 * (height - 1), distortion=(k1, 0, 0, 0, 0)
        )
        return GroundCamera(CameraModel(lens, width, height), Extrinsics(**mount))

    half = 0.5 * baseline_m
    return StereoRig(
        camera(560.0, distortion, x_m=1.7, y_m=half, z_m=1.15, pitch_rad=0.12, yaw_rad=-0.06, roll_rad=0.03),
        camera(600.0, 0.5 * distortion, x_m=1.75, y_m=-half, z_m=1.05, pitch_rad=0.10, yaw_rad=0.05, roll_rad=-0.04),
    )


LINES = (Line(0.5 * LANE_M), Line(-0.5 * LANE_M), Line(1.5 * LANE_M))


def draw_pair(rig: StereoRig, plane: Plane | None = None, lines: tuple[Line, ...] = LINES, **road: float):
    """The pictures (h, w) of both cameras of a car that stands so over the road."""
    left, right = rig.over(plane or Plane())
    seed = int(road.pop("seed", 0))
    return tuple(draw(eye, lines, seed=seed + k, **road) for k, eye in enumerate((left, right)))


def straight_ahead(rig: StereoRig, far_m: float = 45.0, count: int = 80) -> np.ndarray:
    """The predicted centerline of a car that knows nothing: places as complex numbers."""
    near = min(rig.left.first_visible_x_m(), rig.right.first_visible_x_m())
    return np.geomspace(near, far_m, count) + 0j
