"""`contour` with an odometer that lies: it stands still, counts backwards, or counts too much or too little."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import pytest

from automodel.bench.accuracy import FALSE_LANE
from automodel.pipelines.contour import Contour
from automodel.sim.track_files import load_track
from tests.support.rendered_drives import CAR, RenderedDrive, Seen, check_sound
from tests.support.slow_lane import rest_slow

RIGHT = 20  # frames for which the odometer is right
PERIOD_S = 1.0 / 30.0


@lru_cache(maxsize=4)
def drive(name: str, direction: str, from_m: float, to_m: float) -> list[Seen]:
    return RenderedDrive(track=load_track(name), direction=direction, pipeline=Contour(CAR)).run(from_m, to_m)


def longest_false_s(seen: list[Seen], factor: float) -> tuple[float, float]:
    """The longest time that another lane is reported, and the share of frames with a lane."""
    pipeline, longest, run, reported = Contour(CAR), 0, 0, 0
    for k, one in enumerate(seen):
        motion = one.motion if k < RIGHT else replace(one.motion, speed_mps=factor * one.motion.speed_mps)
        estimate = pipeline.step(one.frame, motion)
        check_sound(estimate, one.frame.t_ns)
        reported += estimate.valid
        off = estimate.pose is not None and abs(estimate.pose.offset_m - one.truth.offset_m)
        run = run + 1 if off > FALSE_LANE * one.truth.width_m else 0
        longest = max(longest, run)
    return longest * PERIOD_S, reported / len(seen)


@pytest.mark.parametrize("factor", rest_slow((0.0, -1.0, 0.5, 2.0), -1.0, 2.0))
@pytest.mark.parametrize(
    "place", [("tmr", "forward", 16.0, 21.0), ("oval", "reverse", 0.5, 6.0), ("chicane", "reverse", 0.5, 6.0)]
)
def test_a_wrong_speed_tells_no_other_lane_for_long(place: tuple[str, str, float, float], factor: float) -> None:
    false_s, reported = longest_false_s(drive(*place), factor)
    assert false_s <= 0.34
    assert reported > 0.85


@pytest.mark.parametrize("place", [("tmr", "forward", 16.0, 21.0), ("chicane", "reverse", 0.5, 6.0)])
def test_a_right_speed_is_never_dropped(place: tuple[str, str, float, float]) -> None:
    pipeline = Contour(CAR)
    for one in drive(*place):
        pipeline.step(one.frame, one.motion)
        assert pipeline._odometry.trusted(one.frame.t_ns)
