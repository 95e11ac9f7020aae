"""Times of a run, counted: an hour's need no more memory than a minute's."""

from __future__ import annotations

import numpy as np

STEP_NS = 10_000  # 0.01 ms, to which a time is known
LONGEST_NS = 1_000_000_000  # a longer one counts as that long, but for the longest of all


class Latencies:
    """How many times there were of each length, in steps of `STEP_NS`."""

    def __init__(self) -> None:
        self._counts = np.zeros(LONGEST_NS // STEP_NS + 1, np.int64)
        self._most_ns = 0
        self._total = 0

    def __len__(self) -> int:
        return self._total

    def add(self, ns: int) -> None:
        """One more time [ns]."""
        self._counts[min(max(ns, 0), LONGEST_NS) // STEP_NS] += 1
        self._most_ns = max(self._most_ns, ns)
        self._total += 1

    def percentile_ms(self, percentile: float) -> float | None:
        """The time [ms] that a share of them (0 .. 100) does not exceed, rounded down to a step; None of none."""
        if not self._total:
            return None
        if percentile >= 100.0:
            return self._most_ns * 1e-6
        rank = percentile / 100.0 * (self._total - 1)
        return float(np.searchsorted(np.cumsum(self._counts), rank, side="right")) * (STEP_NS * 1e-6)
