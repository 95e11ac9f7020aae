"""Bird's-eye views drawn from the ground's geometry, with exact shares at the borders."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from automodel.geometry import SE2, View

Shape = Callable[[np.ndarray, np.ndarray], np.ndarray]  # whether the points (x, y) [m] are painted


def line_at(y_m: float, width_m: float = 0.03, slope: float = 0.0, bend_per_m: float = 0.0) -> Shape:
    """A line along y = y_m + slope x + bend x^2 / 2, `width_m` broad square to itself."""

    def painted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        direction = slope + bend_per_m * x
        away = y - y_m - slope * x - 0.5 * bend_per_m * x * x
        return np.abs(away) <= 0.5 * width_m * np.hypot(1.0, direction)

    return painted


def dashed(shape: Shape, dash_m: float, gap_m: float, from_m: float = 0.0) -> Shape:
    return lambda x, y: shape(x, y) & ((x - from_m) % (dash_m + gap_m) < dash_m)


def bar(x_m: float, length_m: float, angle_rad: float = 0.5 * math.pi, half_m: float = 10.0) -> Shape:
    """A bar whose near edge runs through (x_m, 0) in the direction `angle_rad`, `length_m` deep."""

    def painted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        beyond = (x - x_m) * math.sin(angle_rad) - y * math.cos(angle_rad)
        along = (x - x_m) * math.cos(angle_rad) + y * math.sin(angle_rad)
        return (beyond >= 0.0) & (beyond <= length_m) & (np.abs(along) <= half_m)

    return painted


def disc(x_m: float, y_m: float, radius_m: float) -> Shape:
    return lambda x, y: np.hypot(x - x_m, y - y_m) <= radius_m


def seen_from(shape: Shape, world_from_body: SE2) -> Shape:
    """A shape of the world, in the body frame."""

    def painted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        world = world_from_body.apply(np.stack((x, y), axis=-1))
        return shape(world[..., 0], world[..., 1])

    return painted


def share(view: View, *shapes: Shape, samples: int = 6) -> np.ndarray:
    """How much of each pixel (h, w) is painted, 0 .. 1."""
    total = np.zeros((view.height_px, view.width_px))
    rows, columns = np.mgrid[0 : view.height_px, 0 : view.width_px]
    steps = (np.arange(samples) + 0.5) / samples - 0.5
    for row in steps:
        for column in steps:
            ground = view.to_body(np.stack((columns + column, rows + row), axis=-1))
            hit = [shape(ground[..., 0], ground[..., 1]) for shape in shapes]
            total += np.any(hit, axis=0)
    return total / samples**2


def binary(view: View, *shapes: Shape, samples: int = 6) -> np.ndarray:
    """0 or 255: pixels that are painted by half."""
    return np.where(share(view, *shapes, samples=samples) >= 0.5, 255, 0).astype(np.uint8)


def grey(view: View, *shapes: Shape, floor: float = 40.0, marking: float = 200.0) -> np.ndarray:
    return np.round(floor + (marking - floor) * share(view, *shapes)).astype(np.uint8)
