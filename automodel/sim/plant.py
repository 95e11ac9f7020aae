"""The simulated car's dynamics: pulses in, motion and sensor readings out; time is an argument."""

from __future__ import annotations

import math
import random
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from automodel.config import MotorConfig, ServoConfig
from automodel.config.toml_reader import not_negative, positive
from automodel.geometry.se2 import SE2
from automodel.signals import BoardSensors


def interpolate(x: float, xs: Sequence[float], ys: Sequence[float]) -> float:
    """Piecewise linear interpolation through (xs[i], ys[i]), xs rising; constant beyond the ends. For single floats."""
    if x <= xs[0]:
        return ys[0]
    if x >= xs[-1]:
        return ys[-1]
    i = bisect_right(xs, x)
    return ys[i - 1] + (ys[i] - ys[i - 1]) * (x - xs[i - 1]) / (xs[i] - xs[i - 1])


def lagged(value: float, target: float, share: float, step_max: float) -> float:
    """One step of a first-order lag, exact for a constant target; `share` is 1 - exp(-dt / tau).

    The step is limited to `step_max`.
    """
    return value + min(max((target - value) * share, -step_max), step_max)


def through_play(driven: float, driver: float, play: float) -> float:
    """The position of a part that is driven through a gap of width `play`: it moves only when the driver touches it."""
    half = 0.5 * play
    if driver - driven > half:
        return driver - half
    if driven - driver > half:
        return driver + half
    return driven


STEP_NS = 1_000_000  # the integration grid: states do not depend on the times of the calls
KEPT_STEPS = 1002  # the past that `predicted` knows: one second, and the steps at its ends
_STEP_S = STEP_NS * 1e-9
_STICTION_MPS = 0.004  # without drive, a car slower than this stops

Ranges = tuple[float | None, float | None, float | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Slip:
    """A floor on which the tyres slip, from `start_s` to `end_s` after the plant's start.

    The car turns by `share` of what its wheels stand for, and by no more than `lateral_max_mps2` of lateral
    acceleration allows.
    """

    start_s: float
    end_s: float
    share: float = 1.0
    lateral_max_mps2: float = math.inf

    def __post_init__(self) -> None:
        positive(self, "share")
        if not (self.start_s <= self.end_s and self.lateral_max_mps2 > 0):
            raise ValueError(f"start_s, end_s, lateral_max_mps2: expected in order and > 0, got {self}")

    def curvature(self, curvature_per_m: float, speed_mps: float, t_s: float) -> float:
        """The curvature [1/m] of the car's path at `t_s`, where its wheels stand for `curvature_per_m`."""
        if not self.start_s <= t_s < self.end_s:
            return curvature_per_m
        most = self.lateral_max_mps2 / (speed_mps * speed_mps) if speed_mps != 0.0 else math.inf
        return min(max(self.share * curvature_per_m, -most), most)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantConfig:
    """The true parameters of the simulated car; car.toml has the assumed ones.

    `servo` and `motor` are the true tables. A pulse takes effect after the dead time, then through a first-order lag
    (lag time 0: at once). Without drive the car slows down by the same lag, or, where `coast_mps2` [m/s^2] is given, by
    that: its motor controller lets it roll. The wheels follow the servo through a gap of `servo_play_rad`,
    `servo_bias_rad` to the left. `slip` is where the tyres do not hold.
    """

    wheelbase_m: float = 0.26
    servo: ServoConfig = field(default_factory=ServoConfig)
    servo_dead_s: float = 0.020
    servo_lag_s: float = 0.025
    servo_rate_max_radps: float = 8.0
    servo_play_rad: float = 0.01
    servo_bias_rad: float = 0.0
    motor: MotorConfig = field(default_factory=MotorConfig)
    motor_dead_s: float = 0.020
    motor_lag_s: float = 0.120
    coast_mps2: float | None = None
    ticks_per_m: float = 200.0
    gyro: bool = True  # whether one is fitted
    gyro_bias_radps: float = 0.02
    gyro_noise_radps: float = 0.01  # standard deviation of a reading
    seed: int = 0
    battery_v: float = 7.6
    slip: Slip | None = None

    def __post_init__(self) -> None:
        positive(self, "wheelbase_m", "servo_rate_max_radps", "ticks_per_m")
        not_negative(self, "servo_dead_s", "servo_lag_s", "servo_play_rad")
        not_negative(self, "motor_dead_s", "motor_lag_s", "gyro_noise_radps", "battery_v")
        if self.coast_mps2 is not None:
            positive(self, "coast_mps2")
        for name in ("servo_bias_rad", "gyro_bias_radps"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name}: expected a finite number, got {getattr(self, name)}")

    @property
    def dead_time_ns(self) -> int:
        """The shorter of the two dead times [ns]: the time for which the future is determined."""
        return round(min(self.servo_dead_s, self.motor_dead_s) * 1e9)


@dataclass(frozen=True, slots=True, kw_only=True)
class CarState:
    """The car's true state: pose of the rear axle's centre in the world, and motion.

    `steering_rad` is the wheels' true angle; `distance_m` is the path length of the rear axle, decreasing in reverse.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    steering_rad: float
    yaw_rate_radps: float
    distance_m: float


def no_echo(car: CarState) -> Ranges:
    """The ranges in an empty world."""
    return (None, None, None)


class _Snapshot(NamedTuple):
    x: float
    y: float
    yaw: float
    speed: float
    servo: float  # the servo's arm, as road-wheel angle
    wheel: float  # the road wheels, without the bias
    distance: float


class _Timeline:
    """Values and the grid steps, rising, at which they take effect."""

    def __init__(self, initial: float) -> None:
        self._entries: deque[tuple[int, float]] = deque([(-1, initial)])

    def add(self, step: int, value: float) -> None:
        if self._entries[-1][0] >= step:  # of pulses at the same time the last counts
            step = self._entries[-1][0]
            self._entries.pop()
        self._entries.append((step, value))

    def at(self, step: int) -> float:
        for first, value in reversed(self._entries):
            if first <= step:
                return value
        return self._entries[0][1]

    def forget_before(self, step: int) -> None:
        while len(self._entries) > 1 and self._entries[1][0] <= step:
            self._entries.popleft()


class Plant:
    """A kinematic bicycle behind a servo and a motor; implements the emulated board's peripherals.

    With L the wheelbase, delta the wheels' angle and v the rear axle's speed: x' = v cos yaw, y' = v sin yaw,
    yaw' = v tan(delta) / L (Rajamani 2012, section 2.2, at the rear axle), along exact arcs on a grid of 1 ms; less
    where the tyres slip.

    Pulses set at t take effect at the first grid point at or after t + dead time. Until then the motion is determined:
    `predicted(t)` up to `now_ns + config.dead_time_ns` equals a later `advance(t)` to the bit.

    `ranges` are the ultrasonic sensors; `start_ns` is the time of `start_pose` (None: the first time that is passed
    in). Before the first pulse the wheels are straight and the motor is off. A pulse of 0 means no pulse: a servo keeps
    its angle, a motor stops.
    """

    def __init__(
        self,
        config: PlantConfig,
        start_pose: SE2 | None = None,
        ranges: Callable[[CarState], Ranges] = no_echo,
        start_ns: int | None = None,
    ) -> None:
        self.config = config
        pose = SE2() if start_pose is None else start_pose
        self._ranges = ranges
        self._random = random.Random(config.seed)
        self._start_ns = start_ns
        self._now_ns = 0 if start_ns is None else start_ns
        self._step = 0  # grid index of the last snapshot
        start = _Snapshot(pose.x_m, pose.y_m, pose.yaw_rad, 0.0, 0.0, 0.0, 0.0)
        self._past: deque[_Snapshot] = deque([start], maxlen=KEPT_STEPS)
        self._servo, self._motor = _Timeline(0.0), _Timeline(0.0)
        self._servo_share, self._motor_share = self._shares(_STEP_S)

    @property
    def now_ns(self) -> int:
        """The latest time [ns] that was passed in."""
        return self._now_ns

    @property
    def state(self) -> CarState:
        """The state at `now_ns`."""
        return self.predicted(self._now_ns)

    def set_pulses(self, t_ns: int, servo_us: float, motor_us: float) -> None:
        """The pulses [us] at the pins from `t_ns` on."""
        self.advance(t_ns)
        config = self.config
        if servo_us > 0:
            angle = interpolate(servo_us, config.servo.pulse_us, config.servo.steering_rad)
            self._servo.add(self._step_of(self._now_ns + round(config.servo_dead_s * 1e9)), angle)
        speed = interpolate(motor_us, config.motor.pulse_us, config.motor.speed_mps) if motor_us > 0 else 0.0
        self._motor.add(self._step_of(self._now_ns + round(config.motor_dead_s * 1e9)), speed)

    def read_sensors(self, t_ns: int) -> BoardSensors:
        """The sensor readings at `t_ns`; each reading has new gyro noise."""
        self.advance(t_ns)
        car = self.state
        config = self.config
        yaw_rate = None
        if config.gyro:
            yaw_rate = car.yaw_rate_radps + config.gyro_bias_radps + self._random.gauss(0.0, config.gyro_noise_radps)
        return BoardSensors(
            ranges_m=self._ranges(car),
            wheel_ticks=math.floor(car.distance_m * config.ticks_per_m),
            battery_v=config.battery_v,
            yaw_rate_radps=yaw_rate,
        )

    def advance(self, t_ns: int) -> None:
        """Advance to `t_ns`; an earlier time changes nothing."""
        if self._start_ns is None:
            self._start_ns = self._now_ns = t_ns
        if t_ns <= self._now_ns:
            return
        self._now_ns = t_ns
        last = (t_ns - self._start_ns) // STEP_NS
        snapshot = self._past[-1]
        while self._step < last:
            snapshot = self._whole_step(snapshot, self._step)
            self._step += 1
            self._past.append(snapshot)
        self._servo.forget_before(self._step - KEPT_STEPS)
        self._motor.forget_before(self._step - KEPT_STEPS)

    def predicted(self, t_ns: int) -> CarState:
        """The state at `t_ns`; exact up to `now_ns + config.dead_time_ns`, further ahead if no other pulses are set.

        Raises ValueError for a time more than a second in the past.
        """
        if self._start_ns is None:
            return self._car(self._past[-1], 0)
        step, rest_ns = divmod(t_ns - self._start_ns, STEP_NS)
        back = self._step - step
        if back >= len(self._past):
            raise ValueError(f"t_ns: {t_ns} is {self._now_ns - t_ns} ns in the past; the states are kept for a second")
        snapshot = self._past[-1 - max(back, 0)]
        for index in range(self._step, step):
            snapshot = self._whole_step(snapshot, index)
        if rest_ns:
            rest_s = rest_ns * 1e-9
            snapshot = self._moved(snapshot, step, rest_s, *self._shares(rest_s))
        return self._car(snapshot, step)

    def _step_of(self, t_ns: int) -> int:
        start_ns = self._now_ns if self._start_ns is None else self._start_ns
        return -((start_ns - t_ns) // STEP_NS)  # rounded up

    def _shares(self, dt_s: float) -> tuple[float, float]:
        servo, motor = self.config.servo_lag_s, self.config.motor_lag_s
        return (
            1.0 - math.exp(-dt_s / servo) if servo > 0 else 1.0,
            1.0 - math.exp(-dt_s / motor) if motor > 0 else 1.0,
        )

    def _whole_step(self, now: _Snapshot, step: int) -> _Snapshot:
        return self._moved(now, step, _STEP_S, self._servo_share, self._motor_share)

    def _moved(self, now: _Snapshot, step: int, dt: float, servo_share: float, motor_share: float) -> _Snapshot:
        """The state `dt` [s] after the grid point `step`, with the mean speed and wheel angle of the interval."""
        config = self.config
        servo = lagged(now.servo, self._servo.at(step), servo_share, config.servo_rate_max_radps * dt)
        wheel = through_play(now.wheel, servo, config.servo_play_rad)
        drive = self._motor.at(step)
        rolls = drive == 0.0 and config.coast_mps2 is not None
        most = math.inf if config.coast_mps2 is None else config.coast_mps2 * dt
        speed = lagged(now.speed, 0.0, 1.0, most) if rolls else lagged(now.speed, drive, motor_share, math.inf)
        if drive == 0.0 and abs(speed) < _STICTION_MPS:
            speed = 0.0
        distance = 0.5 * (now.speed + speed) * dt
        if distance == 0.0:
            return _Snapshot(now.x, now.y, now.yaw, speed, servo, wheel, now.distance)
        half = 0.5 * distance * self._curvature(0.5 * (now.wheel + wheel), now.speed, step)
        chord = distance * (math.sin(half) / half) if abs(half) > 1e-9 else distance
        middle = now.yaw + half
        return _Snapshot(
            now.x + chord * math.cos(middle),
            now.y + chord * math.sin(middle),
            now.yaw + 2.0 * half,
            speed,
            servo,
            wheel,
            now.distance + distance,
        )

    def _curvature(self, wheel: float, speed: float, step: int) -> float:
        """The curvature [1/m] of the rear axle's path."""
        config = self.config
        steered = math.tan(wheel + config.servo_bias_rad) / config.wheelbase_m
        return steered if config.slip is None else config.slip.curvature(steered, speed, step * _STEP_S)

    def _car(self, now: _Snapshot, step: int) -> CarState:
        steering = now.wheel + self.config.servo_bias_rad
        return CarState(
            x_m=now.x,
            y_m=now.y,
            yaw_rad=now.yaw,
            speed_mps=now.speed,
            steering_rad=steering,
            yaw_rate_radps=now.speed * self._curvature(now.wheel, now.speed, step),
            distance_m=now.distance,
        )
