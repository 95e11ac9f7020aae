"""`stereo` on simulated drives with two cameras: accuracy, plane, one eye that sees nothing, what it refuses."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from automodel.assembly.parts import make_pipeline
from automodel.assembly.simulated_car import renderers
from automodel.bench.stereo_paper import LIGHTS, SPEED_MPS, mirror_car
from automodel.config import CarConfig, ConfigError, LaneConfig, SecondCamera
from automodel.geometry.stereo_rig import Plane
from automodel.pipelines.stereo import Stereo
from automodel.runtime.eye_check import EyeCheck
from automodel.runtime.input_checks import LaneJumpCheck
from automodel.runtime.loop import Loop
from automodel.signals import Frame, LaneEstimate, LaneStatus, Motion, StereoFrame
from automodel.sim.appearance import Appearance
from automodel.sim.highway import Highway, HighwayDrive, LaneChange
from automodel.sim.paint import Paint
from automodel.sim.track_files import load_track
from automodel.sim.trajectory import Odometer
from automodel.sim.truth import TruthFollower
from tests.support.rendered_drives import Seen, check_sound
from tests.support.stereo_drives import StereoDrive, stereo_car

CAR = stereo_car()
LOOK = Appearance(noise_seed=3)


def errors_m(seen: list[Seen]) -> np.ndarray:
    return np.array([abs(one.offset_error_m) for one in seen if one.estimate.valid])


def motion(t_ns: int) -> Motion:
    return Motion(t_ns=t_ns, speed_mps=0.0, yaw_rate_radps=0.0)


@pytest.fixture(scope="module")
def lap() -> tuple[StereoDrive, list[Seen]]:
    drive = StereoDrive(track=load_track("oval"), car=CAR, look=LOOK)
    return drive, drive.run(0.0, 3.0)


def test_the_lane_is_followed(lap: tuple[StereoDrive, list[Seen]]) -> None:
    seen = lap[1]
    for one in seen:
        check_sound(one.estimate, one.frame.t_ns)
    assert all(one.estimate.valid for one in seen[2:])
    assert errors_m(seen).mean() < 0.03 * CAR.lane.width_m
    bounds = np.array([one.estimate.pose.offset_bound_m for one in seen if one.estimate.pose])
    assert (errors_m(seen) < bounds).all()


def test_the_same_pairs_give_the_same_lane(lap: tuple[StereoDrive, list[Seen]]) -> None:
    drive, seen = lap
    drive.estimator.reset()
    for one in seen[:20]:
        again = drive.estimator.step(one.frame, one.motion)
        assert (again.pose is None) == (one.estimate.pose is None)
        if again.pose is not None and one.estimate.pose is not None:
            assert again.pose.offset_m == one.estimate.pose.offset_m


def test_a_nodding_car_keeps_its_lane_and_measures_the_nod() -> None:
    drive = StereoDrive(track=load_track("oval"), car=CAR, look=LOOK, nod_rad=np.radians(1.0))
    found: list[float] = []
    step = drive.estimator.step
    assert isinstance(drive.estimator, Stereo)
    plane = drive.estimator

    def watched(frame: Frame, motion: Motion) -> object:
        estimate = step(frame, motion)
        found.append(plane.plane.pitch_rad)
        return estimate

    drive.estimator.step = watched  # type: ignore[method-assign, assignment]
    seen = drive.run(0.0, 2.0)
    both = [k for k, one in enumerate(seen) if one.estimate.status is LaneStatus.TRACKING and k > 5]
    assert len(both) > 20
    off = np.degrees([found[k] - drive.nod(k) for k in both])
    assert np.abs(off).mean() < 0.4  # less than two thirds of what the nod's mean is
    assert errors_m(seen).mean() < 0.04 * CAR.lane.width_m


@pytest.mark.parametrize("eye", [0, 1])
def test_one_eye_goes_on_alone_and_the_pair_comes_back(eye: int) -> None:
    drive = StereoDrive(track=load_track("oval"), car=CAR, look=LOOK, blind={eye: (15, 40)})
    seen = drive.run(0.0, 2.0)
    assert all(one.estimate.valid for one in seen[2:])
    assert any(one.estimate.left and one.estimate.left.seen for one in seen[20:40])
    assert errors_m(seen).mean() < 0.04 * CAR.lane.width_m
    assert isinstance(drive.estimator, Stereo)
    assert ("left", "right")[eye] in drive.estimator.warning


@pytest.mark.parametrize("eye", [0, 1])
def test_beside_a_frozen_eye_the_other_one_goes_on(eye: int) -> None:
    drive = StereoDrive(track=load_track("oval"), car=CAR, look=LOOK)
    picture, kept = drive.picture, []

    def frozen(*args: Any) -> StereoFrame:
        pair: StereoFrame = picture(*args)
        kept.append((pair.left, pair.right)[eye])
        still = kept[min(len(kept) - 1, 15)]
        return replace(pair, left=still) if eye == 0 else replace(pair, right=still)

    drive.picture = frozen  # type: ignore[method-assign, assignment]
    check, step = EyeCheck(), drive.estimator.step
    drive.estimator.step = lambda frame, motion: step(check.step(frame), motion)  # type: ignore[method-assign, arg-type]
    seen = drive.run(0.0, 2.5)
    assert all(one.estimate.valid for one in seen[2:])
    bounds = np.array([one.estimate.pose.offset_bound_m for one in seen if one.estimate.pose])
    assert (errors_m(seen) < bounds).all()
    assert errors_m(seen).mean() < 0.04 * CAR.lane.width_m
    assert isinstance(drive.estimator, Stereo)
    side = ("left", "right")[eye]
    assert f"the {side} camera gave no image in {len(seen) - 16} frames" in drive.estimator.warning


@pytest.mark.parametrize("eye", [0, 1])
def test_one_camera_drives_alone_and_the_other_comes_back(eye: int) -> None:
    drive = StereoDrive(track=load_track("oval"), car=CAR, look=LOOK)
    picture = drive.picture

    def missing(*args: Any) -> Frame | StereoFrame:
        pair: StereoFrame = picture(*args)
        if not 15 <= pair.index < 45:
            return pair
        return Frame(t_ns=pair.t_ns, index=pair.index, image=pair.left if eye else pair.right, eye=1 - eye)

    drive.picture = missing  # type: ignore[method-assign, assignment]
    seen = drive.run(0.0, 2.5)
    assert all(one.estimate.valid for one in seen[2:])
    assert all(one.estimate.left and one.estimate.left.seen for one in seen[16:45])
    bounds = np.array([one.estimate.pose.offset_bound_m for one in seen if one.estimate.pose])
    assert (errors_m(seen) < bounds).all()
    assert errors_m(seen).mean() < 0.04 * CAR.lane.width_m
    side = ("left", "right")[eye]
    assert drive.estimator.warning == (  # type: ignore[attr-defined]
        f"the {side} camera gave no image in 30 frames: the ground plane of the last good pair was used"
    )


@pytest.mark.parametrize("yaw_rad", [0.01, 0.03])
def test_the_plane_takes_in_an_eye_that_looks_elsewhere_than_calibrated(yaw_rad: float) -> None:
    """A pitch of the ground looks like it; the lane is where it was."""
    assert CAR.camera.right is not None
    there = CAR.camera.right.extrinsics
    right = replace(CAR.camera.right, extrinsics=replace(there, yaw_rad=there.yaw_rad + yaw_rad))
    pipeline = Stereo(replace(CAR, camera=replace(CAR.camera, right=right)))
    drive = StereoDrive(track=load_track("oval"), car=CAR, look=LOOK, pipeline=pipeline)
    seen = drive.run(0.0, 1.5)
    assert all(one.estimate.status is LaneStatus.TRACKING for one in seen[5:])
    assert errors_m(seen).mean() < 0.03 * CAR.lane.width_m
    assert pipeline.plane.pitch_rad == pytest.approx(0.66 * yaw_rad, abs=0.01)


def test_nothing_is_said_of_two_good_eyes(lap: tuple[StereoDrive, list[Seen]]) -> None:
    assert lap[0].estimator.warning == ""  # type: ignore[attr-defined]


def test_both_eyes_dark_is_no_lane() -> None:
    pipeline = Stereo(CAR)
    dark = np.zeros((480, 640), np.uint8)
    for k in range(5):
        estimate = pipeline.step(StereoFrame(t_ns=k * 30_000_000, index=k, left=dark, right=dark), motion(k))
        assert estimate.status is LaneStatus.LOST


@pytest.mark.parametrize("shape", [(480, 640, 3), (480, 640)])
def test_noise_makes_no_lane(shape: tuple[int, ...]) -> None:
    pipeline, rng = Stereo(CAR), np.random.default_rng(4)
    for k in range(10):
        left, right = (rng.integers(0, 256, shape, np.uint8) for _ in range(2))
        estimate = pipeline.step(StereoFrame(t_ns=k * 30_000_000, index=k, left=left, right=right), motion(k))
        check_sound(estimate, k * 30_000_000)
        assert estimate.status is LaneStatus.LOST


@pytest.mark.parametrize(("pitch_deg", "lost"), [(0.0, False), (1.0, False), (2.0, True), (-2.0, True)])
def test_an_eye_that_is_turned_against_its_calibration_makes_a_plane_that_cannot_be(
    pitch_deg: float, lost: bool
) -> None:
    """The right camera nods; no body of a car rolls as far as the ground then seems to. One degree is taken in."""
    assert CAR.camera.right is not None
    at = CAR.camera.right.extrinsics
    leaning = dataclasses.replace(at, pitch_rad=at.pitch_rad + np.radians(pitch_deg))
    second = dataclasses.replace(CAR.camera.right, extrinsics=leaning)
    there = dataclasses.replace(CAR, camera=dataclasses.replace(CAR.camera, right=second))
    drive = StereoDrive(track=load_track("oval"), car=there, look=LOOK, pipeline=Stereo(CAR))
    seen = drive.run(0.0, 1.0)
    assert isinstance(drive.estimator, Stereo)
    assert ("did not fit the cameras' calibration" in drive.estimator.warning) is lost
    assert any(one.estimate.status is LaneStatus.LOST for one in seen[3:]) is lost
    if not lost:
        assert errors_m(seen).max() < 0.05 * CAR.lane.width_m


def test_a_plane_that_cannot_be_is_lost_with_the_reason_until_it_is_gone(lap: tuple[StereoDrive, list[Seen]]) -> None:
    seen, pipeline = lap[1], Stereo(CAR)
    for one in seen[:10]:
        pipeline.step(one.frame, one.motion)
    assert pipeline.trouble == ""
    pipeline._plane.plane = Plane(roll_rad=np.radians(20.0))  # further than one pair can bring it back
    estimate = pipeline.step(seen[10].frame, seen[10].motion)
    assert estimate.status is LaneStatus.LOST
    assert pipeline.trouble.startswith("the ground as both cameras see it does not fit their calibration")
    pipeline.reset()
    assert pipeline.trouble == ""
    assert pipeline.warning == ""
    for one in seen[11:16]:
        pipeline.step(one.frame, one.motion)
    assert pipeline.trouble == ""


@pytest.mark.parametrize("nod_deg", [1.0, 2.0])
def test_a_car_that_bounces_makes_no_plane_that_cannot_be(nod_deg: float) -> None:
    drive = StereoDrive(track=load_track("oval"), car=CAR, look=LOOK, nod_rad=np.radians(nod_deg))
    drive.run(0.0, 1.5)
    assert isinstance(drive.estimator, Stereo)
    assert "calibration" not in drive.estimator.warning


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_picture_of_another_size_is_lost(side: str) -> None:
    images: dict[str, Any] = {"left": np.zeros((480, 640), np.uint8), "right": np.zeros((480, 640), np.uint8)}
    images[side] = np.zeros((240, 320), np.uint8)
    assert Stereo(CAR).step(StereoFrame(t_ns=1, index=0, **images), motion(1)).status is LaneStatus.LOST


def test_a_car_with_one_camera_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"stereo: needs two cameras.*\[camera.right.extrinsics\]"):
        make_pipeline("stereo", CarConfig())


def test_two_cameras_at_one_place_are_refused() -> None:
    same = SecondCamera(intrinsics=CAR.camera.intrinsics, extrinsics=CAR.camera.extrinsics)
    car = dataclasses.replace(CAR, camera=dataclasses.replace(CAR.camera, right=same))
    with pytest.raises(ConfigError, match="both cameras are at the same place"):
        make_pipeline("stereo", car)


def test_dark_markings_are_seen_too() -> None:
    look = Appearance(floor_grey=170.0, marking_grey=50.0)
    for markings in ("dark", "both"):
        car = stereo_car(lane=LaneConfig(markings=markings))
        seen = StereoDrive(track=load_track("oval"), car=car, look=look).run(0.0, 0.6)
        assert all(one.estimate.valid for one in seen[3:])


def test_the_loop_gives_pairs_to_a_pipeline_of_two_cameras() -> None:
    class Watching:
        name = "watching"

        def __init__(self, cameras: int) -> None:
            self.cameras = cameras
            self.seen: list[object] = []

        def step(self, frame: object, motion: Motion) -> object:
            self.seen.append(frame)
            raise KeyboardInterrupt

        def reset(self) -> None:
            """Nothing."""

    image = np.zeros((4, 4), np.uint8)
    pair = StereoFrame(t_ns=1, index=0, left=image, right=image + 1)
    for cameras, kind in ((1, Frame), (2, StereoFrame)):
        pipeline = Watching(cameras)
        loop = Loop(pipeline, None, None, validity_s=1.0)  # type: ignore[arg-type]
        with pytest.raises(KeyboardInterrupt):
            loop.tick(pair, motion(1), None, 1)
        assert isinstance(pipeline.seen[0], kind)


@pytest.mark.slow
@pytest.mark.parametrize("line_m", [-1.75, -5.25], ids=["left dashes", "right edge"])
def test_a_line_that_both_cameras_lose_for_two_seconds_costs_little(line_m: float) -> None:
    """A line of a highway's rightmost lane ends and begins again: its far end alone tells little of the width."""
    car, (track, lanes) = mirror_car(), Highway().build()
    unpainted_m = 50.0, 50.0 + 2.0 * SPEED_MPS + 45.0  # out of view for two seconds

    def missing(paint: Paint) -> bool:
        s, aside = np.transpose([track.road.project(corner) for corner in paint.polygon_m])
        return bool(abs(aside.mean() - line_m) < 0.3 and s.max() > unpainted_m[0] and s.min() < unpainted_m[1])

    track = replace(track, painted=tuple(paint for paint in track.painted if not missing(paint)))
    drive, pipeline, odometer = HighwayDrive(lanes[0], SPEED_MPS), Stereo(car), Odometer(0)
    eyes, follower = renderers(track, car, LIGHTS["day"]), TruthFollower(lanes[0], car.vehicle.reference_x_m)
    alone, errors = 0, []
    for index in range(110):
        at = drive.pose(index / 20.0)
        place = at.x_m, at.y_m, at.yaw_rad
        left, right = (eye.render(*place, at.speed_mps, at.yaw_rate_radps, index) for eye in eyes)
        moved = odometer.motion(drive.pose(max(index / 20.0 - 0.025, 0.0)), round(index * 5e7))
        estimate = pipeline.step(StereoFrame(t_ns=moved.t_ns, index=index, left=left, right=right), moved)
        assert estimate.pose is not None
        alone += estimate.status is LaneStatus.ONE_LINE
        error = abs(estimate.pose.offset_m - follower.step(*place).offset_m)
        errors.append(error)
        assert error < min(0.1, estimate.pose.offset_bound_m)
    assert alone >= 40
    assert np.mean(errors) < 0.04


@pytest.fixture(scope="module")
def overtaking() -> tuple[CarConfig, list[tuple[LaneEstimate, int]]]:
    """A drive that changes to the next lane and back, and for each estimate the lane it is of."""
    car = mirror_car()
    track, lanes = Highway(straights_m=(200.0, 50.0)).build()
    ways = LaneChange(from_s=0.6, lasts_s=3.0), LaneChange(from_s=4.2, lasts_s=3.0, to=-1)
    drive = HighwayDrive(lanes[0], 25.0, ways, wander_m=0.0)
    eyes, pipeline = renderers(track, car, LOOK), Stereo(car)
    followers = [TruthFollower(lane, car.vehicle.reference_x_m) for lane in lanes]
    found = []
    for index in range(154):
        t_s = index / 20.0
        at, t_ns = drive.pose(t_s), round(t_s * 1e9)
        place = at.x_m, at.y_m, at.yaw_rad
        left, right = (eye.render(*place, at.speed_mps, at.yaw_rate_radps, index) for eye in eyes)
        moved = Motion(t_ns=t_ns, speed_mps=at.speed_mps, yaw_rate_radps=drive.pose(t_s - 0.025).yaw_rate_radps)
        estimate = pipeline.step(StereoFrame(t_ns=t_ns, index=index, left=left, right=right), moved)
        truths = [follower.step(*place) for follower in followers]
        if estimate.pose is not None:
            off = [abs(estimate.pose.offset_m - truth.offset_m) for truth in truths]
            assert min(off) < 0.05
            found.append((estimate, off.index(min(off))))
    return car, found


def test_a_lane_change_is_one(overtaking: tuple[CarConfig, list[tuple[LaneEstimate, int]]]) -> None:
    found = overtaking[1]
    assert len(found) > 145
    lanes = [lane for _, lane in found]
    changes = [(k, one.lane_change) for k, (one, _) in enumerate(found) if one.lane_change]
    assert [side for _, side in changes] == [1, -1]
    for k, side in changes:
        assert lanes[k] - lanes[k - 1] == side
        before, after = found[k - 1][0].pose, found[k][0].pose
        assert before is not None
        assert after is not None
        assert 0.65 < abs(before.offset_m) / (0.5 * before.width_m) < 0.77  # a tenth of a metre a frame
        assert after.width_m == pytest.approx(before.width_m, abs=0.05)
    assert sum(a != b for a, b in pairwise(lanes)) == 2


def test_the_check_for_jumps_knows_a_lane_change(
    overtaking: tuple[CarConfig, list[tuple[LaneEstimate, int]]],
) -> None:
    car, found = overtaking
    told, untold = LaneJumpCheck(car.vehicle), LaneJumpCheck(car.vehicle)
    assert [jump for one, _ in found if (jump := told.step(one)) is not None] == []
    silent = (replace(one, lane_change=0) for one, _ in found)
    assert any("jumped sideways" in jump for one in silent if (jump := untold.step(one)) is not None)


def test_lane_changes_do_not_go_with_lines_that_tell_the_lane() -> None:
    car = dataclasses.replace(mirror_car(), lane=LaneConfig(width_m=3.6, left="dashed"))
    with pytest.raises(ConfigError, match="lane_changes: needs"):
        make_pipeline("stereo", car)
