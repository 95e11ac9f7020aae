"""Prescribed drives along a lane at constant speed and laps of circuits: the styles of Cudrano et al. 2020, sec. VI."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from automodel.config.toml_reader import one_of
from automodel.curves import SplineCurve
from automodel.signals import Motion, MotionSource
from automodel.sim.track import Lane
from automodel.types import FloatArray

STYLES = ("centred", "oscillating", "racing")
MAX_HEADING_RAD = math.radians(40.0)  # of the oscillating style
_STEP_M = 1.0  # between the knots of a circuit's path
_SMOOTH_M = 20.0  # the window for smoothing bends and widths of the lane
_LINE_STEP_M = 4.0  # between the knots of the racing line
_LINE_ROUNDS = 80  # iterations of the weights that keep the racing line on the track


@dataclass(frozen=True, slots=True, kw_only=True)
class DrivenPose:
    """Where the car is: pose of the rear axle's centre in the world, speed and yaw rate."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    yaw_rate_radps: float


def pose_on(path: SplineCurve, s_m: float, speed_mps: float) -> DrivenPose:
    """The pose of a car at arc length `s_m` of its path."""
    x, y = path.position(s_m)
    return DrivenPose(
        x_m=float(x),
        y_m=float(y),
        yaw_rad=math.remainder(float(path.heading(s_m)), math.tau),
        speed_mps=speed_mps,
        yaw_rate_radps=float(path.curvature(s_m)) * speed_mps,
    )


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

    @cached_property
    def path(self) -> SplineCurve:
        """The path of the rear axle's centre in the world frame."""
        lane = self.lane.centerline
        width = float(self.lane.width_m(0.0))
        count = max(int(lane.length_m / (0.05 * width)), 64)
        s = np.arange(count) / count * lane.length_m
        points = lane.offset_position(s, self._offsets(s, width))
        return SplineCurve(points, closed=True)

    def pose(self, t_s: float) -> DrivenPose:
        """The pose at `t_s` seconds after the start."""
        return pose_on(self.path, t_s * self.speed_mps, self.speed_mps)

    def time_at(self, lane_s_m: float) -> float:
        """The time [s] at which the car is at arc length `lane_s_m` of the lane's centerline, in the first lap."""
        length_m, knots = self.lane.centerline.length_m, self.path.knots_m
        s = np.linspace(0.0, length_m, len(knots))
        return float(np.interp(lane_s_m % length_m, s, knots)) / self.speed_mps

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
            waves = max(round(length * math.tan(MAX_HEADING_RAD) / (math.tau * amplitude)), 1)
            scale = 0.65 + 0.35 * np.sin(math.tau * max(waves // 8, 1) * s / length)  # headings of 12 to 40 degrees
            return amplitude * scale * np.sin(math.tau * waves * s / length + phase)
        bend = self.lane.centerline.curvature(s) * width
        kernel = np.hanning(2 * int(1.5 / 0.05) + 3)
        smooth = np.convolve(np.tile(bend, 3), kernel / kernel.sum(), mode="same")[len(s) : 2 * len(s)]
        return np.asarray(free * np.tanh(4.0 * smooth / max(float(np.abs(smooth).max()), 1e-9)))


class Odometer:
    """Simulated wheel encoder and gyro of a drive: scale error, bias and noise, seeded."""

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
    """The odometry of a car without encoder and gyro, from its commands; seeded as `Odometer`.

    The car follows a command `LAG_S` later, with a scale error of its speed (battery, slope, load) and a steering
    offset; the yaw rate is that of the bicycle model with the commanded steering.
    """

    LAG_S = 0.2

    def __init__(self, wheelbase_m: float, seed: int) -> None:
        rng = np.random.default_rng([seed, 78])
        self._wheelbase_m = wheelbase_m
        self._scale = 1.0 + float(rng.normal(0.0, 0.04))
        self._bias_rad = float(rng.normal(0.0, 0.005))

    def motion(self, later: DrivenPose, t_ns: int) -> Motion:
        """The assumed motion at `t_ns`; `later` is the pose `LAG_S` after that, which is commanded now."""
        bend = later.yaw_rate_radps / later.speed_mps if later.speed_mps else 0.0
        steering = math.atan(self._wheelbase_m * bend) - self._bias_rad
        speed = later.speed_mps / self._scale
        yaw_rate = speed * math.tan(steering) / self._wheelbase_m
        return Motion(t_ns=t_ns, speed_mps=speed, yaw_rate_radps=yaw_rate, source=MotionSource.COMMAND)


@dataclass(frozen=True, slots=True, kw_only=True)
class Pace:
    """Speeds and accelerations of a drive; the cars of Cudrano et al. 2020 drove at 3 to 15 m/s."""

    slowest_mps: float = 3.0
    fastest_mps: float = 15.0
    lateral_mps2: float = 3.0
    speeding_up_mps2: float = 2.0
    braking_mps2: float = 3.5


class CircuitDrive:
    """Laps of a full-scale circuit in one of `STYLES`, at the speed that its bends allow; the rear axle follows `path`.

    centred: within 5 % of the lane's width. oscillating: from side to side with headings up to 40 degrees, less in
    tight bends. racing: the line of least curvature that keeps the car between the lines.
    """

    def __init__(self, lane: Lane, style: str, car_width_m: float, seed: int = 0, pace: Pace | None = None) -> None:
        one_of("style", style, STYLES)
        length_m = lane.centerline.length_m
        count = round(length_m / _STEP_M)
        s: FloatArray = np.linspace(0.0, length_m, count, endpoint=False)
        free = 0.5 * (lane.width_m(s) - car_width_m)
        phase = float(np.random.default_rng((seed, STYLES.index(style))).uniform(0.0, math.tau))
        offsets = {"centred": _centred, "oscillating": _oscillating, "racing": _racing}[style](lane, s, free, phase)
        self.lane = lane
        self.path = SplineCurve(lane.centerline.offset_position(s, offsets), closed=True)
        self._lane_s: FloatArray = np.append(s, length_m)
        self._speed = _speeds(self.path, pace or Pace())
        knots = self.path.knots_m
        self._time = np.concatenate(([0.0], np.cumsum(2.0 * np.diff(knots) / (self._speed[1:] + self._speed[:-1]))))

    @property
    def lap_s(self) -> float:
        """The time of a lap [s]."""
        return float(self._time[-1])

    def time_at(self, lane_s_m: float) -> float:
        """The time [s] at which the car is at arc length `lane_s_m` of the lane's centerline, in the first lap."""
        return float(np.interp(lane_s_m % self._lane_s[-1], self._lane_s, self._time))

    def poses(self, t_s: ArrayLike) -> list[DrivenPose]:
        """The poses at times (n,) [s] after the start; the acceleration is constant from knot to knot."""
        t = np.asarray(t_s, dtype=np.float64) % self.lap_s
        i = np.clip(np.searchsorted(self._time, t, side="right") - 1, 0, len(self._time) - 2)
        start, ahead = self._speed[i], t - self._time[i]
        accel = (self._speed[i + 1] - start) / (self._time[i + 1] - self._time[i])
        speed = start + accel * ahead
        s = self.path.knots_m[i] + (start + 0.5 * accel * ahead) * ahead
        yaw_rate = self.path.curvature(s) * speed
        columns = (*self.path.position(s).T, self.path.heading(s), speed, yaw_rate)
        return [
            DrivenPose(x_m=x, y_m=y, yaw_rad=math.remainder(yaw, math.tau), speed_mps=v, yaw_rate_radps=rate)
            for x, y, yaw, v, rate in zip(*(column.tolist() for column in columns), strict=True)
        ]


def pick_stretches(lane: Lane, count: int, length_m: float, seed: int) -> list[float]:
    """Arc lengths [m] of the centres of `count` stretches: half of them the sharpest bends, the others random.

    They do not overlap as long as there is room.
    """
    lap_m = lane.centerline.length_m
    s = np.arange(round(lap_m)) * (lap_m / round(lap_m))
    sharp = _smoothed(np.abs(lane.centerline.curvature(s)), 30.0 * len(s) / lap_m)
    rng = np.random.default_rng((seed, 51))
    picked: list[float] = []
    free = np.ones(len(s), np.bool_)
    for k in range(count):
        places = np.flatnonzero(free if free.any() else np.ones(len(s), np.bool_))
        best = places[int(np.argmax(sharp[places]))] if 2 * k < count else places[int(rng.integers(len(places)))]
        picked.append(float(s[best]))
        free &= np.abs((s - s[best] + 0.5 * lap_m) % lap_m - 0.5 * lap_m) >= length_m
    return sorted(picked)


def _centred(lane: Lane, s: FloatArray, free: FloatArray, phase: float) -> FloatArray:
    width, length_m = lane.width_m(s), lane.centerline.length_m
    waves = max(round(length_m / (9.0 * float(width.mean()))), 1)
    return np.asarray(0.05 * width * np.sin(math.tau * waves * s / length_m + phase))


def _oscillating(lane: Lane, s: FloatArray, free: FloatArray, phase: float) -> FloatArray:
    """A sine with the largest amplitude that fits the lane and the shortest wavelength that the headings allow."""
    length_m = lane.centerline.length_m
    window = _SMOOTH_M * len(s) / length_m
    room = _smoothed(free, window)
    bend = _smoothed(np.abs(lane.centerline.curvature(s)), window)
    turned = np.cumsum(math.tan(MAX_HEADING_RAD) / room) * (length_m / len(s))
    waves = max(round(float(turned[-1]) / math.tau), 1)
    scale = 0.65 + 0.35 * np.sin(math.tau * max(waves // 8, 1) * s / length_m)  # headings of 12 to 40 degrees
    in_bends = np.maximum(1.0 - 2.0 * bend * room, 0.0)
    return np.asarray(room * in_bends * scale * np.sin(turned * (math.tau * waves / turned[-1]) + phase))


def _racing(lane: Lane, s: FloatArray, free: FloatArray, phase: float) -> FloatArray:
    """The offsets with the least sum of squared curvature between the sides.

    With the Hessian H and the gradient g of that sum at the centerline, (H + diag(l)) d = -g, where l_i = 0 or |d_i| =
    free_i (Kuhn-Tucker conditions for d_i^2 <= free_i^2). The weights l are found by repeated multiplication with
    (d_i / free_i)^2.
    """
    from scipy import sparse
    from scipy.interpolate import CubicSpline
    from scipy.sparse.linalg import splu

    lap_m = lane.centerline.length_m
    count = round(lap_m / _LINE_STEP_M)
    coarse = np.arange(count) * (lap_m / count)
    room = np.interp(coarse, s, free)
    points, heading = lane.centerline.position(coarse), lane.centerline.heading(coarse)
    second = sparse.diags([1.0, -2.0, 1.0, 1.0, 1.0], [-1, 0, 1, count - 1, 1 - count], shape=(count, count))
    across = [second @ sparse.diags(n) for n in (-np.sin(heading), np.cos(heading))]
    hessian = sum(a.T @ a for a in across)
    gradient = sum(a.T @ (second @ p) for a, p in zip(across, points.T, strict=True))
    weights = np.full(count, 1e-3)
    for _ in range(_LINE_ROUNDS):
        offsets = splu((hessian + sparse.diags(weights)).tocsc()).solve(-gradient)
        weights = np.clip(weights * (offsets / room) ** 2, 1e-9, 1e3)
    inside = np.clip(offsets, -room, room)
    smooth = CubicSpline(np.append(coarse, lap_m), np.append(inside, inside[0]), bc_type="periodic")
    return np.asarray(smooth(s), dtype=np.float64)


def _smoothed(values: FloatArray, window: float) -> FloatArray:
    """A periodic series smoothed with a Hann window of `window` samples (full width at half maximum)."""
    half = max(round(window), 1)
    kernel = np.hanning(2 * half + 1)
    padded = np.concatenate((values[-half:], values, values[:half]))
    return np.asarray(np.convolve(padded, kernel / kernel.sum(), mode="valid"))


def _speeds(path: SplineCurve, pace: Pace) -> FloatArray:
    """The highest speed [m/s] at each knot that bends and accelerations allow; the first is repeated at the end."""
    knots = path.knots_m
    bend = np.abs(path.curvature(knots))
    square = np.clip(pace.lateral_mps2 / np.maximum(bend, 1e-9), pace.slowest_mps**2, pace.fastest_mps**2)
    step = np.diff(knots)
    for _ in range(2):  # the second lap accounts for what precedes the first knot
        for i in range(len(step)):
            square[i + 1] = min(square[i + 1], square[i] + 2.0 * pace.speeding_up_mps2 * step[i])
        square[0] = square[-1]
        for i in range(len(step) - 1, -1, -1):
            square[i] = min(square[i], square[i + 1] + 2.0 * pace.braking_mps2 * step[i])
        square[-1] = square[0]
    return np.sqrt(square)
