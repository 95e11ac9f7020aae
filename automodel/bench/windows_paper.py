"""`bench accuracy --table windows-paper`: Tables I to IV of the paper behind `windows`, beside its own figures.

How far they can be compared:

- The paper does not say how large its pixel is on the ground. Its lines are 16 px wide, those of `windows` as wide as
  the configuration says (5 px): as shares of a line's width its errors are smaller than they look beside ours.
- Its points are the bright pixels of each window, those of `windows` one mean a window, which scatters less.
- It evaluates 6 images a section. Here every frame counts in which a line has more points than its regression has
  coefficients; with fewer the residual is always zero. As in Table II, a metric is the mean over frames of the frame's
  own MAE or RMSE.
- Its crossing error (Table III) is the residual of the line's own points. A `Crossing` carries none, so ours is the
  error of the distance against the truth, which is harder, in rows of the bird's-eye view and in metres.
- Its rates are of ROS nodes on a Jetson Nano; ours are of this machine, one over the time of single frames.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from automodel.assembly.parts import make_pipeline
from automodel.bench.accuracy import Case, Choice, Row, watch
from automodel.bench.speed import TimedStep, opencv_threads
from automodel.config import CarConfig
from automodel.console.messages import say
from automodel.console.workers import Sweep, Tick, complete
from automodel.curves import GraphCurve
from automodel.geometry import SE2, View
from automodel.pipelines.windows import Windows
from automodel.signals import Crossing, LaneEstimate, LaneLine
from automodel.sim.paint import Paint
from automodel.sim.track import Lane
from automodel.sim.track_files import load_track
from automodel.sim.trajectory import DrivenPose
from automodel.types import FloatArray

# MAE and RMSE [px] by section and line. Table II heads its columns wrongly; Table I's images show that they are MAE
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

BEND_PER_LANE = 0.02  # a road with less curvature times lane width is straight
RATE_HZ = 20.0  # enough frames in a lap for metrics that repeat


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueCrossing:
    """A zebra or stop line that is at least partly in view.

    `distance_m` to its near edge along the lane from the reference point, `angle_rad` of that edge in the body frame,
    both as in `automodel.signals.Crossing`; `edge_in_view` is False once the car is too close to see that edge.
    """

    name: str
    distance_m: float
    angle_rad: float
    edge_in_view: bool


def section_of(curvature_per_m: ArrayLike, width_m: float, crossing_in_view: bool) -> str | None:
    """The paper's section by the lane's curvature (n,) [1/m] over the stretch in view.

    "curve A" bends right throughout, "curve B" left, "straight" not at all and has no crossing; else None.
    """
    bend = np.asarray(curvature_per_m, dtype=np.float64) * width_m
    if (bend < -BEND_PER_LANE).all():
        return "curve A"
    if (bend > BEND_PER_LANE).all():
        return "curve B"
    straight = bool((np.abs(bend) <= BEND_PER_LANE).all())
    return "straight" if straight and not crossing_in_view else None


def residuals_px(line: LaneLine, m_per_px: float) -> FloatArray | None:
    """Residuals (n,) [px] across the view of a line's points from their regression.

    None where there is no regression, or not more points than it has coefficients.
    """
    if not isinstance(line.curve, GraphCurve) or len(line.points_m) <= len(line.curve.coefficients):
        return None
    x, y = line.points_m.T
    return (y - np.polynomial.polynomial.polyval(x, line.curve.coefficients)) / m_per_px


@dataclass(slots=True, kw_only=True)
class WindowsPaperMeter:
    """Collects frames; `line_rows`, `crossing_row` and `rate_rows` give the metrics over all of them.

    Pixels are `m_per_px` [m] wide across the road and `m_per_row` [m] along it. A reported crossing is compared with
    the nearest true near edge, which must lie within `gate_m` (half a lane's width: edges lie further apart); without
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
        """Add the lines of one frame."""
        for name, line in (("left", estimate.left), ("right", estimate.right)):
            off = residuals_px(line, self.m_per_px) if section is not None and line is not None else None
            if section is not None and off is not None:
                self.lines.append((section, name, *_mae_rmse(off)))

    def add_crossing(self, found: Crossing | None, true: Sequence[TrueCrossing]) -> None:
        """Add the crossing of one frame; `true` are those in view."""
        self.passed.update(crossing.name for crossing in true if crossing.edge_in_view)
        if found is None:
            return
        near = min(true, key=lambda crossing: abs(found.distance_m - crossing.distance_m), default=None)
        if near is None or abs(found.distance_m - near.distance_m) > self.gate_m:
            self.false_frames += 1
        elif near.edge_in_view:
            turn = math.remainder(found.angle_rad - near.angle_rad, math.pi)  # a line has no direction
            self.crossings.append((found.distance_m - near.distance_m, turn))
            self.seen.add(near.name)

    def add_durations(self, spent_ns: Mapping[str, int]) -> None:
        """The times of one frame's stages, as `TimedStep` has them, booked on the paper's nodes.

        "lane detection" is the whole step, crossings included; "crossing detection" all that it takes to find one.
        """
        self.durations_ns.setdefault("lane detection", []).append(spent_ns["total"])
        stages = [stage for stage in spent_ns if stage != "total"]
        if "crossing" in stages:  # it is not looked for in a frame without a lane
            needed = stages[: stages.index("crossing") + 1]
            self.durations_ns.setdefault("crossing detection", []).append(sum(spent_ns[stage] for stage in needed))

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
        """Tables I and II: a row for each section and line; None without a frame."""
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
    """The paper's eq. (10) and (11)."""
    return float(np.abs(errors).mean()), float(np.sqrt(np.square(errors).mean()))


class LaneCrossings:
    """The zebras and stop lines of one lane.

    Each is a span of the lane's centerline with such paint between the lane's lines. Its near edge is where the span
    starts in the direction of travel, at a right angle to the lane, as it is painted. Each arm of an intersection has
    a zebra, so a lane meets two of them there: before it and after it.
    """

    def __init__(self, name: str, lane: Lane, paint: Iterable[Paint]) -> None:
        self._name = name
        self._line = lane.centerline
        spans: list[tuple[float, float]] = []
        for polygon in (piece.polygon_m for piece in paint if piece.kind in ("zebra", "stop")):
            s_m, d_m = self._line.project(polygon.mean(axis=0))
            if abs(d_m) < 0.5 * float(lane.width_m(s_m)):
                s = [self._line.project(corner, s_m, 1.0)[0] for corner in polygon]
                ahead = [self._distance_m(s_m, corner) for corner in s]
                spans.append((s_m + min(ahead), s_m + max(ahead)))
        self.spans_m: list[tuple[float, float]] = []
        for start, end in sorted(spans):
            if self.spans_m and start <= self.spans_m[-1][1]:
                self.spans_m[-1] = (self.spans_m[-1][0], max(end, self.spans_m[-1][1]))
            else:
                self.spans_m.append((start, end))

    def in_view(self, pose: DrivenPose, s_m: float, view: View) -> list[TrueCrossing]:
        """Those in the bird's-eye view of a car whose reference point is at arc length `s_m`."""
        body = SE2(pose.x_m, pose.y_m, pose.yaw_rad).inverse()
        found = []
        for index, span in enumerate(self.spans_m):
            ahead = [self._distance_m(s_m, s) for s in span]
            if ahead[1] < 0.0 or ahead[0] > view.x_far_m:
                continue
            x, y = body.apply(self._line.position(np.array(span))).T
            if x[1] < view.x_near_m or x[0] > view.x_far_m or abs(y[0]) > view.half_width_m:
                continue
            angle = float(self._line.heading(span[0])) - pose.yaw_rad + 0.5 * np.pi
            edge = bool(x[0] >= view.x_near_m)
            name = f"{self._name} {index}"
            found.append(TrueCrossing(name=name, distance_m=ahead[0], angle_rad=angle, edge_in_view=edge))
        return found

    def _distance_m(self, from_m: float, to_m: float) -> float:
        """Along the lane, forward positive; the shorter direction around a closed lane."""
        length_m = self._line.length_m
        return (to_m - from_m + 0.5 * length_m) % length_m - 0.5 * length_m if self._line.closed else to_m - from_m


def measure_case(car: CarConfig, case: Case, tick: Tick, frames: int | None = None) -> WindowsPaperMeter:
    """The metrics of one drive at `RATE_HZ`, or of its first `frames`, with one thread for OpenCV."""
    car = replace(car, camera=replace(car.camera, rate_hz=RATE_HZ))
    track, pipeline = load_track(case.track), make_pipeline("windows", car)
    assert isinstance(pipeline, Windows)
    lane, view = track.lane(case.direction), pipeline.view
    paint = LaneCrossings(case.direction, lane, track.paint())
    meter = WindowsPaperMeter(m_per_px=view.m_per_px, m_per_row=view.m_per_row, gate_m=0.5 * car.lane.width_m)
    stretch_m = np.linspace(view.x_near_m, view.x_far_m, 25) - car.vehicle.reference_x_m
    step = TimedStep(pipeline)
    with opencv_threads(1):
        for estimate, truth, pose in watch(car, case, step, tick, frames):
            true = paint.in_view(pose, truth.s_m, view)
            curvature = lane.centerline.curvature(truth.s_m + stretch_m)
            meter.add_lines(section_of(curvature, truth.width_m, bool(true)), estimate)
            meter.add_crossing(estimate.crossing, true)
    for spent_ns in step.durations_ns:
        meter.add_durations(spent_ns)
    return meter


def measure(car: CarConfig, choice: Choice, sweep: Sweep) -> dict[str, list[Row]]:
    """Drive tmr in both directions, centred; gives the rows of each table.

    Of `choice` the first seed, the look and the speed count.
    """
    choice = replace(choice, pipelines=("windows",), tracks=("tmr",), styles=("centred",), seeds=choice.seeds[:1])
    cases = [case for direction in ("forward", "reverse") for case in replace(choice, direction=direction).cases()]
    (_, whole), *others = complete("bench accuracy", functools.partial(measure_case, car), cases, sweep)
    for _, other in others:
        whole.include(other)
    say(
        f"a pixel is {1e3 * whole.m_per_px:.3g} mm here and of unknown size in the paper; a marking is"
        f" {car.lane.marking_width_m / whole.m_per_px:.3g} px wide here and 16 px there; the paper's crossing error is"
        " that of a fit, ours that of the distance; its rates are a Jetson Nano's"
    )
    return {"lines": whole.line_rows(), "crossing": [whole.crossing_row()], "rates": whole.rate_rows()}
