"""The clocks of a run: the machine's monotonic one, and a virtual one that a simulation advances."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

NS_PER_S = 1_000_000_000


class SleepingClock(Protocol):
    """A clock that can also let time pass; the runner waits only through it."""

    def now_ns(self) -> int:
        """The time now [ns]."""
        ...

    def sleep(self, seconds: float) -> None:
        """Come back when `seconds` have passed on this clock."""
        ...


class MonotonicClock:
    """The machine's monotonic clock: never goes back, and stands still while the machine is suspended."""

    def now_ns(self) -> int:
        """The time now [ns]."""
        return time.monotonic_ns()

    def sleep(self, seconds: float) -> None:
        """Give the core away for `seconds`."""
        time.sleep(seconds)


class VirtualClock:
    """Time as a simulation says it is.

    `on_advance(t_ns)` is called after every step forward, so that whatever lives on this time (plant, the emulated
    board's timers) catches up no matter who moved the clock.
    """

    def __init__(self, now_ns: int = 0, on_advance: Callable[[int], None] | None = None) -> None:
        self._now_ns = now_ns
        self._on_advance = on_advance

    def now_ns(self) -> int:
        """The time now [ns]."""
        return self._now_ns

    def advance_to(self, t_ns: int) -> None:
        """Move to `t_ns`; raises ValueError where that lies in the past."""
        if t_ns < self._now_ns:
            raise ValueError(f"t_ns: {t_ns} lies {self._now_ns - t_ns} ns in the past; time does not go back")
        if t_ns == self._now_ns:
            return
        self._now_ns = t_ns
        if self._on_advance is not None:
            self._on_advance(t_ns)

    def sleep(self, seconds: float) -> None:
        """Move `seconds` ahead; raises ValueError for a negative time."""
        self.advance_to(self._now_ns + round(seconds * NS_PER_S))
