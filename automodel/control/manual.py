"""A person who drives: what they want, as shares of the greatest, becomes a command in the car's units."""

from __future__ import annotations

from automodel.config import CarConfig
from automodel.signals import Command, DriverInput

FRESH_NS = 200_000_000  # what was wanted longer ago gives no throttle any more: four words of a page were lost
REVERSE_SHARE = 0.5  # of the speed ahead: nobody reverses fast out of a corner
_MAX_STEP_S = 0.1  # a longer gap lets the speed rise no further


class ManualDriver:
    """Implements `interfaces.Driver`.

    The greatest steering is `[safety] steering_max_rad`, the greatest speed `[control] speed_mps`, half of it in
    reverse. The speed rises by `[control] accel_mps2`, in either direction, and falls at once: a stop is never delayed.
    What was wanted `FRESH_NS` ago steers on, without throttle. A command is valid for `[safety] command_validity_s`.
    """

    def __init__(self, car: CarConfig) -> None:
        self._steering_rad = car.safety.steering_max_rad
        self._speed_mps = min(car.control.speed_mps, car.safety.speed_max_mps)
        self._accel_mps2 = car.control.accel_mps2
        self._validity_ns = round(car.safety.command_validity_s * 1e9)
        self._last: Command | None = None

    def step(self, wanted: DriverInput, t_ns: int) -> Command:
        """The requested command at `t_ns`."""
        self._last = Command(
            t_ns=t_ns,
            steering_rad=wanted.steering * self._steering_rad,
            speed_mps=self._risen(0.0 if t_ns - wanted.t_ns >= FRESH_NS else wanted.speed, t_ns),
            valid_until_ns=t_ns + self._validity_ns,
        )
        return self._last

    def reset(self) -> None:
        """Start from a standstill."""
        self._last = None

    def _risen(self, share: float, t_ns: int) -> float:
        """The speed [m/s] on the way to a share of the greatest."""
        target_mps = share * self._speed_mps * (REVERSE_SHARE if share < 0 else 1.0)
        last_mps, dt_s = 0.0, 0.0
        if self._last is not None:
            last_mps, dt_s = self._last.speed_mps, min(max((t_ns - self._last.t_ns) * 1e-9, 0.0), _MAX_STEP_S)
        before_mps = abs(last_mps) if last_mps * target_mps > 0 else 0.0
        risen_mps = min(abs(target_mps), before_mps + self._accel_mps2 * dt_s)
        return risen_mps if target_mps > 0 else -risen_mps
