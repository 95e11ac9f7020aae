"""How far an estimate is from the truth: the figures of Cudrano et al. 2020, Table I, and tails of the distribution."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from automodel.signals import LaneEstimate

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
