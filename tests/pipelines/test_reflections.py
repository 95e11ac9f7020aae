"""Pipelines on floors that may be shiny: what they take for a line may be a lamp's reflection."""

from __future__ import annotations

import pytest

from automodel.assembly.parts import make_pipeline
from automodel.perception.line_scan import SightedLine
from automodel.sim.track_files import load_track
from automodel.tracking.belief import LaneBelief
from automodel.tracking.lane_tracking import Followed, LaneTracking
from tests.support.rendered_drives import CAR, RenderedDrive
from tests.support.slow_lane import rest_slow


@pytest.mark.parametrize("name", rest_slow(("windows", "contour", "centerline"), "windows", "contour"))
def test_of_each_line_that_is_looked_at_while_a_lane_is_followed_it_is_told_how_likely_it_is_a_reflection(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    judge, looked_at = LaneTracking.judge, list[SightedLine]()

    def watched(tracking: LaneTracking, lines: tuple[SightedLine, ...], followed: Followed) -> LaneBelief | None:
        looked_at.extend(lines)
        return judge(tracking, lines, followed)

    monkeypatch.setattr(LaneTracking, "judge", watched)
    seen = RenderedDrive(track=load_track("oval"), pipeline=make_pipeline(name, CAR)).run(0.5, 2.5)
    assert seen[-1].estimate.valid
    assert len(looked_at) > 4
    assert min(line.reflection for line in looked_at) > 0.0
