"""Runs the cases of `bench accuracy`, in parallel."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from automodel.cli.progress import progress
from automodel.cli.simulated import appearance, renderer
from automodel.cli.workers import spread
from automodel.config import CarConfig
from automodel.evaluation.accuracy import AccuracyMeter, TruePose
from automodel.pipelines import make_pipeline
from automodel.signals import Frame, LaneEstimate, Motion
from automodel.sim.track import load_track
from automodel.sim.trajectory import Drive, DrivenPose, Odometer
from automodel.sim.truth import Truth, TruthFollower

COLUMNS = (
    "pipeline", "track", "style", "seed", "frames", "heading_mae_deg", "heading_p99_deg", "offset_mae_m",
    "offset_mae_pct", "offset_p99_m", "availability_pct", "false_lane_pct",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One drive: a lap over a track in a driving style, seen by one pipeline in one light."""

    pipeline: str
    track: str
    style: str
    seed: int
    look: str = "competition"
    direction: str = "forward"
    speed_mps: float = 1.0


def watch(
    car: CarConfig, case: Case, step: Callable[[Frame, Motion], LaneEstimate]
) -> Iterator[tuple[LaneEstimate, Truth, DrivenPose]]:
    """Render the drive frame by frame and let `step` see it: its estimate, the truth, and the pose of the body."""
    track = load_track(case.track)
    lane = track.lane(case.direction)
    way = Drive(lane=lane, style=case.style, speed_mps=case.speed_mps, car_width_m=car.vehicle.width_m, seed=case.seed)
    camera = renderer(track, car, appearance(case.look, case.seed))
    follower, odometer = TruthFollower(lane, car.vehicle.reference_x_m), Odometer(case.seed)
    period_s = 1.0 / car.camera.rate_hz
    for index in range(int(way.path.length_m / case.speed_mps / period_s)):
        t_ns = round(index * period_s * 1e9)
        pose = way.pose(index * period_s)
        image = camera.render(pose.x_m, pose.y_m, pose.yaw_rad, pose.speed_mps, pose.yaw_rate_radps, index)
        # the odometry of the way since the frame before, as a car would have it
        motion = odometer.motion(way.pose((index - 0.5) * period_s), t_ns)
        estimate = step(Frame(t_ns=t_ns, index=index, image=image), motion)
        yield estimate, follower.step(pose.x_m, pose.y_m, pose.yaw_rad), pose


def drive(car: CarConfig, case: Case) -> AccuracyMeter:
    """The drive's estimates compared with the truth."""
    meter = AccuracyMeter()
    for estimate, truth, _ in watch(car, case, make_pipeline(case.pipeline, car).step):
        meter.add(
            estimate.t_ns * 1e-9,
            estimate,
            TruePose(offset_m=truth.offset_m, heading_rad=truth.heading_rad, width_m=truth.width_m),
        )
    return meter


def measure(car: CarConfig, cases: list[Case], jobs: int | None, plot: Path | None) -> list[dict[str, object]]:
    """A row a case, in the order of `cases`; `plot` gets a PNG of all of them."""
    jobs = min(jobs or os.cpu_count() or 1, len(cases))
    meters: list[AccuracyMeter] = []
    with progress("bench accuracy", len(cases)) as bar:
        for meter in spread(functools.partial(drive, car), cases, jobs):
            meters.append(meter)
            bar()
    if plot is not None:
        from automodel.viewer.plots import plot_accuracy

        names = [f"{case.pipeline}, {case.track}, {case.style}, seed {case.seed}" for case in cases]
        plot_accuracy(plot, [(name, m.t_s, m.estimated, m.true) for name, m in zip(names, meters, strict=True)])
    rows = []
    for case, meter in zip(cases, meters, strict=True):
        row: dict[str, object] = {**asdict(case), **meter.row()}
        rows.append({name: row[name] for name in COLUMNS})
    return rows
