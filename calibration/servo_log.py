"""The log of a calibration drive, and the road-wheel angle in each interval of one pulse."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from automodel.types import FloatArray, IntArray

STILL_MPS = 0.02
_STILL_NS = 500_000_000  # shortest standstill that is used for the gyro's bias
_STILL_EDGE_NS = 200_000_000  # left out at both ends of a standstill, where the car may rock
MOVING_MPS = 0.1
SETTLE_NS = 400_000_000  # dead time, lag and rate limit of a step are over
_LEAST_ROWS = 6
_SPIKE = 5.0  # standard deviations


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ServoLog:
    """A drive at nearly constant speed with changing steering pulses.

    From `pulse_t_ns[i]` (m,) on, `pulse_us[i]` (m,) [us] was at the pin. At `t_ns` (n,) the car's yaw rate
    `yaw_rate_radps` (n,) [rad/s] and the rear axle's speed `speed_mps` (n,) [m/s] were measured, on the same clock. A
    yaw rate is the mean over `window_s` around its time. Raises ValueError for lists that do not fit together.
    """

    pulse_t_ns: IntArray
    pulse_us: FloatArray
    t_ns: IntArray
    yaw_rate_radps: FloatArray
    speed_mps: FloatArray
    window_s: float = 0.0

    def __post_init__(self) -> None:
        for name, kind in (
            ("pulse_t_ns", np.int64),
            ("pulse_us", np.float64),
            ("t_ns", np.int64),
            ("yaw_rate_radps", np.float64),
            ("speed_mps", np.float64),
        ):
            array = np.array(getattr(self, name), dtype=kind)
            if array.ndim != 1 or not np.isfinite(array).all():
                raise ValueError(f"{name}: expected a list of finite numbers")
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if len(self.pulse_t_ns) != len(self.pulse_us) or len(self.pulse_us) == 0:
            raise ValueError(
                f"pulse_us: expected one for each of {len(self.pulse_t_ns)} times, got {len(self.pulse_us)}"
            )
        if not len(self.t_ns) == len(self.yaw_rate_radps) == len(self.speed_mps):
            raise ValueError("t_ns, yaw_rate_radps, speed_mps: expected the same length")
        for name in ("pulse_t_ns", "t_ns"):
            if (np.diff(getattr(self, name)) <= 0).any():
                raise ValueError(f"{name}: must be rising")


@dataclass(frozen=True, slots=True, kw_only=True)
class Hold:
    """An interval at one pulse, after the wheels had settled.

    `rose`: the pulse before was lower. `steering_rad` is the mean angle of the road wheels, `sd_rad` the standard
    deviation of that mean.
    """

    t_ns: int
    pulse_us: float
    rose: bool
    steering_rad: float
    sd_rad: float


def without_bias(log: ServoLog) -> ServoLog:
    """The log minus the gyro's bias: the median at standstill, linear in time between two standstills.

    Raises ValueError where the car never stood still for half a second.
    """
    still = np.abs(log.speed_mps) < STILL_MPS
    edges = np.flatnonzero(np.diff(np.concatenate(([False], still, [False])).astype(np.int8)))
    times, biases = [], []
    for first, last in edges.reshape(-1, 2):
        start_ns, end_ns = log.t_ns[first], log.t_ns[last - 1]
        if end_ns - start_ns < _STILL_NS:
            continue
        inner = (log.t_ns >= start_ns + _STILL_EDGE_NS) & (log.t_ns <= end_ns - _STILL_EDGE_NS)
        times.append(0.5 * (float(start_ns) + float(end_ns)))
        biases.append(float(np.median(log.yaw_rate_radps[inner])))
    if not times:
        raise ValueError("the car never stood still for half a second: the gyro's bias is unknown; drive again")
    bias = np.interp(log.t_ns.astype(np.float64), times, biases)
    return dataclasses.replace(log, yaw_rate_radps=log.yaw_rate_radps - bias)


def holds_of(log: ServoLog, wheelbase_m: float) -> list[Hold]:
    """The intervals of one pulse, with delta = atan(L r / v) from the means of yaw rate r and speed v in each.

    At the rear axle, Rajamani 2012, section 2.2. Left out are the first 0.4 s of each, outliers of five standard
    deviations, and intervals that are too short or were not driven forward.
    """
    changes = np.concatenate(([0], np.flatnonzero(np.diff(log.pulse_us)) + 1))
    starts = log.pulse_t_ns[changes]
    ends = np.append(starts[1:], log.t_ns[-1] + 1 if len(log.t_ns) else starts[-1])
    holds = []
    for i in range(1, len(changes)):
        rows = np.flatnonzero((log.t_ns >= starts[i] + SETTLE_NS) & (log.t_ns < ends[i]))
        if len(rows) < _LEAST_ROWS or log.speed_mps[rows].min() < MOVING_MPS:
            continue
        pulse_us = float(log.pulse_us[changes[i]])
        angle, sd = _mean_angle(log.yaw_rate_radps[rows], log.speed_mps[rows], wheelbase_m)
        rose = pulse_us > log.pulse_us[changes[i] - 1]
        holds.append(Hold(t_ns=int(starts[i]), pulse_us=pulse_us, rose=bool(rose), steering_rad=angle, sd_rad=sd))
    return holds


def _mean_angle(yaw_rate: FloatArray, speed: FloatArray, wheelbase_m: float) -> tuple[float, float]:
    kappa = yaw_rate / speed
    off = np.abs(kappa - np.median(kappa))
    kept = off <= _SPIKE * 1.4826 * max(float(np.median(off)), 1e-6)
    mean = float(yaw_rate[kept].mean() / speed[kept].mean())
    sd = float(np.std(kappa[kept])) / math.sqrt(int(kept.sum()))
    bend = wheelbase_m * mean
    return math.atan(bend), wheelbase_m * sd / (1.0 + bend * bend)
