"""Worlds with a camera of a few pixels, for processes of their own: these import this module by its name."""

from __future__ import annotations

import os

import numpy as np

from automodel.geometry import SE2
from automodel.sim.plant import CarState, Plant, PlantConfig
from automodel.sim.track_files import load_track
from automodel.sim.truth import TruthFollower
from automodel.sim.world import EyePair, World

SHAPE = (4, 6)


class CountingRenderer:
    """Pictures that say their index, counted from `first`, and where the car is."""

    def __init__(self, first: int = 0) -> None:
        self.first = first

    def render(
        self,
        x_m: float,
        y_m: float,
        yaw_rad: float,
        speed_mps: float = 0.0,
        yaw_rate_radps: float = 0.0,
        index: int = 0,
    ) -> np.ndarray:
        picture = np.zeros(SHAPE, np.uint8)
        picture[0, 0] = (self.first + index) % 256
        picture[1] = int(1000 * x_m) % 256
        return picture


class DyingRenderer(CountingRenderer):
    """Takes its process with it at the tenth picture."""

    def render(self, *args: float, index: int = 0) -> np.ndarray:
        if index >= 10 or (len(args) > 5 and args[5] >= 10):
            os._exit(3)
        return np.zeros(SHAPE, np.uint8)


class NoPort:
    """A board's port that nobody serves."""

    path = "/dev/nowhere"

    def start(self) -> None:
        pass

    def close(self) -> None:
        pass


class BrokenPort(NoPort):
    def start(self) -> None:
        raise OSError("no pseudo terminals left")


def small_world(renderer: object | None = None) -> World:
    lane = load_track("oval").lane("forward")
    start = lane.pose(0.5)
    plant = Plant(PlantConfig(), SE2(start.x_m, start.y_m, start.yaw_rad))
    return World(plant, renderer or CountingRenderer(), TruthFollower(lane, 0.13), reach)  # type: ignore[arg-type]


def reach(state: CarState) -> float:
    return 0.1


def living() -> tuple[World, NoPort]:
    return small_world(), NoPort()


def seeing_double() -> tuple[World, NoPort]:
    return small_world(EyePair(CountingRenderer(), CountingRenderer(first=100))), NoPort()


def dying() -> tuple[World, NoPort]:
    return small_world(DyingRenderer()), NoPort()


def portless() -> tuple[World, NoPort]:
    return small_world(), BrokenPort()


def stillborn() -> tuple[World, NoPort]:
    raise OSError("nothing there")
