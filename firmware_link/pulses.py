"""Conversion between pulse width and angle or speed by the tables of car.toml."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence

from firmware_link.messages import PULSE_STEP_US


class PulseTable:
    """Piecewise linear and strictly monotonic: `pulse_us[i]` [us] gives `values[i]`.

    Values and pulses are limited to the ends of the table. `zero_us` is the pulse for the value 0.
    """

    def __init__(self, pulse_us: Sequence[float], values: Sequence[float]) -> None:
        by_value = sorted(zip(values, pulse_us, strict=True))
        self._values = [value for value, _ in by_value]
        self._pulses_of_values = [pulse for _, pulse in by_value]
        by_pulse = sorted(zip(pulse_us, values, strict=True))
        self._pulses = [pulse for pulse, _ in by_pulse]
        self._values_of_pulses = [value for _, value in by_pulse]
        self.min_us, self.max_us = _on_grid(self._pulses[0]), _on_grid(self._pulses[-1])
        self.zero_us = self.pulse_us(0.0)

    def pulse_us(self, value: float) -> float:
        """The pulse [us] for `value`, on the wire's grid of 0.5 us."""
        return _on_grid(_interpolate(value, self._values, self._pulses_of_values))

    def value(self, pulse_us: float) -> float:
        """The angle or speed for a pulse [us]."""
        return _interpolate(pulse_us, self._pulses, self._values_of_pulses)


def _on_grid(pulse_us: float) -> float:
    return round(pulse_us / PULSE_STEP_US) * PULSE_STEP_US


def _interpolate(x: float, xs: list[float], ys: list[float]) -> float:
    if x <= xs[0]:
        return ys[0]
    if x >= xs[-1]:
        return ys[-1]
    i = bisect_right(xs, x)
    share = (x - xs[i - 1]) / (xs[i] - xs[i - 1])
    return ys[i - 1] + share * (ys[i] - ys[i - 1])
