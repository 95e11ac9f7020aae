"""Steering pulse -> road-wheel angle, from the log of a drive that sweeps the pulses up and down.

The wheels follow the servo through a gap. A pulse reached from below gives an angle half the play too small, reached
from above half the play too large. The table is the middle of the two, so straight ahead is the middle of the play.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
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
LEAST_PULSES = 6
LEAST_RANGE_RAD = 0.035  # a servo that moves the wheels less than 2 deg over all pulses does not move them
_STRAY = 6.0  # robust standard deviations from which a pulse is an outlier
_STRAY_RAD = 0.025  # and at least this [rad]: the kink at a stop is no outlier
_CONTRADICTION_RAD = 0.03  # largest correction that makes the angles monotone
_STOP_SLOPE = 0.3  # of the gain in the inner half; a smaller slope is the linkage at its stop
_STOP_POINTS = 5  # angles before the stop that locate it
_STOP_BETTER = 0.3  # of the sum of squares of a line without a stop
_PASSES = 5  # alternating the table and the wheels' place in the gap; without stops two are enough
_TOLERANCE_RAD = 0.0025  # largest error from leaving a point out of the table
_LEAST_SD_RAD = 5e-4


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


class ServoError(ValueError):
    """The measurements do not give the servo's table; the text says why and what to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoTable:
    """Pulse -> angle, as in `ServoConfig`, and its accuracy.

    `sd_rad[i]` is the standard deviation of `steering_rad[i]`; `rms_rad` the scatter of the single intervals around
    table and play; `strays` the pulses [us] whose measurements were left out as outliers.
    """

    pulse_us: tuple[float, ...]
    steering_rad: tuple[float, ...]
    sd_rad: tuple[float, ...]
    centre_us: float
    centre_sd_us: float
    play_rad: float
    play_sd_rad: float
    rms_rad: float
    holds: int
    strays: tuple[float, ...]

    def angle_rad(self, pulse_us: FloatArray) -> FloatArray:
        """The road-wheel angles [rad] of pulses [us], constant beyond the ends."""
        return np.interp(pulse_us, self.pulse_us, self.steering_rad)


def fit_table(log: ServoLog, wheelbase_m: float) -> ServoTable:
    """The table, its centre and the play from a log without gyro bias; raises ServoError."""
    holds = holds_of(log, wheelbase_m)
    pulses = np.array([hold.pulse_us for hold in holds])
    angles = np.array([hold.steering_rad for hold in holds])
    _check(pulses, angles)
    sign = 1.0 if np.polyfit(pulses, angles, 1)[0] > 0 else -1.0
    angles *= sign  # from here on the angle rises with the pulse
    changes, at = _pulse_sequence(log, holds)
    nodes = np.unique(pulses)
    lead = np.array([0.5 if hold.rose else -0.5 for hold in holds])
    play, play_sd = _play(pulses, angles, lead)
    behind = -play * lead
    strays: FloatArray = np.empty(0)
    for _ in range(_PASSES):
        x, y, strays = _without_strays(nodes, _averages(nodes, pulses, angles - behind))
        rising = _monotone(x, y)
        behind = _behind(np.interp(changes, x, rising), play)[at]
    x, rising = _within_stop(x, rising)
    x, rising = _within_stop(-x[::-1], -rising[::-1])
    x, rising = -x[::-1], -rising[::-1]
    used = ~np.isin(pulses, strays) & (pulses >= x[0]) & (pulses <= x[-1])
    sd = np.array([max(hold.sd_rad, _LEAST_SD_RAD) for hold in holds])
    knots = x[_simplified(x, rising, _TOLERANCE_RAD)]
    ends = (float(rising[0]), float(rising[-1]))
    fitted, sd, rms = _least_squares(knots, ends, pulses[used], (angles - behind)[used], sd[used])
    sd = np.hypot(sd, 0.5 * _TOLERANCE_RAD)  # the servo's curve between the knots
    centre, centre_sd, knots, fitted, sd = _with_centre(knots, fitted, sd)
    return ServoTable(
        pulse_us=tuple(round(float(p), 1) for p in knots),
        steering_rad=tuple(round(float(sign * a), 5) + 0.0 for a in fitted),
        sd_rad=tuple(float(s) for s in sd),
        centre_us=centre,
        centre_sd_us=centre_sd,
        play_rad=play,
        play_sd_rad=play_sd,
        rms_rad=rms,
        holds=len(holds),
        strays=tuple(float(p) for p in strays),
    )


def _check(pulses: FloatArray, angles: FloatArray) -> None:
    if len(np.unique(pulses)) < LEAST_PULSES:
        raise ServoError(
            f"expected {LEAST_PULSES} pulses that were driven for long enough, got {len(np.unique(pulses))}; "
            "was the drive cut short, or does the car not roll?"
        )
    if np.ptp(angles) < LEAST_RANGE_RAD:
        raise ServoError(
            f"the servo does not respond: {pulses.min():.0f} .. {pulses.max():.0f} us turned the wheels by "
            f"{np.degrees(np.ptp(angles)):.1f} deg; check its plug, its supply and the linkage"
        )


def _pulse_sequence(log: ServoLog, holds: Sequence[Hold]) -> tuple[FloatArray, IntArray]:
    """The sequence of pulses [us] at the pin, and the index of each hold in it."""
    changes = np.concatenate(([0], np.flatnonzero(np.diff(log.pulse_us)) + 1))
    return log.pulse_us[changes], np.searchsorted(log.pulse_t_ns[changes], [hold.t_ns for hold in holds])


def _behind(arm: FloatArray, play: float) -> FloatArray:
    """The angle of the wheels minus that of the servo's arm (n,), each time it has come to rest at `arm` (n,)."""
    wheel, half = float(arm[0]), 0.5 * play
    out = np.empty(len(arm))
    for i, angle in enumerate(arm.tolist()):
        wheel = min(max(wheel, angle - half), angle + half)
        out[i] = wheel - angle
    return out


def _play(pulses: FloatArray, angles: FloatArray, lead: FloatArray) -> tuple[float, float]:
    """The play: the median difference of the angles reached from above and from below, and its standard deviation."""
    gaps = []
    for pulse in np.unique(pulses):
        at = pulses == pulse
        above, below = angles[at & (lead < 0)], angles[at & (lead > 0)]
        if len(above) and len(below):
            gaps.append(above.mean() - below.mean())
    if len(gaps) < 3:
        raise ServoError("too few pulses were reached from both sides to measure the play; drive the whole sweep")
    middle = float(np.median(gaps))
    sd = 1.4826 * float(np.median(np.abs(np.array(gaps) - middle))) * 1.2533 / len(gaps) ** 0.5
    return max(middle, 0.0), sd


def _averages(nodes: FloatArray, pulses: FloatArray, angles: FloatArray) -> FloatArray:
    return np.array([angles[pulses == node].mean() for node in nodes])


def _without_strays(nodes: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Leaves out the pulses whose angle is far from the line between its neighbours, the worst first."""
    kept = np.ones(len(nodes), dtype=bool)
    while True:
        x, y = nodes[kept], values[kept]
        off = np.zeros(len(x))
        between = y[:-2] + (y[2:] - y[:-2]) * (x[1:-1] - x[:-2]) / (x[2:] - x[:-2])
        off[1:-1] = np.abs(y[1:-1] - between)
        worst = int(np.argmax(off))
        if off[worst] < max(_STRAY_RAD, _STRAY * 1.4826 * float(np.median(off[1:-1]))):
            return x, y, nodes[~kept]
        if kept.sum() <= max(0.75 * len(nodes), LEAST_PULSES):
            raise ServoError(
                "the angles of neighbouring pulses do not agree; do the wheels slip, or does something catch? "
                "Drive slower, on a floor that grips"
            )
        kept[np.flatnonzero(kept)[worst]] = False


def _monotone(nodes: FloatArray, values: FloatArray) -> FloatArray:
    """The nearest rising sequence (isotonic regression); raises ServoError where it is far."""
    from scipy.optimize import isotonic_regression

    rising = np.asarray(isotonic_regression(values).x, dtype=np.float64)
    worst = int(np.argmax(np.abs(rising - values)))
    if abs(rising[worst] - values[worst]) > _CONTRADICTION_RAD:
        raise ServoError(
            f"the angle turns back around {nodes[worst]:.0f} us, by {np.degrees(abs(rising - values)[worst]):.1f} deg: "
            "no servo does that; do the wheels slip, or is the linkage loose?"
        )
    return rising


def _within_stop(x: FloatArray, rising: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cuts the upper end where the linkage is at its stop and the angle no longer follows the pulse.

    The stop is the s for which y = a + b min(x, s) fits the last angles best, if that is much better than a line.
    """
    inner = x <= 0.5 * (x[0] + x[-1])
    gain = (rising[inner][-1] - rising[inner][0]) / (x[inner][-1] - x[inner][0])
    level = rising[-1] - _STOP_SLOPE * gain * (x[-1] - x)
    first = int(np.argmax(rising >= level - 1e-12))  # from here on flatter than _STOP_SLOPE
    start = max(min(first, len(x) - 1) - _STOP_POINTS, 0)
    window, angles = x[start:], rising[start:]
    stops = np.linspace(window[2], window[-1], 20 * len(window))
    fits = [_fit_to_stop(window, angles, stop) for stop in stops]
    best = int(np.argmin([off for off, _ in fits]))
    if fits[best][0] > _STOP_BETTER * fits[-1][0] + 1e-12 or stops[best] > window[-1] - 0.1 * (window[-1] - window[-2]):
        return x, rising
    kept = x < stops[best] - 1.0
    return np.append(x[kept], stops[best]), np.append(rising[kept], fits[best][1])


def _fit_to_stop(x: FloatArray, y: FloatArray, stop: float) -> tuple[float, float]:
    """The residual sum of squares of a line that ends at `stop`, and the angle there."""
    bent = np.minimum(x, stop)
    slope, offset = np.polyfit(bent - stop, y, 1)
    return float(((offset + slope * (bent - stop) - y) ** 2).sum()), float(offset)


def _simplified(x: FloatArray, y: FloatArray, tolerance: float) -> list[int]:
    """The indices of a polyline's points that keep it within `tolerance` in y (Douglas and Peucker 1973)."""
    keep, spans = {0, len(x) - 1}, [(0, len(x) - 1)]
    while spans:
        first, last = spans.pop()
        if last - first < 2:
            continue
        line = np.interp(x[first : last + 1], (x[first], x[last]), (y[first], y[last]))
        off = np.abs(y[first : last + 1] - line)
        worst = int(np.argmax(off))
        if off[worst] > tolerance:
            keep.add(first + worst)
            spans += [(first, first + worst), (first + worst, last)]
    return sorted(keep)


def _least_squares(
    knots: FloatArray, ends: tuple[float, float], x: FloatArray, y: FloatArray, sd: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """The polyline over `knots` nearest to the points: values, their standard deviations, and the RMS residual.

    The values at the two ends count as one more measurement each: an end that was cut has no point of its own.
    """
    x, y = np.concatenate((x, knots[[0, -1]])), np.concatenate((y, ends))
    sd = np.concatenate((sd, [float(np.median(sd))] * 2))
    hats = np.array([np.interp(x, knots, row) for row in np.eye(len(knots))]).T
    weighted = hats / sd[:, None]
    values, *_ = np.linalg.lstsq(weighted, y / sd, rcond=None)
    off = y - hats @ values
    freedom = max(len(y) - len(knots), 1)
    scale = max(float(((off / sd) ** 2).sum()) / freedom, 1.0)
    covariance = scale * np.linalg.pinv(weighted.T @ weighted)
    for i in np.flatnonzero(np.diff(values) <= 0.0)[:1]:
        raise ServoError(f"the angle does not change from {knots[i]:.0f} to {knots[i + 1]:.0f} us; drive again")
    return values, np.sqrt(np.diag(covariance)), float(np.sqrt((off * off).mean()))


def _with_centre(
    knots: FloatArray, rising: FloatArray, sd: FloatArray
) -> tuple[float, float, FloatArray, FloatArray, FloatArray]:
    """Adds straight ahead as a point of the table; raises ServoError where the wheels never reached it."""
    if not rising[0] < 0.0 < rising[-1]:
        raise ServoError(
            f"the wheels are never straight: {np.degrees(rising[0]):.1f} .. {np.degrees(rising[-1]):.1f} deg; "
            "mount the servo horn so that the middle pulse is about straight"
        )
    centre = float(np.interp(0.0, rising, knots))
    above = int(np.searchsorted(rising, 0.0))
    slope = (rising[above] - rising[above - 1]) / (knots[above] - knots[above - 1])
    deviation = float(np.interp(centre, knots, sd))
    at = int(np.argmin(np.abs(knots - centre)))
    if 0 < at < len(knots) - 1 and abs(knots[at] - centre) < 10.0:
        knots, rising, sd = (np.delete(array, at) for array in (knots, rising, sd))
    where = int(np.searchsorted(knots, centre))
    knots, rising, sd = (
        np.insert(array, where, value) for array, value in ((knots, centre), (rising, 0.0), (sd, deviation))
    )
    return centre, deviation / slope, knots, rising, sd
