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
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from automodel.curves import GraphCurve
from automodel.estimation.regression import evaluate_polynomial
from automodel.signals import Crossing, LaneEstimate, LaneLine
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
