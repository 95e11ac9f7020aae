"""The simulated world: a car on a track, its camera and its controller board, on time that is passed in."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Protocol

from automodel.sim.plant import CarState, Plant
from automodel.sim.renderer import Renderer
from automodel.sim.truth import Truth, TruthFollower
from automodel.signals import Image


class Board(Protocol):
    """The controller board on the car: an emulated Arduino, say. It drives the plant as its peripheral."""

    def advance(self, now_ns: int) -> None:
        """Run its program up to `now_ns`."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """What is true at one capture."""

    t_ns: int
    index: int
    car: CarState
    truth: Truth


class World:
    """Board and plant advance together; `capture` takes a picture and the truth of the same instant.

    The plant's actuators have dead times, so that where the car will be that much later is settled already: a picture
    can be rendered ahead of its time and be exact (`capture` with a time in the near future).
    """

    def __init__(self, plant: Plant, board: Board, renderer: Renderer, follower: TruthFollower) -> None:
        self.plant, self.board, self.renderer, self.follower = plant, board, renderer, follower
        self._lock = threading.Lock()

    def advance(self, t_ns: int) -> None:
        """Run board and plant up to `t_ns`."""
        with self._lock:
            self.board.advance(t_ns)
            self.plant.advance(t_ns)

    def capture(self, t_ns: int, index: int) -> tuple[Image, Scene]:
        """Picture and truth at `t_ns`, now or at most the plant's shortest dead time ahead."""
        with self._lock:
            car = self.plant.predicted(t_ns)
        image = self.renderer.render(car.x_m, car.y_m, car.yaw_rad, car.speed_mps, car.yaw_rate_radps, index)
        truth = self.follower.step(car.x_m, car.y_m, car.yaw_rad)
        return image, Scene(t_ns=t_ns, index=index, car=car, truth=truth)
