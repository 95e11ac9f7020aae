"""The simulated world: a car on a track and its camera, on time that is passed in; a controller board drives it."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Protocol

from automodel.signals import BoardSensors
from automodel.sim.plant import CarState, Plant
from automodel.sim.truth import Truth, TruthFollower
from automodel.types import Image


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
