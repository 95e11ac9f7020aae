"""Two sources as one pair of cameras, by the times of their frames."""

from __future__ import annotations

from collections.abc import Callable

from automodel.interfaces import Source
from automodel.signals import Frame, StereoFrame
from automodel.sources.errors import EndOfSource

TOLERANCE = 0.25  # of a period: at half of it cameras that take turns would pass for pairs


class PairSource:
    """Implements `Source`: the frames of two sources that were taken within `tolerance_s` of each other.

    A pair has time and index of its left frame. `unpaired` counts the frames of either side without a partner, at the
    end of `read`'s pairs also those that one side has beyond the other's end. Raises ValueError for a tolerance below
    zero.
    """

    def __init__(self, left: Source, right: Source, tolerance_s: float) -> None:
        if not tolerance_s >= 0.0:
            raise ValueError(f"tolerance_s: expected 0 or more, got {tolerance_s}")
        self._left, self._right, self.tolerance_s = left, right, tolerance_s
        self.rate_hz = getattr(left, "rate_hz", 0.0)
        self.frame_count = getattr(left, "frame_count", None)
        self.unpaired = 0
        self._waiting: dict[Source, Frame] = {}  # read, and not yet paired

    def read(self, timeout_s: float) -> StereoFrame | None:
        """The next pair, None if a frame did not come in time; raises EndOfSource where either side ends."""
        while True:
            left = self._next(self._left, self._right, timeout_s)
            right = self._next(self._right, self._left, timeout_s)
            if left is None or right is None:
                return None
            apart_s = (right.t_ns - left.t_ns) * 1e-9
            if abs(apart_s) <= self.tolerance_s:
                self._waiting.clear()
                return StereoFrame(t_ns=left.t_ns, index=left.index, left=left.image, right=right.image)
            self._waiting.pop(self._left if apart_s > 0.0 else self._right)
            self.unpaired += 1

    def close(self) -> None:
        """Close both."""
        self.frame_count = None
        self._left.close()
        self._right.close()

    def _next(self, side: Source, other: Source, timeout_s: float) -> Frame | None:
        """The frame of a side that is to be paired; at its end the rest of the other one has no partner."""
        if side not in self._waiting:
            try:
                frame = side.read(timeout_s)
            except EndOfSource:
                self.unpaired += len(self._waiting) + _rest(lambda: other.read(timeout_s))
                self._waiting.clear()
                raise
            if frame is None:
                return None
            if isinstance(frame, StereoFrame):
                raise TypeError("a pair of pairs: each side must be a single camera")
            self._waiting[side] = frame
        return self._waiting[side]


def _rest(read: Callable[[], object]) -> int:
    """How many frames are left."""
    count = 0
    try:
        while read() is not None:
            count += 1
    except EndOfSource:
        pass
    return count
