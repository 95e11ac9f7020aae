"""`contour` over time: coasting, loss, reset, and whatever a camera, a clock or an odometer may deliver."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from automodel.assembly.parts import make_pipeline
from automodel.config import ConfigError, ContourConfig
from automodel.interfaces import Pipeline
from automodel.pipelines.contour import Contour
from automodel.signals import Frame, LaneEstimate, LaneStatus, Motion, MotionSource
from tests.support.masked_drives import arc, bits, line, road
from tests.support.rendered_drives import CAR, RenderedDrive, Seen, camera, check_sound, with_camera

SIZE = (CAR.camera.height_px, CAR.camera.width_px)
BLACK, WHITE = np.zeros(SIZE, np.uint8), np.full(SIZE, 255, np.uint8)
PERIOD_NS = 33_333_333
ODD = (math.nan, math.inf, -math.inf, 1e300, -1e300, 0.0)


@pytest.fixture(scope="module")
def seen() -> list[Seen]:
    """A metre of a straight and the beginning of a bend."""
    return RenderedDrive(track=road(line(1.6), arc(1.5, 1.0)), pipeline=Contour(CAR)).run(0.4, 1.4)


@pytest.fixture(scope="module")
def straight() -> list[Seen]:
    return RenderedDrive(track=road(line(6.0)), pipeline=Contour(CAR)).run(0.4, 1.2)


def motion(t_ns: int, speed_mps: float = 0.0, yaw_rate_radps: float = 0.0) -> Motion:
    return Motion(t_ns=t_ns, speed_mps=speed_mps, yaw_rate_radps=yaw_rate_radps)


def replayed(pipeline: Pipeline, drive: list[Seen], from_ns: int = 0) -> list[LaneEstimate]:
    return [pipeline.step(replace(s.frame, t_ns=s.frame.t_ns + from_ns), s.motion) for s in drive]


def shown(
    pipeline: Pipeline, image: np.ndarray, after: list[Seen], frames: int, speed_mps: float
) -> list[LaneEstimate]:
    """One image again and again after a drive; what is said is sound."""
    last_ns = after[-1].frame.t_ns
    reported = []
    for k in range(1, frames + 1):
        t_ns = last_ns + k * PERIOD_NS
        reported.append(pipeline.step(Frame(t_ns=t_ns, index=100 + k, image=image), motion(t_ns, speed_mps)))
        check_sound(reported[-1], t_ns)
    return reported


def test_the_same_frames_give_the_same_bits(seen: list[Seen]) -> None:
    first = [bits(e) for e in replayed(Contour(CAR), seen)]
    assert all(e.estimate.valid for e in seen)
    assert first == [bits(e) for e in replayed(Contour(CAR), seen)]
    assert first == [bits(s.estimate) for s in seen]


def test_reset_forgets_everything(seen: list[Seen]) -> None:
    pipeline = Contour(CAR)
    replayed(pipeline, seen[::-1], 10**12)
    shown(pipeline, BLACK, seen, 5, 1.0)
    pipeline.reset()
    assert [bits(e) for e in replayed(pipeline, seen)] == [bits(s.estimate) for s in seen]


def test_reset_in_the_midst_of_a_drive_loses_the_lane(seen: list[Seen]) -> None:
    pipeline = Contour(CAR)
    replayed(pipeline, seen)
    assert shown(pipeline, BLACK, seen, 1, 1.0)[0].status is LaneStatus.COASTING
    pipeline.reset()
    after = shown(pipeline, BLACK, seen, 1, 1.0)[0]
    assert after.status is LaneStatus.LOST


def test_the_frames_are_left_alone(seen: list[Seen]) -> None:
    before = seen[3].frame.image.copy()
    replayed(Contour(CAR), seen[:5])
    np.testing.assert_array_equal(seen[3].frame.image, before)


def test_what_was_reported_stays_as_it_was(seen: list[Seen]) -> None:
    """Estimates are read later, by other threads: no buffer of the pipeline shows through."""
    pipeline = Contour(CAR)
    reported = replayed(pipeline, seen[:8])
    before = [bits(e) for e in reported]
    replayed(pipeline, seen[8:])
    pipeline.reset()
    assert [bits(e) for e in reported] == before


@pytest.mark.parametrize("image", [BLACK, WHITE], ids=["black", "white"])
@pytest.mark.parametrize("speed_mps", [1.0, 0.0])
def test_a_blank_image_is_coasted_over_for_a_while(straight: list[Seen], image: np.ndarray, speed_mps: float) -> None:
    pipeline, options = Contour(CAR), CAR.pipeline.contour
    replayed(pipeline, straight)
    reported = shown(pipeline, image, straight, 90, speed_mps)
    coasting = [e for e in reported if e.valid]
    assert all(e.status is LaneStatus.COASTING for e in coasting)
    assert reported[: len(coasting)] == coasting  # once lost, lost for good
    way_s = options.coast_lanes * CAR.lane.width_m / speed_mps if speed_mps else math.inf
    assert 0.5 <= len(coasting) * PERIOD_NS * 1e-9 <= min(options.coast_s, way_s) + 0.1
    assert [e.frame_age_ns for e in reported] == [k * PERIOD_NS for k in range(1, 91)]
    assert not reported[-1].valid


def test_while_coasting_the_lane_moves_with_the_car_and_is_less_sure(seen: list[Seen]) -> None:
    pipeline = Contour(CAR)
    last = replayed(pipeline, seen)[-1].pose
    reported = shown(pipeline, BLACK, seen, 8, 1.0)
    assert last is not None
    sigmas = [math.sqrt(e.pose.covariance[0, 0]) for e in reported if e.pose]
    assert len(sigmas) == 8
    assert all(after > before for before, after in pairwise(sigmas))
    standing = Contour(CAR)
    replayed(standing, seen)
    still = shown(standing, BLACK, seen, 8, 0.0)[-1].pose
    assert still is not None
    assert still.offset_m == pytest.approx(last.offset_m, abs=2e-3)  # what was believed is told now
    assert still.heading_rad == pytest.approx(last.heading_rad, abs=1e-2)
    moved = reported[-1].pose
    assert moved is not None
    assert moved.offset_m != still.offset_m


def test_the_lane_is_found_again(seen: list[Seen]) -> None:
    pipeline = Contour(CAR)
    replayed(pipeline, seen)
    assert not shown(pipeline, BLACK, seen, 90, 1.0)[-1].valid
    again = replayed(pipeline, seen, 10**11)
    assert all(e.valid for e in again[3:])
    for estimate, s in zip(again[8:], seen[8:], strict=True):
        assert estimate.pose is not None
        assert estimate.pose.offset_m == pytest.approx(s.truth.offset_m, abs=0.01)


@pytest.mark.parametrize("jump_ns", [-(10**10), -1, 0, 10**9, 10**10, 2**62])
def test_a_gap_in_time_starts_again(seen: list[Seen], jump_ns: int) -> None:
    pipeline = Contour(CAR)
    replayed(pipeline, seen)
    t_ns = seen[-1].frame.t_ns + jump_ns
    dark = pipeline.step(Frame(t_ns=t_ns, index=0, image=BLACK), motion(t_ns, 1.0))
    check_sound(dark, t_ns)
    assert not dark.valid
    fresh = [pipeline.step(replace(s.frame, t_ns=t_ns + s.frame.t_ns + PERIOD_NS), s.motion) for s in seen[:6]]
    assert all(e.valid for e in fresh[3:])


def test_a_car_that_stands_keeps_its_lane(seen: list[Seen]) -> None:
    pipeline, last = Contour(CAR), seen[-1]
    replayed(pipeline, seen)
    for estimate in shown(pipeline, last.frame.image, seen, 45, 0.0):
        assert estimate.valid
        assert estimate.status is not LaneStatus.COASTING
        assert estimate.pose is not None
        assert estimate.pose.offset_m == pytest.approx(last.truth.offset_m, abs=0.01)
        assert estimate.pose.heading_rad == pytest.approx(last.truth.heading_rad, abs=0.03)


def test_frames_that_jump_are_not_followed_into_another_lane(seen: list[Seen]) -> None:
    """Every third image comes from elsewhere on the road; what is reported stays sound, and the lane is kept."""
    pipeline = Contour(CAR)
    reported = []
    for k, s in enumerate(seen):
        image = seen[(k * 17) % len(seen)].frame.image if k % 3 == 2 else s.frame.image
        reported.append(pipeline.step(replace(s.frame, image=image), s.motion))
        check_sound(reported[-1], s.frame.t_ns)
    errors = [abs(e.pose.offset_m - s.truth.offset_m) for e, s in zip(reported, seen, strict=True) if e.pose]
    assert len(errors) == len(seen)
    assert max(errors) < 0.25 * CAR.lane.width_m


@pytest.mark.parametrize("shape", [(240, 320), (360, 641), (1, 1), (720, 1280, 3), (640, 360), (1080, 1920)])
def test_images_of_another_size_are_no_lane(seen: list[Seen], shape: tuple[int, ...]) -> None:
    pipeline = Contour(CAR)
    for before in ([], seen):
        replayed(pipeline, before)
        t_ns = seen[-1].frame.t_ns + PERIOD_NS
        estimate = pipeline.step(Frame(t_ns=t_ns, index=99, image=np.zeros(shape, np.uint8)), motion(t_ns, 1.0))
        check_sound(estimate, t_ns)
        assert not estimate.valid
    t_ns += PERIOD_NS
    right = pipeline.step(Frame(t_ns=t_ns, index=100, image=seen[-1].frame.image), motion(t_ns))
    check_sound(right, t_ns)
    assert right.valid


@pytest.mark.parametrize("speed", ODD)
@pytest.mark.parametrize("yaw_rate", ODD)
def test_motion_that_cannot_be_is_not_used(seen: list[Seen], speed: float, yaw_rate: float) -> None:
    pipeline = Contour(CAR)
    replayed(pipeline, seen[:10])
    for s in seen[10:13]:
        reported = pipeline.step(s.frame, motion(s.frame.t_ns, speed, yaw_rate))
        check_sound(reported, s.frame.t_ns)
        assert reported.pose is not None
        assert reported.pose.offset_m == pytest.approx(s.truth.offset_m, abs=0.02)


def test_motion_that_cannot_be_counts_as_none(seen: list[Seen]) -> None:
    reported = []
    for source, speed in ((MotionSource.MEASURED, math.nan), (MotionSource.NONE, 0.0), (MotionSource.NONE, math.nan)):
        pipeline = Contour(CAR)
        replayed(pipeline, seen[:10])
        missing = [replace(s.motion, speed_mps=speed, source=source) for s in seen[10:20]]
        reported.append([bits(pipeline.step(s.frame, m)) for s, m in zip(seen[10:20], missing, strict=True)])
    assert reported[0] == reported[1] == reported[2]


@pytest.mark.parametrize("pitch_rad", [-1.2, -0.6])
def test_a_camera_that_sees_no_ground_is_refused(pitch_rad: float) -> None:
    with pytest.raises(ValueError, match="pitch_rad"):
        Contour(with_camera(camera(pitch_rad=pitch_rad)))
    with pytest.raises(ConfigError, match="pitch_rad"):
        make_pipeline("contour", with_camera(camera(pitch_rad=pitch_rad)))


@pytest.mark.parametrize(
    ("name", "value"), [("colour", "infrared"), ("update", "newton"), ("precision", "half"), ("nodes", 3)]
)
def test_options_that_are_none_are_refused(name: str, value: object) -> None:
    options: dict[str, Any] = {name: value}
    with pytest.raises(ValueError, match=name):
        ContourConfig(**options)


def test_stages_are_timed_by_the_stopwatch_alone(seen: list[Seen]) -> None:
    pipeline = Contour(CAR)
    replayed(pipeline, seen[:2])
    assert pipeline.stages.durations_ns == {}
    ticks = iter(range(0, 10**9, 7))
    pipeline.stages.stopwatch = lambda: next(ticks)
    replayed(pipeline, seen[2:4])
    assert {"prediction", "projection", "search", "update", "estimate"} <= set(pipeline.stages.durations_ns)
    assert all(taken % 7 == 0 for taken in pipeline.stages.durations_ns.values())
