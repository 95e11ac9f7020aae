from __future__ import annotations

import pytest

from automodel.runtime.clocks import MonotonicClock, VirtualClock


def test_virtual_time_moves_only_when_told_and_tells_of_it() -> None:
    seen: list[tuple[int, int]] = []
    clock = VirtualClock(100, lambda t_ns: seen.append((t_ns, clock.now_ns())))
    assert clock.now_ns() == 100
    clock.advance_to(250)
    clock.advance_to(250)
    clock.sleep(1e-6)
    assert clock.now_ns() == 1250
    assert seen == [(250, 250), (1250, 1250)]


def test_virtual_time_never_goes_back() -> None:
    clock = VirtualClock(100)
    with pytest.raises(ValueError, match="1 ns in the past"):
        clock.advance_to(99)
    with pytest.raises(ValueError, match="does not go back"):
        clock.sleep(-0.1)
    assert clock.now_ns() == 100


def test_monotonic_time_goes_on_while_sleeping() -> None:
    clock = MonotonicClock()
    before = clock.now_ns()
    clock.sleep(0.002)
    assert clock.now_ns() - before >= 2_000_000  # sleep never comes back early
