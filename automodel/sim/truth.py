"""Ground truth: the true pose of a car in its lane."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from automodel.config import VehicleConfig
from automodel.curves.foot import newton_step
from automodel.geometry import SE2
from automodel.sim.plant import CarState
from automodel.sim.track import Lane

_STEP_M = 1e-3
_MAX_SAMPLES = 60_000


Pose: TypeAlias = SE2 | CarState  # world from body, body at the rear axle's centre


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """The car's true pose in its lane at the reference point; signs as in `automodel.signals.LanePose`.

    `s_m` is the arc length on the centerline within one lap; `lap` counts the complete laps since the first step
    (negative when driven backwards) and is 0 on an open lane.
    """

    offset_m: float
    heading_rad: float
    curvature_per_m: float
    width_m: float
    s_m: float
    lap: int


class TruthFollower:
    """Follows a car along a lane; where the road crosses itself, it stays on the branch that the car was on.

    The first step looks about `start_s_m` [m], the arc length at which the car starts. Where that is not given it
    searches the whole lane and prefers, among branches at about the same distance, the one in the car's direction: of
    a car that stands aslant on an intersection that may be the other one. `reference_x_m` is the distance of the
    reported point ahead of the rear axle.

    The centerline is tabulated every millimetre (at most 60,000 samples), so that a step takes about 10 us. The foot of
    the perpendicular is refined on the osculating circle: errors are below 1e-6 m and 1e-6 rad, except within half a
    step of a curvature jump (there half a step times the jump: 0.0004 rad at 0.8 1/m).
    """

    def __init__(self, lane: Lane, reference_x_m: float, start_s_m: float | None = None) -> None:
        self.lane, self.reference_x_m, self._start_s_m = lane, reference_x_m, start_s_m
        line = lane.centerline
        self._count = min(max(math.ceil(line.length_m / _STEP_M), 16), _MAX_SAMPLES)
        self._step_m = line.length_m / self._count
        s = np.arange(self._count + (not line.closed)) * self._step_m
        self._size = len(s)
        self._points = line.position(s)
        self._heading, self._curvature = line.heading(s), line.curvature(s)
        self._width = lane.width_m(s)
        self._reach = max(math.ceil(0.5 * float(self._width.max()) / self._step_m), 8)
        if line.closed:  # windows may extend over the seam
            self._x, self._y = np.pad(self._points, ((self._reach, self._reach), (0, 0)), mode="wrap").T.copy()
        else:
            self._x, self._y = np.pad(self._points, ((self._reach,) * 2, (0, 0)), constant_values=np.inf).T.copy()
        self.reset()

    def reset(self) -> None:
        """Forget the car: the next step is the first one, and laps count from there."""
        start = self._start_s_m
        self._index: int | None = None if start is None else int(start / self._step_m) % self._size
        self._s_m, self._distance_m = start or 0.0, 0.0

    def step(self, x_m: float, y_m: float, yaw_rad: float) -> Truth:
        """The truth for a rear axle at (x, y) [m] in the world frame, turned by yaw [rad]."""
        x = x_m + self.reference_x_m * math.cos(yaw_rad)
        y = y_m + self.reference_x_m * math.sin(yaw_rad)
        first = self._index is None
        index = self._nearest(x, y, self._locate(x, y, yaw_rad))
        ahead, offset = self._foot(x, y, index)
        length_m, curvature = self.lane.centerline.length_m, float(self._curvature[index])
        s_m = index * self._step_m + ahead
        if self.lane.centerline.closed:
            s_m %= length_m
        if not first:
            moved = s_m - self._s_m
            self._distance_m += math.remainder(moved, length_m) if self.lane.centerline.closed else moved
        self._index, self._s_m = index, s_m
        return Truth(
            offset_m=offset,
            heading_rad=math.remainder(yaw_rad - float(self._heading[index]) - curvature * ahead, math.tau),
            curvature_per_m=curvature,
            width_m=float(self._width[index]),
            s_m=s_m,
            lap=int(self._distance_m / length_m) if self.lane.centerline.closed else 0,
        )

    def lateral_reach_m(self, pose: Pose, vehicle: VehicleConfig) -> float:
        """The largest distance |d| [m] of the body's four corners from the centerline."""
        start = self._locate(pose.x_m, pose.y_m, pose.yaw_rad)
        cos, sin = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
        reach = 0.0
        for along in (vehicle.wheelbase_m + vehicle.front_overhang_m, -vehicle.rear_overhang_m):
            for lateral in (0.5 * vehicle.width_m, -0.5 * vehicle.width_m):
                x, y = pose.x_m + along * cos - lateral * sin, pose.y_m + along * sin + lateral * cos
                reach = max(reach, abs(self._foot(x, y, self._nearest(x, y, start))[1]))
        return reach

    def _locate(self, x: float, y: float, yaw_rad: float) -> int:
        """A sample on the car's branch: that of the last step, or the best one of the whole lane."""
        if self._index is not None:
            return self._index
        away = np.hypot(self._points[:, 0] - x, self._points[:, 1] - y) / self._width
        return int(np.argmin(away**2 + 2.0 * (1.0 - np.cos(self._heading - yaw_rad))))

    def _nearest(self, x: float, y: float, start: int) -> int:
        """The sample nearest to the point, by descent from `start`."""
        reach, closed = self._reach, self.lane.centerline.closed
        for _ in range(self._size // reach + 1):
            window = slice(start, start + 2 * reach + 1)  # the padded table starts `reach` before the lane
            dx, dy = self._x[window] - x, self._y[window] - y
            found = int(np.argmin(dx * dx + dy * dy))
            start += found - reach
            if closed:
                start %= self._size
            if 0 < found < 2 * reach:
                break
        return start

    def _foot(self, x: float, y: float, index: int) -> tuple[float, float]:
        """The distance [m] from a sample to the foot of the perpendicular, and the signed distance [m] there."""
        theta, curvature = float(self._heading[index]), float(self._curvature[index])
        dx, dy = x - float(self._points[index, 0]), y - float(self._points[index, 1])
        ahead, along, left = newton_step(dx, dy, math.cos(theta), math.sin(theta), curvature, 1e-3)
        limit = self._step_m
        if not self.lane.centerline.closed and index in (0, self._size - 1):
            limit = 0.0
        ahead = min(max(ahead, -limit), limit)
        return ahead, left - 0.5 * curvature * ahead * along
