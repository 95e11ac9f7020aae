"""The table of random worlds: what counts as misled, as a phantom, as visible; a short run."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from automodel.assembly.simulated_car import renderer
from automodel.bench.accuracy import AccuracyMeter
from automodel.bench.random_worlds import LaneSight, WorldChoice, build_world, measure, row_of, true_camera
from automodel.config import CarConfig
from automodel.console.workers import Sweep
from automodel.curves import line
from automodel.signals import LaneEstimate, LaneLine, LanePose, LaneStatus
from automodel.sim.truth import Truth, TruthFollower

ROAD = line(0.0, 0.0, 0.0, 1.0)
NO_LINE = LaneLine(curve=ROAD, points_m=np.empty((0, 2)), seen=False)
LOST = LaneEstimate(t_ns=0, status=LaneStatus.LOST)
TRUTH = Truth(offset_m=0.0, heading_rad=0.0, width_m=0.4, curvature_per_m=0.0, s_m=0.0, lap=0)


def claim(offset_m: float, bound_m: float, heading_rad: float = 0.0, heading_bound_rad: float = 1.0) -> LaneEstimate:
    pose = LanePose(
        offset_m=offset_m,
        heading_rad=heading_rad,
        width_m=0.4,
        curvature_per_m=0.0,
        covariance=np.eye(3),
        offset_bound_m=bound_m,
        heading_bound_rad=heading_bound_rad,
    )
    status = LaneStatus.TRACKING
    return LaneEstimate(t_ns=0, status=status, left=NO_LINE, right=NO_LINE, centerline=ROAD, pose=pose)


def met(*estimates: LaneEstimate, marked: bool = True) -> AccuracyMeter:
    meter = AccuracyMeter()
    for estimate in estimates:
        meter.add(0.0, estimate, TRUTH, marked=marked)
    return meter


def test_misled_is_far_off_and_sure() -> None:
    row = met(
        claim(0.2, 0.1),  # misled
        claim(0.2, 0.3),  # off, and says so
        claim(0.2, math.inf),
        claim(0.09, 0.01),  # less than a quarter of the lane
        LOST,
    ).row()
    assert row["misled_pct"] == 20.0
    assert row["false_lane_pct"] == 60.0


def test_bounds_are_exceeded_by_offset_or_heading() -> None:
    row = met(
        claim(0.02, 0.01),
        claim(0.02, 0.03),
        claim(0.0, 0.01, 0.2, 0.1),
        claim(0.5, math.inf, 0.5, math.inf),
        LOST,
    ).row()
    assert row["bound_exceeded_pct"] == 50.0  # of frames with an estimate
    assert row["bound_median_m"] == 0.03
    assert met(claim(0.0, 0.1), claim(0.0, math.inf), claim(0.0, math.inf)).row()["bound_median_m"] is None
    assert met(LOST).row()["bound_exceeded_pct"] is None


def test_without_markings_only_a_bound_of_half_a_lane_does_not_mislead() -> None:
    meter = met(claim(0.0, 0.05), claim(0.0, 0.19), claim(0.0, 0.2), claim(0.3, math.inf), LOST, marked=False)
    row = row_of("contour", 1, "unmarked", meter)
    assert row["phantom_pct"] == row["misled_pct"] == 40.0
    assert row["offset_mae_m"] is row["availability_pct"] is row["bound_exceeded_pct"] is None
    assert row["false_lane_pct"] == 0.0
    assert row["estimate_pct"] == 80.0
    assert row_of("contour", 1, "plain", met(claim(0.0, 0.05)))["phantom_pct"] is None


def test_availability_counts_where_a_marking_is_in_view() -> None:
    meter = AccuracyMeter()
    for visible, estimate in ((True, claim(0.0, 0.1)), (True, LOST), (False, LOST), (False, LOST)):
        meter.add(0.0, estimate, TRUTH, visible=visible)
    assert meter.row()["availability_pct"] == 50.0


def test_meters_add_up() -> None:
    one, other = met(claim(0.2, 0.1)), met(claim(0.0, 0.1), LOST, LOST)
    one.include(other)
    assert one.row() == met(claim(0.2, 0.1), claim(0.0, 0.1), LOST, LOST).row()


@pytest.mark.parametrize("seed", [2, 12])
def test_a_lane_is_in_sight_where_its_paint_is_in_the_image(seed: int) -> None:
    """The drawn mask of a road without any other paint is the independent answer."""
    world = build_world(CarConfig(), seed, "widths")
    eye, sight = renderer(world.track, world.car, world.look), LaneSight(world)
    (pose,) = world.poses([1.0])
    truth = TruthFollower(world.lane, world.car.vehicle.reference_x_m).step(pose.x_m, pose.y_m, pose.yaw_rad)
    away = dataclasses.replace(pose, yaw_rad=pose.yaw_rad + math.pi, x_m=pose.x_m + 50.0)
    for place, visible in ((pose, True), (away, False)):
        mask = eye.render_mask(place.x_m, place.y_m, place.yaw_rad)
        assert bool((mask > 128).sum() > 50) == visible
        assert sight.sees(true_camera(world, 0.0), place, truth.s_m) == visible
    bare = dataclasses.replace(world, track=dataclasses.replace(world.track, painted=()))
    assert not LaneSight(bare).sees(true_camera(world, 0.0), pose, truth.s_m)


def test_a_short_run_has_its_rows_and_pictures(tmp_path: Path) -> None:
    choice = WorldChoice(pipelines=("windows",), seeds=range(2), kinds=("plain", "unmarked"), frames=8, worst=tmp_path)
    rows = measure(CarConfig(), choice, Sweep(jobs=1), tmp_path / "plot.png")
    assert [(row["pipeline"], row["seed"], row["frames"]) for row in rows] == [
        ("windows", 0, 8),
        ("windows", 1, 8),
        ("windows", None, 8),
        ("windows", None, 8),
        ("windows", None, 16),
    ]
    assert [row["world"] for row in rows[2:]] == ["all 1 plain", "all 1 unmarked", "all 2"]
    assert all(rows[2][name] == rows[0][name] for name in rows[0] if name not in ("seed", "world"))
    assert rows[1]["world"].startswith("unmarked")
    assert rows[1]["phantom_pct"] is not None
    assert {path.name for path in tmp_path.iterdir()} == {"windows-0000.png", "windows-0001.png", "plot.png"}
    assert measure(CarConfig(), choice, Sweep(jobs=1), None) == rows
