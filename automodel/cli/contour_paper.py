"""Drives bends for `bench contour-paper`: the pipeline `contour` with the speed, without it, and with a wrong one."""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from automodel.cli.figures import show
from automodel.cli.progress import progress
from automodel.cli.simulated import appearance, renderer
from automodel.cli.telling import say
from automodel.cli.workers import spread
from automodel.config import CarConfig, ConfigError
from automodel.evaluation.accuracy import TruePose
from automodel.evaluation.contour_paper import BENT_PER_LANE, TELLINGS, ClaimMeter, Row
from automodel.pipelines.contour import Contour
from automodel.signals import Frame
from automodel.sim.track import load_track
from automodel.sim.trajectory import Drive, Odometer
from automodel.sim.truth import TruthFollower

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
