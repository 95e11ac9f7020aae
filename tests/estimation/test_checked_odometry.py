"""An odometry that is suspected, and the ground in the images that is asked."""

from __future__ import annotations

import dataclasses
from functools import lru_cache

import numpy as np
import pytest

from automodel.estimation import checked_odometry
from automodel.estimation.checked_odometry import ASKED, DISSENT, CheckedOdometry
from automodel.signals import Frame, Motion, MotionSource
from tests.estimation.test_image_motion import CAMERA, LANE, floor, frames

SPEED, YAW_RATE = 0.8, 0.4


@lru_cache(maxsize=2)
def drive(contrast: float = 40.0) -> tuple[Frame, ...]:
    return tuple(frames(SPEED, YAW_RATE, 12, floor(contrast)))


def told(frame: Frame, factor: float) -> Motion:
    return Motion(t_ns=frame.t_ns, speed_mps=factor * SPEED, yaw_rate_radps=YAW_RATE)


def suspected(factor: float, contrast: float = 40.0) -> tuple[CheckedOdometry, list[bool]]:
    """An odometry whose speed is wrong by a factor and suspected in the third frame; in which later ones it is used."""
    odometry, used = CheckedOdometry(CAMERA, LANE), []
    for frame in drive(contrast):
        motion = odometry.step(frame, told(frame, factor))
        if frame.index > 2:
            used.append(motion == told(frame, factor))
        if frame.index == 2:
            odometry.suspect()
    return odometry, used


@pytest.mark.parametrize("factor", [0.0, 1.0, 2.0])
def test_without_a_suspicion_it_is_used_as_it_is(factor: float) -> None:
    odometry = CheckedOdometry(CAMERA, LANE)
    assert all(odometry.step(frame, told(frame, factor)) == told(frame, factor) for frame in drive())


@pytest.mark.parametrize("factor", [0.0, -1.0, 0.5, 2.0])
def test_a_wrong_one_is_found_out_and_the_ground_tells_the_motion(factor: float) -> None:
    odometry, used = suspected(factor)
    before = DISSENT - 1  # frames
    assert not odometry.borne_out
    assert used == before * [True] + (9 - before) * [False]
    assert not odometry.trusted
    frame = frames(SPEED, YAW_RATE, 13, floor())[-1]
    motion = odometry.step(frame, told(frame, factor))
    assert motion.source is MotionSource.IMAGES
    assert motion.speed_mps == pytest.approx(SPEED, abs=0.05)


@pytest.mark.parametrize("contrast", [40.0, 0.0])
def test_a_right_one_is_kept_also_where_the_ground_says_nothing(contrast: float) -> None:
    odometry, used = suspected(1.0, contrast)
    assert all(used)
    assert odometry.trusted
    assert odometry.borne_out == (contrast > 0.0)


@pytest.mark.parametrize(("ground", "trusted"), [((1.0, 1.1), False), ((-1.0, 3.0), True)])
def test_ground_that_tells_another_speed_in_each_frame_tells_none(
    monkeypatch: pytest.MonkeyPatch, ground: tuple[float, float], trusted: bool
) -> None:
    """As that below a body that nods."""
    odometry = CheckedOdometry(CAMERA, LANE)
    monkeypatch.setattr(odometry._images, "agrees", lambda frame, motion: False)
    odometry.suspect()
    for frame in drive():
        odometry._images.most = np.array((ground[frame.index % 2] * SPEED, 0.0))
        odometry.step(frame, told(frame, 2.0))
    assert odometry.trusted is trusted


def later(frame: Frame, by_ns: int) -> Frame:
    return dataclasses.replace(frame, t_ns=frame.t_ns + by_ns)


@pytest.mark.parametrize(("factor", "trusted"), [(2.0, False), (1.0, True)])
def test_after_some_time_it_gets_another_chance(monkeypatch: pytest.MonkeyPatch, factor: float, trusted: bool) -> None:
    odometry, _ = suspected(2.0)
    monkeypatch.setattr(checked_odometry, "RETRY_NS", 100_000_000)
    for frame in frames(SPEED, YAW_RATE, 18, floor())[12:]:
        odometry.step(frame, told(frame, factor))
    assert odometry.trusted is trusted


@pytest.mark.parametrize("by_ns", [-(10**12), 10**12])
def test_time_that_jumps_gives_another_chance(by_ns: int) -> None:
    odometry, _ = suspected(2.0)
    assert not odometry.trusted
    frame = later(drive()[-1], by_ns)
    odometry.step(frame, told(frame, 2.0))
    assert odometry.trusted


def test_by_another_camera_it_is_trusted_again() -> None:
    odometry, _ = suspected(2.0)
    odometry.see_with(CAMERA.pitched(0.02))
    assert odometry.trusted


def test_after_a_reset_it_is_trusted() -> None:
    odometry, _ = suspected(2.0)
    odometry.reset()
    assert odometry.trusted
    assert odometry.step(drive()[0], told(drive()[0], 2.0)) == told(drive()[0], 2.0)


def test_a_motion_that_is_not_known_is_that_of_the_ground() -> None:
    odometry = CheckedOdometry(CAMERA, LANE)
    unknown = Motion(t_ns=0, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
    motions = [odometry.step(frame, dataclasses.replace(unknown, t_ns=frame.t_ns)) for frame in drive()[:6]]
    assert motions[-1].source is MotionSource.IMAGES


def test_a_suspicion_that_nothing_bears_out_is_dropped() -> None:
    odometry, asked = CheckedOdometry(CAMERA, LANE), []
    seen = frames(SPEED, YAW_RATE, ASKED + 6, floor(contrast=0.0))
    for frame in seen:
        odometry.step(frame, told(frame, 1.0))
        if frame.index == 2:
            odometry.suspect()
        asked.append(odometry._others is not None)
    assert asked == [2 <= index < 2 + ASKED for index in range(len(seen))]
    assert odometry.trusted
