"""Pipelines whose camera looks up or down by more than car.toml says: they find out, and measure by what they found."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from automodel.assembly.parts import make_pipeline
from automodel.config import CarConfig
from automodel.geometry import GroundCamera
from automodel.sim.track_files import load_track
from tests.support.rendered_drives import CAR, RenderedDrive, check_sound
from tests.support.slow_lane import rest_slow

OVAL = load_track("oval")


def told(wrong_deg: float) -> CarConfig:
    """A car.toml whose camera looks further down than the real one."""
    place = CAR.camera.extrinsics.pitched(math.radians(wrong_deg))
    return replace(CAR, camera=replace(CAR.camera, extrinsics=place))


@pytest.mark.parametrize("wrong_deg", [1.5, -1.5])
@pytest.mark.parametrize("name", rest_slow(("windows", "contour", "centerline"), "contour"))
def test_a_wrong_pitch_is_found_and_measured_by(name: str, wrong_deg: float) -> None:
    pipeline = make_pipeline(name, told(wrong_deg))
    seen = RenderedDrive(track=OVAL, pipeline=pipeline).run(0.5, 7.5)
    for one in seen:
        check_sound(one.estimate, one.frame.t_ns)
    settled = seen[2 * len(seen) // 3 :]
    assert np.degrees(settled[-1].estimate.camera_pitch_rad) == pytest.approx(-wrong_deg, abs=0.4)
    assert np.mean([abs(one.offset_error_m) for one in settled]) < 0.007
    assert np.degrees(np.mean([abs(one.heading_error_rad) for one in settled])) < 0.8
    assert "[camera.extrinsics] pitch_rad = " in getattr(pipeline, "warning", "")
    pipeline.reset()
    assert getattr(pipeline, "warning", None) == ""
    first = pipeline.step(seen[0].frame, seen[0].motion)
    assert first.camera_pitch_rad == 0.0


@pytest.mark.parametrize("name", ["windows", "contour"])
def test_a_right_pitch_stays(name: str) -> None:
    seen = RenderedDrive(track=load_track("chicane"), pipeline=make_pipeline(name, CAR)).run(0.5, 9.5)
    assert {one.estimate.camera_pitch_rad for one in seen} == {0.0}


def test_a_pitched_camera_looks_further_down() -> None:
    camera, down = GroundCamera.from_config(CAR.camera), math.radians(2.0)
    place = replace(CAR.camera.extrinsics, pitch_rad=CAR.camera.extrinsics.pitch_rad + down)
    same = GroundCamera.from_config(replace(CAR.camera, extrinsics=place))
    points = np.array([[0.6, 0.1], [1.5, -0.2]])
    assert camera.pitched(down).ground_to_px(points) == pytest.approx(same.ground_to_px(points))
    assert (camera.pitched(down).ground_to_px(points)[:, 1] < camera.ground_to_px(points)[:, 1]).all()
