"""The accuracy meter on constructed errors."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.bench.accuracy import AccuracyMeter
from automodel.curves import line
from automodel.signals import LaneEstimate, LaneLine, LanePose, LaneStatus
from automodel.sim.truth import Truth

ROAD = line(0.0, 0.0, 0.0, 1.0)
NO_LINE = LaneLine(curve=ROAD, points_m=np.empty((0, 2)), seen=False)
LOST = LaneEstimate(t_ns=0, status=LaneStatus.LOST)


def estimate(offset_m: float, heading_rad: float, status: LaneStatus = LaneStatus.TRACKING) -> LaneEstimate:
    pose = LanePose(offset_m=offset_m, heading_rad=heading_rad, width_m=0.5, curvature_per_m=0.0, covariance=np.eye(3))
    return LaneEstimate(t_ns=0, status=status, left=NO_LINE, right=NO_LINE, centerline=ROAD, pose=pose)


def truth(offset_m: float = 0.0, heading_rad: float = 0.0, width_m: float = 0.4) -> Truth:
    return Truth(offset_m=offset_m, heading_rad=heading_rad, width_m=width_m, curvature_per_m=0.0, s_m=0.0, lap=0)


def test_constructed_errors_are_reported() -> None:
    meter = AccuracyMeter()
    for k in range(100):  # errors of 0 .. 99 mm and 0 .. 9.9 degrees, of both signs
        sign = 1 if k % 2 else -1
        meter.add(
            0.1 * k,
            estimate(0.02 + sign * 1e-3 * k, -0.3 + sign * math.radians(0.1 * k)),
            truth(0.02, -0.3, width_m=0.5),
        )
    row = meter.row()
    assert row["frames"] == 100
    assert row["offset_mae_m"] == pytest.approx(0.0495)
    assert row["offset_mae_pct"] == pytest.approx(100 * 0.0495 / 0.5)
    assert row["heading_mae_deg"] == pytest.approx(4.95)
    assert row["offset_p99_m"] == pytest.approx(0.098, abs=0.001)
    assert row["heading_p99_deg"] == pytest.approx(9.8, abs=0.1)
    assert row["availability_pct"] == 100.0
    assert row["false_lane_pct"] == 0.0


@pytest.mark.parametrize(
    ("estimated", "true", "error_deg"),
    [
        (math.pi - 0.01, -math.pi + 0.01, math.degrees(0.02)),
        (-3.1, 3.1, math.degrees(math.tau - 6.2)),
        (0.1, math.tau, math.degrees(0.1)),
        (0.5, -0.5, math.degrees(1.0)),
    ],
)
def test_headings_are_compared_around_the_circle(estimated: float, true: float, error_deg: float) -> None:
    meter = AccuracyMeter()
    meter.add(0.0, estimate(0.0, estimated), truth(heading_rad=true))
    assert meter.row()["heading_mae_deg"] == pytest.approx(error_deg)


def test_frames_without_an_estimate_count_for_availability_alone() -> None:
    meter = AccuracyMeter()
    for _ in range(3):
        meter.add(0.0, estimate(0.01, 0.0, LaneStatus.COASTING), truth())
    meter.add(0.0, LOST, truth(0.3, 1.0))
    row = meter.row()
    assert row["frames"] == 4
    assert row["availability_pct"] == 75.0
    assert row["offset_mae_m"] == pytest.approx(0.01)
    assert row["heading_mae_deg"] == 0.0
    assert np.isnan(meter.estimated[-1]).all()


def test_false_lanes_are_wrong_by_over_a_quarter() -> None:
    meter = AccuracyMeter()
    for offset in (0.0, 0.099, -0.099, 0.101, -0.3):  # the lane is 0.4 m wide
        meter.add(0.0, estimate(offset, 0.0), truth())
    for _ in range(5):
        meter.add(0.0, LOST, truth())
    assert meter.row()["false_lane_pct"] == pytest.approx(20.0)  # of all frames


@pytest.mark.parametrize("frames", [0, 3])
def test_no_estimate_at_all_gives_no_errors(frames: int) -> None:
    meter = AccuracyMeter()
    for _ in range(frames):
        meter.add(0.0, LOST, truth())
    row = meter.row()
    assert row["frames"] == frames
    assert row["availability_pct"] == 0.0
    assert row["false_lane_pct"] == 0.0
    for name in ("heading_mae_deg", "heading_p99_deg", "offset_mae_m", "offset_mae_pct", "offset_p99_m"):
        assert row[name] is None
