"""What pipelines share: how many points make a line seen, and the durations of their stages.

The durations are taken by an injected stopwatch: a pipeline itself reads no clock.
"""

from __future__ import annotations

from collections.abc import Callable

SEEN = 2  # points of a frame that make a line seen


class StageClock:
    """`lap(name)` adds the time since the last lap to a stage; without a stopwatch nothing is measured."""

    def __init__(self) -> None:
        self.stopwatch: Callable[[], int] | None = None  # [ns]
        self.durations_ns: dict[str, int] = {}
        self._last_ns = 0

    def start(self) -> None:
        """Start a new frame."""
        if self.stopwatch is not None:
            self.durations_ns = {}
            self._last_ns = self.stopwatch()

    def lap(self, stage: str) -> None:
        """End a stage."""
        if self.stopwatch is not None:
            now_ns = self.stopwatch()
            self.durations_ns[stage] = self.durations_ns.get(stage, 0) + now_ns - self._last_ns
            self._last_ns = now_ns
