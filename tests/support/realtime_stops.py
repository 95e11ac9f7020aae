"""What is demanded of a car that is disturbed, see `realtime_rig`; all times are the board's own."""

from __future__ import annotations

import random

from tests.support.realtime_rig import MS, TIMER_MS, Bench

REACTION_MS = 150.0  # from the fault to neutral at the pin
# Where the program ends by itself a turn that is under way may still send its command, which lives for 100 ms and then
# feeds the board's timer once more: only a machine that holds the program up just then needs so long.
LAST_TURN_MS = 250.0
QUIET_MS = 600.0  # watched for a restart that nobody asked for: longer than a car that is well takes to arm


def phase_ms(name: str) -> float:
    """When in the loop's and the servo's period the fault comes; another for each test."""
    return random.Random(name).uniform(50.0, 90.0)


def check_stop(bench: Bench, fault_ns: int, within_ms: float = REACTION_MS) -> None:
    """Neutral in time, and neutral it stays: whatever the program does from here on."""
    bench.wait(QUIET_MS)
    assert (bench.stopped_ns(fault_ns) - fault_ns) / MS <= within_ms


def check_stop_by_the_timer(bench: Bench, asked_ns: int) -> None:
    """Neutral in time after the last command: what keeps a loop waiting begins some time after it was asked for."""
    bench.until(lambda: not bench.driving, "it drives on")
    bench.wait(QUIET_MS)
    stopped_ns = bench.stopped_ns(asked_ns)
    assert (stopped_ns - bench.last_drive_ns(stopped_ns)) / MS <= TIMER_MS


def paused_by_the_timer(bench: Bench, asked_ns: int) -> bool:
    """Whether it drives again without a person; checks that it was neutral in time after the last command before."""
    bench.until(lambda: not bench.driving, "it drives on")
    bench.wait(QUIET_MS)
    neutral_ns = next(t_ns for t_ns, drives in bench.pulses() if t_ns > asked_ns and not drives)
    assert (neutral_ns - bench.last_drive_ns(neutral_ns)) / MS <= TIMER_MS
    return any(drives for t_ns, drives in bench.pulses() if t_ns > neutral_ns)


def check_never_drives(bench: Bench, since_ns: float) -> None:
    """Not once from `since_ns` until now."""
    pulses = bench.pulses()
    assert pulses[-1][0] > since_ns, "nothing was seen since"
    assert not [t_ns for t_ns, drives in pulses if drives and t_ns > since_ns]
