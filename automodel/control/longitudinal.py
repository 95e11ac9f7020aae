"""The speed: limited by the bends ahead, by obstacles, by how well the lane is seen and how wrong the pose may be."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from automodel.config import ControlConfig, VehicleConfig
from automodel.control.path import LanePath
from automodel.signals import LaneEstimate, LanePose, LaneStatus, VehicleState

STATE_TIMEOUT_NS = 500_000_000
_MAX_STEP_S = 0.1
_LOOKS = 16  # places ahead at which the curvature is evaluated
_MIN_WINDOW_S = 0.1  # the curvature is averaged at least over the distance driven in this time
_CREEP_MPS = 0.1  # least speed towards an obstacle, so that the car reaches the stopping distance


class ObstacleGuard:
    """Stop and go by the ultrasonic range ahead, with hysteresis, on the median of the last three readings.

    No echo means a free path. A single wrong reading, short or missing, changes nothing. Raises ValueError unless
    0 <= stop_m <= go_m.
    """

    def __init__(self, stop_m: float, go_m: float) -> None:
        if not 0 <= stop_m <= go_m:
            raise ValueError(f"go_m: expected at least stop_m = {stop_m} >= 0, got {go_m}")
        self._stop_m, self._go_m = stop_m, go_m
        self.blocked = False
        self._readings: deque[float] = deque(maxlen=3)
        self._read_ns: int | None = None

    def step(self, state: VehicleState | None, t_ns: int) -> None:
        """Use the newest state; one that was given before is ignored."""
        if state is None or state.t_ns == self._read_ns or t_ns - state.t_ns > STATE_TIMEOUT_NS:
            return
        if not state.ranges_m:
            return
        self._read_ns = state.t_ns
        reading = state.ranges_m[len(state.ranges_m) // 2]
        self._readings.append(math.inf if reading is None or not math.isfinite(reading) else reading)
        if self.range_m < self._stop_m:
            self.blocked = True
        elif self.range_m > self._go_m:
            self.blocked = False

    @property
    def range_m(self) -> float:
        """The free distance ahead [m]; infinity without an echo."""
        readings = sorted((*self._readings, math.inf, math.inf, math.inf)[:3])
        return readings[1]

    def reset(self) -> None:
        """Forget every reading."""
        self.blocked = False
        self._readings.clear()
        self._read_ns = None


def speed_in_free_space(pose: LanePose, free_m: float, delay_s: float) -> float:
    """The greatest speed [m/s] at which the car stays inside its lane until the next command acts on what it sees then.

    The car's side is inside while its middle is at most `free_m` from the centerline. It may be |offset| + b away now,
    with b the offset's bound. Of the way that it drives, the part sin(psi) goes sideways unseen, with psi the heading's
    bound; the heading that is known is steered for. For the delay T no command acts:

        |offset| + b + sin(psi) v T <= free

    0 where the bound alone fills the space. Without a bound of the offset any speed; without one of the heading nothing
    goes sideways.
    """
    if math.isinf(pose.offset_bound_m):
        return math.inf
    left_m = free_m - abs(pose.offset_m) - pose.offset_bound_m
    sideways = 0.0 if math.isinf(pose.heading_bound_rad) else math.sin(min(pose.heading_bound_rad, 0.5 * math.pi))
    if left_m <= 0:
        return 0.0
    return left_m / (sideways * delay_s) if sideways * delay_s > 0.0 else math.inf


class SpeedPlanner:
    """The requested speed.

    In a bend v^2 |kappa| <= a_lat; a bend at the distance x ahead allows sqrt(v_bend^2 + 2 a_dec x) here. Where the
    lane's lines are out of sight, the tightest bend of the road may begin: `tightest_m`, its radius. An obstacle
    allows sqrt(2 a_dec x) for the distance x to the stopping distance, and 0 below it. A pose whose bound fills the
    space beside the car allows `speed_in_free_space`, but never less than the share `control.uncertain_speed`: a car
    that stands sees nothing new and cannot steer back; whether it may go on at all is for `runtime.input_checks` to
    say. While a machine that is too slow works on a frame the car drives `control.late_lanes` lane widths at most. The
    requested speed changes along ramps; only a stop for an obstacle is immediate.
    """

    def __init__(
        self, control: ControlConfig, speed_max_mps: float, vehicle: VehicleConfig, tightest_m: float = math.inf
    ) -> None:
        self._control, self._tightest_m = control, tightest_m
        self._vehicle = vehicle
        self._speed_mps = min(control.speed_mps, speed_max_mps)
        self._guard = ObstacleGuard(control.obstacle_stop_m, control.obstacle_go_m)
        self._shares = {LaneStatus.ONE_LINE: control.one_line_speed, LaneStatus.COASTING: control.coasting_speed}
        self._requested: tuple[int, float] | None = None
        self._sight: tuple[int, float] | None = None  # time, and the way ahead [m] along which lines have been seen

    def observe(self, state: VehicleState | None, t_ns: int) -> None:
        """Use the vehicle's state, in every frame."""
        self._guard.step(state, t_ns)

    def step(self, lane: LanePath, s_m: float, estimate: LaneEstimate, speed_mps: float, t_ns: int) -> float:
        """Requested speed [m/s] of a car at arc length `s_m` of the lane that drives at `speed_mps`."""
        requested = min(
            self._speed_mps * self._shares.get(estimate.status, 1.0),
            self._for_pose(estimate, t_ns),
            self._for_delay(estimate, t_ns),
            self._for_bends(lane, s_m, speed_mps),
            self._for_sight(estimate, speed_mps),
            self._for_obstacle(speed_mps),
        )
        if self._requested is None:
            start, dt = max(speed_mps, 0.0), 0.0
        else:
            start, dt = self._requested[1], min(max((t_ns - self._requested[0]) * 1e-9, 0.0), _MAX_STEP_S)
        ramped = min(max(requested, start - self._control.decel_mps2 * dt), start + self._control.accel_mps2 * dt)
        ramped = 0.0 if self._guard.blocked else min(ramped, self._speed_mps)
        self._requested = (t_ns, ramped)
        return ramped

    def stop(self) -> float:
        """The requested speed without a lane: 0 at once; the next ramp starts from the car's speed at that time."""
        self._requested = self._sight = None
        return 0.0

    def reset(self) -> None:
        """Forget everything but the configuration."""
        self._requested = self._sight = None
        self._guard.reset()

    def _for_pose(self, estimate: LaneEstimate, t_ns: int) -> float:
        pose, control = estimate.pose, self._control
        if pose is None:
            return math.inf
        # from the frame to wheels that turn or slow down for it, whichever takes longer
        delay_s = max(t_ns - estimate.t_ns, 0) * 1e-9 + max(control.actuator_delay_s, control.speed_delay_s)
        free_m = self._vehicle.free_space_m(pose.width_m)
        allowed = speed_in_free_space(pose, free_m, delay_s)
        return max(allowed, control.uncertain_speed * self._speed_mps)

    def _for_delay(self, estimate: LaneEstimate, t_ns: int) -> float:
        """v T <= `late_lanes` of the lane's width, for the time T from the frame to its command."""
        if estimate.pose is None or t_ns <= estimate.t_ns:
            return math.inf
        return self._control.late_lanes * estimate.pose.width_m / ((t_ns - estimate.t_ns) * 1e-9)

    def _for_bends(self, lane: LanePath, s_m: float, speed_mps: float) -> float:
        control = self._control
        speed = max(speed_mps, 0.5 * self._speed_mps)
        horizon = speed * control.speed_delay_s + speed * speed / (2.0 * control.decel_mps2)
        spacing = max(horizon / _LOOKS, 1e-3)
        window = max(speed * _MIN_WINDOW_S, spacing)
        allowed2 = math.inf
        for look in range(_LOOKS + 2):
            start = s_m + look * spacing
            if start > lane.length_m and look > 0:
                break
            kappa = abs(lane.mean_curvature(start, start + window))
            if kappa > 1e-9:  # a bend may start anywhere after the previous place
                braking = max((look - 1) * spacing - speed * control.speed_delay_s, 0.0)
                allowed2 = min(allowed2, control.lateral_accel_mps2 / kappa + 2.0 * control.decel_mps2 * braking)
        return math.sqrt(allowed2)

    def _for_sight(self, estimate: LaneEstimate, speed_mps: float) -> float:
        """v^2 <= v_bend^2 + 2 a_dec x for the way x to where a line's end is seen, or was and is still ahead.

        Any speed where the estimate says nothing of lines.
        """
        if math.isinf(self._tightest_m) or (estimate.left is None and estimate.right is None):
            return math.inf
        control, left_m = self._control, 0.0
        half_m = 0.5 * estimate.pose.width_m if estimate.pose is not None else 0.0
        if self._sight is not None:
            then_ns, seen_m = self._sight
            left_m = seen_m - max(speed_mps, 0.0) * max(estimate.t_ns - then_ns, 0) * 1e-9
        lines = [line for line in (estimate.left, estimate.right) if line is not None and len(line.points_m)]
        if lines:  # the inner line of a bend ends first
            left_m = max(left_m, min(float(np.hypot(*line.points_m.T).max()) for line in lines) - half_m)
        self._sight = (estimate.t_ns, max(left_m, 0.0))
        braking_m = max(left_m - max(speed_mps, 0.0) * control.speed_delay_s, 0.0)
        return math.sqrt(control.lateral_accel_mps2 * self._tightest_m + 2.0 * control.decel_mps2 * braking_m)

    def _for_obstacle(self, speed_mps: float) -> float:
        if math.isinf(self._guard.range_m):
            return math.inf
        left = self._guard.range_m - self._control.obstacle_stop_m - max(speed_mps, 0.0) * self._control.speed_delay_s
        return max(math.sqrt(2.0 * self._control.decel_mps2 * max(left, 0.0)), _CREEP_MPS)
