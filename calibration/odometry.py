"""Wheel ticks a metre, and motor pulse -> speed, from runs along a measured distance."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from automodel.types import FloatArray

_SPREAD = 0.03  # share of the median by which a run may differ from it
_BAND_US = 5.0  # a narrower dead band around neutral is not written into the table
_CREEP_MPS = 0.01  # speed at the end of the dead band: a table must rise everywhere


class OdometryError(ValueError):
    """The runs do not give the result; the text says why and what to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredRun:
    """One run: the wheel ticks counted over a measured distance [m] forward."""

    ticks: int
    distance_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TicksPerMetre:
    """Ticks a metre, the standard deviation of that mean, and the runs' scatter around it (one tick at least)."""

    ticks_per_m: float
    sd_per_m: float
    scatter_per_m: float
    runs: int


def fit_ticks(runs: Sequence[MeasuredRun]) -> TicksPerMetre:
    """Ticks a metre, each run weighted by its distance; raises OdometryError for runs that contradict each other."""
    if not runs or not all(run.distance_m > 0 for run in runs):
        raise OdometryError("expected at least one run, over a distance above 0 m")
    if all(run.ticks == 0 for run in runs):
        raise OdometryError("the wheel sensor counted nothing; check its plug and the gap to the wheel's magnets")
    if any(run.ticks < 0 for run in runs):
        raise OdometryError("the ticks count down while the car goes ahead; swap the sensor's two wires")
    ratios = np.array([run.ticks / run.distance_m for run in runs])
    middle = float(np.median(ratios))
    worst = int(np.argmax(np.abs(ratios - middle)))
    rounding = 2.0 / runs[worst].distance_m  # a count starts and ends anywhere between two ticks
    if len(runs) > 1 and abs(ratios[worst] - middle) > _SPREAD * middle + rounding:
        raise OdometryError(
            f"run {worst + 1} has {ratios[worst]:.1f} ticks a metre, the others {middle:.1f}; "
            "measure again, did the car slip or was a distance misread?"
        )
    total_m = sum(run.distance_m for run in runs)
    mean = sum(run.ticks for run in runs) / total_m
    count_sd = (2.0 / 12.0) ** 0.5  # of the ticks of a run: a uniform error of one tick at each end
    scatter = float(np.std(ratios, ddof=1)) if len(runs) > 1 else 0.0
    return TicksPerMetre(
        ticks_per_m=mean,
        sd_per_m=max(scatter / len(runs) ** 0.5, count_sd * len(runs) ** 0.5 / total_m),
        scatter_per_m=max(scatter, count_sd * len(runs) / total_m),
        runs=len(runs),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class SteadySpeed:
    """The speed [m/s] that a motor pulse [us] gave, once it was steady."""

    pulse_us: float
    speed_mps: float


@dataclass(frozen=True, slots=True, kw_only=True)
class MotorTable:
    """Motor pulse -> speed, as in `MotorConfig`.

    `band_us` is the width of the dead band beside neutral, `rms_mps` the scatter of the speeds around a line beyond it.
    """

    pulse_us: tuple[float, ...]
    speed_mps: tuple[float, ...]
    band_us: float
    rms_mps: float


def fit_motor(steady: Sequence[SteadySpeed], neutral_us: float, reverse: Sequence[tuple[float, float]]) -> MotorTable:
    """The table through neutral, the end of the dead band around it, and the measured forward speeds.

    Equal pulses are averaged. The line through all of them extends the table by 100 us beyond the fastest. `reverse`
    are the (pulse [us], speed [m/s] < 0) of the old table, which are kept: nothing was driven backwards. Raises
    OdometryError where more pulse does not give more speed.
    """
    pulses = np.unique([s.pulse_us for s in steady])
    if len(pulses) < 2:
        raise OdometryError(f"expected at least two motor pulses, got {len(pulses)}; give other --speeds")
    away = pulses - neutral_us
    if not ((away > 0).all() or (away < 0).all()):
        raise OdometryError(f"the motor pulses lie on both sides of neutral at {neutral_us:.0f} us")
    pulses = pulses[np.argsort(np.abs(away))]
    speeds = np.array([np.mean([s.speed_mps for s in steady if s.pulse_us == p]) for p in pulses])
    for (p, v), (q, w) in itertools.pairwise(zip(pulses.tolist(), speeds.tolist(), strict=True)):
        if not 0 < v < w:
            raise OdometryError(
                f"{p:.0f} us gave {v:.2f} m/s and {q:.0f} us {w:.2f} m/s: more pulse must give more speed; "
                "charge the battery and drive again"
            )
    slope, offset = np.polyfit(pulses, speeds, 1)
    rms = float(np.sqrt(np.mean((slope * pulses + offset - speeds) ** 2)))
    start_us = float(-offset / slope)
    sign = 1.0 if away[0] > 0 else -1.0
    band = max(sign * (start_us - neutral_us), 0.0)
    entries = [(neutral_us, 0.0)]
    if band > _BAND_US and sign * (float(pulses[0]) - start_us) > _BAND_US and speeds[0] > 2 * _CREEP_MPS:
        entries.append((start_us + _CREEP_MPS / slope, _CREEP_MPS))
    entries += list(zip(pulses.tolist(), speeds.tolist(), strict=True))
    last_us = float(np.clip(pulses[-1] + sign * 100.0, 500.0, 2500.0))
    entries.append((last_us, float(speeds[-1] + slope * (last_us - pulses[-1]))))
    entries += [(p, v) for p, v in reverse if v < 0]
    entries.sort()
    return MotorTable(
        pulse_us=tuple(round(float(p), 1) for p, _ in entries),
        speed_mps=tuple(round(float(v), 4) for _, v in entries),
        band_us=band,
        rms_mps=rms,
    )


def speeds(t_ns: ArrayLike, distance: ArrayLike, window_s: float = 0.5) -> FloatArray:
    """The slope (n,) of `distance` (n,) over time, per second: a least-squares line in a window around each time.

    The window is shorter at the ends. Differences of successive ticks, which are whole numbers, would be useless.
    """
    seconds = (np.asarray(t_ns, dtype=np.int64) - np.asarray(t_ns, dtype=np.int64).reshape(-1)[:1]) * 1e-9
    y = np.asarray(distance, dtype=np.float64)
    y = y - y[:1]
    first = np.searchsorted(seconds, seconds - 0.5 * window_s - 1e-9)
    last = np.searchsorted(seconds, seconds + 0.5 * window_s + 1e-9)
    sums = [np.concatenate(([0.0], np.cumsum(v))) for v in (seconds, y, seconds * seconds, seconds * y)]
    t, d, tt, td = (s[last] - s[first] for s in sums)
    n = last - first
    spread = tt - t * t / n
    return np.where(n > 1, (td - t * d / n) / np.maximum(spread, 1e-12), 0.0)


def steady_speed(t_ns: ArrayLike, ticks: ArrayLike, ticks_per_m: float) -> float:
    """The speed [m/s] in the middle of a run: from 40 to 90 % of its ticks, without start and stop.

    Raises OdometryError where nothing was counted.
    """
    times, counts = np.asarray(t_ns, dtype=np.int64), np.asarray(ticks, dtype=np.int64)
    total = int(counts[-1] - counts[0])
    if total < 4:
        raise OdometryError("the wheel sensor counted nothing; check its plug, and that the car rolls")
    inner = (counts - counts[0] > 0.4 * total) & (counts - counts[0] < 0.9 * total)
    if inner.sum() < 3:
        raise OdometryError("the run was too short to measure its speed; give a longer --distance-m")
    slope = np.polyfit((times[inner] - times[inner][0]) * 1e-9, counts[inner].astype(np.float64), 1)[0]
    return float(slope) / ticks_per_m
