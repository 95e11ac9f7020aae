"""`bench contour-paper`: the claim of the paper behind `contour` (Smith) that a tracker should know the speed.

A tracker that knows the speed is said to need fewer iterations and to lose the lane less often. `contour` drives bends
with the speed, with a wrong one and without it; all see the same frames. A loss is a run of frames in which the lane
that was followed is not followed on: LOST, searched anew on whole rows, or a false lane (`FALSE_LANE`).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from automodel.bench.accuracy import Case, RenderedDrive, Row
from automodel.config import CarConfig
from automodel.console.messages import say
from automodel.console.workers import Sweep, Tick, spread
from automodel.pipelines.contour import Contour
from automodel.signals import FALSE_LANE, Frame, LaneEstimate, LaneStatus, Motion, MotionSource
from automodel.sim.trajectory import Drive, Odometer
from automodel.sim.truth import Truth
from automodel.viewer.plots import plotted

BEND_PER_LANE = 0.1  # a road with more curvature times lane width bends
LAWS = ("gauss_newton", "gradient_descent")
COLUMNS = (
    "law", "rate_hz", "speed", "iterations", "losses_per_1000", "heading_mae_deg", "offset_mae_m", "frames", "losses",
)  # fmt: skip


def _unknown(motion: Motion) -> Motion:
    return Motion(t_ns=motion.t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)


def _scaled(share: float) -> Callable[[Motion], Motion]:
    return lambda motion: replace(motion, speed_mps=share * motion.speed_mps)


# The motion that the pipeline gets for a measured one. A wrong speed leaves the yaw rate: it is another sensor's.
SPEEDS: dict[str, Callable[[Motion], Motion]] = {
    "told": _scaled(1.0),  # the names stand in the results
    "+20 %": _scaled(1.2),
    "-20 %": _scaled(0.8),
    "none": _unknown,
}


@dataclass(slots=True)
class ClaimMeter:
    """Collects the frames of one reported speed at one frame rate, from the first estimate on.

    Errors are over frames that have an estimate, iterations only over those in which the lane was followed from the
    frame before and a line was seen: without one there is nothing to converge on. Coasting alone is no loss.
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
    _started: bool = False
    _followed: bool = True

    def add(self, estimate: LaneEstimate, truth: Truth, iterations: int, searched: bool, counts: bool) -> None:
        """Add one frame; `searched` where whole rows were searched for a lane, `counts` where the frame is scored."""
        pose = estimate.pose
        if not self._started:
            self._started = pose is not None
            return
        error = math.inf if pose is None else abs(pose.offset_m - truth.offset_m)
        false = pose is not None and error > FALSE_LANE * truth.width_m
        before, self._followed = self._followed, not (pose is None or searched or false)
        if not counts:
            return
        self.frames += 1
        self.lost += pose is None
        self.searched += searched
        self.false += false
        coasting = estimate.status is LaneStatus.COASTING
        self.coasting += coasting
        self.losses += before and not self._followed
        if pose is not None:
            self.offset_m.append(error)
            self.heading_rad.append(abs(math.remainder(pose.heading_rad - truth.heading_rad, math.tau)))
            if not (searched or coasting):
                self.iterations.append(iterations)

    def include(self, other: ClaimMeter) -> None:
        """Add the frames of another drive."""
        counts, values = (
            ("frames", "lost", "searched", "false", "coasting", "losses"),
            ("offset_m", "heading_rad", "iterations"),
        )
        for name in counts + values:
            setattr(self, name, getattr(self, name) + getattr(other, name))

    def row(self) -> Row:
        """The metrics; None where no frame gives one."""
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


RATES_HZ = (5, 10, 20, 30, 60)  # all divide the last, at which the frames are rendered
FEWEST_HZ = 20  # a slower rate sees the drive from several first frames, so that it has as many frames as this one

Key = tuple[str, int, str]  # update law, frame rate [Hz], reported speed
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


class Tracker:
    """One pipeline that gets every frame of one rate, and its metrics."""

    def __init__(self, car: CarConfig, key: Key, first: int, seed: int) -> None:
        law, self.rate_hz, speed = self.key = key
        pipeline = replace(car.pipeline, name="contour", contour=replace(car.pipeline.contour, update=law))
        self.every = RATES_HZ[-1] // self.rate_hz
        self.first, self.meter = first, ClaimMeter()
        self._report, self._odometer = SPEEDS[speed], Odometer(seed)
        self._pipeline = Contour(replace(car, camera=replace(car.camera, rate_hz=self.rate_hz), pipeline=pipeline))
        self._pipeline.stages.stopwatch = lambda: 0  # names the stages that ran

    def see(self, rendered: Frame, drive: Drive, truth: Truth, bends: bool) -> None:
        """Take one of the rendered frames, if it is one of this rate's."""
        if rendered.index % self.every != self.first:
            return
        frame = replace(rendered, index=rendered.index // self.every)
        # odometry measures the distance since the frame before: its speeds are those of the middle between both
        pose = drive.pose(rendered.index / RATES_HZ[-1] - 0.5 / self.rate_hz)
        estimate = self._pipeline.step(frame, self._report(self._odometer.motion(pose, frame.t_ns)))
        searched = "start" in self._pipeline.stages.durations_ns
        self.meter.add(estimate, truth, self._pipeline.iterations, searched, bends)


def measure_drive(car: CarConfig, claim: ClaimDrive, tick: Tick) -> Meters:
    """The metrics of one drive; frames count where the lane bends at the car or within a lane's width ahead."""
    case = Case(pipeline="contour", track=claim.track, style=claim.style, seed=claim.seed, speed_mps=claim.speed_mps)
    rendered = RenderedDrive(car, case)
    trackers = [
        Tracker(car, (law, rate, speed), first, claim.seed)
        for law in claim.laws
        for rate in RATES_HZ
        for speed in SPEEDS
        for first in np.linspace(0, RATES_HZ[-1] // rate, max(FEWEST_HZ // rate, 1), endpoint=False).astype(int)
    ]
    seconds = rendered.lap_s if claim.seconds is None else min(claim.seconds, rendered.lap_s)
    times_s = [index / RATES_HZ[-1] for index in range(int(seconds * RATES_HZ[-1]))]
    for frame, _, truth in rendered.frames(times_s, tick):
        s_m = truth.s_m + np.linspace(0.0, 1.0, 5) * truth.width_m
        bend = np.abs(rendered.lane.centerline.curvature(s_m)).max() * truth.width_m
        for tracker in trackers:
            tracker.see(frame, rendered.drive, truth, bool(bend > BEND_PER_LANE))
    meters: Meters = {}
    for tracker in trackers:
        meters.setdefault(tracker.key, ClaimMeter()).include(tracker.meter)
    return meters


def measure(car: CarConfig, drives: Sequence[ClaimDrive], sweep: Sweep, figure: Path | None) -> list[Row]:
    """A row for each law, rate and reported speed, over all drives; `figure` gets a PNG."""
    whole: Meters = {}
    for _, meters in spread("bench contour-paper", functools.partial(measure_drive, car), drives, sweep):
        for key, meter in meters.items():
            whole.setdefault(key, ClaimMeter()).include(meter)
    rows: list[Row] = [
        {"law": law, "rate_hz": rate, "speed": speed, **meter.row()} for (law, rate, speed), meter in whole.items()
    ]
    if figure is not None:
        plot(figure, rows)
    say(
        "a loss is a run of frames that are LOST, searched anew or false; only frames in bends count; a wrong speed"
        " leaves the yaw rate right; gauss_newton measures the image at most three times a frame, and iterates once or"
        " twice on each measurement"
    )
    return rows


PANELS = (
    ("iterations", "iterations a frame"),
    ("losses_per_1000", "losses per 1000 frames"),
    ("heading_mae_deg", "heading MAE [deg]"),
    ("offset_mae_m", "offset MAE [m]"),
)


def plot(path: Path, rows: Sequence[Row]) -> None:
    """A panel for each metric over the frame rate, a row of panels for each law, a line for each reported speed."""
    laws = list(dict.fromkeys(str(row["law"]) for row in rows))
    with plotted(path, (16, 3.6 * len(laws))) as figure:
        axes = figure.subplots(len(laws), len(PANELS), squeeze=False)
        for law, line in zip(laws, axes, strict=True):
            for (name, label), axis in zip(PANELS, line, strict=True):
                for speed, marker in zip(SPEEDS, "osv^", strict=True):
                    mine = [row for row in rows if (row["law"], row["speed"]) == (law, speed)]
                    values = [np.nan if row[name] is None else row[name] for row in mine]
                    axis.plot([row["rate_hz"] for row in mine], values, marker=marker, markersize=5, label=speed)
                axis.set_xscale("log")
                axis.set_xticks(RATES_HZ, [str(rate) for rate in RATES_HZ])
                axis.minorticks_off()
                axis.set_xlabel("frames/s")
                axis.set_title(f"{law}: {label}", fontsize=9, loc="left")
                axis.set_ylim(bottom=0.0)
                axis.grid(alpha=0.3)
        axes[0][0].legend(title="speed", fontsize=8)
