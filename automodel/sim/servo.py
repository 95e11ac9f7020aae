"""What actuators do to a command on its way to the wheel: table, lag, rate limit, play. Plain floats, one step each."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence


def interpolate(x: float, xs: Sequence[float], ys: Sequence[float]) -> float:
    """Piecewise linear through (xs[i], ys[i]), xs rising; the end values beyond the ends."""
    if x <= xs[0]:
        return ys[0]
    if x >= xs[-1]:
        return ys[-1]
    i = bisect_right(xs, x)
    return ys[i - 1] + (ys[i] - ys[i - 1]) * (x - xs[i - 1]) / (xs[i] - xs[i - 1])


def lagged(value: float, target: float, share: float, step_max: float) -> float:
    """One step of a first-order lag, exact for a constant target, never moving more than `step_max`.

    `share` is 1 - exp(-dt / tau).
    """
    step = (target - value) * share
    if step > step_max:
        step = step_max
    elif step < -step_max:
        step = -step_max
    return value + step


def through_play(driven: float, driver: float, play: float) -> float:
    """Where a part rests that is driven through a gap of width `play`: it moves only when the driver touches it."""
    half = 0.5 * play
    if driver - driven > half:
        return driver - half
    if driven - driver > half:
        return driver + half
    return driven
