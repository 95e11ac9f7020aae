"""`bench accuracy`: estimates against the simulator's truth, by the metrics of Cudrano et al. 2020, Table I."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from automodel.assembly.parts import make_pipeline
from automodel.assembly.simulated_car import appearance, renderer
from automodel.config import PIPELINE_NAMES, CarConfig
from automodel.console.workers import Sweep, Tick, spread
from automodel.signals import FALSE_LANE, Frame, LaneEstimate, LaneStatus, Motion
from automodel.sim.track_files import load_track
from automodel.sim.trajectory import STYLES, Drive, DrivenPose, Odometer
from automodel.sim.truth import Truth, TruthFollower
from automodel.types import Bools, FloatArray

TRACKS = ("tmr", "oval", "chicane")
COLUMNS = (
    "pipeline", "track", "style", "seed", "heading_mae_deg", "offset_mae_m", "availability_pct", "false_lane_pct",
    "misled_pct", "bound_exceeded_pct", "bound_median_m", "offset_p99_m", "heading_p99_deg", "offset_mae_pct", "frames",
)  # fmt: skip

Row = dict[str, Any]


@dataclass(slots=True)
class AccuracyMeter:
    """Collects frames; `row` gives the metrics over all of them.

    Errors and bounds count over frames with an estimate on a road with markings, availability over all frames in which
    a marking of the lane was in view, the shares of false and misled frames over all. An estimate misleads where it is
    off by more than `FALSE_LANE` of the lane's width and its bound is less than that error; on a road without any
    marking, where its bound is less than half the lane's width.
    """

    t_s: list[float] = field(default_factory=list)
    estimated: list[tuple[float, float]] = field(default_factory=list)  # offset, heading; NaN without an estimate
    true: list[tuple[float, float, float]] = field(default_factory=list)  # offset, heading, width
    bounds: list[tuple[float, float]] = field(default_factory=list)  # of offset and heading; NaN without an estimate
    statuses: list[LaneStatus] = field(default_factory=list)
    visible: list[bool] = field(default_factory=list)  # whether a marking of the lane was in view
    marked: list[bool] = field(default_factory=list)  # whether the road has markings

    def add(
        self, t_s: float, estimate: LaneEstimate, truth: Truth, *, visible: bool = True, marked: bool = True
    ) -> None:
        """Add one frame."""
        pose = estimate.pose if estimate.valid else None
        self.t_s.append(t_s)
        self.estimated.append((pose.offset_m, pose.heading_rad) if pose else (math.nan, math.nan))
        self.true.append((truth.offset_m, truth.heading_rad, truth.width_m))
        self.bounds.append((pose.offset_bound_m, pose.heading_bound_rad) if pose else (math.nan, math.nan))
        self.statuses.append(estimate.status)
        self.visible.append(visible and marked)
        self.marked.append(marked)

    def include(self, other: AccuracyMeter) -> None:
        """Add the frames of another drive."""
        for name in ("t_s", "estimated", "true", "bounds", "statuses", "visible", "marked"):
            getattr(self, name).extend(getattr(other, name))

    def errors(self) -> tuple[FloatArray, FloatArray]:
        """Absolute errors (n,) of offset [m] and heading [rad] by frame; NaN without an estimate."""
        estimated, true = np.array(self.estimated).reshape(-1, 2), np.array(self.true).reshape(-1, 3)
        turn = estimated[:, 1] - true[:, 1]
        return np.abs(estimated[:, 0] - true[:, 0]), np.abs((turn + np.pi) % (2.0 * np.pi) - np.pi)

    def misled(self) -> Bools:
        """The frames (n,) whose estimate misleads."""
        bound_m, width_m = np.array(self.bounds).reshape(-1, 2)[:, 0], np.array(self.true).reshape(-1, 3)[:, 2]
        offset_m = self.errors()[0]
        on_road = (offset_m > FALSE_LANE * width_m) & (bound_m < offset_m)
        return np.where(np.array(self.marked, np.bool_), on_road, self.phantoms())

    def phantoms(self) -> Bools:
        """The frames (n,) of a road without markings whose estimate claims to know the lane."""
        bound_m, width_m = np.array(self.bounds).reshape(-1, 2)[:, 0], np.array(self.true).reshape(-1, 3)[:, 2]
        return ~np.array(self.marked, np.bool_) & (bound_m < 0.5 * width_m)

    def row(self) -> Row:
        """The metrics; None where no frame gives one."""
        (offset, heading), marked = self.errors(), np.array(self.marked, np.bool_)
        width, bounds = np.array(self.true).reshape(-1, 3)[:, 2], np.array(self.bounds).reshape(-1, 2)
        known, visible = np.isfinite(offset), np.array(self.visible, np.bool_)
        frames = len(offset)
        row: Row = {"frames": frames}
        names = ("heading_mae_deg", "heading_p99_deg", "offset_mae_m", "offset_mae_pct", "offset_p99_m")
        row.update(dict.fromkeys(names))
        row["availability_pct"] = 100.0 * float(known[visible].mean()) if visible.any() else None if frames else 0.0
        row["false_lane_pct"] = row["misled_pct"] = 0.0
        row["bound_exceeded_pct"] = row["bound_median_m"] = None
        if frames:
            row["misled_pct"] = 100.0 * float(self.misled().mean())
        known &= marked
        if known.any():
            offset, heading, width, bounds = offset[known], heading[known], width[known], bounds[known]
            share, degrees = offset / width, np.degrees(heading)
            row["heading_mae_deg"], row["heading_p99_deg"] = float(degrees.mean()), float(np.quantile(degrees, 0.99))
            row["offset_mae_m"], row["offset_p99_m"] = float(offset.mean()), float(np.quantile(offset, 0.99))
            row["offset_mae_pct"] = 100.0 * float(share.mean())
            row["false_lane_pct"] = 100.0 * float((share > FALSE_LANE).sum()) / frames
            exceeded = (offset > bounds[:, 0]) | (heading > bounds[:, 1])
            row["bound_exceeded_pct"] = 100.0 * float(exceeded.mean())
            middle = float(np.quantile(bounds[:, 0], 0.5, method="higher"))
            row["bound_median_m"] = middle if math.isfinite(middle) else None
        return row


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


class RenderedDrive:
    """The frames of a case, and the truth in each of them."""

    def __init__(self, car: CarConfig, case: Case) -> None:
        track = load_track(case.track)
        self.lane = track.lane(case.direction)
        self.drive = Drive(
            lane=self.lane,
            style=case.style,
            speed_mps=case.speed_mps,
            car_width_m=car.vehicle.width_m,
            seed=case.seed,
        )
        self.lap_s = self.drive.path.length_m / case.speed_mps
        self._camera = renderer(track, car, appearance(case.look, case.seed))
        self._follower = TruthFollower(self.lane, car.vehicle.reference_x_m)

    def frames(self, t_s: Sequence[float], tick: Tick) -> Iterator[tuple[Frame, DrivenPose, Truth]]:
        """A frame at each of the times, with the pose of the body."""
        for index, t in enumerate(t_s):
            pose = self.drive.pose(t)
            image = self._camera.render(pose.x_m, pose.y_m, pose.yaw_rad, pose.speed_mps, pose.yaw_rate_radps, index)
            truth = self._follower.step(pose.x_m, pose.y_m, pose.yaw_rad)
            yield Frame(t_ns=round(t * 1e9), index=index, image=image), pose, truth
            tick(1.0 / len(t_s))


Step = Callable[[Frame, Motion], LaneEstimate]


def watch(
    car: CarConfig, case: Case, step: Step, tick: Tick, frames: int | None = None
) -> Iterator[tuple[LaneEstimate, Truth, DrivenPose]]:
    """Render a lap, or `frames`, and yield what `step` makes of each frame, the truth, and the pose of the body."""
    drive, odometer = RenderedDrive(car, case), Odometer(case.seed)
    period_s = 1.0 / car.camera.rate_hz
    count = frames or int(drive.lap_s / period_s)
    for frame, pose, truth in drive.frames([index * period_s for index in range(count)], tick):
        # odometry measures the distance since the frame before: its speeds are those of the middle between both
        motion = odometer.motion(drive.drive.pose((frame.index - 0.5) * period_s), frame.t_ns)
        yield step(frame, motion), truth, pose


def measure_case(car: CarConfig, case: Case, tick: Tick) -> AccuracyMeter:
    """The drive's estimates compared with the truth."""
    meter = AccuracyMeter()
    for estimate, truth, _ in watch(car, case, make_pipeline(case.pipeline, car).step, tick):
        meter.add(estimate.t_ns * 1e-9, estimate, truth)
    return meter


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """The drives of a bench: every pipeline, track, style and seed with every other; empty means all."""

    pipelines: tuple[str, ...] = ()
    tracks: tuple[str, ...] = ()
    styles: tuple[str, ...] = ()
    seeds: range = range(1)
    look: str = "competition"
    direction: str = "forward"
    speed_mps: float = 1.0

    def cases(self) -> list[Case]:
        """All drives, in this order."""
        rest: dict[str, Any] = {"look": self.look, "direction": self.direction, "speed_mps": self.speed_mps}
        return [
            Case(pipeline=pipeline, track=track, style=style, seed=seed, **rest)
            for pipeline, track, style, seed in itertools.product(
                self.pipelines or PIPELINE_NAMES, self.tracks or TRACKS, self.styles or STYLES, self.seeds
            )
        ]


def measure(car: CarConfig, choice: Choice, sweep: Sweep, plot: Path | None) -> list[Row]:
    """A row a drive; `plot` gets a PNG of all of them."""
    found = list(spread("bench accuracy", functools.partial(measure_case, car), choice.cases(), sweep))
    if plot is not None:
        from automodel.viewer.plots import plot_accuracy

        names = [f"{case.pipeline}, {case.track}, {case.style}, seed {case.seed}" for case, _ in found]
        plot_accuracy(plot, [(name, m.t_s, m.estimated, m.true) for name, (_, m) in zip(names, found, strict=True)])
    return [
        {"pipeline": case.pipeline, "track": case.track, "style": case.style, "seed": case.seed, **meter.row()}
        for case, meter in found
    ]
