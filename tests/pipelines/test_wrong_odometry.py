"""Pipelines with an odometer that lies: it stands still, counts backwards, or counts too much or too little."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import pytest

from automodel.interfaces import Pipeline
from automodel.pipelines.contour import Contour
from automodel.pipelines.windows import Windows
from automodel.signals import FALSE_LANE, Motion
from automodel.sim.track_files import load_track
from tests.support.rendered_drives import CAR, RenderedDrive, Seen, check_sound
from tests.support.slow_lane import rest_slow

RIGHT = 20  # frames for which the odometer is right
PERIOD_S = 1.0 / 30.0
PLACES = [("tmr", "forward", 16.0, 21.0), ("oval", "reverse", 0.5, 6.0), ("chicane", "reverse", 0.5, 6.0)]
FACTORS = (0.0, -1.0, 0.5, 2.0)


@lru_cache(maxsize=4)
def drive(name: str, direction: str, from_m: float, to_m: float) -> list[Seen]:
    return RenderedDrive(track=load_track(name), direction=direction, pipeline=Contour(CAR)).run(from_m, to_m)


def driven(pipeline: Pipeline, seen: list[Seen], speed: float = 1.0, yaw_rate: float = 1.0) -> tuple[float, int, float]:
    """The longest time that another lane is told, the frames that mislead, and the share of frames with a lane."""
    longest, run, misled, reported = 0, 0, 0, 0
    for k, one in enumerate(seen):
        motion = one.motion if k < RIGHT else wrong(one.motion, speed, yaw_rate)
        estimate = pipeline.step(one.frame, motion)
        check_sound(estimate, one.frame.t_ns)
        reported += estimate.valid
        off = 0.0 if estimate.pose is None else abs(estimate.pose.offset_m - one.truth.offset_m)
        false = off > FALSE_LANE * one.truth.width_m
        run = run + 1 if false else 0
        longest = max(longest, run)
        misled += false and estimate.pose is not None and off > estimate.pose.offset_bound_m
    return longest * PERIOD_S, misled, reported / len(seen)


def wrong(motion: Motion, speed: float, yaw_rate: float) -> Motion:
    return replace(motion, speed_mps=speed * motion.speed_mps, yaw_rate_radps=yaw_rate * motion.yaw_rate_radps)


@pytest.mark.parametrize("factor", rest_slow(FACTORS, -1.0, 2.0))
@pytest.mark.parametrize("place", PLACES)
def test_a_wrong_speed_misleads_contour_in_no_frame(place: tuple[str, str, float, float], factor: float) -> None:
    false_s, misled, reported = driven(Contour(CAR), drive(*place), speed=factor)
    assert misled == 0
    assert false_s <= 0.75  # told within its bound, until no other story is likelier than that allows
    assert reported > 0.85


@pytest.mark.parametrize("factor", rest_slow(FACTORS, 0.5))
@pytest.mark.parametrize("place", PLACES)
def test_a_wrong_speed_does_not_mislead_windows_for_long(place: tuple[str, str, float, float], factor: float) -> None:
    _, misled, reported = driven(Windows(CAR), drive(*place), speed=factor)
    assert misled * PERIOD_S <= 0.2
    assert reported > 0.85


@pytest.mark.parametrize("factor", rest_slow((0.0, 0.5, 2.0), 0.0))
@pytest.mark.parametrize("pipeline", [Contour, Windows])
@pytest.mark.parametrize("place", PLACES)
def test_a_wrong_yaw_rate_does_not_mislead_for_long(
    place: tuple[str, str, float, float], pipeline: type[Contour | Windows], factor: float
) -> None:
    _, misled, reported = driven(pipeline(CAR), drive(*place), yaw_rate=factor)
    hard = pipeline is Windows and place[0] == "chicane"  # two lanes fit until the next bend
    assert misled * PERIOD_S <= ({0.0: 0.3, 0.5: 0.6}.get(factor, 0.2) if hard else 0.2)
    assert reported > 0.85


@pytest.mark.parametrize("place", [PLACES[0], PLACES[2]])
def test_a_right_speed_is_never_dropped(place: tuple[str, str, float, float]) -> None:
    pipeline = Contour(CAR)
    for one in drive(*place):
        pipeline.step(one.frame, one.motion)
        assert pipeline._tracking.reckons or one.frame.index == 0
