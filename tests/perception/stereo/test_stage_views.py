"""What `stereo` shows of its stages lies where the images show it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from automodel.pipelines.stereo import Stereo
from automodel.runtime.eye_check import EyeCheck
from automodel.signals import Motion, Role, StageMark, StageView, StereoFrame
from automodel.sim.appearance import Appearance
from automodel.sim.track_files import load_track
from automodel.types import FloatArray
from tests.support.rendered_drives import Seen
from tests.support.stereo_drives import StereoDrive, stereo_car

CAR = stereo_car()
STAGES = ["search region", "ridges", "stripes", "matches", "ground plane", "lane"]
BRIGHT = 90  # paint's grey level at least; the floor's is less
Shown = dict[tuple[str, int], StageView]


def shown(pipeline: Stereo) -> Shown:
    return {(view.stage, view.eye): view for view in pipeline.stage_views}


def marks(view: StageView, role: Role, joined: bool) -> FloatArray:
    """All pixels (n, 2) of marks of a kind that are there."""
    found = [mark.pixels for mark in view.marks if mark.role is role and mark.joined is joined]
    pixels = np.concatenate(found) if found else np.empty((0, 2))
    return np.asarray(pixels[np.isfinite(pixels).all(axis=1)])


def grey_at(image: np.ndarray, pixels: FloatArray) -> np.ndarray:
    u, v = np.round(pixels).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < image.shape[1]) & (v < image.shape[0])
    assert inside.sum() > 9
    return np.asarray(image[v[inside], u[inside]])


@pytest.fixture(scope="module")
def drive() -> tuple[Stereo, list[Seen], list[Shown]]:
    drive = StereoDrive(track=load_track("oval"), car=CAR, look=Appearance(noise_seed=3), nod_rad=np.radians(1.0))
    pipeline, views = drive.estimator, []
    assert isinstance(pipeline, Stereo)
    step = pipeline.step

    def watched(frame: StereoFrame, motion: Motion) -> object:
        estimate = step(frame, motion)
        views.append(shown(pipeline))
        return estimate

    drive.estimator.step = watched  # type: ignore[method-assign, assignment]
    seen = drive.run(0.0, 0.6)
    drive.estimator.step = step  # type: ignore[method-assign]
    return pipeline, seen, views


def test_every_stage_is_shown_in_both_eyes_in_the_order_of_its_work(
    drive: tuple[Stereo, list[Seen], list[Shown]],
) -> None:
    for views in drive[2]:
        assert list(views) == [(stage, eye) for eye in (0, 1) for stage in STAGES]


@pytest.mark.parametrize("eye", [0, 1])
def test_marks_lie_on_the_paint_that_they_are_of(drive: tuple[Stereo, list[Seen], list[Shown]], eye: int) -> None:
    frame, views = drive[1][-1].frame, drive[2][-1]
    image = (frame.left, frame.right)[eye]  # type: ignore[attr-defined]
    (region,) = [mark.pixels for mark in views["search region", eye].marks if mark.role is Role.FOUND]
    ridges = views["ridges", eye]
    ends = marks(ridges, Role.USED, True)
    middles = 0.5 * (ends[::2] + ends[1::2])
    inside = [cv2.pointPolygonTest(region.astype(np.float32), tuple(map(float, at)), True) for at in middles]
    half_px = 0.5 * np.hypot(*(ends[1::2] - ends[::2]).T)  # a ridge is found by its highest sample, its middle is there
    assert (inside > -half_px - 1.0).all()
    stripes, matches = marks(views["stripes", eye], Role.USED, True), marks(views["matches", eye], Role.FOUND, False)
    plane = marks(views["ground plane", eye], Role.USED, False)
    knots = marks(views["lane", eye], Role.FOUND, False)
    for pixels in (middles, stripes, matches, plane, knots[knots[:, 1] > 0.5 * image.shape[0]]):
        assert len(pixels) > 10
        assert np.median(grey_at(image, pixels)) > BRIGHT
    curves = [mark.pixels for mark in views["lane", eye].marks if mark.role is Role.USED]
    assert len(curves) == 3
    lines = np.concatenate((curves[0], curves[2]))
    near = [np.nanmin(np.hypot(*(lines - at).T)) for at in plane]
    assert np.median(near) < 6.0


def test_the_horizon_moves_with_the_plane(drive: tuple[Stereo, list[Seen], list[Shown]]) -> None:
    """A camera that looks down by a degree more sees the horizon higher: by the focal length times its tangent."""
    pipeline, _, views = drive
    for eye in (0, 1):
        expected, used = (
            next(mark for mark in views[-1]["ground plane", eye].marks if mark.role is role and mark.joined).pixels
            for role in (Role.EXPECTED, Role.USED)
        )
        focal = (CAR.camera.eyes[eye]).intrinsics.fy_px
        middle = np.nanargmin(np.abs(expected[:, 0] - 320.0))
        moved = expected[middle, 1] - used[middle, 1]
        assert abs(pipeline.plane.pitch_rad) > 0.002
        assert moved == pytest.approx(focal * pipeline.plane.pitch_rad, rel=0.2, abs=1.0)


def test_an_eye_that_is_left_out_shows_no_stage_and_nothing_is_shown_before_a_frame() -> None:
    drive = StereoDrive(track=load_track("oval"), car=CAR, look=Appearance(noise_seed=3), blind={0: (3, 9)})
    pipeline, check = drive.estimator, EyeCheck()
    assert isinstance(pipeline, Stereo)
    assert pipeline.stage_views == ()
    step = pipeline.step
    drive.estimator.step = lambda frame, motion: step(check.step(frame), motion)  # type: ignore[method-assign]
    drive.run(0.0, 0.15)
    assert {eye for _, eye in shown(pipeline)} == {1}
    plane = shown(pipeline)["ground plane", 1]
    assert {mark.role for mark in plane.marks if len(mark.pixels)} == {Role.EXPECTED, Role.USED}
    pipeline.reset()
    assert pipeline.stage_views == ()


def test_a_mark_s_pixels_are_pairs_and_stay() -> None:
    mark = StageMark(role=Role.FOUND, pixels=np.zeros((3, 2)))
    with pytest.raises(ValueError, match="read-only"):
        mark.pixels[0, 0] = 1.0
    with pytest.raises(ValueError, match=r"StageMark.pixels: expected shape"):
        StageMark(role=Role.FOUND, pixels=np.zeros((3, 3)))
