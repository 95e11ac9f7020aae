"""The simulated ground: a road, its lanes, its paint and the obstacles on it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from automodel.curves import Curve, OffsetCurve, ReversedCurve
from automodel.geometry import SE2
from automodel.sim.paint import Paint, RoadCrossing
from automodel.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lane:
    """One lane in its driving direction; the lines are the centres of the painted markings.

    `width_m(s)` is the distance [m] between the two lines at arc length s of the centerline (vectorised).
    """

    centerline: Curve
    left: Curve
    right: Curve
    width_m: Callable[[ArrayLike], FloatArray]

    def pose(self, s_m: float, offset_m: float = 0.0, heading_rad: float = 0.0) -> SE2:
        """World pose at arc length `s_m`, `offset_m` left of the centerline, turned left of it by `heading_rad`."""
        x_m, y_m = self.centerline.offset_position(s_m, offset_m)
        return SE2(float(x_m), float(y_m), math.remainder(float(self.centerline.heading(s_m)) + heading_rad, math.tau))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Obstacle:
    """An upright prism on the floor: its outline (n, 2) [m] in the world frame, anticlockwise and convex.

    `grey` is the brightness of its lit faces, 0 .. 255. It stands `base_m` above the floor.
    """

    polygon_m: FloatArray
    height_m: float
    grey: int
    base_m: float = 0.0

    def __post_init__(self) -> None:
        polygon = np.array(self.polygon_m, dtype=np.float64)
        polygon.flags.writeable = False
        object.__setattr__(self, "polygon_m", polygon)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Track:
    """A road with its markings and surroundings in the world frame.

    `road` is the reference line in the middle of the road; forward is its direction, and traffic keeps right. `floor`
    is (x0, y0, x1, y1) [m]; `start` is the pose of the car's rear axle at the start, on the lane of `start_direction`.
    `roadside` is the asphalt and the kerbs of a circuit; it is empty for a plain floor.
    """

    name: str
    road: Curve
    forward: Lane
    reverse: Lane
    floor: tuple[float, float, float, float]
    start: SE2
    start_direction: str = "forward"
    obstacles: tuple[Obstacle, ...] = ()
    crossings: tuple[RoadCrossing, ...] = ()
    painted: tuple[Paint, ...] = ()
    roadside: tuple[Paint, ...] = ()

    @property
    def closed(self) -> bool:
        """Whether the road returns to its start."""
        return self.road.closed

    def lane(self, direction: str = "forward", index: int = 0) -> Lane:
        """The lane `index` of a direction, 0 being the rightmost; raises ValueError if it does not exist."""
        lanes = self.lanes(direction)
        if not 0 <= index < len(lanes):
            raise ValueError(f"index: {index}, but {self.name} has {len(lanes)} {direction} lane(s)")
        return lanes[index]

    def lanes(self, direction: str = "forward") -> tuple[Lane, ...]:
        """The lanes of a direction, "forward" or "reverse", the rightmost first."""
        if direction not in ("forward", "reverse"):
            raise ValueError(f"direction: expected forward or reverse, got {direction!r}")
        return (self.forward,) if direction == "forward" else (self.reverse,)

    def paint(self) -> tuple[Paint, ...]:
        """Everything painted on the ground."""
        return self.painted


def lane_between(road: Curve, width_m: Callable[[ArrayLike], FloatArray]) -> Lane:
    """A lane around `road` whose width [m] is a function of the road's arc length; ValueError if an edge folds back."""
    left, right = OffsetCurve(road, lambda s: 0.5 * width_m(s)), OffsetCurve(road, lambda s: -0.5 * width_m(s))
    return Lane(centerline=road, left=left, right=right, width_m=width_m)


def constant(width_m: float) -> Callable[[ArrayLike], FloatArray]:
    """A constant lane width as a function of arc length."""
    return lambda s_m: np.full(np.shape(s_m), width_m)


def reversed_lane(lane: Lane) -> Lane:
    """The same lane driven in the opposite direction."""
    length_m = lane.centerline.length_m
    return Lane(
        centerline=ReversedCurve(lane.centerline),
        left=ReversedCurve(lane.right),
        right=ReversedCurve(lane.left),
        width_m=lambda s_m: lane.width_m(length_m - np.asarray(s_m, dtype=np.float64)),
    )
