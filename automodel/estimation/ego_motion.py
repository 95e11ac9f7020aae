"""The car's motion from the vehicle's sensors, or else from the last command."""

from __future__ import annotations

import math

from automodel.config import VehicleConfig
from automodel.signals import Command, Motion, MotionSource, VehicleState

STATE_TIMEOUT_NS = 200_000_000  # an older state is ignored
SETTLE_NS = 300_000_000  # time at rest before a gyro reading counts as bias
MIN_READINGS = 10  # readings from which on the bias is known
MAX_READINGS = 500  # memory of the running mean: the bias drifts with the temperature
BIAS_MAX_RADPS = 0.3  # a car at rest that turns faster is being carried


class MotionEstimator:
    """Speed and yaw rate for dead reckoning, from the best source available.

    ========  =============  ===============================================
    source    speed          yaw rate
    ========  =============  ===============================================
    MEASURED  the vehicle's  its gyro, less the bias
    MODEL     the vehicle's  v tan(delta) / L, delta as applied
    COMMAND   as commanded   by the best of the above, or delta as commanded
    COMMAND   the vehicle's  v tan(delta) / L, delta as commanded
    NONE      0              0
    ========  =============  ===============================================

    The gyro's bias is the running mean of its readings at rest; the gyro is not used before ten of them. An expired
    command counts as speed 0.
    """

    def __init__(self, vehicle: VehicleConfig) -> None:
        self._wheelbase_m = vehicle.wheelbase_m
        self.reset()

    @property
    def bias_radps(self) -> float | None:
        """The gyro's bias [rad/s]; None while unknown."""
        return self._mean_radps if self._readings >= MIN_READINGS else None

    def step(self, state: VehicleState | None, last_command: Command | None, t_ns: int) -> Motion:
        """The motion at `t_ns`; `last_command` is the one on the wire."""
        if state is not None and t_ns - state.t_ns > STATE_TIMEOUT_NS:
            state = None
        commanded = None if last_command is None else _commanded_mps(last_command, t_ns)
        if state is not None and state.t_ns != self._read_ns:
            self._learn(state, commanded)
        measured = None if state is None else _finite(state.speed_mps)
        speed = commanded if measured is None else measured
        if speed is None:
            return Motion(t_ns=t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
        gyro = None if state is None else _finite(state.yaw_rate_radps)
        applied = None if state is None else _finite(state.steering_rad)
        if gyro is not None and self.bias_radps is not None:
            source = MotionSource.COMMAND if measured is None else MotionSource.MEASURED
            return Motion(t_ns=t_ns, speed_mps=speed, yaw_rate_radps=gyro - self.bias_radps, source=source)
        source = MotionSource.COMMAND if measured is None or applied is None else MotionSource.MODEL
        steering = applied
        if steering is None and last_command is not None:
            steering = _finite(last_command.steering_rad)
        if steering is None:
            if speed != 0.0:  # the car moves and its steering is unknown
                return Motion(t_ns=t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
            steering = 0.0
        yaw_rate = speed * math.tan(steering) / self._wheelbase_m
        return Motion(t_ns=t_ns, speed_mps=speed, yaw_rate_radps=yaw_rate, source=source)

    def reset(self) -> None:
        """Forget everything but the configuration."""
        self._mean_radps, self._readings = 0.0, 0
        self._read_ns: int | None = None
        self._still_since_ns: int | None = None

    def _learn(self, state: VehicleState, commanded_mps: float | None) -> None:
        """Use a new state's gyro reading for the bias, if the car has been at rest long enough."""
        self._read_ns = state.t_ns
        gyro = _finite(state.yaw_rate_radps)
        still = state.speed_mps == 0.0 and not commanded_mps
        if not still or gyro is None or abs(gyro) > BIAS_MAX_RADPS:
            self._still_since_ns = None
            return
        if self._still_since_ns is None:
            self._still_since_ns = state.t_ns
        if state.t_ns - self._still_since_ns >= SETTLE_NS:
            self._readings = min(self._readings + 1, MAX_READINGS)
            self._mean_radps += (gyro - self._mean_radps) / self._readings


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _commanded_mps(command: Command, t_ns: int) -> float | None:
    return 0.0 if t_ns > command.valid_until_ns else _finite(command.speed_mps)
