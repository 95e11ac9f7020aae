"""The claim of seed 004 (Smith): a tracker that is told the speed needs fewer iterations and loses the lane less often.

Every way of telling sees the same pictures. A loss is a run of frames in which the lane that was followed is not
followed on: LOST, looked for anew on whole rows, or a false lane (as `automodel.bench.accuracy` counts).

Drives bends for `bench contour-paper`: the pipeline `contour` with the speed, without it, and with a wrong one.
"""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from automodel.assembly.simulated_car import appearance, renderer
from automodel.bench.accuracy import FALSE_LANE, TruePose
from automodel.config import CarConfig, ConfigError
from automodel.console.messages import say
from automodel.console.progress import progress
from automodel.console.tables import show
from automodel.console.workers import spread
from automodel.pipelines.contour import Contour
from automodel.signals import Frame, LaneEstimate, LaneStatus, Motion, MotionSource
from automodel.sim.track_files import load_track
from automodel.sim.trajectory import Drive, Odometer
from automodel.sim.truth import TruthFollower

Row = dict[str, object]

BENT_PER_LANE = 0.1  # a road with more curvature times lane width bends


def _nothing(motion: Motion) -> Motion:
    return Motion(t_ns=motion.t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)


def _scaled(share: float) -> Callable[[Motion], Motion]:
    return lambda motion: replace(motion, speed_mps=share * motion.speed_mps)


# What the pipeline is told of a measured motion. A wrong speed leaves the yaw rate: it comes from another sensor.
TELLINGS: dict[str, Callable[[Motion], Motion]] = {
    "told": _scaled(1.0),
    "+20 %": _scaled(1.2),
    "-20 %": _scaled(0.8),
    "none": _nothing,
}


@dataclass(slots=True)
class ClaimMeter:
    """Collects the frames of one way of telling at one frame rate; what it counts begins with the first estimate.

    Errors are over frames that have an estimate, iterations only over those in which the lane was followed from the
    frame before and a line seen: without one there is nothing to converge on. Coasting alone is no loss.
    """

    frames: int = 0
    lost: int = 0
    searched: int = 0
    false: int = 0
    coasting: int = 0
    losses: int = 0
    offset_m: list[float] = field(default_factory=list)
    heading_rad: list[float] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    _begun: bool = False
    _well: bool = True

    def add(self, estimate: LaneEstimate, truth: TruePose, iterations: int, searched: bool, counts: bool) -> None:
        """One frame; `searched` where whole rows were read for a lane, `counts` where the frame is to be scored."""
        pose = estimate.pose
        if not self._begun:
            self._begun = pose is not None
            return
        error = math.inf if pose is None else abs(pose.offset_m - truth.offset_m)
        false = pose is not None and error > FALSE_LANE * truth.width_m
        before, self._well = self._well, not (pose is None or searched or false)
        if not counts:
            return
        self.frames += 1
        self.lost += pose is None
        self.searched += searched
        self.false += false
        coasting = estimate.status is LaneStatus.COASTING
        self.coasting += coasting
        self.losses += before and not self._well
        if pose is not None:
            self.offset_m.append(error)
            self.heading_rad.append(abs(math.remainder(pose.heading_rad - truth.heading_rad, math.tau)))
            if not (searched or coasting):
                self.iterations.append(iterations)

    def include(self, other: ClaimMeter) -> None:
        """The frames of another drive."""
        for name in ("frames", "lost", "searched", "false", "coasting", "losses"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.offset_m += other.offset_m
        self.heading_rad += other.heading_rad
        self.iterations += other.iterations

    def row(self) -> Row:
        """The figures; None where no frame gives one."""
        row: Row = {"frames": self.frames, "iterations": None, "iterations_p95": None}
        if self.iterations:
            row["iterations"] = float(np.mean(self.iterations))
            row["iterations_p95"] = float(np.quantile(self.iterations, 0.95))
        row.update(losses=self.losses, losses_per_1000=None, lost=self.lost, searched=self.searched, false=self.false)
        row["coasting"] = self.coasting
        if self.frames:
            row["losses_per_1000"] = 1000.0 * self.losses / self.frames
        row.update(heading_mae_deg=None, offset_mae_m=None)
        if self.offset_m:
            row["heading_mae_deg"] = math.degrees(float(np.mean(self.heading_rad)))
            row["offset_mae_m"] = float(np.mean(self.offset_m))
        return row


COMMAND = "bench contour-paper"
RATES_HZ = (5, 10, 20, 30, 60)  # all divide the last, at which the pictures are rendered
FEWEST_HZ = 20  # a slower rate sees the drive from several first frames, so that it has as many frames as this one

Key = tuple[str, int, str]  # update law, frame rate [Hz], what is told of the speed
Meters = dict[Key, ClaimMeter]


@dataclass(frozen=True, slots=True, kw_only=True)
class ClaimDrive:
    """One lap, or its first `seconds`, seen with each of `laws`."""

    track: str
    style: str
    seed: int
    speed_mps: float
    laws: tuple[str, ...]
    seconds: float | None = None


class Seer:
    """One pipeline that sees every frame of one rate, and its figures."""

    def __init__(self, car: CarConfig, key: Key, first: int, seed: int) -> None:
        law, self.rate_hz, telling = self.key = key
        pipeline = replace(car.pipeline, name="contour", contour=replace(car.pipeline.contour, update=law))
        self.every = RATES_HZ[-1] // self.rate_hz
        self.first, self.meter = first, ClaimMeter()
        self._told, self._odometer = TELLINGS[telling], Odometer(seed)
        self._pipeline = Contour(replace(car, camera=replace(car.camera, rate_hz=self.rate_hz), pipeline=pipeline))
        self._pipeline.stages.stopwatch = lambda: 0  # names the stages that ran

    def see(self, image: Any, way: Drive, index: int, truth: TruePose, bends: bool) -> None:
        """The picture `index` of those rendered, if it is one of this rate's."""
        if index % self.every != self.first:
            return
        t_s = index / RATES_HZ[-1]
        frame = Frame(t_ns=round(t_s * 1e9), index=index // self.every, image=image)
        # the odometry of the way since the frame before, as a car would have it
        motion = self._odometer.motion(way.pose(t_s - 0.5 / self.rate_hz), frame.t_ns)
        estimate = self._pipeline.step(frame, self._told(motion))
        searched = "start" in self._pipeline.stages.durations_ns
        self.meter.add(estimate, truth, self._pipeline.iterations, searched, bends)


def drive(car: CarConfig, case: ClaimDrive) -> Meters:
    """The figures of one drive; frames count where the lane bends at the car or within a lane's width ahead."""
    track = load_track(case.track)
    lane = track.lane("forward")
    way = Drive(lane=lane, style=case.style, speed_mps=case.speed_mps, car_width_m=car.vehicle.width_m, seed=case.seed)
    camera = renderer(track, car, appearance("competition", case.seed))
    follower = TruthFollower(lane, car.vehicle.reference_x_m)
    seers = [
        Seer(car, (law, rate, telling), first, case.seed)
        for law in case.laws
        for rate in RATES_HZ
        for telling in TELLINGS
        for first in np.linspace(0, RATES_HZ[-1] // rate, max(FEWEST_HZ // rate, 1), endpoint=False).astype(int)
    ]
    seconds = way.path.length_m / case.speed_mps
    seconds = seconds if case.seconds is None else min(case.seconds, seconds)
    for index in range(int(seconds * RATES_HZ[-1])):
        pose = way.pose(index / RATES_HZ[-1])
        image = camera.render(pose.x_m, pose.y_m, pose.yaw_rad, pose.speed_mps, pose.yaw_rate_radps, index)
        truth = follower.step(pose.x_m, pose.y_m, pose.yaw_rad)
        bend = np.abs(lane.centerline.curvature(truth.s_m + np.linspace(0.0, 1.0, 5) * truth.width_m)).max()
        true = TruePose(offset_m=truth.offset_m, heading_rad=truth.heading_rad, width_m=truth.width_m)
        for seer in seers:
            seer.see(image, way, index, true, bool(bend * truth.width_m > BENT_PER_LANE))
    meters: Meters = {}
    for seer in seers:
        meters.setdefault(seer.key, ClaimMeter()).include(seer.meter)
    return meters


def bench(car: CarConfig, cases: Sequence[ClaimDrive], jobs: int | None, figure: Path | None, as_json: bool) -> None:
    """Drive `cases`, print a row a law, rate and telling over all of them; `figure` gets a PNG."""
    jobs = min(jobs or os.cpu_count() or 1, len(cases))
    whole: Meters = {}
    with progress(COMMAND, len(cases)) as bar:
        for meters in spread(functools.partial(drive, car), cases, jobs):
            for key, meter in meters.items():
                whole.setdefault(key, ClaimMeter()).include(meter)
            bar()
    rows: list[Row] = [
        {"law": law, "rate_hz": rate, "speed": telling, **meter.row()} for (law, rate, telling), meter in whole.items()
    ]
    if figure is not None:
        plot(figure, rows)
    say(
        "a loss is a run of frames LOST, searched anew or false; only frames in bends count; a wrong speed leaves the"
        " yaw rate right; one look at a picture is one or two iterations of gauss_newton, at most three looks a frame"
    )
    show(COMMAND, rows, as_json)


PANELS = (
    ("iterations", "iterations a frame"),
    ("losses_per_1000", "losses per 1000 frames"),
    ("heading_mae_deg", "heading MAE [deg]"),
    ("offset_mae_m", "offset MAE [m]"),
)


def plot(path: Path, rows: Sequence[Row]) -> None:
    """A panel a figure over the frame rate, a row of them a law, a line a way of telling the speed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    laws = list(dict.fromkeys(str(row["law"]) for row in rows))
    figure = Figure(figsize=(16, 3.6 * len(laws)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(laws), len(PANELS), squeeze=False)
    for law, line in zip(laws, axes, strict=True):
        for (name, label), axis in zip(PANELS, line, strict=True):
            for telling, marker in zip(TELLINGS, "osv^", strict=True):
                mine = [row for row in rows if (row["law"], row["speed"]) == (law, telling)]
                values = [np.nan if row[name] is None else row[name] for row in mine]
                axis.plot([row["rate_hz"] for row in mine], values, marker=marker, markersize=5, label=telling)
            axis.set_xscale("log")
            axis.set_xticks(RATES_HZ, [str(rate) for rate in RATES_HZ])
            axis.minorticks_off()
            axis.set_xlabel("frames/s")
            axis.set_title(f"{law}: {label}", fontsize=9, loc="left")
            axis.set_ylim(bottom=0.0)
            axis.grid(alpha=0.3)
    axes[0][0].legend(title="speed", fontsize=8)
    try:
        figure.savefig(path, dpi=90)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be written as a picture: {error}") from None
