"""The simulated world's ground: a road, its lanes, what is painted on it and what stands on it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from automodel.config.toml_reader import ConfigError, read_text, where
from automodel.curves import Curve, OffsetCurve, ReversedCurve
from automodel.geometry import SE2
from automodel.sim.paint import Paint, RoadCrossing, find_crossings, paint_road
from automodel.sim.roadside import build_roadside
from automodel.sim.track_reading import read_track
from automodel.sim.track_sections import Box, LaneWidth, TrackFile
from automodel.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lane:
    """One lane in the direction in which it is driven; the lines are the middles of the painted markings.

    `width_m(s)` is the distance between the two lines [m] at arc length s of the centerline (vectorised).
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
    """Something upright on the floor: its outline (n, 2) [m] in the world frame, anticlockwise."""

    polygon_m: FloatArray
    height_m: float
    grey: int

    def __post_init__(self) -> None:
        polygon = np.array(self.polygon_m, dtype=np.float64)
        polygon.flags.writeable = False
        object.__setattr__(self, "polygon_m", polygon)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Track:
    """A road and what belongs to it, world frame.

    `road` is the reference line, the middle of the road; traffic keeps right, forward is its direction. `floor` is
    (x0, y0, x1, y1) [m]; `start` is the pose of the car's rear axle at the start, on the lane of `start_direction`.
    `roadside` is the asphalt and the kerbs of a circuit; empty where the floor is one piece.
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
        """Whether the road comes back to its beginning."""
        return self.road.closed

    def lane(self, direction: str = "forward", index: int = 0) -> Lane:
        """The lane `index` of a direction, 0 the rightmost; raises ValueError where there is none."""
        lanes = self.lanes(direction)
        if not 0 <= index < len(lanes):
            raise ValueError(f"index: {index}, but {self.name} has {len(lanes)} {direction} lane(s)")
        return lanes[index]

    def lanes(self, direction: str = "forward") -> tuple[Lane, ...]:
        """The lanes of a direction, "forward" or "reverse", the rightmost first."""
        if direction not in ("forward", "reverse"):
            raise ValueError(f"direction: {direction!r} where forward or reverse is wanted")
        return (self.forward,) if direction == "forward" else (self.reverse,)

    def paint(self) -> tuple[Paint, ...]:
        """Everything painted on the ground."""
        return self.painted


def load_track(path_or_name: str | Path) -> Track:
    """A shipped track by its name ("tmr"), a track file (.toml) or a race track's centreline (.csv).

    Raises ConfigError with the file, line, key and reason.
    """
    path = Path(path_or_name)
    if path.suffix == ".csv":
        from automodel.sim.racetrack import read_racetrack  # its splines import scipy, 0.3 s

        return read_racetrack(path)
    if path.suffix == ".toml":
        return parse_track(read_text(path), str(path))
    shipped = {
        Path(entry.name).stem: entry for entry in resources.files("tracks").iterdir() if entry.name.endswith(".toml")
    }
    entry = shipped.get(str(path_or_name))
    if entry is None:
        raise ConfigError(
            f"{path_or_name}: no such track; shipped are {', '.join(sorted(shipped))};"
            " of your own give the path of a .toml or .csv file"
        )
    return parse_track(entry.read_text(encoding="utf-8"), f"tracks/{entry.name}")


def parse_track(text: str, file: str) -> Track:
    """The track in the text of a track file; `file` is its name in errors. Raises ConfigError."""
    sections, road = read_track(text, file)
    try:
        forward, reverse, edges = _lanes(sections, road)
        roadside = _roadside(sections, road, forward)
        crossings = find_crossings(road, 0.25 * sections.lanes.half_road_m)
        painted = tuple(paint_road(sections, (edges[0], road, edges[1]), crossings))
    except ValueError as error:  # what only the whole road shows
        key = "broken" if str(error).startswith("share") else "widths"
        raise ConfigError(f"{where(text, file, (), key)}: {error}") from None
    start = sections.start
    lane = forward if start.direction == "forward" else reverse
    return Track(
        name=sections.name,
        road=road,
        forward=forward,
        reverse=reverse,
        floor=(sections.floor.x0_m, sections.floor.y0_m, sections.floor.x1_m, sections.floor.y1_m),
        start=lane.pose(start.s_m, start.offset_m, start.heading_rad),
        start_direction=start.direction,
        obstacles=tuple(_obstacle(box) for box in sections.obstacles),
        crossings=crossings,
        painted=painted,
        roadside=roadside,
    )


def _lanes(sections: TrackFile, road: Curve) -> tuple[Lane, Lane, tuple[Curve, Curve]]:
    """The forward and the reverse lane, and the road's left and right edge; ValueError where an edge folds back."""
    width_m, half_m = sections.lanes.width_m, sections.lanes.half_road_m
    if sections.widths:
        width = LaneWidth(sections.widths, road.length_m, road.closed)
        forward = lane_between(road, width)
        return forward, reversed_lane(forward), (forward.left, forward.right)
    left, right = OffsetCurve(road, half_m), OffsetCurve(road, -half_m)
    if sections.lanes.count == 2:
        middle = (OffsetCurve(road, -0.5 * width_m), OffsetCurve(road, 0.5 * width_m))
        forward = Lane(centerline=middle[0], left=road, right=right, width_m=constant(width_m))
        reverse = reversed_lane(Lane(centerline=middle[1], left=left, right=road, width_m=constant(width_m)))
    else:
        forward = Lane(centerline=road, left=left, right=right, width_m=constant(width_m))
        reverse = reversed_lane(forward)
    return forward, reverse, (left, right)


def _roadside(sections: TrackFile, road: Curve, forward: Lane) -> tuple[Paint, ...]:
    if sections.roadside is None:
        return ()
    width = forward.width_m if sections.lanes.count == 1 else constant(2.0 * sections.lanes.width_m)
    return build_roadside(road, width, sections.roadside, sections.markings.left.width_m)


def lane_between(road: Curve, width_m: Callable[[ArrayLike], FloatArray]) -> Lane:
    """A lane around `road` whose width [m] is a function of the road's arc length; ValueError where it folds back."""
    left, right = OffsetCurve(road, lambda s: 0.5 * width_m(s)), OffsetCurve(road, lambda s: -0.5 * width_m(s))
    return Lane(centerline=road, left=left, right=right, width_m=width_m)


def constant(width_m: float) -> Callable[[ArrayLike], FloatArray]:
    """A lane's width that is the same everywhere."""
    return lambda s_m: np.full(np.shape(s_m), width_m)


def reversed_lane(lane: Lane) -> Lane:
    """The same strip of ground driven the other way."""
    length_m = lane.centerline.length_m
    return Lane(
        centerline=ReversedCurve(lane.centerline),
        left=ReversedCurve(lane.right),
        right=ReversedCurve(lane.left),
        width_m=lambda s_m: lane.width_m(length_m - np.asarray(s_m, dtype=np.float64)),
    )


def _obstacle(box: Box) -> Obstacle:
    half = 0.5 * np.array([box.length_m, box.width_m])
    corners = half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    outline = SE2(box.x_m, box.y_m, box.heading_rad).apply(corners)
    return Obstacle(polygon_m=outline, height_m=box.height_m, grey=box.grey)
