"""What a pipeline said over a run, frame by frame, beside its truth where there is one: the data of a report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from automodel.signals import FALSE_LANE, Event, LaneEstimate, LaneStatus, Motion, MotionSource
from automodel.types import FloatArray, Image


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunTrace:
    """A pipeline over a run of n frames; NaN where it said nothing.

    `t_s` (n,) counts from the run's first frame; `frames` (n,) are their numbers, `statuses` (n,) the values of
    `LaneStatus`. `offset_m`, `heading_rad` and `width_m` (n,) are the pose, `offset_bound_m` and `heading_bound_rad`
    (n,) its bounds; `time_ms` (n,) is the time a frame took.
    """

    name: str
    t_s: FloatArray
    frames: Sequence[int]
    statuses: Sequence[LaneStatus]
    offset_m: FloatArray
    heading_rad: FloatArray
    width_m: FloatArray
    offset_bound_m: FloatArray
    heading_bound_rad: FloatArray
    time_ms: FloatArray


@dataclass(slots=True)
class TraceRecorder:
    """Collects a `RunTrace` frame by frame."""

    name: str
    frames: list[int] = field(default_factory=list)
    statuses: list[LaneStatus] = field(default_factory=list)
    rows: list[tuple[float, ...]] = field(default_factory=list)

    def add(self, t_s: float, frame: int, estimate: LaneEstimate | None, time_ms: float | None) -> None:
        """One frame; no estimate counts as LOST."""
        pose = None if estimate is None else estimate.pose
        values: tuple[float, ...] = (math.nan,) * 5
        if pose is not None:
            bounds = (
                bound if math.isfinite(bound) else math.nan for bound in (pose.offset_bound_m, pose.heading_bound_rad)
            )
            values = (pose.offset_m, pose.heading_rad, pose.width_m, *bounds)
        self.frames.append(frame)
        self.statuses.append(LaneStatus.LOST if estimate is None else estimate.status)
        self.rows.append((t_s, *values, math.nan if time_ms is None else time_ms))

    def trace(self) -> RunTrace:
        """What was collected."""
        t_s, offset, heading, width, offset_bound, heading_bound, time_ms = np.array(self.rows).reshape(-1, 7).T
        return RunTrace(
            name=self.name,
            t_s=t_s,
            frames=tuple(self.frames),
            statuses=tuple(self.statuses),
            offset_m=offset,
            heading_rad=heading,
            width_m=width,
            offset_bound_m=offset_bound,
            heading_bound_rad=heading_bound,
            time_ms=time_ms,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrivenPath:
    """Where the car drove: `xy_m` (n, 2) and `speed_mps` (n,), NaN where unknown; `true` where it is the truth."""

    xy_m: FloatArray
    speed_mps: FloatArray
    true: bool


def dead_reckoned(t_s: FloatArray, motions: Sequence[Motion]) -> DrivenPath:
    """The path from the motion with each frame, from (0, 0) towards x; it stands still where no motion is known."""
    known = np.array([motion.source is not MotionSource.NONE for motion in motions])
    speed = np.where(known, [motion.speed_mps for motion in motions], 0.0)
    rate = np.where(known, [motion.yaw_rate_radps for motion in motions], 0.0)
    step_s = np.diff(t_s, prepend=t_s[:1])
    turn = rate * step_s
    middle = np.cumsum(turn) - 0.5 * turn
    along = (speed * step_s)[:, None] * np.column_stack((np.cos(middle), np.sin(middle)))
    return DrivenPath(xy_m=np.cumsum(along, axis=0), speed_mps=np.where(known, speed, np.nan), true=False)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moment:
    """A frame worth looking at: why, and its picture by pipeline, (h, w, 3) BGR."""

    t_s: float
    frame: int
    why: str
    pictures: Mapping[str, Image]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReportedRun:
    """A run as a report shows it: traces on the same frames, path, `truth_m` (n,) the true offset or None, events."""

    name: str
    origin: str
    traces: tuple[RunTrace, ...]
    path: DrivenPath | None
    truth_m: FloatArray | None
    events: tuple[tuple[float, Event], ...]
    moments: tuple[Moment, ...]
    settings: Mapping[str, object]


def disagreement_m(traces: Sequence[RunTrace]) -> FloatArray:
    """(k, n) [m]: each pipeline's offset minus the median of all; NaN where fewer than two have one."""
    offsets = np.array([trace.offset_m for trace in traces])
    several = np.isfinite(offsets).sum(axis=0) > 1
    difference = np.full(offsets.shape, np.nan)
    if several.any():
        difference[:, several] = offsets[:, several] - np.nanmedian(offsets[:, several], axis=0)
    return difference


def metrics(run: ReportedRun) -> list[dict[str, object]]:
    """A row for each pipeline of a run; None for what is not known."""
    apart = disagreement_m(run.traces)
    rows: list[dict[str, object]] = []
    for trace, difference in zip(run.traces, apart, strict=True):
        count = max(len(trace.statuses), 1)
        row: dict[str, object] = {"run": run.name, "pipeline": trace.name, "frames": len(trace.statuses)}
        shares = {status: 100.0 * trace.statuses.count(status) / count for status in LaneStatus}
        row["availability_pct"] = 100.0 - shares[LaneStatus.LOST]
        row.update({f"{status.value.lower()}_pct": share for status, share in shares.items()})
        row["offset_bound_median_m"] = _of(trace.offset_bound_m, 0.5)
        row["disagreement_median_m"] = _of(np.abs(difference), 0.5)
        row["disagreement_p99_m"] = _of(np.abs(difference), 0.99)
        row |= _against_truth(trace, run.truth_m)
        row["p50_ms"], row["p99_ms"] = _of(trace.time_ms, 0.5), _of(trace.time_ms, 0.99)
        rows.append(row)
    return rows


def _of(values: FloatArray, share: float) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.quantile(known, share)) if len(known) else None


def _against_truth(trace: RunTrace, truth_m: FloatArray | None) -> dict[str, object]:
    """The offset's mean absolute error, and the share of frames that mislead."""
    if truth_m is None:
        return {"offset_mae_m": None, "misled_pct": None}
    error = np.abs(trace.offset_m - truth_m)
    known = np.isfinite(error)
    off = error[known] > FALSE_LANE * trace.width_m[known]
    bound = trace.offset_bound_m[known]
    misled = off & ~(np.where(np.isfinite(bound), bound, np.inf) >= error[known])
    return {
        "offset_mae_m": float(error[known].mean()) if known.any() else None,
        "misled_pct": 100.0 * float(misled.sum()) / max(len(error), 1),
    }
