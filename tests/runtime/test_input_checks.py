from __future__ import annotations

import dataclasses

import numpy as np

from automodel.config import CameraConfig, CarConfig
from automodel.runtime.input_checks import InputChecks
from automodel.runtime.loop import Loop
from automodel.signals import Frame, LaneStatus, Motion, StereoFrame
from tests.support.runner_fakes import MS, FakeController, FakeLimits, FakePipeline

CAR = dataclasses.replace(CarConfig(), camera=CameraConfig(width_px=160, height_px=90))
MOTION = Motion(t_ns=0, speed_mps=1.0, yaw_rate_radps=0.0)
RNG = np.random.default_rng(0)
NOISY = [np.tile(np.linspace(20, 220, 160), (90, 1)) + RNG.normal(0, 2, (90, 160)) for _ in range(20)]
ROAD = [picture.clip(0, 255).astype(np.uint8) for picture in NOISY]


def make(at: dict[int, object] | None = None) -> tuple[Loop, FakePipeline]:
    pipeline = FakePipeline(at)
    return Loop(pipeline, FakeController(), FakeLimits(), validity_s=0.1, checks=InputChecks(CAR)), pipeline


def tick(loop: Loop, index: int, image: np.ndarray):
    frame = Frame(t_ns=index * 16 * MS, index=index, image=image)
    return loop.tick(frame, MOTION, None, frame.t_ns + 3 * MS)


def test_a_frame_of_another_size_never_reaches_the_pipeline() -> None:
    loop, pipeline = make()
    assert tick(loop, 0, ROAD[0]).faults == ()
    wrong = tick(loop, 1, ROAD[1][::2])
    assert wrong.estimate.status is LaneStatus.LOST
    assert wrong.faults == ("the image has 160x45 pixels; the camera has 160x90",)
    assert wrong.command.speed_mps == 0.0
    assert [frame.index for frame in pipeline.seen] == [0]
    assert tick(loop, 2, ROAD[2]).faults == ()


def test_doubts_are_told_beside_an_estimate_that_is_left_as_it_is() -> None:
    loop, pipeline = make()
    ticks = [tick(loop, index, ROAD[0]) for index in range(6)]
    assert [len(each.faults) for each in ticks] == [0, 0, 0, 0, 1, 1]
    assert {each.estimate.status for each in ticks} == {LaneStatus.TRACKING}
    assert len(pipeline.seen) == 6


def test_a_lane_that_jumps_is_told_in_its_tick() -> None:
    loop, _ = make({3: 0.3})
    faults = [tick(loop, index, ROAD[index]).faults for index in range(5)]
    assert faults == [(), (), (), ("the lane has jumped sideways by 0.30 m",), ()]


def test_an_exception_of_the_pipeline_makes_nobody_forget_the_last_lane() -> None:
    loop, _ = make({1: 0.3})
    tick(loop, 0, ROAD[0])
    loop.reset()
    assert tick(loop, 1, ROAD[1]).faults != ()


def test_both_pictures_of_a_pair_are_looked_at() -> None:
    checks = InputChecks(CAR)

    def of_pair(index: int, left: np.ndarray, right: np.ndarray) -> tuple[str, ...]:
        return checks.of_frame(StereoFrame(t_ns=index * 16 * MS, index=index, left=left, right=right))

    found = [of_pair(index, ROAD[index], ROAD[0]) for index in range(6)]
    assert [len(texts) for texts in found] == [0, 0, 0, 0, 1, 1]
    pair = StereoFrame(t_ns=0, index=0, left=ROAD[0], right=ROAD[0][::2])
    assert checks.misfit(pair) is not None
