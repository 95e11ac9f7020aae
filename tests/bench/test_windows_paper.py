"""The tables of `windows` on constructed residuals, crossings and durations; where a zebra truly is."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.bench.accuracy import Case
from automodel.bench.windows_paper import (
    LaneCrossings,
    TrueCrossing,
    WindowsPaperMeter,
    measure_case,
    residuals_px,
    section_of,
)
from automodel.config import CarConfig
from automodel.curves import GraphCurve, line
from automodel.geometry import View
from automodel.signals import Crossing, LaneEstimate, LaneLine, LaneStatus
from automodel.sim.track_files import load_track
from automodel.sim.trajectory import DrivenPose
from tests.support.command_line import Cli, cli

__all__ = ["cli"]

X = np.array([0.5, 0.6, 0.7, 0.8])
PARABOLA = np.array([0.2, -0.3, 0.4])


def meter() -> WindowsPaperMeter:
    return WindowsPaperMeter(m_per_px=0.005, m_per_row=0.01, gate_m=0.2)


def lane_line(off_px: list[float], m_per_px: float = 0.005) -> LaneLine:
    """Points that lie `off_px` to the left of a parabola, which is told to be their regression."""
    x = X[: len(off_px)]
    y = PARABOLA[0] + PARABOLA[1] * x + PARABOLA[2] * x * x + m_per_px * np.array(off_px)
    return LaneLine(curve=GraphCurve(PARABOLA, 0.5, 0.8), points_m=np.stack((x, y), axis=1), seen=True)


def estimate(left: LaneLine | None, right: LaneLine | None) -> LaneEstimate:
    return LaneEstimate(t_ns=0, status=LaneStatus.TRACKING, left=left, right=right)


def zebra(distance_m: float, name: str = "a", angle_rad: float = 0.5 * math.pi, edge: bool = True) -> TrueCrossing:
    return TrueCrossing(name=name, distance_m=distance_m, angle_rad=angle_rad, edge_in_view=edge)


def crossing(distance_m: float, angle_rad: float = 0.5 * math.pi) -> Crossing:
    return Crossing(distance_m=distance_m, angle_rad=angle_rad)


def test_residuals_are_across_the_road_in_pixels() -> None:
    assert residuals_px(lane_line([1.0, -2.0, 0.5, 0.0]), 0.005) == pytest.approx([1.0, -2.0, 0.5, 0.0])


def test_a_line_without_spare_points_or_regression_has_no_residuals() -> None:
    edge = LaneLine(curve=line(0.0, 0.0, 0.0, 1.0), points_m=np.ones((9, 2)), seen=True)
    assert residuals_px(lane_line([1.0, 2.0, 3.0]), 0.005) is None  # a parabola goes through any three
    assert residuals_px(edge, 0.005) is None


def test_figures_are_means_over_pictures_beside_the_papers() -> None:
    told = meter()
    told.add_lines("curve B", estimate(lane_line([1.0, -1.0, 1.0, -1.0]), None))
    told.add_lines("curve B", estimate(lane_line([4.0, 0.0, 0.0, 0.0]), lane_line([2.0, 2.0, 2.0, 2.0])))
    told.add_lines(None, estimate(lane_line([9.0, 9.0, 9.0, 9.0]), None))
    rows = {(row["section"], row["line"]): row for row in told.line_rows()}
    assert len(rows) == 6
    left, right = rows["curve B", "left"], rows["curve B", "right"]
    assert (left["mae_px"], left["rmse_px"], left["frames"]) == (pytest.approx(1.0), pytest.approx(1.5), 2)
    assert (right["mae_px"], right["rmse_px"], right["frames"]) == (pytest.approx(2.0), pytest.approx(2.0), 1)
    assert (left["paper_mae_px"], left["paper_rmse_px"]) == (3.748, 5.587)
    assert (rows["straight", "left"]["mae_px"], rows["straight", "left"]["frames"]) == (None, 0)


@pytest.mark.parametrize(
    ("curvature_per_m", "across", "section"),
    [
        ([0.0, 0.01, -0.01], False, "straight"),
        ([0.0, 0.0, 0.0], True, None),
        ([-0.8, -0.7, -0.8], False, "curve A"),
        ([0.6, 0.7, 0.8], True, "curve B"),
        ([0.0, 0.7, 0.7], False, None),
        ([-0.7, 0.7, 0.7], False, None),
    ],
)
def test_sections(curvature_per_m: list[float], across: bool, section: str | None) -> None:
    assert section_of(curvature_per_m, 0.4, across) == section


def test_crossings_are_held_against_the_nearest_true_edge() -> None:
    told = meter()
    told.add_crossing(crossing(1.03), [zebra(0.5, "a"), zebra(1.0, "b")])
    told.add_crossing(crossing(0.49, 0.5 * math.pi + math.radians(3.0)), [zebra(0.5, "a"), zebra(1.0, "b")])
    told.add_crossing(None, [zebra(0.9, "c")])
    row = told.crossing_row()
    assert (row["seen"], row["passed"], row["false_frames"], row["frames"]) == (2, 3, 0, 2)
    assert row["mae_m"] == pytest.approx(0.02)
    assert row["mae_px"] == pytest.approx(2.0)
    assert row["rmse_px"] == pytest.approx(math.sqrt((9.0 + 1.0) / 2.0))
    assert row["mae_deg"] == pytest.approx(1.5)


def test_a_line_across_has_no_beginning() -> None:
    told = meter()
    told.add_crossing(crossing(0.5, 0.01), [zebra(0.5, angle_rad=math.pi - 0.01)])
    assert told.crossing_row()["mae_deg"] == pytest.approx(math.degrees(0.02))


def test_a_crossing_where_none_is_is_false_but_not_over_a_zebra() -> None:
    told = meter()
    told.add_crossing(crossing(0.9), [zebra(0.5)])
    told.add_crossing(crossing(0.9), [])
    told.add_crossing(crossing(0.4), [zebra(0.3, "under the car", edge=False)])
    row = told.crossing_row()
    assert (row["seen"], row["passed"], row["false_frames"], row["frames"]) == (0, 1, 2, 0)
    assert row["mae_px"] is None


def test_rates_and_drives_together() -> None:
    first, second = meter(), meter()
    for ms in (10, 20, 50):
        first.add_durations({"total": ms * 1_000_000, "view": 3})
    second.add_durations({"total": 25_000_000, "view": 3_000_000, "crossing": 2_000_000, "lines": 9_000_000})
    second.add_crossing(crossing(0.5), [zebra(0.5, "b")])
    second.add_lines("straight", estimate(None, lane_line([1.0, 1.0, 1.0, 1.0])))
    second.add_crossing(crossing(0.5), [])
    first.add_crossing(None, [zebra(0.5, "a")])
    first.include(second)
    lanes, crossings = first.rate_rows()
    assert (lanes["median_hz"], lanes["min_hz"], lanes["max_hz"], lanes["frames"]) == pytest.approx((45, 20, 100, 4))
    assert (lanes["paper_min_hz"], lanes["paper_max_hz"]) == (16.0, 34.0)
    assert crossings["median_hz"] == pytest.approx(200.0)
    row = first.crossing_row()
    assert (row["seen"], row["passed"], row["false_frames"]) == (1, 2, 1)
    assert [row["frames"] for row in first.line_rows() if row["mae_px"] == pytest.approx(1.0)] == [1]


@pytest.mark.parametrize("direction", ["forward", "reverse"])
def test_every_arm_of_a_crossing_has_its_zebra(direction: str) -> None:
    """By tmr's drawing: 0.4 m half a road, 0.05 m clear, bars of 0.2 m, on either side of every pass."""
    track = load_track("tmr")
    lane = track.lane(direction)
    spans = LaneCrossings(direction, lane, track.paint()).spans_m
    assert len(spans) == 8
    assert [end - begin for begin, end in spans] == pytest.approx([0.2] * 8, abs=1e-6)
    middles = {(5.18, 3.08), (6.78, 3.08)}
    for begin, end in spans:
        x, y = lane.centerline.position(0.5 * (begin + end))
        away = min((abs(x - mx), abs(y - my)) for mx, my in middles if math.hypot(x - mx, y - my) < 0.7)
        assert sorted(away) == pytest.approx([0.2, 0.55], abs=1e-6)


def test_a_zebra_is_seen_from_the_car() -> None:
    """On x = 5.18 south: the lane's middle is x = 4.98, the near zebra reaches from y = 3.73 to 3.53."""
    track = load_track("tmr")
    paint = LaneCrossings("south", track.forward, track.paint())
    view = View(x_near_m=0.3, x_far_m=1.2, half_width_m=0.6, m_per_px=0.006)
    turned = math.radians(5.0)

    def look(y_m: float) -> list[TrueCrossing]:
        s_m, _ = track.forward.centerline.project((4.98, y_m))
        pose = DrivenPose(x_m=4.98, y_m=y_m, yaw_rad=-0.5 * math.pi + turned, speed_mps=1.0, yaw_rate_radps=0.0)
        return paint.in_view(pose, s_m, view)

    (one,) = look(4.4)
    assert one.distance_m == pytest.approx(0.67, abs=1e-6)
    assert math.remainder(one.angle_rad - 0.5 * math.pi + turned, math.tau) == pytest.approx(0.0, abs=1e-6)
    assert one.edge_in_view
    (close,) = look(4.0)
    assert close.distance_m == pytest.approx(0.27, abs=1e-6)
    assert not close.edge_in_view
    (beyond,) = look(3.8)  # the zebra behind the crossing, from y = 2.63
    assert beyond.distance_m == pytest.approx(1.17, abs=1e-6)
    assert beyond.edge_in_view
    assert look(5.0) == []


@pytest.mark.parametrize("extra", [("--track", "oval"), ("--plot", "x.png"), ("--direction", "reverse")])
def test_what_would_choose_other_drives_is_refused(cli: Cli, extra: tuple[str, str]) -> None:
    said = cli("bench", "accuracy", "--table", "windows-paper", *extra)
    assert said.code == 2
    assert f"leave out {extra[0]}" in said.line()


@pytest.mark.slow
def test_a_short_drive_fills_the_tables() -> None:
    case = Case(pipeline="windows", track="tmr", style="centred", seed=0)
    told = measure_case(CarConfig(), case, lambda share: None, frames=200)
    rows = told.line_rows()
    assert sum(row["frames"] for row in rows if row["section"] == "curve A") > 0
    assert all(0.0 < row["mae_px"] <= row["rmse_px"] < 3.0 for row in rows if row["frames"])
    assert all(row["median_hz"] > 0 for row in told.rate_rows())


@pytest.mark.slow
def test_the_tables_as_json(cli: Cli) -> None:
    said = cli("bench", "accuracy", "--table", "windows-paper", "--speed", "8", "--jobs", "1", "--json")
    assert said.code == 0
    assert [row["table"] for row in said.rows] == ["lines"] * 6 + ["crossing"] + ["rates"] * 2
    assert len({tuple(row) for row in said.rows}) == 1
    assert said.err.count("\n") == 1
