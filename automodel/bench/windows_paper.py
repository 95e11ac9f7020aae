"""The figures of seed 003, section V, Tables I to IV, for the pipeline `windows`, beside those that it prints.

How far they can be compared:

- The paper does not say how large its pixel is on the ground. Its lines are 16 px wide, those of `windows` as wide as
  the configuration says (5 px): as shares of a line's width its errors are smaller than they look beside ours.
- Its points are the bright pixels of each window, those of `windows` one mean a window, which scatters less.
- It evaluates 6 pictures a section. Here every frame counts in which a line has more points than its regression has
  coefficients; with fewer the residual is zero whatever they are. As in Table II, a figure is the mean over pictures
  of the picture's own MAE or RMSE.
- Its crossing error (Table III) is the residual of the line's own points. A `Crossing` carries none, so ours is the
  error of the distance against the truth, which is harder, in rows of the bird's-eye view and in metres.
- Its rates are of ROS nodes on a Jetson Nano; ours are of this machine, one over the time of single frames.

Drives tmr in both directions for the tables of seed 003 (`bench accuracy --table windows-paper`).
"""

from __future__ import annotations

import functools
import itertools
import math
import os
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from automodel.assembly.parts import make_pipeline
from automodel.bench.accuracy import Case, watch
from automodel.bench.speed import WARM_UP
from automodel.config import CarConfig
from automodel.console.messages import say
from automodel.console.progress import progress
from automodel.console.tables import show
from automodel.console.workers import spread
from automodel.curves import GraphCurve
from automodel.estimation.polynomial.regression import evaluate_polynomial
from automodel.geometry import SE2, View
from automodel.pipelines.windows import Windows
from automodel.signals import Crossing, Frame, LaneEstimate, LaneLine, Motion
from automodel.sim.paint import Paint
from automodel.sim.track import Lane
from automodel.sim.track_files import load_track
from automodel.sim.trajectory import DrivenPose
from automodel.types import FloatArray

Row = dict[str, object]

# MAE and RMSE [px] by section and line. Table II heads its columns wrongly; Table I's pictures show that they are MAE
# left, MAE right, RMSE left, RMSE right.
PAPER_LINES_PX = {
    ("straight", "left"): (1.211, 2.025),
    ("straight", "right"): (0.598, 0.847),
    ("curve A", "left"): (1.699, 2.256),
    ("curve A", "right"): (2.181, 2.821),
    ("curve B", "left"): (3.748, 5.587),
    ("curve B", "right"): (1.953, 2.469),
}
PAPER_CROSSING_PX = (4.001, 6.306)  # Table III
PAPER_RATES_HZ = {"lane detection": (16.0, 34.0), "crossing detection": (19.0, 37.0)}  # Table IV: least, most

BENT_PER_LANE = 0.02  # a road with less curvature times lane width is straight


@dataclass(frozen=True, slots=True, kw_only=True)
class Across:
    """A zebra or stop line that is at least partly in view, in truth.

    `distance_m` to its near edge along the lane from the reference point, `angle_rad` of that edge in the body frame,
    as `automodel.signals.Crossing` counts; `edge_in_view` is False once the car has come too close to see that edge.
    """

    name: str
    distance_m: float
    angle_rad: float
    edge_in_view: bool


def section_of(curvature_per_m: ArrayLike, width_m: float, across_in_view: bool) -> str | None:
    """The paper's section by the lane's curvature (n,) [1/m] over the stretch in view.

    "curve A" bends right all along, "curve B" left, "straight" not at all and has nothing across; else None.
    """
    bend = np.asarray(curvature_per_m, dtype=np.float64) * width_m
    if (bend < -BENT_PER_LANE).all():
        return "curve A"
    if (bend > BENT_PER_LANE).all():
        return "curve B"
    straight = bool((np.abs(bend) <= BENT_PER_LANE).all())
    return "straight" if straight and not across_in_view else None


def residuals_px(line: LaneLine, m_per_px: float) -> FloatArray | None:
    """Residuals (n,) [px] across the view of a line's points from their regression.

    None where there is no regression, or not more points than it has coefficients.
    """
    if not isinstance(line.curve, GraphCurve) or len(line.points_m) <= len(line.curve.coefficients):
        return None
    x, y = line.points_m.T
    return (y - evaluate_polynomial(line.curve.coefficients, x)) / m_per_px


@dataclass(slots=True, kw_only=True)
class WindowsPaperMeter:
    """Collects frames; `line_rows`, `crossing_row` and `rate_rows` give the figures over all of them.

    Pixels are `m_per_px` [m] wide across the road and `m_per_row` [m] along it. A told crossing is held against the
    true near edge nearest to it, which must lie within `gate_m` (half a lane's width: edges lie further apart); without
    one it is false, unless the edge belongs to paint whose near edge is out of view already.
    """

    m_per_px: float
    m_per_row: float
    gate_m: float
    lines: list[tuple[str, str, float, float]] = field(default_factory=list)  # section, line, MAE, RMSE [px]
    crossings: list[tuple[float, float]] = field(default_factory=list)  # errors: distance [m], angle [rad]
    passed: set[str] = field(default_factory=set)
    seen: set[str] = field(default_factory=set)
    false_frames: int = 0
    durations_ns: dict[str, list[int]] = field(default_factory=dict)  # a frame's, by the paper's node

    def add_lines(self, section: str | None, estimate: LaneEstimate) -> None:
        """The lines of one frame."""
        for name, line in (("left", estimate.left), ("right", estimate.right)):
            off = residuals_px(line, self.m_per_px) if section is not None and line is not None else None
            if section is not None and off is not None:
                self.lines.append((section, name, *_mae_rmse(off)))

    def add_crossing(self, told: Crossing | None, true: Sequence[Across]) -> None:
        """The crossing of one frame, and what there was to see."""
        self.passed.update(across.name for across in true if across.edge_in_view)
        if told is None:
            return
        near = min(true, key=lambda across: abs(told.distance_m - across.distance_m), default=None)
        if near is None or abs(told.distance_m - near.distance_m) > self.gate_m:
            self.false_frames += 1
        elif near.edge_in_view:
            turn = math.remainder(told.angle_rad - near.angle_rad, math.pi)  # a line has no beginning
            self.crossings.append((told.distance_m - near.distance_m, turn))
            self.seen.add(near.name)

    def add_duration(self, node: str, duration_ns: int) -> None:
        """The time that one frame took."""
        self.durations_ns.setdefault(node, []).append(duration_ns)

    def include(self, other: WindowsPaperMeter) -> None:
        """Add all frames of another drive with the same view."""
        self.lines += other.lines
        self.crossings += other.crossings
        self.passed |= other.passed
        self.seen |= other.seen
        self.false_frames += other.false_frames
        for node, durations in other.durations_ns.items():
            self.durations_ns.setdefault(node, []).extend(durations)

    def line_rows(self) -> list[Row]:
        """Tables I and II: a row for each section and line; figures are None without a frame."""
        rows: list[Row] = []
        for (section, name), paper in PAPER_LINES_PX.items():
            found = np.array([line[2:] for line in self.lines if line[:2] == (section, name)]).reshape(-1, 2)
            mae, rmse = found.mean(axis=0).tolist() if len(found) else (None, None)
            row: Row = {"section": section, "line": name, "mae_px": mae, "rmse_px": rmse}
            rows.append({**row, "paper_mae_px": paper[0], "paper_rmse_px": paper[1], "frames": len(found)})
        return rows

    def crossing_row(self) -> Row:
        """Table III; distances [m] and [px], angles [deg], and how many of the near edges passed were seen."""
        distance, turn = np.array(self.crossings).reshape(-1, 2).T
        mae, rmse = _mae_rmse(distance) if len(distance) else (None, None)
        row: Row = {
            "section": "crossing",
            "line": "across",
            "mae_px": None if mae is None else mae / self.m_per_row,
            "rmse_px": None if rmse is None else rmse / self.m_per_row,
            "paper_mae_px": PAPER_CROSSING_PX[0],
            "paper_rmse_px": PAPER_CROSSING_PX[1],
            "frames": len(distance),
            "mae_m": mae,
            "mae_deg": math.degrees(np.abs(turn).mean()) if len(turn) else None,
        }
        return {**row, "seen": len(self.seen), "passed": len(self.passed), "false_frames": self.false_frames}

    def rate_rows(self) -> list[Row]:
        """Table IV: one over the time of a frame [Hz]."""
        rows: list[Row] = []
        for node, (low, high) in PAPER_RATES_HZ.items():
            hz = 1e9 / np.array(self.durations_ns.get(node, []), dtype=np.float64)
            middle, least, most = (float(np.median(hz)), float(hz.min()), float(hz.max())) if len(hz) else (None,) * 3
            row: Row = {"node": node, "median_hz": middle, "min_hz": least, "max_hz": most}
            rows.append({**row, "paper_min_hz": low, "paper_max_hz": high, "frames": len(hz)})
        return rows


def _mae_rmse(errors: FloatArray) -> tuple[float, float]:
    """Seed 003, eq. (10) and (11)."""
    return float(np.abs(errors).mean()), float(np.sqrt(np.square(errors).mean()))


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
