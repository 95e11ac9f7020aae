"""What a car drives to be calibrated: pulses and speeds over time, as a value."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

STAND_S = 2.0  # at both ends: the gyro's bias
HOLD_S = 0.9
_STEPS = (
    0.6,
    -0.6,
    0.3,
    -0.3,
    0.6,
    0.0,
    -0.6,
    0.6,
    -0.3,
    0.6,
    -0.6,
    0.3,
)  # shares of the way from the centre to an end
_STEP_S = 0.66


@dataclass(frozen=True, slots=True, kw_only=True)
class Leg:
    """A stretch of a drive: for `duration_s` the steering is at `steering` and the motor at `speed_mps`."""

    duration_s: float
    steering: float  # in the drive's own units: a pulse [us], or an angle [rad]
    speed_mps: float


class DrivePlan:
    """Legs one after the other, from the drive's time 0 on."""

    def __init__(self, legs: tuple[Leg, ...]) -> None:
        if not legs or not all(leg.duration_s > 0 for leg in legs):
            raise ValueError("legs: one at least is wanted, each longer than 0 s")
        self.legs = legs
        self._ends_s = np.cumsum([leg.duration_s for leg in legs]).tolist()

    @property
    def duration_s(self) -> float:
        """How long the drive takes [s]."""
        return float(self._ends_s[-1])

    def at(self, t_s: float) -> Leg | None:
        """The leg at `t_s`; None when the drive is over."""
        i = bisect_right(self._ends_s, t_s)
        return self.legs[i] if i < len(self.legs) else None


def servo_plan(low_us: float, high_us: float, speed_mps: float, levels: int = 13) -> DrivePlan:
    """The drive that tells a servo: all pulses upwards and downwards, twice, the second time in between; then steps.

    Every pulse but the two ends is reached from both sides, by steps of (high - low) / (levels - 1): these must be
    more than the play.
    """
    if not high_us > low_us or levels < 5:
        raise ValueError(f"low_us, high_us, levels: {low_us}, {high_us}, {levels} give no sweep")
    coarse = np.linspace(low_us, high_us, levels)
    between = 0.5 * (coarse[:-1] + coarse[1:])
    middle, half = 0.5 * (low_us + high_us), 0.5 * (high_us - low_us)
    sweeps = (*coarse, *between[::-1], low_us, *between, *coarse[::-1])
    legs = [Leg(duration_s=STAND_S, steering=middle, speed_mps=0.0)]
    legs.append(Leg(duration_s=HOLD_S, steering=middle, speed_mps=speed_mps))
    legs += [Leg(duration_s=HOLD_S, steering=float(pulse), speed_mps=speed_mps) for pulse in sweeps]
    legs += [Leg(duration_s=_STEP_S, steering=middle + share * half, speed_mps=speed_mps) for share in _STEPS]
    legs.append(Leg(duration_s=STAND_S, steering=middle, speed_mps=0.0))
    return DrivePlan(tuple(legs))


def straight_plan(distance_m: float, speed_mps: float) -> DrivePlan:
    """A drive straight ahead over `distance_m` at one speed, with a standstill before and after it.

    It has half as much time again: a car that is slower than it was told gets there, too.
    """
    if not (distance_m > 0 and speed_mps > 0):
        raise ValueError(f"distance_m, speed_mps: {distance_m}, {speed_mps} where positive numbers are wanted")
    return DrivePlan(
        (
            Leg(duration_s=1.0, steering=0.0, speed_mps=0.0),
            Leg(duration_s=1.5 * distance_m / speed_mps + 0.5, steering=0.0, speed_mps=speed_mps),
            Leg(duration_s=1.5, steering=0.0, speed_mps=0.0),
        )
    )
