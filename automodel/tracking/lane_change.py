"""Lane changes: when the neighbour lane becomes the lane, once.

After the stereo paper's stage 6: the tracker jumps to the neighbour lane when the car's lateral position passes three
quarters of half the lane's width while it advances towards that lane. Right after a jump the car is still nearer to the
lane that it left; only when it has gone back well into that one has it given up.
"""

from __future__ import annotations

from automodel.signals import LanePose

PASSED = 0.75  # shares of half a lane's width from its middle: the paper's
SETTLED = 0.65  # within which a change is over: a car that drives on the limit makes one change, not many


class LaneChanges:
    """Follows where the car is in its lane from frame to frame."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the last change: the car is in its lane, wherever there."""
        self._came_from = 0  # the side on which the lane lies that was left: +1 left, -1 right, 0 none

    def due(self, pose: LanePose) -> int:
        """The side on which the neighbour lane should become the lane: +1 left, -1 right, 0 for none."""
        share = pose.offset_m / (0.5 * pose.width_m)
        if abs(share) < SETTLED:
            self._came_from = 0
        side = 1 if share > 0.0 else -1
        # Seen from the lane that was left, the car has come back to as far from its middle as ends a change.
        limit = 2.0 - SETTLED if side == self._came_from else PASSED
        return side if abs(share) > limit and pose.heading_rad * side > 0.0 else 0

    def changed(self, side: int) -> None:
        """The lane on a side became the lane."""
        self._came_from = -side
