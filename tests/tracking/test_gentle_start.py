"""Starts from one whole image of a motorway: dashes and dots, and nothing to start from."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from automodel.assembly.parts import make_pipeline
from automodel.bench.tusimple import highway_car
from automodel.config import CameraConfig, CarConfig, Extrinsics, Intrinsics
from automodel.geometry import GroundCamera
from automodel.signals import Frame, LaneStatus, Motion, MotionSource
from automodel.tracking.gentle_start import GentleStart
from automodel.types import Image
from tests.support.highway_pictures import DASHES, DOTS, LANE_M, SOLID, Line, camera_model, draw, mounted

CAMERA = mounted(camera_model(f_px=443.4))
CENTRE_M, HEADING_RAD = 0.3, 0.01


def car() -> CarConfig:
    model = CAMERA.camera
    u_px, v_px = 0.5 * (model.width_px - 1), 0.5 * (model.height_px - 1)
    return highway_car(
        CameraConfig(
            width_px=model.width_px,
            height_px=model.height_px,
            intrinsics=Intrinsics(fx_px=443.4, fy_px=443.4, cx_px=u_px, cy_px=v_px),
            extrinsics=Extrinsics(x_m=0.0, z_m=1.6, pitch_rad=0.1),  # as `mounted` has them
        )
    )


def picture(pattern=DASHES) -> Image:
    lines = [Line(side * LANE_M - CENTRE_M, pattern, 1.7 * (side > 0.0)) for side in (0.5, -0.5)]
    return draw(CAMERA, [*lines, Line(1.5 * LANE_M - CENTRE_M, SOLID)], HEADING_RAD, seed=3)


@pytest.mark.parametrize("pattern", [DASHES, DOTS], ids=["dashes", "dots"])
def test_the_lines_of_the_start_are_those_that_were_drawn(pattern) -> None:
    found = GentleStart(car(), GroundCamera.from_config(car().camera), 3.0).step(picture(pattern))
    assert found is not None
    for points, side in ((found.left_m, 0.5), (found.right_m, -0.5)):
        line = side * LANE_M - CENTRE_M + HEADING_RAD * points[:, 0]
        assert points[:, 1] == pytest.approx(line, abs=0.04 * LANE_M)
        assert (np.diff(points[:, 0]) > 0.0).all()
    assert found.belief.width_m == pytest.approx(LANE_M, rel=0.03)


def test_a_bare_road_and_a_road_with_tight_bends_give_no_start() -> None:
    camera = GroundCamera.from_config(car().camera)
    assert GentleStart(car(), camera, 3.0).step(draw(CAMERA, [], seed=4)) is None
    pipeline = car().pipeline
    tight = dataclasses.replace(pipeline, contour=dataclasses.replace(pipeline.contour, radius_lanes=3.0))
    assert GentleStart(dataclasses.replace(car(), pipeline=tight), camera, 3.0).step(picture()) is None


@pytest.mark.parametrize("pattern", [DASHES, DOTS], ids=["dashes", "dots"])
@pytest.mark.parametrize("name", ["windows", "centerline"])
def test_a_pipeline_starts_on_dashes_that_it_does_not_find_itself(name: str, pattern) -> None:
    motion = Motion(t_ns=0, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
    estimate = make_pipeline(name, car()).step(Frame(t_ns=0, index=0, image=picture(pattern)), motion)
    assert estimate.status is LaneStatus.TRACKING
    assert estimate.pose is not None
    middle = CENTRE_M - HEADING_RAD * car().vehicle.reference_x_m
    assert estimate.pose.offset_m == pytest.approx(middle, abs=0.03 * LANE_M)
    assert estimate.pose.heading_rad == pytest.approx(-HEADING_RAD, abs=0.02)
    assert estimate.pose.offset_bound_m > 0.2 * LANE_M  # a single image is no proof
