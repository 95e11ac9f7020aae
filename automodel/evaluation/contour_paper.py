"""The claim of seed 004 (Smith): a tracker that is told the speed needs fewer iterations and loses the lane less often.

Every way of telling sees the same pictures. A loss is a run of frames in which the lane that was followed is not
followed on: LOST, looked for anew on whole rows, or a false lane (as `automodel.evaluation.accuracy` counts).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from automodel.evaluation.accuracy import FALSE_LANE, TruePose
from automodel.signals import LaneEstimate, LaneStatus, Motion, MotionSource

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
