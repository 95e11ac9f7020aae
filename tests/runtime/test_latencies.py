"""Times that are counted: their percentiles against the times themselves."""

from __future__ import annotations

import numpy as np
import pytest

from automodel.runtime.latencies import LONGEST_NS, STEP_NS, Latencies


def of(times_ns: list[int]) -> Latencies:
    latencies = Latencies()
    for ns in times_ns:
        latencies.add(ns)
    return latencies


@pytest.mark.parametrize("count", [1, 2, 99, 1000])
@pytest.mark.parametrize("percentile", [0.0, 50.0, 99.0, 100.0])
def test_percentiles_are_known_to_a_step(count: int, percentile: float) -> None:
    times_ns = np.random.default_rng(count).lognormal(15.0, 1.0, count).astype(np.int64)
    exact_ms = float(np.percentile(times_ns, percentile, method="lower")) * 1e-6
    found_ms = of(times_ns.tolist()).percentile_ms(percentile)
    assert found_ms is not None
    assert -1e-9 <= exact_ms - found_ms < STEP_NS * 1e-6


def test_none_is_none_and_the_longest_of_all_is_kept() -> None:
    assert of([]).percentile_ms(50.0) is None
    long = of([3 * LONGEST_NS, 5 * LONGEST_NS, -1])
    assert len(long) == 3
    assert (long.percentile_ms(0.0), long.percentile_ms(50.0)) == (0.0, LONGEST_NS * 1e-6)
    assert long.percentile_ms(100.0) == 5 * LONGEST_NS * 1e-6
