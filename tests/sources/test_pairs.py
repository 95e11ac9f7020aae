"""Two sources as one pair: by time, with a count of what has no partner."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from automodel.signals import Frame, StereoFrame
from automodel.sources.errors import EndOfSource
from automodel.sources.pairs import PairSource

MS = 1_000_000


class Timed:
    """Frames of these times [ms], each with its time as grey level; None: no frame in time."""

    rate_hz = 50.0

    def __init__(self, times_ms: Sequence[int | None]) -> None:
        self.times_ms, self.next, self.closed = list(times_ms), 0, False

    def read(self, timeout_s: float) -> Frame | None:
        if self.next == len(self.times_ms):
            raise EndOfSource
        self.next += 1
        t_ms = self.times_ms[self.next - 1]
        if t_ms is None:
            return None
        return Frame(t_ns=t_ms * MS, index=self.next - 1, image=np.full((2, 2), t_ms, np.uint8))

    def close(self) -> None:
        self.closed = True


def pairs(left: Sequence[int | None], right: Sequence[int | None]) -> tuple[list[tuple[int, int, int]], int]:
    """Index, left and right time [ms] of each pair, and how many frames have no partner."""
    source = PairSource(Timed(left), Timed(right), tolerance_s=0.005)
    found: list[tuple[int, int, int]] = []
    while True:
        try:
            frame = source.read(0.0)
        except EndOfSource:
            return found, source.unpaired
        if frame is not None:
            assert isinstance(frame, StereoFrame)
            assert frame.t_ns == int(frame.left[0, 0]) * MS
            found.append((frame.index, int(frame.left[0, 0]), int(frame.right[0, 0])))


@pytest.mark.parametrize(
    ("left", "right", "expected", "unpaired"),
    [
        ([0, 20, 40], [0, 20, 40], [(0, 0, 0), (1, 20, 20), (2, 40, 40)], 0),
        ([0, 20, 40], [5, 15, 46], [(0, 0, 5), (1, 20, 15)], 2),  # the tolerance itself is within, 6 ms are not
        ([0, 40, 60], [0, 20, 40, 60], [(0, 0, 0), (1, 40, 40), (2, 60, 60)], 1),  # the left camera lost one
        ([0, 20, 40, 60], [0, 60], [(0, 0, 0), (3, 60, 60)], 2),
        ([0, 20, 40, 60, 80], [0, 20], [(0, 0, 0), (1, 20, 20)], 3),  # after the right one's end
        ([0, 20], [0, 20, 40, 60], [(0, 0, 0), (1, 20, 20)], 2),  # after the left one's end
        ([0, None, 20], [0, 20], [(0, 0, 0), (2, 20, 20)], 0),  # late, not lost
        ([0, 20], [0, None, 20], [(0, 0, 0), (1, 20, 20)], 0),
        ([0, 20, 40], [10, 30, 50], [], 6),  # cameras that take turns are no pair
    ],
)
def test_frames_pair_by_their_times(
    left: list[int | None], right: list[int | None], expected: list[tuple[int, int, int]], unpaired: int
) -> None:
    assert pairs(left, right) == (expected, unpaired)


def test_it_closes_both_and_knows_the_rate() -> None:
    left, right = Timed([0]), Timed([0])
    source = PairSource(left, right, 0.0)
    source.close()
    assert (left.closed, right.closed, source.rate_hz) == (True, True, 50.0)
    with pytest.raises(ValueError, match="tolerance_s"):
        PairSource(left, right, -1.0)
