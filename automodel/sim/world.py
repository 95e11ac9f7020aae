"""The simulated world: a car on a track with camera and ultrasonic sensors, driven by a controller board.

Time is an argument. `TrueLane` is a pipeline that reports the ground truth.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from automodel.curves import TabulatedCurve
from automodel.geometry import SE2
from automodel.signals import BoardSensors, Frame, LaneEstimate, LanePose, LaneStatus, Motion
from automodel.sim.full_size import FullSizePlant
from automodel.sim.plant import CarState, Plant, Ranges
from automodel.sim.track import Lane
from automodel.sim.truth import Truth, TruthFollower
from automodel.types import Image

BEHIND_LANES, AHEAD_LANES = 0.3, 3.5  # extent of the estimate about the reference point, in lane widths
SEEN_LANES = 1.5  # at a larger offset the lane is out of sight
_STEP_LANES = 0.1  # between two points
MAX_M = 4.0
MIN_M = 0.02
CONE_HALF_RAD = math.radians(15.0)
MOUNT_YAWS_RAD = (math.radians(30.0), 0.0, math.radians(-30.0))  # left, centre, right

Segment = tuple[float, float, float, float]  # x0, y0, x1, y1 [m]


class UltrasonicRanges:
    """Three HC-SR04 sensors: ranges (left, centre, right) [m] to convex obstacles (n, 2) [m]; None without an echo.

    A sensor measures the nearest point within its cone of 15 deg to each side, at least 0.02 m. All three sit at
    `bumper_x_m` ahead of the rear axle, the outer two at `spacing_m` to the sides.
    """

    def __init__(self, obstacles_m: Sequence[ArrayLike], bumper_x_m: float, spacing_m: float = 0.06) -> None:
        self._obstacles = tuple(_closed(obstacle) for obstacle in obstacles_m)
        self._mounts = tuple(
            (bumper_x_m, y_m, yaw_rad)
            for y_m, yaw_rad in zip((spacing_m, 0.0, -spacing_m), MOUNT_YAWS_RAD, strict=True)
        )

    def __call__(self, car: CarState) -> Ranges:
        """The readings for a car in this state."""
        left, centre, right = (self._range(car, *mount) for mount in self._mounts)
        return left, centre, right

    def _range(self, car: CarState, x_m: float, y_m: float, yaw_rad: float) -> float | None:
        cos, sin = math.cos(car.yaw_rad), math.sin(car.yaw_rad)
        x = car.x_m + cos * x_m - sin * y_m
        y = car.y_m + sin * x_m + cos * y_m
        cos, sin = math.cos(car.yaw_rad + yaw_rad), math.sin(car.yaw_rad + yaw_rad)
        nearest = math.inf
        for obstacle in self._obstacles:
            if _holds(obstacle, x, y):
                return MIN_M
            for x0, y0, x1, y1 in obstacle:
                dx0, dy0, dx1, dy1 = x0 - x, y0 - y, x1 - x, y1 - y
                segment = (
                    cos * dx0 + sin * dy0,
                    cos * dy0 - sin * dx0,
                    cos * dx1 + sin * dy1,
                    cos * dy1 - sin * dx1,
                )
                nearest = min(nearest, distance_in_cone(segment, CONE_HALF_RAD))
        return max(nearest, MIN_M) if nearest <= MAX_M else None


def distance_in_cone(segment: Segment, half_rad: float) -> float:
    """Distance [m] from the origin to a segment's part in the cone |angle| <= `half_rad` about x; inf without one."""
    x0, y0, x1, y1 = segment
    cos, sin = math.cos(half_rad), math.sin(half_rad)
    low, high = 0.0, 1.0
    for side in (1.0, -1.0):  # a point is in the cone where x sin -+ y cos >= 0 on both sides
        start, end = x0 * sin - side * y0 * cos, x1 * sin - side * y1 * cos
        if start < 0 and end < 0:
            return math.inf
        if start < 0:
            low = max(low, start / (start - end))
        elif end < 0:
            high = min(high, start / (start - end))
    if low > high:
        return math.inf
    dx, dy = x1 - x0, y1 - y0
    length2 = dx * dx + dy * dy
    foot = -(x0 * dx + y0 * dy) / length2 if length2 > 0 else 0.0
    share = min(max(foot, low), high)
    return math.hypot(x0 + share * dx, y0 + share * dy)


def _closed(obstacle_m: ArrayLike) -> tuple[Segment, ...]:
    corners = np.asarray(obstacle_m, dtype=np.float64)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
        raise ValueError(f"obstacles_m: expected shape (n >= 3, 2), got {corners.shape}")
    if not np.isfinite(corners).all():
        raise ValueError("obstacles_m: must be finite")
    points: list[tuple[float, float]] = [(float(x), float(y)) for x, y in corners]
    return tuple((*start, *end) for start, end in pairwise([*points, points[0]]))


def _holds(obstacle: tuple[Segment, ...], x: float, y: float) -> bool:
    sides = [(x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) for x0, y0, x1, y1 in obstacle]
    return all(side > 0 for side in sides) or all(side < 0 for side in sides)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """The ground truth of one capture; `reach_m` is the largest distance of the car's body from the centerline."""

    t_ns: int
    index: int
    car: CarState
    truth: Truth
    reach_m: float


class Dynamics(Protocol):
    """A car whose motion is determined for its actuators' dead time."""

    def advance(self, t_ns: int) -> None:
        """Advance to `t_ns`."""
        ...

    def predicted(self, t_ns: int) -> CarState:
        """The state at `t_ns`, at most the dead time ahead."""
        ...


DynamicsT = TypeVar("DynamicsT", bound=Dynamics)


class Surroundings(Generic[DynamicsT]):
    """The plant behind a lock (a served board has its own thread), with its camera and ground truth.

    The plant's actuators have dead times, during which its motion is already determined: `capture` can render a frame
    ahead of its time and be exact. `reach` gives `Scene.reach_m`. `pair`: the car has two cameras.
    """

    def __init__(
        self, plant: DynamicsT, renderer: Eye, follower: TruthFollower, reach: Callable[[CarState], float]
    ) -> None:
        self.plant, self.renderer, self.follower, self._reach = plant, renderer, follower, reach
        self.pair = isinstance(renderer, EyePair)
        self._lock = threading.Lock()

    def capture(self, t_ns: int, index: int) -> tuple[Image, Scene]:
        """Image and truth at `t_ns`, which is now or at most the plant's shortest dead time ahead.

        Of two cameras the images of both, left first: (2, h, w).
        """
        with self._lock:
            car = self.plant.predicted(t_ns)
        image = self.renderer.render(car.x_m, car.y_m, car.yaw_rad, car.speed_mps, car.yaw_rate_radps, index)
        truth = self.follower.step(car.x_m, car.y_m, car.yaw_rad)
        scene = Scene(t_ns=t_ns, index=index, car=car, truth=truth, reach_m=self._reach(car))
        return image, scene

    def settle(self, t_ns: int) -> None:
        """Advance the plant to `t_ns`, beyond the board's last step."""
        with self._lock:
            self.plant.advance(t_ns)


class World(Surroundings[Plant]):
    """The world of a scale car: its controller board's peripherals."""

    def set_pulses(self, t_ns: int, servo_us: float, motor_us: float) -> None:
        """The pulses at the board's pins."""
        with self._lock:
            self.plant.set_pulses(t_ns, servo_us, motor_us)

    def read_sensors(self, t_ns: int) -> BoardSensors:
        """The readings of the board's sensors."""
        with self._lock:
            return self.plant.read_sensors(t_ns)


class FullSizeWorld(Surroundings[FullSizePlant]):
    """The world of a full-size car: its vehicle controller's body."""

    def drive(self, t_ns: int, steering_rad: float | None, accel_mps2: float) -> None:
        """Steer and accelerate from `t_ns` on."""
        with self._lock:
            self.plant.demand(t_ns, steering_rad, accel_mps2)

    def measure(self, t_ns: int) -> CarState:
        """The state at `t_ns`."""
        with self._lock:
            return self.plant.predicted(t_ns)


class Eye(Protocol):
    """A camera of the simulated world, such as `Renderer`."""

    def render(
        self, x_m: float, y_m: float, yaw_rad: float, speed_mps: float, yaw_rate_radps: float, index: int
    ) -> Image:
        """The image from a pose of the body frame."""
        ...


class EyePair:
    """Two cameras that look at the same time; an `Eye` whose image is that of both, left first: (2, h, w)."""

    def __init__(self, left: Eye, right: Eye) -> None:
        self._eyes = left, right

    def render(
        self, x_m: float, y_m: float, yaw_rad: float, speed_mps: float, yaw_rate_radps: float, index: int
    ) -> Image:
        """Both images from a pose of the body frame."""
        return np.stack([eye.render(x_m, y_m, yaw_rad, speed_mps, yaw_rate_radps, index) for eye in self._eyes])


class TrueLane:
    """Implements `Pipeline` with the ground truth from `on_scene` instead of the image: perception without errors.

    The lane is LOST where it is too far to the side. The centerline is cut from a table of the whole lane for speed.
    """

    name = "truth"

    def __init__(self, lane: Lane) -> None:
        line, width_m = lane.centerline, float(lane.width_m(0.0))
        self._step_m = _STEP_LANES * width_m
        self._behind, self._ahead = round(BEHIND_LANES / _STEP_LANES), round(AHEAD_LANES / _STEP_LANES)
        count = math.ceil(line.length_m / self._step_m)
        s = np.arange(-self._behind, count + self._ahead + 1) * self._step_m
        self._points_m, self._headings_rad = line.position(s), line.heading(s)
        self._curvatures_per_m = line.curvature(s)
        self._scenes: dict[int, Scene] = {}

    def on_scene(self, scene: Scene) -> None:
        """Take the truth of the next frame."""
        self._scenes[scene.index] = scene

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        """The lane in this frame."""
        scene = self._scenes.get(frame.index)
        self._scenes = {index: kept for index, kept in self._scenes.items() if index > frame.index}
        if scene is None or abs(scene.truth.offset_m) > SEEN_LANES * scene.truth.width_m:
            return LaneEstimate(t_ns=frame.t_ns, status=LaneStatus.LOST)
        truth, car = scene.truth, scene.car
        pose = LanePose(
            offset_m=truth.offset_m,
            heading_rad=truth.heading_rad,
            width_m=truth.width_m,
            curvature_per_m=truth.curvature_per_m,
            covariance=np.zeros((3, 3)),
        )
        first = int(truth.s_m / self._step_m)
        part = slice(first, first + self._behind + self._ahead + 1)
        headings = self._headings_rad[part] - car.yaw_rad
        centerline = TabulatedCurve(
            np.arange(len(headings)) * self._step_m,
            SE2(car.x_m, car.y_m, car.yaw_rad).inverse().apply(self._points_m[part]),
            headings - math.tau * round(float(headings[self._behind]) / math.tau),
            self._curvatures_per_m[part],
        )
        return LaneEstimate(t_ns=frame.t_ns, status=LaneStatus.TRACKING, centerline=centerline, pose=pose)

    def reset(self) -> None:
        """No state to reset."""
