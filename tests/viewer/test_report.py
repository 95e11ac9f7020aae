"""The figures and the page of a report."""

from __future__ import annotations

import dataclasses
import math
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from automodel.signals import Event, LaneEstimate, LanePose, LaneStatus, Motion, MotionSource
from automodel.viewer.report_page import page
from automodel.viewer.report_plots import MOST_POINTS, plots, thinned
from automodel.viewer.run_trace import (
    DrivenPath,
    Moment,
    ReportedRun,
    RunTrace,
    TraceRecorder,
    dead_reckoned,
    disagreement_m,
    metrics,
)


def pose_at(offset_m: float, bound_m: float) -> LanePose:
    return LanePose(
        offset_m=offset_m,
        heading_rad=0.1,
        width_m=0.4,
        curvature_per_m=0.0,
        covariance=np.eye(3),
        offset_bound_m=bound_m,
    )


def trace(name: str, offsets_m: list[float], bound_m: float = 0.05) -> RunTrace:
    """A pipeline that saw the lane, 0.4 m wide, at these offsets, 0.1 s apart; LOST where NaN."""
    recorder = TraceRecorder(name)
    for frame, offset in enumerate(offsets_m):
        estimate = LaneEstimate(t_ns=0, status=LaneStatus.LOST)
        if math.isfinite(offset):
            estimate = dataclasses.replace(estimate, status=LaneStatus.TRACKING, pose=pose_at(offset, bound_m))
        recorder.add(0.1 * frame, frame, estimate, 2.0 + frame)
    return recorder.trace()


def run(*traces: RunTrace, name: str = "run.mcap", truth_m: list[float] | None = None, **more) -> ReportedRun:
    values = {"path": None, "events": (), "moments": (), "settings": {}} | more
    truth = None if truth_m is None else np.array(truth_m)
    return ReportedRun(name=name, origin="somewhere", traces=traces, truth_m=truth, **values)


def test_figures_of_two_pipelines_on_the_same_frames() -> None:
    first, second = trace("one", [0.0, 0.1, math.nan, 0.2]), trace("two", [0.02, 0.12, 0.3, 0.3])
    np.testing.assert_allclose(disagreement_m([first, second])[1], [0.01, 0.01, math.nan, 0.05])
    one, two = metrics(run(first, second))
    assert (one["pipeline"], one["frames"], one["availability_pct"], one["lost_pct"]) == ("one", 4, 75.0, 25.0)
    assert two["disagreement_median_m"] == pytest.approx(0.01)
    assert one["p50_ms"] == 3.5
    assert one["misled_pct"] is None


@pytest.mark.parametrize(("bound_m", "misled_pct"), [(0.05, 25.0), (0.2, 0.0), (math.inf, 0.0)])
def test_a_frame_misleads_that_is_off_by_a_quarter_lane_and_does_not_say_so(bound_m: float, misled_pct: float) -> None:
    (row,) = metrics(run(trace("one", [0.0, 0.15, math.nan, 0.04], bound_m), truth_m=[0.0, 0.0, 0.0, 0.0]))
    assert row["misled_pct"] == misled_pct
    assert row["offset_mae_m"] == pytest.approx((0.15 + 0.04) / 3.0)


def test_a_quarter_circle_is_added_up() -> None:
    t_s = np.linspace(0.0, 2.0, 201)
    rate = 0.25 * math.pi
    path = dead_reckoned(t_s, [Motion(t_ns=0, speed_mps=rate, yaw_rate_radps=rate)] * 201)  # of radius 1 m
    np.testing.assert_allclose(path.xy_m[-1], [1.0, 1.0], atol=1e-4)
    unknown = Motion(t_ns=0, speed_mps=9.0, yaw_rate_radps=9.0, source=MotionSource.NONE)
    still = dead_reckoned(t_s, [unknown] * 201)
    assert not still.xy_m.any()
    assert np.isnan(still.speed_mps).all()


def test_thinned_curves_keep_peaks_and_gaps() -> None:
    t_s = np.linspace(0.0, 60.0, 10 * MOST_POINTS)
    values = np.zeros(len(t_s))
    values[1234] = -3.0
    values[3000:3500] = math.nan
    times, kept = thinned(t_s, values)
    assert len(times) == len(kept) == MOST_POINTS
    assert np.nanmin(kept) == -3.0
    assert np.isnan(kept).any()


def whole() -> ReportedRun:
    path = DrivenPath(xy_m=np.arange(8.0).reshape(4, 2), speed_mps=np.full(4, 0.5), true=False)
    moment = Moment(t_s=0.1, frame=1, why="one LOST", pictures={"one": np.zeros((90, 160, 3), np.uint8)})
    event = Event(t_ns=0, kind="hold", text="<b>no & frame</b>")
    return run(
        trace("one", [0.0, 0.1, math.nan, 0.2]),
        trace("two", [0.0, 0.1, 0.1, 0.2]),
        name='<script>"x"&.mcap',
        truth_m=[0.0, 0.1, math.nan, 0.2],
        path=path,
        moments=(moment,),
        events=((0.1, event),),
        settings={"lane.width_m": 0.4},
    )


def test_a_page_needs_nothing_else_and_shows_everything() -> None:
    other = run(trace("one", [0.0]), name="other.mp4", settings={"lane.width_m": 3.7})
    text = page([whole(), other], "1.2.3")
    assert not re.search(r'(src|href)="(?!data:|#)', text)
    assert "<script" not in text
    assert "<b>no" not in text
    for shown in (
        "Map",
        "Speed",
        "Heading",
        "Status",
        "Disagreement",
        "Worst moments",
        "lane.width_m",
        "hold",
        "misled",
    ):
        assert shown in text
    assert "the motion of the car is not known" in text  # of the other run
    assert 'name="viewport"' in text


def test_plots_are_drawings_that_scale() -> None:
    names: set[str] = set()
    for svg in plots(whole()).values():
        root = ET.fromstring(svg)
        assert "viewBox" in root.attrib
        assert "width" not in root.attrib
        own = {part.attrib["id"] for part in root.iter() if "id" in part.attrib}
        assert not own & names  # in one page two parts of one name would be one
        names |= own


def test_a_run_in_which_nothing_was_seen_has_a_page() -> None:
    lost = run(trace("one", [math.nan] * 3), trace("two", [math.nan] * 3))
    assert "100" in page([lost], "1")
