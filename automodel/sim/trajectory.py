"""Prescribed drives along a lane: the driving styles of Cudrano et al. 2020, section VI, for benches."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from automodel.curves import Curve, SplineCurve
from automodel.signals import Motion, MotionSource
from automodel.sim.track import Lane
from automodel.types import FloatArray

STYLES = ("centred", "oscillating", "racing")


@dataclass(frozen=True, slots=True, kw_only=True)
class DrivenPose:
    """Where the car is: pose of the rear axle's centre in the world, speed and yaw rate."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    yaw_rate_radps: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Drive:
    """A lap along `lane` in one of `STYLES`, at constant speed; the rear axle's centre follows the path.

    centred: within 5 % of the lane's width. oscillating: a sine through the lane whose headings reach 40 degrees.
    racing: the inside of each bend, the car's side close to the line.
    """

    lane: Lane
    style: str
    speed_mps: float
    car_width_m: float
    seed: int = 0

    MAX_HEADING_RAD = math.radians(40.0)

    @cached_property
    def path(self) -> Curve:
        """The way of the rear axle's centre, in the world frame."""
        lane = self.lane.centerline
        width = float(self.lane.width_m(0.0))
        count = max(int(lane.length_m / (0.05 * width)), 64)
        s = np.arange(count) / count * lane.length_m
        points = lane.offset_position(s, self._offsets(s, width))
        return SplineCurve(points, closed=True)

    def pose(self, t_s: float) -> DrivenPose:
        """The pose at `t_s` seconds after the start."""
        s = t_s * self.speed_mps
        x, y = self.path.position(s)
        return DrivenPose(
            x_m=float(x),
            y_m=float(y),
            yaw_rad=math.remainder(float(self.path.heading(s)), math.tau),
            speed_mps=self.speed_mps,
            yaw_rate_radps=float(self.path.curvature(s)) * self.speed_mps,
        )

    def _offsets(self, s: FloatArray, width: float) -> FloatArray:
        free = np.asarray(0.5 * (self.lane.width_m(s) - self.car_width_m))
        rng = np.random.default_rng([self.seed, STYLES.index(self.style)])
        phase = rng.uniform(0.0, math.tau)
        length = self.lane.centerline.length_m
        if self.style == "centred":
            waves = max(round(length / (9.0 * width)), 1)
            return 0.05 * width * np.sin(math.tau * waves * s / length + phase)
        if self.style == "oscillating":
            amplitude = float(free.min()) + 0.05 * width
            waves = max(round(length * math.tan(self.MAX_HEADING_RAD) / (math.tau * amplitude)), 1)
            swell = 0.65 + 0.35 * np.sin(math.tau * max(waves // 8, 1) * s / length)  # headings of 12 to 40 degrees
            return amplitude * swell * np.sin(math.tau * waves * s / length + phase)
        bend = self.lane.centerline.curvature(s) * width
        kernel = np.hanning(2 * int(1.5 / 0.05) + 3)
        smooth = np.convolve(np.tile(bend, 3), kernel / kernel.sum(), mode="same")[len(s) : 2 * len(s)]
        return np.asarray(free * np.tanh(4.0 * smooth / max(float(np.abs(smooth).max()), 1e-9)))


class Odometer:
    """What wheel encoder and gyro would say of a drive: scale error, bias and noise, seeded."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 77])
        self._scale = 1.0 + float(rng.normal(0.0, 0.01))
        self._bias_radps = float(rng.normal(0.0, 0.005))
        self._noise_radps = 0.01
        self._rng = rng

    def motion(self, pose: DrivenPose, t_ns: int) -> Motion:
        """The measured motion at `t_ns`."""
        yaw_rate = pose.yaw_rate_radps + self._bias_radps + float(self._rng.normal(0.0, self._noise_radps))
        return Motion(
            t_ns=t_ns,
            speed_mps=pose.speed_mps * self._scale,
            yaw_rate_radps=yaw_rate,
            source=MotionSource.MEASURED,
        )


class CommandedMotion:
    """What a car without encoder and gyro believes of a drive: its own command, seeded as `Odometer`.

    The car does what it was told `LAG_S` later, at a speed that is wrong by some percent (battery, slope, load), its
    wheels a little to one side; the yaw rate is that of the bicycle model on the commanded steering.
    """

    LAG_S = 0.2

    def __init__(self, wheelbase_m: float, seed: int) -> None:
        rng = np.random.default_rng([seed, 78])
        self._wheelbase_m = wheelbase_m
        self._scale = 1.0 + float(rng.normal(0.0, 0.04))
        self._bias_rad = float(rng.normal(0.0, 0.005))

    def motion(self, later: DrivenPose, t_ns: int) -> Motion:
        """The believed motion at `t_ns`; `later` is where the car is `LAG_S` after that, as it is told now."""
        bend = later.yaw_rate_radps / later.speed_mps if later.speed_mps else 0.0
        steering = math.atan(self._wheelbase_m * bend) - self._bias_rad
        speed = later.speed_mps / self._scale
        yaw_rate = speed * math.tan(steering) / self._wheelbase_m
        return Motion(t_ns=t_ns, speed_mps=speed, yaw_rate_radps=yaw_rate, source=MotionSource.COMMAND)
