"""Stretches of the contest's floor as `bench accuracy` drives them, intersections included."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.bench.accuracy import AccuracyMeter
from automodel.pipelines.windows import Windows
from automodel.signals import Frame, LaneStatus
from automodel.sim.appearance import Appearance
from automodel.sim.track_files import load_track
from automodel.sim.trajectory import Drive, Odometer
from automodel.sim.truth import TruthFollower
from tests.support.rendered_drives import CAR, check_sound, renderer

TMR = load_track("tmr")
LANE = TMR.lane("forward")


def first_crossing_m() -> float:
    """Arc length on the forward lane at the first crossing of the road with itself."""
    line = LANE.centerline
    point = TMR.road.position(TMR.crossings[0].s_first_m)
    s = np.arange(0.0, 0.5 * line.length_m, 0.01)
    away = np.hypot(*(line.position(s) - point).T)
    return float(s[np.argmin(away)])


WARM_UP_M = 0.9  # a lane's start has not seen the ground under the car; a lap has one start


def drive(
    style: str, seed: int, rate_hz: float, speed_mps: float, from_m: float, to_m: float
) -> tuple[AccuracyMeter, set]:
    """Metrics and statuses from `from_m` to `to_m`; the drive starts a little before."""
    statuses: set[LaneStatus] = set()
    drive = Drive(lane=LANE, style=style, speed_mps=speed_mps, car_width_m=CAR.vehicle.width_m, seed=seed)
    eye = renderer(TMR, CAR, Appearance.random(seed, "competition"))
    pipeline, follower = Windows(CAR), TruthFollower(LANE, CAR.vehicle.reference_x_m)
    odometer, meter = Odometer(seed), AccuracyMeter()
    for index in range(round((from_m - WARM_UP_M) / speed_mps * rate_hz), round(to_m / speed_mps * rate_hz)):
        t_ns = round(index / rate_hz * 1e9)
        pose = drive.pose(index / rate_hz)
        image = eye.render(pose.x_m, pose.y_m, pose.yaw_rad, pose.speed_mps, pose.yaw_rate_radps, index)
        motion = odometer.motion(drive.pose((index - 0.5) / rate_hz), t_ns)
        estimate = pipeline.step(Frame(t_ns=t_ns, index=index, image=image), motion)
        check_sound(estimate, t_ns)
        truth = follower.step(pose.x_m, pose.y_m, pose.yaw_rad)
        if index < round(from_m / speed_mps * rate_hz):
            continue
        meter.add(t_ns * 1e-9, estimate, truth)
        statuses.add(estimate.status)
    return meter, statuses


def check(meter: AccuracyMeter) -> None:
    row = meter.row()
    assert row["heading_mae_deg"] is not None
    assert row["heading_mae_deg"] <= 1.0
    assert row["offset_mae_m"] is not None
    assert row["offset_mae_m"] <= 0.01
    assert row["availability_pct"] is not None
    assert row["availability_pct"] >= 99.0
    assert row["false_lane_pct"] == 0.0


@pytest.mark.parametrize(
    ("rate_hz", "speed_mps"), [pytest.param(60.0, 1.0, marks=pytest.mark.slow), (20.0, 1.0), (30.0, 2.0)]
)
def test_over_an_intersection(rate_hz: float, speed_mps: float) -> None:
    crossing_m = first_crossing_m()
    meter, statuses = drive("centred", 3, rate_hz, speed_mps, crossing_m - 1.6, crossing_m + 1.5)
    check(meter)
    assert LaneStatus.COASTING in statuses  # the lines stop inside it


def test_a_crossing_is_reported_on_the_way_to_the_zebra() -> None:
    crossing_m = first_crossing_m()
    line = LANE.centerline
    bars = [p.polygon_m for p in TMR.paint() if p.kind == "zebra"]
    s = np.array([[line.project(point, crossing_m, 1.5) for point in bar] for bar in bars])  # (bars, corners, 2)
    mine = (np.abs(s[..., 1]) < 0.15).all(axis=1) & (np.abs(s[..., 0] - crossing_m) < 1.2).all(axis=1)
    edge_m = float(s[mine][..., 0].min())  # the near edge of the first zebra in the lane
    assert 0.3 < crossing_m - edge_m < 1.2
    eye, pipeline = renderer(TMR, CAR), Windows(CAR)
    follower, odometer = TruthFollower(LANE, CAR.vehicle.reference_x_m), Odometer(0)
    drive = Drive(lane=LANE, style="centred", speed_mps=1.0, car_width_m=0.2)
    errors, skews = [], []
    for index in range(round((edge_m - 1.8) * 30), round((edge_m - 0.5) * 30)):
        pose, t_ns = drive.pose(index / 30.0), round(index / 30.0 * 1e9)
        truth = follower.step(pose.x_m, pose.y_m, pose.yaw_rad)
        frame = Frame(t_ns=t_ns, index=index, image=eye.render(pose.x_m, pose.y_m, pose.yaw_rad))
        estimate = pipeline.step(frame, odometer.motion(drive.pose((index - 0.5) / 30.0), t_ns))
        if estimate.crossing is not None and edge_m - truth.s_m < 0.9:
            errors.append(estimate.crossing.distance_m - (edge_m - truth.s_m))
            square = 0.5 * math.pi + float(line.heading(edge_m)) - pose.yaw_rad
            skews.append(math.remainder(estimate.crossing.angle_rad - square, math.tau))
    assert len(errors) >= 5
    assert np.abs(np.median(errors)) < 0.02
    assert np.abs(np.median(skews)) < math.radians(3.0)
    assert np.abs(errors).max() < 0.06


@pytest.mark.slow
@pytest.mark.parametrize(("style", "seed"), [("centred", 0), ("oscillating", 5), ("racing", 0)])
def test_half_a_lap_in_every_style(style: str, seed: int) -> None:
    check(drive(style, seed, 60.0, 1.0, 2.0, 20.0)[0])
