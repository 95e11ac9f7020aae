"""How far an estimate is from the truth: the figures of Cudrano et al. 2020, Table I, and tails of the distribution.

Runs the cases of `bench accuracy`, in parallel.
"""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from automodel.assembly.parts import make_pipeline
from automodel.assembly.simulated_car import appearance, renderer
from automodel.config import CarConfig
from automodel.console.progress import progress
from automodel.console.workers import spread
from automodel.signals import Frame, LaneEstimate, Motion
from automodel.sim.track_files import load_track
from automodel.sim.trajectory import Drive, DrivenPose, Odometer
from automodel.sim.truth import Truth, TruthFollower

FALSE_LANE = 0.25  # a valid estimate whose offset is wrong by more than this share of the lane's width


@dataclass(frozen=True, slots=True, kw_only=True)
class TruePose:
    """The truth of one frame, as `LanePose` counts."""

    offset_m: float
    heading_rad: float
    width_m: float


@dataclass(slots=True)
class AccuracyMeter:
    """Collects frames; `row` gives the figures over all of them.

    Errors count over frames with an estimate, availability over all frames.
    """

    t_s: list[float] = field(default_factory=list)
    estimated: list[tuple[float, float]] = field(default_factory=list)  # offset, heading; NaN without an estimate
    true: list[tuple[float, float, float]] = field(default_factory=list)
    status: list[str] = field(default_factory=list)

    def add(self, t_s: float, estimate: LaneEstimate, truth: TruePose) -> None:
        """One frame."""
        pose = estimate.pose if estimate.valid else None
        self.t_s.append(t_s)
        self.estimated.append((pose.offset_m, pose.heading_rad) if pose else (math.nan, math.nan))
        self.true.append((truth.offset_m, truth.heading_rad, truth.width_m))
        self.status.append(estimate.status.value)

    def row(self) -> dict[str, float | int | None]:
        """The figures; None where no frame had an estimate."""
        estimated, true = np.array(self.estimated).reshape(-1, 2), np.array(self.true).reshape(-1, 3)
        have = np.isfinite(estimated[:, 0])
        frames = len(estimated)
        row: dict[str, float | int | None] = {"frames": frames}
        names = ("heading_mae_deg", "heading_p99_deg", "offset_mae_m", "offset_mae_pct", "offset_p99_m")
        row.update(dict.fromkeys(names))
        row["availability_pct"] = 100.0 * float(have.mean()) if frames else 0.0
        row["false_lane_pct"] = 0.0
        if have.any():
            offset = np.abs(estimated[have, 0] - true[have, 0])
            turn = estimated[have, 1] - true[have, 1]
            heading = np.degrees(np.abs((turn + np.pi) % (2.0 * np.pi) - np.pi))
            share = offset / true[have, 2]
            row["heading_mae_deg"], row["heading_p99_deg"] = float(heading.mean()), float(np.quantile(heading, 0.99))
            row["offset_mae_m"], row["offset_p99_m"] = float(offset.mean()), float(np.quantile(offset, 0.99))
            row["offset_mae_pct"] = 100.0 * float(share.mean())
            row["false_lane_pct"] = 100.0 * float((share > FALSE_LANE).sum()) / frames
        return row


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
