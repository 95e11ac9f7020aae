"""A full-size car's dynamics: the dynamic bicycle with tyres that saturate, behind a steering actuator and a drive.

Time is an argument. It is `firmware_link.emulator.can_vehicle`'s body.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

from automodel.config.toml_reader import not_negative, positive
from automodel.geometry.se2 import SE2
from automodel.sim.plant import CarState, lagged

STEP_NS = 1_000_000
STEP_S = STEP_NS * 1e-9
SLOW_MPS = 3.0  # below this the wheels are taken to roll without slip: slip angles have no meaning for a standing car
GRAVITY_MPS2 = 9.81


@dataclass(frozen=True, slots=True, kw_only=True)
class FullSizeConfig:
    """The true parameters; of the order of those of a compact SUV.

    The understeer gradient m / L (b / C_f - a / C_r) is 0.0022 rad s^2/m per unit of lateral acceleration.
    """

    wheelbase_m: float = 2.65
    cg_to_front_m: float = 1.25
    mass_kg: float = 1700.0
    inertia_kgm2: float = 2700.0  # about the vertical axis
    front_stiffness_npr: float = 110e3  # of the axle [N/rad]
    rear_stiffness_npr: float = 130e3
    friction: float = 0.9  # dry asphalt
    dead_s: float = 0.03  # of steering and drive: bus, controllers
    steering_lag_s: float = 0.08
    steering_rate_max_radps: float = 0.7
    drive_lag_s: float = 0.3

    def __post_init__(self) -> None:
        positive(self, "wheelbase_m", "cg_to_front_m", "mass_kg", "inertia_kgm2", "front_stiffness_npr")
        positive(self, "rear_stiffness_npr", "friction", "steering_lag_s", "steering_rate_max_radps", "drive_lag_s")
        not_negative(self, "dead_s")
        if not self.cg_to_front_m < self.wheelbase_m:
            raise ValueError(f"cg_to_front_m: {self.cg_to_front_m} is not less than wheelbase_m")

    @property
    def cg_to_rear_m(self) -> float:
        """From the centre of mass to the rear axle [m]."""
        return self.wheelbase_m - self.cg_to_front_m

    @property
    def understeer_s2pm(self) -> float:
        """Steering angle per lateral acceleration [rad s^2/m] beyond the kinematic one, where the tyres are linear."""
        front, rear = self.cg_to_rear_m / self.front_stiffness_npr, self.cg_to_front_m / self.rear_stiffness_npr
        return self.mass_kg / self.wheelbase_m * (front - rear)


class Moving(NamedTuple):
    """The state at a grid point: pose of the rear axle's centre, speeds of the centre of mass in the body frame."""

    x_m: float
    y_m: float
    yaw_rad: float
    ahead_mps: float
    left_mps: float
    yaw_rate_radps: float
    steering_rad: float
    accel_mps2: float
    distance_m: float


class Demand(NamedTuple):
    """What is asked of the actuators from a grid point on; no steering: they keep the angle."""

    step: int
    steering_rad: float | None
    accel_mps2: float


def tyre_force_n(slip_rad: float, stiffness_npr: float, load_n: float, friction: float) -> float:
    """Lateral force [N] of an axle: linear for small slip angles, at most friction times load."""
    most = friction * load_n
    return most * math.tanh(stiffness_npr * slip_rad / most)


def stepped(now: Moving, demand: Demand, config: FullSizeConfig, dt_s: float = STEP_S) -> Moving:
    """The state after `dt_s`, by semi-implicit Euler steps.

    With a, b the distances from the centre of mass to the axles, u and w its speeds ahead and to the left, r the yaw
    rate: m (w' + u r) = F_f cos(delta) + F_r, I r' = a F_f cos(delta) - b F_r (Rajamani 2012, section 2.3), the slip
    angles alpha_f = delta - atan((w + a r) / u), alpha_r = -atan((w - b r) / u).
    """
    wanted = now.steering_rad if demand.steering_rad is None else demand.steering_rad
    share = 1.0 - math.exp(-dt_s / config.steering_lag_s)
    steering = lagged(now.steering_rad, wanted, share, config.steering_rate_max_radps * dt_s)
    accel = lagged(now.accel_mps2, demand.accel_mps2, 1.0 - math.exp(-dt_s / config.drive_lag_s), math.inf)
    ahead = max(now.ahead_mps + accel * dt_s, 0.0)
    a, b = config.cg_to_front_m, config.cg_to_rear_m
    if ahead < SLOW_MPS:
        rate = ahead * math.tan(steering) / config.wheelbase_m
        left = rate * b
    else:
        mass, loads = config.mass_kg, config.mass_kg * GRAVITY_MPS2 / config.wheelbase_m
        front_slip = steering - math.atan2(now.left_mps + a * now.yaw_rate_radps, ahead)
        rear_slip = -math.atan2(now.left_mps - b * now.yaw_rate_radps, ahead)
        front = tyre_force_n(front_slip, config.front_stiffness_npr, loads * b, config.friction) * math.cos(steering)
        rear = tyre_force_n(rear_slip, config.rear_stiffness_npr, loads * a, config.friction)
        rate = now.yaw_rate_radps + (a * front - b * rear) / config.inertia_kgm2 * dt_s
        left = now.left_mps + ((front + rear) / mass - ahead * rate) * dt_s
    yaw = now.yaw_rad + 0.5 * (now.yaw_rate_radps + rate) * dt_s
    middle = 0.5 * (now.yaw_rad + yaw)
    sideways = left - b * rate  # of the rear axle
    return Moving(
        now.x_m + (ahead * math.cos(middle) - sideways * math.sin(middle)) * dt_s,
        now.y_m + (ahead * math.sin(middle) + sideways * math.cos(middle)) * dt_s,
        yaw,
        ahead,
        left,
        rate,
        steering,
        accel,
        now.distance_m + math.hypot(ahead, sideways) * dt_s,
    )


class FullSizePlant:
    """The car on a grid of 1 ms: demands in, states out; what is demanded acts after the dead times."""

    def __init__(
        self,
        config: FullSizeConfig,
        start_pose: SE2 | None = None,
        start_mps: float = 0.0,
        start_curvature_per_m: float = 0.0,
    ) -> None:
        """At the start the car drives a steady bend of this curvature, with tyres that are linear."""
        self.config = config
        pose = SE2() if start_pose is None else start_pose
        rate = start_mps * start_curvature_per_m
        steering = (config.wheelbase_m + config.understeer_s2pm * start_mps**2) * start_curvature_per_m
        rear_load = config.mass_kg * config.cg_to_front_m / config.wheelbase_m
        left = config.cg_to_rear_m * rate - start_mps * rear_load * start_mps * rate / config.rear_stiffness_npr
        self._state = Moving(pose.x_m, pose.y_m, pose.yaw_rad, start_mps, left, rate, steering, 0.0, 0.0)
        self._step = 0
        self._start_ns: int | None = None
        self._now_ns = 0
        self._demands: deque[Demand] = deque([Demand(-1, None, 0.0)])

    @property
    def dead_time_ns(self) -> int:
        """For so long [ns] the future is determined."""
        return round(self.config.dead_s * 1e9)

    @property
    def now_ns(self) -> int:
        """The latest time [ns] that was passed in."""
        return self._now_ns

    def demand(self, t_ns: int, steering_rad: float | None, accel_mps2: float) -> None:
        """What is asked of the actuators from `t_ns` on."""
        self.advance(t_ns)
        self._demands.append(Demand(self._step + round(self.config.dead_s / STEP_S), steering_rad, accel_mps2))

    def advance(self, t_ns: int) -> None:
        """Advance to `t_ns`; an earlier time changes nothing."""
        if self._start_ns is None:
            self._start_ns = t_ns
        self._now_ns = max(self._now_ns, t_ns)
        while (self._step + 1) * STEP_NS <= self._now_ns - self._start_ns:
            self._state = stepped(self._state, self._demand(self._step), self.config)
            self._step += 1
        while len(self._demands) > 1 and self._demands[1].step <= self._step:
            self._demands.popleft()

    def predicted(self, t_ns: int) -> CarState:
        """The state at `t_ns`, exact up to `dead_time_ns` ahead; a time that is past gives the state now."""
        state, step = self._state, self._step
        start_ns = t_ns if self._start_ns is None else self._start_ns
        while (step + 1) * STEP_NS <= t_ns - start_ns:
            state = stepped(state, self._demand(step), self.config)
            step += 1
        rest_s = min(max(t_ns - start_ns - step * STEP_NS, 0) * 1e-9, STEP_S)
        if rest_s > 0.0:
            state = stepped(state, self._demand(step), self.config, rest_s)
        return CarState(
            x_m=state.x_m,
            y_m=state.y_m,
            yaw_rad=state.yaw_rad,
            speed_mps=state.ahead_mps,
            steering_rad=state.steering_rad,
            yaw_rate_radps=state.yaw_rate_radps,
            distance_m=state.distance_m,
        )

    def _demand(self, step: int) -> Demand:
        return next(demand for demand in reversed(self._demands) if demand.step <= step)
