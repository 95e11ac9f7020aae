"""The steering actuator's dead time, lag and rate limit, from the yaw rate of a drive with known pulses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from automodel.types import FloatArray
from calibration.servo import MOVING_MPS, ServoLog, ServoTable

_STEP_NS = 2_500_000  # of the time grid of the model
_BLOCK_NS = 1_000_000_000  # readings within this time have correlated errors
_WITHIN = (-0.4, -0.2, 0.0, 0.2, 0.4)  # samples of a reading's window, in its lengths
_DELAY_MAX_S = 0.5
_LAG_MAX_S = 0.3
_RATES_RADPS = (0.5, 100.0)
_BINDING = 12.0  # noise variances by which a rate limit must reduce the sum of squares to count as observed


@dataclass(frozen=True, slots=True, kw_only=True)
class Actuator:
    """From a pulse at the pin to the road wheels: dead time, then a first-order lag with a rate limit.

    `rate_max_radps` is None where the drive never reached it; it is then above `rate_seen_radps`. `rms_radps` is the
    RMS residual of the yaw rate.
    """

    delay_s: float
    delay_sd_s: float
    lag_s: float
    lag_sd_s: float
    rate_max_radps: float | None
    rate_sd_radps: float
    rate_seen_radps: float
    rms_radps: float

    @property
    def total_s(self) -> float:
        """Dead time and lag [s]: the delay of a slow movement."""
        return self.delay_s + self.lag_s


def wheel_angles(target: FloatArray, dt_s: float, lag_s: float, rate_radps: float, play_rad: float) -> FloatArray:
    """The angle of the road wheels (n,) [rad] for a servo's `target` (n,) [rad] in steps of `dt_s`, no dead time.

    A first-order lag, exact for constant targets, limited to `rate_radps`; the wheels follow through a gap of
    `play_rad`. They start in the middle of the gap, at the first target.
    """
    share = 1.0 - math.exp(-dt_s / lag_s) if lag_s > 0 else 1.0
    step_max, half = rate_radps * dt_s, 0.5 * play_rad
    servo = wheel = float(target[0])
    out = np.empty(len(target))
    for i, commanded in enumerate(target.tolist()):
        step = (commanded - servo) * share
        servo += min(max(step, -step_max), step_max)
        wheel = min(max(wheel, servo - half), servo + half)
        out[i] = wheel
    return out


class _Model:
    """The yaw rate from the pulses of a log, as a function of (delay [s], lag [s], log of the rate limit)."""

    def __init__(self, log: ServoLog, table: ServoTable, wheelbase_m: float) -> None:
        self._rows = log.speed_mps > MOVING_MPS
        self.t_ns = log.t_ns[self._rows]
        self.measured = log.yaw_rate_radps[self._rows]
        self._gain = log.speed_mps[self._rows] / wheelbase_m
        start_ns = int(log.pulse_t_ns[0])
        grid_ns = np.arange(start_ns, int(log.t_ns[-1]) + _STEP_NS, _STEP_NS)
        index = np.searchsorted(log.pulse_t_ns, grid_ns, side="right") - 1
        self._target = table.angle_rad(log.pulse_us[index])
        self._play = table.play_rad
        self._around_s = log.window_s * np.array(_WITHIN if log.window_s > 0 else (0.0,))
        self._grid_s = (grid_ns - start_ns) * 1e-9
        self._rows_s = (self.t_ns - start_ns) * 1e-9

    def residuals(self, parameters: FloatArray) -> FloatArray:
        delay_s, lag_s, log_rate = parameters
        dt_s = _STEP_NS * 1e-9
        bend = np.tan(wheel_angles(self._target, dt_s, lag_s, math.exp(log_rate), self._play))
        # a grid point has the angle at the end of its step
        sample_s = self._rows_s[:, None] + self._around_s - delay_s - dt_s
        return self._gain * np.interp(sample_s, self._grid_s, bend).mean(axis=1) - self.measured

    def fastest_radps(self, parameters: FloatArray) -> float:
        wheel = wheel_angles(self._target, _STEP_NS * 1e-9, parameters[1], math.exp(parameters[2]), 0.0)
        return float(np.abs(np.diff(wheel)).max()) / (_STEP_NS * 1e-9)


def fit_actuator(log: ServoLog, table: ServoTable, wheelbase_m: float) -> Actuator:
    """Least squares over the whole log, without gyro bias; raises ValueError where the car hardly moved.

    The standard deviations are sandwich estimates with blocks of a second, in which errors are correlated (Liang and
    Zeger 1986).
    """
    from scipy.optimize import least_squares

    model = _Model(log, table, wheelbase_m)
    if len(model.t_ns) < 100:
        raise ValueError(f"{len(model.t_ns)} readings of a moving car are too few to measure the actuator's delay")
    top = math.log(_RATES_RADPS[1])
    low, high = (0.0, 0.0, math.log(_RATES_RADPS[0])), (_DELAY_MAX_S, _LAG_MAX_S, top)
    delays = np.arange(0.0, 0.31, 0.02)
    first_delay = delays[int(np.argmin([_cost(model.residuals(np.array((d, 0.02, math.log(6.0))))) for d in delays]))]
    start = np.array((first_delay, 0.02, math.log(6.0)))
    scale = 1.4826 * float(np.median(np.abs(model.residuals(start)))) + 1e-6
    options = {"loss": "soft_l1", "f_scale": 3.0 * scale, "diff_step": 1e-3, "x_scale": (0.02, 0.02, 0.5)}
    limited = least_squares(model.residuals, start, bounds=(low, high), **options)
    free = least_squares(
        lambda x: model.residuals(np.array((*x, top))),
        start[:2],
        bounds=(low[:2], high[:2]),
        **{**options, "x_scale": (0.02, 0.02)},
    )
    noise = 1.4826 * float(np.median(np.abs(limited.fun))) + 1e-9
    binding = 2.0 * (free.cost - limited.cost) > _BINDING * noise * noise
    best = limited.x if binding else np.array((*free.x, top))
    deviations = _deviations(limited if binding else free, model.t_ns)
    rate = math.exp(best[2]) if binding else None
    return Actuator(
        delay_s=float(best[0]),
        delay_sd_s=float(deviations[0]),
        lag_s=float(best[1]),
        lag_sd_s=float(deviations[1]),
        rate_max_radps=rate,
        rate_sd_radps=float(deviations[2]) * rate if rate is not None else math.inf,
        rate_seen_radps=model.fastest_radps(best),
        rms_radps=float(np.sqrt(np.mean(model.residuals(best) ** 2))),
    )


def modelled_yaw_rates(
    log: ServoLog, table: ServoTable, actuator: Actuator, wheelbase_m: float
) -> tuple[NDArray[np.int64], FloatArray]:
    """Times [ns] (k,) and the fitted actuator's yaw rates [rad/s] (k,) for the pulses of the log."""
    model = _Model(log, table, wheelbase_m)
    rate = _RATES_RADPS[1] if actuator.rate_max_radps is None else actuator.rate_max_radps
    off = model.residuals(np.array((actuator.delay_s, actuator.lag_s, math.log(rate))))
    return model.t_ns, off + model.measured


def _cost(off: FloatArray) -> float:
    return float(np.abs(off).sum())


def _deviations(fit: object, t_ns: NDArray[np.int64]) -> FloatArray:
    jacobian, off = np.asarray(fit.jac), np.asarray(fit.fun)  # type: ignore[attr-defined]
    bread = np.linalg.pinv(jacobian.T @ jacobian)
    blocks = (t_ns - t_ns[0]) // _BLOCK_NS
    scores = np.zeros((int(blocks[-1]) + 1, jacobian.shape[1]))
    np.add.at(scores, blocks, jacobian * off[:, None])
    return np.sqrt(np.diag(bread @ (scores.T @ scores) @ bread))
