from __future__ import annotations

import itertools

from automodel.runtime.clocks import VirtualClock
from automodel.runtime.run_log import RunLog
from automodel.runtime.supervised_source import START_S, SupervisedSource
from automodel.signals import Frame
from automodel.sources.errors import SourceError


class Broken:
    def read(self, timeout_s: float) -> Frame | None:
        raise SourceError("unplugged")

    def close(self) -> None:
        pass


class Starting:
    """A camera that has not given its first frame yet."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock = clock

    def read(self, timeout_s: float) -> Frame | None:
        self.clock.sleep(timeout_s)
        return None

    def close(self) -> None:
        pass


def test_a_camera_opened_again_has_its_time_to_start() -> None:
    clock = VirtualClock()
    opened: list[float] = []

    def reopen() -> Starting:
        opened.append(clock.now_ns() * 1e-9)
        return Starting(clock)

    source = SupervisedSource(Broken(), clock, RunLog(None, None), reopen)
    start_s = clock.now_ns() * 1e-9
    while clock.now_ns() * 1e-9 - start_s < 2.2 * START_S:
        assert source.read(0.02, at_rest=True) is None
    assert len(opened) == 3
    assert all(b - a >= START_S for a, b in itertools.pairwise(opened))
