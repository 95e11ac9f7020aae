"""Wheel ticks a metre, and motor pulse -> speed, from runs along a measured way."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from automodel.types import FloatArray

_SPREAD = 0.03  # runs that differ by more from their median contradict each other
_BAND_US = 5.0  # a band around neutral narrower than this is none
_CREEP_MPS = 0.01  # speed at the band's end: a table rises throughout


class OdometryError(ValueError):
    """The runs do not tell what was asked; the text says why and what to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
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


def fit_ticks(ways: Sequence[Way]) -> TicksPerMetre:
    """Ticks a metre, each run weighted by its distance; raises OdometryError for runs that contradict each other."""
    if not ways or not all(way.distance_m > 0 for way in ways):
        raise OdometryError("one run at least is wanted, over a distance above 0 m")
    if all(way.ticks == 0 for way in ways):
        raise OdometryError("the wheel sensor counted nothing; check its plug and the gap to the wheel's magnets")
    if any(way.ticks < 0 for way in ways):
        raise OdometryError("the ticks count down while the car goes ahead; swap the sensor's two wires")
    ratios = np.array([way.ticks / way.distance_m for way in ways])
    middle = float(np.median(ratios))
    worst = int(np.argmax(np.abs(ratios - middle)))
    ticks = 2.0 / ways[worst].distance_m  # a count starts and ends anywhere between two ticks
    if len(ways) > 1 and abs(ratios[worst] - middle) > _SPREAD * middle + ticks:
        raise OdometryError(
            f"run {worst + 1} has {ratios[worst]:.1f} ticks a metre, the others {middle:.1f}; "
            "measure again, did the car slip or was a distance misread?"
        )
    total_m = sum(way.distance_m for way in ways)
    mean = sum(way.ticks for way in ways) / total_m
    rounding = (2.0 / 12.0) ** 0.5 * len(ways) ** 0.5 / total_m
    scatter = float(np.std(ratios, ddof=1)) if len(ways) > 1 else 0.0
    return TicksPerMetre(
        ticks_per_m=mean,
        sd_per_m=max(scatter / len(ways) ** 0.5, rounding),
        scatter_per_m=max(scatter, (2.0 / 12.0) ** 0.5 * len(ways) / total_m),
        runs=len(ways),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class SteadySpeed:
    """The speed [m/s] that a motor pulse [us] gave, once it was steady."""

    pulse_us: float
    speed_mps: float


@dataclass(frozen=True, slots=True, kw_only=True)
class MotorTable:
    """Motor pulse -> speed as `MotorConfig` has it.

    `rms_mps` is the speeds' scatter around the line from the end of the band that moves nothing, `band_us` wide.
    """

    pulse_us: tuple[float, ...]
    speed_mps: tuple[float, ...]
    band_us: float
    rms_mps: float


def fit_motor(steady: Sequence[SteadySpeed], neutral_us: float, reverse: Sequence[tuple[float, float]]) -> MotorTable:
    """The table through neutral, the end of the band around it, and the speeds that were driven forward.

    Equal pulses are averaged. Beyond the fastest one the line through all of them is carried on to the next 100 us, so
    that a little more may be asked for. `reverse` are the (pulse [us], speed [m/s] < 0) that the table had: backwards
    nothing was driven. Raises OdometryError where more pulse does not give more speed.
    """
    pulses = np.unique([s.pulse_us for s in steady])
    if len(pulses) < 2:
        raise OdometryError(f"{len(pulses)} motor pulse was driven, two at least are wanted; give other --speeds")
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


def speeds(t_ns: ArrayLike, way: ArrayLike, window_s: float = 0.5) -> FloatArray:
    """The slope (n,) of `way` (n,) over time in a window around each of the times (n,), per second.

    A line by least squares, shorter at the ends: ticks are whole numbers, their differences are useless.
    """
    seconds = (np.asarray(t_ns, dtype=np.int64) - np.asarray(t_ns, dtype=np.int64).reshape(-1)[:1]) * 1e-9
    y = np.asarray(way, dtype=np.float64)
    y = y - y[:1]
    first = np.searchsorted(seconds, seconds - 0.5 * window_s - 1e-9)
    last = np.searchsorted(seconds, seconds + 0.5 * window_s + 1e-9)
    sums = [np.concatenate(([0.0], np.cumsum(v))) for v in (seconds, y, seconds * seconds, seconds * y)]
    t, w, tt, tw = (s[last] - s[first] for s in sums)
    n = last - first
    spread = tt - t * t / n
    return np.where(n > 1, (tw - t * w / n) / np.maximum(spread, 1e-12), 0.0)


def steady_speed(t_ns: ArrayLike, ticks: ArrayLike, ticks_per_m: float) -> float:
    """The speed [m/s] over the middle of a run, from its first to its last tick: without start and stop.

    Raises OdometryError where nothing was counted.
    """
    times, counts = np.asarray(t_ns, dtype=np.int64), np.asarray(ticks, dtype=np.int64)
    total = int(counts[-1] - counts[0])
    if total < 4:
        raise OdometryError("the wheel sensor counted nothing; check its plug, or did the car not roll?")
    inner = (counts - counts[0] > 0.4 * total) & (counts - counts[0] < 0.9 * total)
    if inner.sum() < 3:
        raise OdometryError("the run was too short to tell its speed; give a longer --distance-m")
    slope = np.polyfit((times[inner] - times[inner][0]) * 1e-9, counts[inner].astype(np.float64), 1)[0]
    return float(slope) / ticks_per_m
