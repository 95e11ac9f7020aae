from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import automodel
from automodel import CarConfig, LaneFinder, LaneStatus
from automodel.assembly.parts import make_pipeline
from automodel.assembly.simulated_car import appearance, renderer
from automodel.signals import Frame, Motion
from automodel.sim.track_files import load_track
from automodel.types import Image

CAR = CarConfig()


@pytest.fixture(scope="module")
def images() -> list[Image]:
    """A straight drive at 1 m/s along the oval, 60 frames/s."""
    track = load_track("oval")
    camera = renderer(track, CAR, appearance("competition", 3))
    poses = [track.lane().pose(1.0 + index / 60, 0.03) for index in range(30)]
    return [camera.render(p.x_m, p.y_m, p.yaw_rad, 1.0, 0.0, index) for index, p in enumerate(poses)]


def test_it_sees_what_the_pipeline_sees(images: list[Image]) -> None:
    finder = LaneFinder(CAR, pipeline="windows")
    pipeline = make_pipeline("windows", CAR)
    for index, image in enumerate(images):
        t_ns = round(index / 60 * 1e9)
        found = finder.see(image, index / 60, 1.0, 0.0)
        frame = Frame(t_ns=t_ns, index=index, image=image)
        expected = pipeline.step(frame, Motion(t_ns=t_ns, speed_mps=1.0, yaw_rate_radps=0.0))
        assert found.status is expected.status
        if expected.pose is not None:
            assert found.pose is not None
            assert found.pose.offset_m == expected.pose.offset_m
    assert found.status is LaneStatus.TRACKING
    assert found.pose is not None
    assert found.pose.offset_m == pytest.approx(0.03, abs=0.005)


def test_without_motion_it_still_sees(images: list[Image]) -> None:
    finder = LaneFinder(pipeline="windows")
    assert [finder.see(image, index / 60) for index, image in enumerate(images)][-1].valid


def test_what_does_not_fit_is_refused(images: list[Image]) -> None:
    finder = LaneFinder(CAR, pipeline="windows")
    finder.see(images[0], 1.0)
    for arguments, reason in (
        ((images[0], 1.0), "t_s: expected a time after 1.000000, got 1.000000"),
        ((images[0], float("nan")), "t_s: expected a finite time, got nan"),
        ((images[0][::2], 2.0), "image: expected 640x360 as in [camera], got 640x180"),
        ((images[0].astype(float), 2.0), "expected uint8"),
        ((images[0], 2.0, float("inf"), 0.0), "expected a finite motion, got inf m/s and 0.0 rad/s"),
    ):
        with pytest.raises(ValueError) as caught:
            finder.see(*arguments)
        assert reason in str(caught.value)
    finder.see(images[0], 2.0)  # nothing of that was taken in
    finder.reset()
    finder.see(images[0], 0.5)


def test_the_public_names_are_there() -> None:
    for name in automodel.__all__:
        assert getattr(automodel, name) is not None
    assert set(automodel.__all__) <= set(dir(automodel))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        automodel.nothing  # noqa: B018


def test_importing_the_package_imports_nothing_heavy() -> None:
    code = "import sys, automodel; print(sorted({'numpy', 'cv2', 'scipy', 'numba', 'onnxruntime'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_an_image_may_be_a_colour_one(images: list[Image]) -> None:
    finder = LaneFinder(CAR, pipeline="windows")
    assert isinstance(finder.see(np.repeat(images[0][..., None], 3, axis=2), 0.0), automodel.LaneEstimate)
