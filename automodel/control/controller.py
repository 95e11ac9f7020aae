"""The controller of the loop: a lane estimate in, the requested command out.

The delay between a frame and the wheels that turn for it is compensated by prediction (a Smith predictor).
"""

from __future__ import annotations

from collections import deque

from automodel.config import CarConfig
from automodel.control.lateral import lateral_controller
from automodel.control.limits import Limits
from automodel.control.longitudinal import STATE_TIMEOUT_NS, SpeedPlanner
from automodel.control.path import LanePath
from automodel.control.vehicle_model import arc_motion
from automodel.geometry.se2 import SE2
from automodel.signals import Command, LaneEstimate, Motion, VehicleState

_FORGET_NS = 300_000_000  # after a longer gap between frames the commands in flight are forgotten


class SteeringInFlight:
    """Steering commands that do not act yet: a Smith predictor on the kinematic bicycle.

    A command that goes out at t acts from t + delay on. One pure delay stands for wire, servo frame, dead time and lag.
    When a command goes out is measured: a slow machine's commands act later. Raises ValueError for a negative delay.
    """

    def __init__(self, delay_s: float, wheelbase_m: float) -> None:
        if not delay_s >= 0:
            raise ValueError(f"delay_s: expected a number >= 0, got {delay_s}")
        self._delay_ns = round(delay_s * 1e9)
        self._wheelbase_m = wheelbase_m
        self._commands: deque[tuple[int, float]] = deque()  # from when it acts
        self._frame_ns: int | None = None

    def add(self, frame_ns: int, sent_ns: int, steering_rad: float) -> None:
        """Remember the command for the frame at `frame_ns`, which goes out at `sent_ns`."""
        if self._frame_ns is not None and not 0 < frame_ns - self._frame_ns < _FORGET_NS:
            self._commands.clear()
        self._frame_ns = frame_ns
        acts_ns = sent_ns + self._delay_ns
        while self._commands and self._commands[-1][0] >= acts_ns:  # this one takes its place
            self._commands.pop()
        self._commands.append((acts_ns, steering_rad))
        while len(self._commands) > 1 and self._commands[1][0] <= frame_ns:
            self._commands.popleft()

    def predict(self, frame_ns: int, sent_ns: int, speed_mps: float, steering_before_rad: float) -> SE2:
        """`frame_from_then`: the pose, in the body frame at `frame_ns`, that the car will have when its command acts.

        That command goes out at `sent_ns`. `steering_before_rad` applies to the time before the first remembered one.
        """
        then = SE2()
        steering, since, end = steering_before_rad, frame_ns, max(sent_ns + self._delay_ns, frame_ns)
        for acts_ns, value in self._commands:
            until = min(max(acts_ns, since), end)
            then = then @ arc_motion(speed_mps, steering, self._wheelbase_m, (until - since) * 1e-9)
            steering, since = value, until
        return then @ arc_motion(speed_mps, steering, self._wheelbase_m, (end - since) * 1e-9)

    def reset(self) -> None:
        """Forget every command."""
        self._commands.clear()
        self._frame_ns = None


class LaneController:
    """Drives along the estimated centerline; implements `interfaces.Controller`.

    The control laws act on the pose that the car will have when the command takes effect: that of the frame, moved by
    the bicycle model with the steering in flight (`SteeringInFlight`, `control.actuator_delay_s` after the time at
    which the command goes out, the `t_ns` of `step`). A lost lane keeps
    the steering and requests speed 0. A command is valid for `safety.command_validity_s` from its frame on.
    """

    def __init__(self, car: CarConfig) -> None:
        self._car = car
        self._lateral = lateral_controller(car.control, car.vehicle)
        self._speed = SpeedPlanner(
            car.control,
            car.safety.speed_max_mps,
            car.vehicle,
            tightest_m=car.pipeline.contour.radius_lanes * car.lane.width_m,
        )
        self._in_flight = SteeringInFlight(car.control.actuator_delay_s, car.vehicle.wheelbase_m)
        self._expected = Limits(car.safety, car.vehicle)  # predicts what the limits will leave of a command
        self._validity_ns = round(car.safety.command_validity_s * 1e9)
        self._last: Command | None = None
        self._applied_rad = 0.0

    def step(self, estimate: LaneEstimate, motion: Motion, state: VehicleState | None, t_ns: int) -> Command:
        """The requested command at `t_ns`."""
        if self._last is None:
            self._start(state, t_ns)
        self._speed.observe(state, t_ns)
        centerline = estimate.centerline if estimate.valid else None
        if centerline is None:
            steering, speed = self._steering_rad, self._speed.stop()
        else:
            steering, speed = self._follow(LanePath(centerline), estimate, motion, t_ns)
        command = Command(
            t_ns=t_ns,
            steering_rad=steering,
            speed_mps=speed,
            valid_until_ns=estimate.t_ns + self._validity_ns,
        )
        self._last = command
        self._in_flight.add(estimate.t_ns, t_ns, self._expected.step(command, motion, t_ns).command.steering_rad)
        return command

    def reset(self) -> None:
        """Forget everything but the configuration."""
        self._last = None
        self._applied_rad = 0.0
        self._speed.reset()
        self._in_flight.reset()
        self._expected.reset()

    @property
    def _steering_rad(self) -> float:
        return self._applied_rad if self._last is None else self._last.steering_rad

    def _start(self, state: VehicleState | None, t_ns: int) -> None:
        """Start from the steering that the vehicle reports as applied."""
        if state is not None and state.steering_rad is not None and t_ns - state.t_ns <= STATE_TIMEOUT_NS:
            self._applied_rad = state.steering_rad
        applied = Command(t_ns=t_ns, steering_rad=self._applied_rad, speed_mps=0.0, valid_until_ns=t_ns)
        self._expected.reset(applied)

    def _follow(self, lane: LanePath, estimate: LaneEstimate, motion: Motion, t_ns: int) -> tuple[float, float]:
        """Steering [rad] and speed [m/s] along a valid lane."""
        speed = motion.speed_mps if motion.known else (0.0 if self._last is None else self._last.speed_mps)
        then = self._in_flight.predict(estimate.t_ns, t_ns, speed, self._applied_rad)
        steering_max = self._car.safety.steering_max_rad
        steering = self._lateral.steer(lane, then, max(speed, 0.0))
        s_m, _ = lane.foot(then.x_m, then.y_m)
        return (
            min(max(steering, -steering_max), steering_max),
            self._speed.step(lane, s_m, estimate, speed, t_ns),
        )
