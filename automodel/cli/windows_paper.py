"""Drives tmr in both directions for the tables of seed 003 (`bench accuracy --table windows-paper`)."""

from __future__ import annotations

import functools
import itertools
import os
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace

import cv2
import numpy as np

from automodel.cli.accuracy import Case, watch
from automodel.cli.figures import show
from automodel.cli.progress import progress
from automodel.cli.speed import WARM_UP
from automodel.cli.telling import say
from automodel.cli.workers import spread
from automodel.config import CarConfig
from automodel.evaluation.windows_paper import Across, WindowsPaperMeter, section_of
from automodel.geometry import SE2, View
from automodel.pipelines import make_pipeline
from automodel.pipelines.windows import Windows
from automodel.signals import Frame, LaneEstimate, Motion
from automodel.sim.paint import Paint
from automodel.sim.track import Lane, load_track
from automodel.sim.trajectory import DrivenPose

COMMAND = "bench accuracy"
RATE_HZ = 20.0  # frames of a lap that give stable figures


class PaintAcross:
    """The zebras and stop lines of one lane.

    Each is a stretch of the lane's centerline over which such paint lies between the lane's lines. Its near edge is
    where the stretch begins in the direction of travel, square to the lane there, as it is painted. Each arm of a
    crossing has a zebra, so a lane meets two of them where it passes a crossing: before it and after it.
    """

    def __init__(self, name: str, lane: Lane, paint: Iterable[Paint]) -> None:
        self._name = name
        self._line = lane.centerline
        spans: list[tuple[float, float]] = []
        for polygon in (piece.polygon_m for piece in paint if piece.kind in ("zebra", "stop")):
            s_m, d_m = self._line.project(polygon.mean(axis=0))
            if abs(d_m) < 0.5 * float(lane.width_m(s_m)):
                s = [self._line.project(corner, s_m, 1.0)[0] for corner in polygon]
                ahead = [self._way(s_m, corner) for corner in s]
                spans.append((s_m + min(ahead), s_m + max(ahead)))
        self.spans_m: list[tuple[float, float]] = []
        for begin, end in sorted(spans):
            if self.spans_m and begin <= self.spans_m[-1][1]:
                self.spans_m[-1] = (self.spans_m[-1][0], max(end, self.spans_m[-1][1]))
            else:
                self.spans_m.append((begin, end))

    def in_view(self, pose: DrivenPose, s_m: float, view: View) -> list[Across]:
        """What lies across the lane in the bird's-eye view of a car whose reference point is at arc length `s_m`."""
        body = SE2(pose.x_m, pose.y_m, pose.yaw_rad).inverse()
        found = []
        for index, span in enumerate(self.spans_m):
            ahead = [self._way(s_m, s) for s in span]
            if ahead[1] < 0.0 or ahead[0] > view.x_far_m:
                continue
            x, y = body.apply(self._line.position(np.array(span))).T
            if x[1] < view.x_near_m or x[0] > view.x_far_m or abs(y[0]) > view.half_width_m:
                continue
            angle = float(self._line.heading(span[0])) - pose.yaw_rad + 0.5 * np.pi
            edge = bool(x[0] >= view.x_near_m)
            found.append(Across(name=f"{self._name} {index}", distance_m=ahead[0], angle_rad=angle, edge_in_view=edge))
        return found

    def _way(self, from_m: float, to_m: float) -> float:
        """The way along the lane [m], the shorter one round a closed lane."""
        length_m = self._line.length_m
        return (to_m - from_m + 0.5 * length_m) % length_m - 0.5 * length_m if self._line.closed else to_m - from_m


class TimedStep:
    """`Windows.step` with the durations of the paper's two nodes booked in `meter`.

    "lane detection" is the whole step, crossings included; "crossing detection" all that it takes to find a crossing.
    """

    def __init__(self, pipeline: Windows, meter: WindowsPaperMeter) -> None:
        self._pipeline, self._meter = pipeline, meter
        pipeline.stages.stopwatch = time.perf_counter_ns

    def __call__(self, frame: Frame, motion: Motion) -> LaneEstimate:
        """One step."""
        begin_ns = time.perf_counter_ns()
        estimate = self._pipeline.step(frame, motion)
        spent_ns = time.perf_counter_ns() - begin_ns
        stages = self._pipeline.stages.durations_ns
        if frame.index >= WARM_UP:
            self._meter.add_duration("lane detection", spent_ns)
            if "crossing" in stages:  # not in a frame without a lane across which to look
                until = list(stages).index("crossing") + 1
                self._meter.add_duration("crossing detection", sum(list(stages.values())[:until]))
        return estimate


def drive(car: CarConfig, case: Case, frames: int | None = None) -> WindowsPaperMeter:
    """The figures of one drive at `RATE_HZ`, or of its first `frames`, with one thread for OpenCV."""
    car = replace(car, camera=replace(car.camera, rate_hz=RATE_HZ))
    track, pipeline = load_track(case.track), make_pipeline("windows", car)
    assert isinstance(pipeline, Windows)
    lane, view = track.lane(case.direction), pipeline.view
    paint = PaintAcross(case.direction, lane, track.paint())
    meter = WindowsPaperMeter(m_per_px=view.m_per_px, m_per_row=view.m_per_row, gate_m=0.5 * car.lane.width_m)
    stretch_m = np.linspace(view.x_near_m, view.x_far_m, 25) - car.vehicle.reference_x_m
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for estimate, truth, pose in itertools.islice(watch(car, case, TimedStep(pipeline, meter)), frames):
            across = paint.in_view(pose, truth.s_m, view)
            curvature = lane.centerline.curvature(truth.s_m + stretch_m)
            meter.add_lines(section_of(curvature, truth.width_m, bool(across)), estimate)
            meter.add_crossing(estimate.crossing, across)
    finally:
        cv2.setNumThreads(threads)
    return meter


def show_tables(car: CarConfig, cases: Sequence[Case], jobs: int | None, as_json: bool) -> None:
    """Drive `cases` and print the tables; as JSON they are one list of rows, each with the name of its table."""
    jobs = min(jobs or os.cpu_count() or 1, len(cases))
    meters: list[WindowsPaperMeter] = []
    with progress("bench accuracy", len(cases)) as bar:
        for meter in spread(functools.partial(drive, car), cases, jobs):
            meters.append(meter)
            bar()
    whole = meters[0]
    for other in meters[1:]:
        whole.include(other)
    tables = {"lines": whole.line_rows(), "crossing": [whole.crossing_row()], "rates": whole.rate_rows()}
    say(
        f"a pixel is {1e3 * whole.m_per_px:.3g} mm here and of unknown size in the paper; a marking is"
        f" {car.lane.marking_width_m / whole.m_per_px:.3g} px wide here and 16 px there; the paper's crossing error is"
        " of a fit, ours of the distance; its rates are a Jetson Nano's"
    )
    if as_json:
        keys = dict.fromkeys(key for rows in tables.values() for row in rows for key in row)
        show(COMMAND, [{"table": name, **keys, **row} for name, rows in tables.items() for row in rows], True)
        return
    for rows in tables.values():
        show(COMMAND, rows, False)
