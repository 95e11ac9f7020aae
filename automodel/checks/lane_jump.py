"""Whether the lane is still the one that was followed: a car cannot jump aside, or turn, from one frame to the next."""

from __future__ import annotations

import math

from automodel.signals import LaneEstimate, LaneStatus

OFFSET_LANES = 0.5  # further aside than half a lane's width, another line was taken for the lane's
HEADING_RAD = 0.6  # turned by more than this, a line across the road was
KEPT_S = 0.5  # a lane that was seen longer ago is no measure any more; longer than a car is held


class LaneJumpCheck:
    """Compares each estimate with the last one that was right.

    Estimates that jump are wrong until one comes that is near the last right one, or until that is `KEPT_S` old: then
    whoever armed the car anew has looked at where it stands. After COASTING a jump is no fault: dead reckoning drifts,
    and a line that is seen again outranks it.
    """

    def __init__(self) -> None:
        self._right: LaneEstimate | None = None

    def step(self, estimate: LaneEstimate) -> str | None:
        """How the lane has jumped, None where it has not or there is none."""
        jump = self._jump(estimate)
        if jump is None and estimate.pose is not None:
            self._right = estimate
        return jump

    def _jump(self, estimate: LaneEstimate) -> str | None:
        right, pose = self._right, estimate.pose
        if pose is None or right is None or right.pose is None or right.status is LaneStatus.COASTING:
            return None
        if not 0 <= estimate.t_ns - right.t_ns < KEPT_S * 1e9:
            return None
        aside_m = pose.offset_m - right.pose.offset_m
        if abs(aside_m) > OFFSET_LANES * right.pose.width_m:
            return f"the lane has jumped aside by {abs(aside_m):.2f} m"
        turn_rad = math.remainder(pose.heading_rad - right.pose.heading_rad, math.tau)
        if abs(turn_rad) > HEADING_RAD:
            return f"the lane has turned by {abs(turn_rad):.2f} rad at once"
        return None
