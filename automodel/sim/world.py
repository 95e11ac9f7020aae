"""The simulated world: a car on a track and its camera, on time that is passed in; a controller board drives it.

Three HC-SR04 ultrasonic sensors on the front bumper of the simulated car.

Perception without any error: the lane as the simulator knows it.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from automodel.curves import TabulatedCurve
from automodel.geometry import SE2
from automodel.signals import BoardSensors, Frame, LaneEstimate, LanePose, LaneStatus, Motion
from automodel.sim.plant import CarState, Plant, Ranges
from automodel.sim.track import Lane
from automodel.sim.truth import Truth, TruthFollower
from automodel.types import Image

MAX_M = 4.0
MIN_M = 0.02
CONE_HALF_RAD = math.radians(15.0)
MOUNT_YAWS_RAD = (math.radians(30.0), 0.0, math.radians(-30.0))  # left, centre, right

Segment = tuple[float, float, float, float]  # x0, y0, x1, y1 [m]


class UltrasonicRanges:
    """Ranges (left, centre, right) [m] to convex obstacles, each (n, 2) [m] in the world; None without an echo.

    A sensor hears the nearest point within its cone, 15 deg to each side. All three sit at `bumper_x_m` ahead of the
    rear axle, the outer two `spacing_m` to the sides. What is nearer than 0.02 m reads as 0.02 m.
    Whatever lies behind the nearest point cannot be heard, so that hiding needs no care.
    """

    def __init__(self, obstacles_m: Sequence[ArrayLike], bumper_x_m: float, spacing_m: float = 0.06) -> None:
        self._obstacles = tuple(_closed(obstacle) for obstacle in obstacles_m)
        self._mounts = tuple(
            (bumper_x_m, y_m, yaw_rad)
            for y_m, yaw_rad in zip((spacing_m, 0.0, -spacing_m), MOUNT_YAWS_RAD, strict=True)
        )

    def __call__(self, car: CarState) -> Ranges:
        """What the sensors of a car in this state read."""
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
    """Distance [m] from the origin to a segment's part in the cone |angle| <= `half_rad` about x; inf where none is."""
    x0, y0, x1, y1 = segment
    cos, sin = math.cos(half_rad), math.sin(half_rad)
    low, high = 0.0, 1.0
    for side in (1.0, -1.0):  # a point is in the cone where x sin -+ y cos >= 0 on both sides
        begin, end = x0 * sin - side * y0 * cos, x1 * sin - side * y1 * cos
        if begin < 0 and end < 0:
            return math.inf
        if begin < 0:
            low = max(low, begin / (begin - end))
        elif end < 0:
            high = min(high, begin / (begin - end))
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
        raise ValueError(f"obstacles_m: shape {corners.shape} where (n >= 3, 2) is wanted")
    if not np.isfinite(corners).all():
        raise ValueError("obstacles_m: must be finite")
    points: list[tuple[float, float]] = [(float(x), float(y)) for x, y in corners]
    return tuple((*begin, *end) for begin, end in pairwise([*points, points[0]]))


def _holds(obstacle: tuple[Segment, ...], x: float, y: float) -> bool:
    sides = [(x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) for x0, y0, x1, y1 in obstacle]
    return all(side > 0 for side in sides) or all(side < 0 for side in sides)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """What is true at one capture; `reach_m` is how far the car's body reaches from the lane's middle."""

    t_ns: int
    index: int
    car: CarState
    truth: Truth
    reach_m: float


class World:
    """The plant behind a lock (a served board lives in a thread of its own), and pictures and truth of it.

    The plant's actuators have dead times, so that where the car will be that much later is settled already: a picture
    can be rendered ahead of its time and be exact (`capture` with a time in the near future).
    """

    def __init__(self, plant: Plant, renderer: Eye, follower: TruthFollower, reach: Reach) -> None:
        self.plant, self.renderer, self.follower, self._reach = plant, renderer, follower, reach
        self._lock = threading.Lock()

    def set_pulses(self, t_ns: int, servo_us: float, motor_us: float) -> None:
        """The board's pins."""
        with self._lock:
            self.plant.set_pulses(t_ns, servo_us, motor_us)

    def read_sensors(self, t_ns: int) -> BoardSensors:
        """The board's sensors."""
        with self._lock:
            return self.plant.read_sensors(t_ns)

    def capture(self, t_ns: int, index: int) -> tuple[Image, Scene]:
        """Picture and truth at `t_ns`, now or at most the plant's shortest dead time ahead."""
        with self._lock:
            car = self.plant.predicted(t_ns)
        image = self.renderer.render(car.x_m, car.y_m, car.yaw_rad, car.speed_mps, car.yaw_rate_radps, index)
        truth = self.follower.step(car.x_m, car.y_m, car.yaw_rad)
        scene = Scene(t_ns=t_ns, index=index, car=car, truth=truth, reach_m=self._reach(car))
        return image, scene

    def settle(self, t_ns: int) -> None:
        """Let the plant's time pass up to `t_ns`, beyond what the board made of it."""
        with self._lock:
            self.plant.advance(t_ns)


class Eye(Protocol):
    """What gives pictures; a `Renderer` is one."""

    def render(
        self, x_m: float, y_m: float, yaw_rad: float, speed_mps: float, yaw_rate_radps: float, index: int
    ) -> Image:
        """The picture from a pose of the body frame."""
        ...


class Reach(Protocol):
    """How far the car's body reaches from the lane's middle [m]."""

    def __call__(self, car: CarState) -> float:
        """For one state of the car."""
        ...


BEHIND_LANES, AHEAD_LANES = 0.3, 3.5  # of the reference point
SEEN_LANES = 1.5  # a lane further aside is out of sight
_STEP_LANES = 0.1  # between two points


class TrueLane:
    """Implements `Pipeline` on what `on_scene` was told last: it belongs behind a simulated camera's truth.

    No picture is looked at. Lost where the lane is too far aside to be seen. The centerline's points are those of a
    table of the whole lane, so that a step costs little.
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
        """The truth of a frame that is about to be delivered."""
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
        """Nothing but the truth is kept."""
