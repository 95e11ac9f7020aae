"""The battery's voltage, and whether it is nearly empty."""

from __future__ import annotations

LASTING_NS = 1_000_000_000  # a motor that starts pulls the voltage down for shorter
FITTED_V = 1.0  # below this nothing is wired to the board's input


class BatteryMeter:
    """Low from when the voltage has been below `low_v` for a second, until it has been above for as long."""

    def __init__(self, low_v: float) -> None:
        self._low_v = low_v
        self.reset()

    def reset(self) -> None:
        """Forget all readings."""
        self.voltage_v: float | None = None  # read last
        self.low = False
        self._other_since_ns: int | None = None  # since when the readings say otherwise

    def step(self, voltage_v: float, t_ns: int) -> bool:
        """Take in a reading; whether the battery is low."""
        self.voltage_v = voltage_v
        if (FITTED_V <= voltage_v < self._low_v) is self.low:
            self._other_since_ns = None
        elif self._other_since_ns is None:
            self._other_since_ns = t_ns
        elif t_ns - self._other_since_ns >= LASTING_NS:
            self.low, self._other_since_ns = not self.low, None
        return self.low
