from __future__ import annotations

import math
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import pytest

from automodel.runtime.loop import Loop, estimate_faults, motion_faults, state_faults
from automodel.signals import (
    NEUTRAL,
    Command,
    Crossing,
    Frame,
    LaneEstimate,
    LaneStatus,
    Motion,
    MotionSource,
    StereoFrame,
    VehicleState,
)
from tests.support.runner_fakes import MS, PICTURE, FakeController, FakeLimits, FakePipeline, Straight, estimate, frame

MOTION = Motion(t_ns=0, speed_mps=0.5, yaw_rate_radps=0.1)


def make(pipeline: FakePipeline | None = None, **how: object) -> tuple[Loop, FakePipeline, FakeController, FakeLimits]:
    parts = (pipeline or FakePipeline(), FakeController(), FakeLimits())
    return Loop(*parts, validity_s=0.1, **how), *parts  # type: ignore[arg-type]


def test_a_tick_is_the_chain() -> None:
    loop, pipeline, controller, _ = make()
    controller.override = Command(t_ns=0, steering_rad=0.3, speed_mps=9.0, valid_until_ns=70 * MS)
    tick = loop.tick(frame(10.0), MOTION, None, 12 * MS)
    assert pipeline.motions == [MOTION]
    assert tick.estimate.status is LaneStatus.TRACKING
    assert tick.motion is MOTION
    assert (tick.wanted.speed_mps, tick.command.speed_mps, tick.command.steering_rad) == (9.0, 2.0, 0.3)
    assert (tick.limited_by, tick.faults) == (("speed",), ())
    assert tick.command.valid_until_ns == 70 * MS  # a shorter life than the frame's is kept


@pytest.mark.parametrize(("captured_ms", "valid_until_ms"), [(10.0, 110), (40.0, 112)])
def test_a_command_lives_no_longer_than_its_frame_allows(captured_ms: float, valid_until_ms: int) -> None:
    loop, *_ = make()  # the controller would let it live for a second
    tick = loop.tick(frame(captured_ms), MOTION, None, 12 * MS)  # 40 ms: from a clock that runs ahead
    assert tick.command.valid_until_ns == valid_until_ms * MS


def test_stages_are_timed_by_the_stopwatch() -> None:
    readings = iter([0, 100, 130, 134])
    loop, *_ = make(stopwatch=lambda: next(readings))
    assert loop.tick(frame(0.0), MOTION, None, 0).stages_ns == (100, 30, 4)
    assert make()[0].tick(frame(0.0), MOTION, None, 0).stages_ns == (0, 0, 0)


def test_the_stopwatch_changes_nothing_else() -> None:
    odd = count(17, 1000)
    timed, plain = make(stopwatch=lambda: next(odd))[0], make()[0]
    for i in range(5):
        a = timed.tick(frame(16.0 * i, i), MOTION, None, 16 * i * MS)
        b = plain.tick(frame(16.0 * i, i), MOTION, None, 16 * i * MS)
        assert a.command == b.command


def test_a_pipeline_of_one_camera_sees_the_left_picture_of_a_pair() -> None:
    loop, pipeline, *_ = make()
    right = np.ones((2, 2), dtype=np.uint8)
    loop.tick(StereoFrame(t_ns=5, index=3, left=PICTURE, right=right), MOTION, None, 6)
    assert (pipeline.seen[0].t_ns, pipeline.seen[0].index) == (5, 3)
    assert not pipeline.seen[0].image.any()


def test_a_pipeline_of_one_camera_is_not_given_what_the_right_one_sees_alone() -> None:
    loop, pipeline, *_ = make()
    tick = loop.tick(Frame(t_ns=5, index=3, image=PICTURE, eye=1), MOTION, None, 6)
    assert pipeline.seen == []
    assert (tick.estimate.status, tick.command.speed_mps) == (LaneStatus.LOST, 0.0)
    assert tick.faults == ("the left camera gives no image, and this pipeline sees through that one alone",)


class Looked:
    """Checks that keep what they are asked about."""

    def __init__(self) -> None:
        self.asked: list[tuple[object, object]] = []

    def misfit(self, frame: Frame | StereoFrame) -> None:
        pass

    def of_frame(self, frame: Frame | StereoFrame, seen: Frame | StereoFrame) -> tuple[str, ...]:
        self.asked.append((frame, seen))
        return ()

    def of_estimate(self, estimate: LaneEstimate, motion: Motion, state: VehicleState | None) -> tuple[str, ...]:
        return ()


@pytest.mark.parametrize("cameras", [1, 2])
def test_only_a_pipeline_of_two_cameras_is_given_the_good_eye_alone(cameras: int) -> None:
    pipeline, checks = FakePipeline(), Looked()
    pipeline.cameras = cameras  # type: ignore[attr-defined]
    loop, *_ = make(pipeline, checks=checks)
    road = np.arange(64, dtype=np.uint8).reshape(8, 8) * 4
    pair = StereoFrame(t_ns=5, index=3, left=np.zeros((8, 8), np.uint8), right=road)
    loop.tick(pair, MOTION, None, 6)
    ((frame, seen),) = checks.asked
    assert frame is pair
    if cameras == 1:
        assert seen is pair
        assert not pipeline.seen[0].image.any()
        assert (loop.eye_trouble, loop.warning) == ("", "")
        return
    assert seen is pipeline.seen[0]
    assert (seen.eye, seen.t_ns, seen.index) == (1, 5, 3)
    assert (seen.image == road).all()
    assert loop.eye_trouble == "left camera: the image is blank"
    pipeline.warning = "too wide"  # type: ignore[attr-defined]
    assert loop.warning == "1 images of the left camera were left out: the image is blank; too wide"


def test_an_exception_of_a_stage_goes_up() -> None:
    loop, *_ = make(FakePipeline({0: KeyError("x")}))
    with pytest.raises(KeyError):
        loop.tick(frame(0.0), MOTION, None, 0)


class Misfit:
    """Checks to which no frame fits."""

    def misfit(self, frame: Frame | StereoFrame) -> str:
        return "too small"

    def of_frame(self, frame: Frame | StereoFrame, seen: Frame | StereoFrame) -> tuple[str, ...]:
        raise AssertionError("not looked at any more")

    def of_estimate(self, estimate: LaneEstimate, motion: Motion, state: VehicleState | None) -> tuple[str, ...]:
        raise AssertionError("there is none")


def test_a_frame_that_does_not_fit_never_reaches_the_pipeline() -> None:
    loop, pipeline, *_ = make(checks=Misfit())
    tick = loop.tick(frame(7.0), MOTION, None, 8 * MS)
    assert pipeline.seen == []
    assert (tick.estimate.status, tick.faults, tick.command.speed_mps) == (LaneStatus.LOST, ("too small",), 0.0)


def test_what_a_pipeline_finds_wrong_with_the_cameras_is_a_fault_of_the_lane() -> None:
    pipeline = FakePipeline()
    loop, *_ = make(pipeline)
    assert loop.tick(frame(0.0), MOTION, None, MS).lane_faults == ()
    pipeline.trouble = "a camera was turned"  # type: ignore[attr-defined]
    assert loop.tick(frame(20.0, 1), MOTION, None, 21 * MS).lane_faults == ("a camera was turned",)


def test_an_estimate_that_is_not_finite_is_lost() -> None:
    loop, pipeline, *_ = make(FakePipeline({0: math.nan}))
    tick = loop.tick(frame(7.0), MOTION, None, 8 * MS)
    assert (tick.estimate.status, tick.estimate.t_ns, tick.estimate.pose) == (LaneStatus.LOST, 7 * MS, None)
    assert tick.faults == ("the estimate's pose is not finite",)
    assert tick.command.speed_mps == 0.0
    assert pipeline.resets == 0  # it still knows the lane
    assert loop.tick(frame(20.0, 1), MOTION, None, 21 * MS).faults == ()


def test_a_pipeline_that_fails_four_times_in_a_row_begins_anew() -> None:
    failing: dict[int, object] = dict.fromkeys((0, 1, 2, 4, 5, 6, 7, 8, 9, 10, 11), math.nan)
    loop, pipeline, *_ = make(FakePipeline(failing))
    resets = []
    for index in range(13):
        loop.tick(frame(16.0 * index, index), MOTION, None, 16 * index * MS)
        resets.append(pipeline.resets)
    assert resets == [0] * 7 + [1] * 4 + [2] * 2
    for _ in range(4):
        loop.failed()  # by an exception: it is the same
    assert pipeline.resets == 3


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", ["steering_rad", "speed_mps"])
@pytest.mark.parametrize("stage", ["controller", "limits"])
def test_a_command_that_is_not_finite_is_a_standstill(stage: str, field: str, bad: float) -> None:
    loop, _, controller, limits = make()
    values: dict[str, Any] = {"steering_rad": 0.1, "speed_mps": 0.5, field: bad}
    command = Command(t_ns=0, valid_until_ns=50 * MS, **values)
    if stage == "controller":
        controller.override = command
    else:
        limits.override = command
    tick = loop.tick(frame(0.0), MOTION, None, 0)
    assert (tick.command.steering_rad, tick.command.speed_mps) == (0.0, 0.0)
    assert len(tick.faults) == 1
    assert tick.faults[0].startswith(f"the {stage} gave")
    assert (controller.resets, len(limits.reset_to)) == ((1, 0) if stage == "controller" else (0, 1))


@pytest.mark.parametrize("bad", [{"speed_mps": math.nan}, {"yaw_rate_radps": math.inf}])
def test_a_motion_that_is_not_finite_never_reaches_the_pipeline(bad: dict[str, Any]) -> None:
    loop, pipeline, *_ = make()
    tick = loop.tick(frame(0.0), replace(MOTION, **bad), None, 0)
    assert pipeline.motions == [Motion(t_ns=0, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)]
    assert tick.motion == pipeline.motions[0]
    assert len(tick.faults) == 1


def test_overruled_starts_the_ramp_anew_and_tells_the_limits_what_is_on_the_wire() -> None:
    loop, _, _, limits = make()
    speeds = [loop.tick(frame(16.0 * i, i), MOTION, None, 16 * i * MS).command.speed_mps for i in range(4)]
    assert speeds == pytest.approx([0.1, 0.2, 0.3, 0.4])
    loop.overruled(NEUTRAL)
    assert limits.reset_to == [NEUTRAL]
    assert loop.tick(frame(90.0, 5), MOTION, None, 90 * MS).command.speed_mps == pytest.approx(0.1)


class Doubtful(FakePipeline):
    """A lane that may be the next one: its offset's bound is `bound_m`, of a lane of 0.4 m."""

    bound_m = 0.52

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        seen = super().step(frame, motion)
        assert seen.pose is not None
        return replace(seen, pose=replace(seen.pose, offset_bound_m=self.bound_m))


STANDING = Motion(t_ns=0, speed_mps=0.0, yaw_rate_radps=0.0)


def resets(state: VehicleState | None, motion: Motion = STANDING, bound_m: float = 0.52) -> list[int]:
    """How often the pipeline was reset after each of 50 frames of 20 ms."""
    pipeline = Doubtful()
    pipeline.bound_m = bound_m
    loop, *_ = make(pipeline)
    counts = []
    for index in range(50):
        loop.tick(frame(20.0 * index, index), motion, state, 20 * index * MS)
        counts.append(pipeline.resets)
    return counts


def test_a_car_that_stands_looks_for_its_lane_anew_where_it_may_not_be_armed_in_it() -> None:
    state = VehicleState(t_ns=0, armed=False)
    assert resets(state) == [1] * 25 + [2] * 25
    assert resets(state, bound_m=0.2)[-1] == 2
    assert resets(state, bound_m=0.19)[-1] == 0
    assert resets(state, bound_m=math.inf)[-1] == 0  # it states none


def test_a_car_that_is_armed_or_moves_or_may_move_keeps_its_lane() -> None:
    disarmed = VehicleState(t_ns=0, armed=False)
    assert resets(VehicleState(t_ns=0, armed=True))[-1] == 0
    assert resets(None)[-1] == 0
    assert resets(disarmed, replace(STANDING, speed_mps=0.1))[-1] == 0
    assert resets(disarmed, replace(STANDING, source=MotionSource.NONE))[-1] == 0


def test_reset_forgets_all() -> None:
    loop, pipeline, _, limits = make()
    loop.tick(frame(0.0), MOTION, None, 0)
    loop.reset()
    assert (pipeline.resets, limits.reset_to) == (1, [None])
    assert loop.tick(frame(16.0, 1), MOTION, None, 16 * MS).command.speed_mps == pytest.approx(0.1)


def test_estimate_faults() -> None:
    good = estimate(0)
    assert good.pose is not None
    assert estimate_faults(good) == ()
    assert estimate_faults(estimate(0, LaneStatus.LOST)) == ()
    assert len(estimate_faults(LaneEstimate(t_ns=0, status=LaneStatus.COASTING))) == 1
    assert len(estimate_faults(replace(good, centerline=None))) == 1
    for name in ("offset_m", "heading_rad", "width_m", "curvature_per_m"):
        wrong: dict[str, Any] = {name: math.nan}
        assert len(estimate_faults(replace(good, pose=replace(good.pose, **wrong)))) == 1
    covariance = np.eye(3)
    covariance[1, 2] = math.inf
    assert len(estimate_faults(replace(good, pose=replace(good.pose, covariance=covariance)))) == 1
    for offset_m, heading_rad in ((math.nan, 0.1), (0.1, math.nan), (-0.01, 0.1)):
        pose = replace(good.pose, offset_bound_m=offset_m, heading_bound_rad=heading_rad)
        assert estimate_faults(replace(good, pose=pose)) == ("a bound of the estimate's pose is not a number >= 0",)
    stated = replace(good.pose, offset_bound_m=0.0, heading_bound_rad=0.1)
    assert estimate_faults(replace(good, pose=stated)) == ()
    assert estimate_faults(replace(good, crossing=Crossing(distance_m=1.0, angle_rad=1.5))) == ()
    assert len(estimate_faults(replace(good, crossing=Crossing(distance_m=math.inf, angle_rad=1.5)))) == 1
    assert len(estimate_faults(replace(good, crossing=Crossing(distance_m=1.0, angle_rad=math.nan)))) == 1
    assert len(estimate_faults(replace(good, centerline=Straight(math.nan)))) == 1


def test_motion_and_state_faults() -> None:
    assert motion_faults(MOTION) == ()
    assert len(motion_faults(replace(MOTION, yaw_rate_radps=-math.inf))) == 1
    state = VehicleState(t_ns=0, speed_mps=1.0, ranges_m=(None, 0.4, 1.0), battery_v=7.4)
    assert state_faults(state) == ()
    wrong: dict[str, Any] = {"speed_mps": math.nan, "ranges_m": (None, math.nan), "battery_v": math.inf}
    wrong |= {"yaw_rate_radps": math.nan, "steering_rad": math.nan}
    for name, value in wrong.items():
        assert len(state_faults(replace(state, **{name: value}))) == 1


def test_a_life_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="validity_s"):
        Loop(FakePipeline(), FakeController(), FakeLimits(), validity_s=0.0)
