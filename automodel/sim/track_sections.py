"""The sections of a track file; every value is checked on its own (tracks/README.md describes the schema)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from automodel.config.toml_reader import not_negative, one_of, positive
from automodel.curves import Curve, arc, clothoid, line
from automodel.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class WidthAt:
    """The width of a single lane at `s_m` of the reference line; between two places it changes smoothly."""

    s_m: float
    width_m: float

    def __post_init__(self) -> None:
        not_negative(self, "s_m")
        positive(self, "width_m")


@dataclass(frozen=True, slots=True, kw_only=True)
class BrokenLines:
    """Random stretches without an edge line.

    `share` of each line is missing, in stretches from `shortest_m` to `longest_m` long, some on both sides at once.
    """

    share: float = 0.07
    shortest_m: float = 2.0
    longest_m: float = 15.0
    seed: int = 0

    def __post_init__(self) -> None:
        positive(self, "share", "shortest_m")
        not_negative(self, "seed")
        if self.share > 0.3:
            raise ValueError(f"share: expected at most 0.3, got {self.share}")
        if self.longest_m < self.shortest_m:
            raise ValueError(f"longest_m: {self.longest_m} is less than shortest_m")


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadsideSection:
    """The ground beside a track.

    The asphalt extends `asphalt_m` beyond the centres of the edge lines. Bends sharper than `kerb_radius_m` have a kerb
    of red and white blocks, `block_m` long, on the inside, and on the outside over `kerb_exit_m` after the bend.
    """

    asphalt_m: float = 0.6
    kerb_radius_m: float = 90.0
    kerb_width_m: float = 1.0
    kerb_exit_m: float = 15.0
    block_m: float = 1.0

    def __post_init__(self) -> None:
        not_negative(self, "asphalt_m", "kerb_radius_m", "kerb_exit_m")
        positive(self, "kerb_width_m", "block_m")


class LaneWidth:
    """The width [m] at arc length s of a reference line of length `length_m`, interpolated between given places.

    The interpolation is a step of the fifth degree, so that the curvature of the edges is continuous. A closed line is
    interpolated from the last place to the first; on an open one the end values are constant.
    """

    def __init__(self, places: tuple[WidthAt, ...], length_m: float, closed: bool) -> None:
        s = np.array([place.s_m for place in places])
        width = np.array([place.width_m for place in places])
        if (np.diff(s) <= 0.0).any():
            raise ValueError("s_m: must rise from place to place")
        self._length_m, self._closed = length_m, closed
        if closed:
            s = np.concatenate((s[-1:] - length_m, s, s[:1] + length_m))
            width = np.concatenate((width[-1:], width, width[:1]))
        self._s, self._width = s, width

    def __call__(self, s_m: ArrayLike) -> FloatArray:
        """Width (...,) [m]."""
        s = np.asarray(s_m, dtype=np.float64)
        s = s % self._length_m if self._closed else np.clip(s, self._s[0], self._s[-1])
        if len(self._s) == 1:
            return np.full(s.shape, self._width[0])
        i = np.clip(np.searchsorted(self._s, s, side="right") - 1, 0, len(self._s) - 2)
        t = (s - self._s[i]) / (self._s[i + 1] - self._s[i])
        step = t * t * t * (10.0 + t * (6.0 * t - 15.0))
        return np.asarray(self._width[i] + step * (self._width[i + 1] - self._width[i]))


STYLES = ("solid", "dashed", "none")
COLOURS = ("white", "yellow")
DIRECTIONS = ("forward", "reverse")
LINES = ("left", "centre", "right")


@dataclass(frozen=True, slots=True, kw_only=True)
class FloorSection:
    """The floor's rectangle in the world frame."""

    x0_m: float
    y0_m: float
    x1_m: float
    y1_m: float

    def __post_init__(self) -> None:
        if not self.x1_m > self.x0_m:
            raise ValueError(f"x1_m: expected more than x0_m = {self.x0_m}, got {self.x1_m}")
        if not self.y1_m > self.y0_m:
            raise ValueError(f"y1_m: expected more than y0_m = {self.y0_m}, got {self.y1_m}")


@dataclass(frozen=True, slots=True, kw_only=True)
class OriginSection:
    """The start of the road's reference line, and its direction there."""

    x_m: float = 0.0
    y_m: float = 0.0
    heading_rad: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LanesSection:
    """One lane driven both ways, or two lanes in right-hand traffic."""

    count: int = 2
    width_m: float = 0.40

    def __post_init__(self) -> None:
        if self.count not in (1, 2):
            raise ValueError(f"count: expected 1 or 2, got {self.count}")
        positive(self, "width_m")

    @property
    def half_road_m(self) -> float:
        """From the reference line to the road's edge."""
        return 0.5 * self.count * self.width_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Marking:
    """The paint of one line; `dash_m` and `gap_m` apply to the dashed style."""

    style: str
    width_m: float = 0.03
    dash_m: float = 0.20
    gap_m: float = 0.20
    colour: str = "white"

    def __post_init__(self) -> None:
        one_of("style", self.style, STYLES)
        one_of("colour", self.colour, COLOURS)
        positive(self, "width_m", "dash_m", "gap_m")


@dataclass(frozen=True, slots=True, kw_only=True)
class MarkingsSection:
    """The road's lines, named as seen in the direction of the reference line."""

    left: Marking = field(default_factory=lambda: Marking(style="solid"))
    centre: Marking = field(default_factory=lambda: Marking(style="dashed"))
    right: Marking = field(default_factory=lambda: Marking(style="solid"))


@dataclass(frozen=True, slots=True, kw_only=True)
class ZebraPattern:
    """Bars along the road, side by side across it, at `distance_m` from the edge of the crossing road."""

    bar_width_m: float = 0.05
    bar_gap_m: float = 0.05
    length_m: float = 0.20
    distance_m: float = 0.05
    colour: str = "white"

    def __post_init__(self) -> None:
        positive(self, "bar_width_m", "bar_gap_m", "length_m")
        not_negative(self, "distance_m")
        one_of("colour", self.colour, COLOURS)


@dataclass(frozen=True, slots=True, kw_only=True)
class CrossingsSection:
    """The paint where the road crosses itself."""

    interrupt_lines: bool = True
    zebra: ZebraPattern | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class StopLine:
    """A bar across the lane of one direction, centred at `s_m` of the reference line."""

    s_m: float
    direction: str = "forward"
    width_m: float = 0.04
    colour: str = "white"

    def __post_init__(self) -> None:
        positive(self, "width_m")
        one_of("direction", self.direction, DIRECTIONS)
        one_of("colour", self.colour, COLOURS)


@dataclass(frozen=True, slots=True, kw_only=True)
class Gap:
    """A stretch of the reference line on which the named lines are not painted."""

    from_m: float
    to_m: float
    lines: tuple[str, ...] = LINES

    def __post_init__(self) -> None:
        not_negative(self, "from_m")
        if not self.to_m > self.from_m:
            raise ValueError(f"to_m: expected more than from_m = {self.from_m}, got {self.to_m}")
        for name in self.lines:
            if name not in LINES:
                raise ValueError(f"lines: expected some of {', '.join(LINES)}, got {name!r}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Box:
    """A box on the floor; its centre and direction in the world frame."""

    x_m: float
    y_m: float
    heading_rad: float = 0.0
    length_m: float = 0.20
    width_m: float = 0.20
    height_m: float = 0.20
    grey: int = 200

    def __post_init__(self) -> None:
        positive(self, "length_m", "width_m", "height_m")
        if not 0 <= self.grey <= 255:
            raise ValueError(f"grey: expected 0 .. 255, got {self.grey}")


@dataclass(frozen=True, slots=True, kw_only=True)
class StartSection:
    """The start of the car's rear axle on the lane of `direction`: arc length on that lane and offset to the left."""

    direction: str = "forward"
    s_m: float = 0.0
    offset_m: float = 0.0
    heading_rad: float = 0.0

    def __post_init__(self) -> None:
        one_of("direction", self.direction, DIRECTIONS)


@dataclass(frozen=True, slots=True, kw_only=True)
class LinePiece:
    """A straight piece."""

    length_m: float

    def __post_init__(self) -> None:
        positive(self, "length_m")

    @property
    def sharpest_per_m(self) -> float:
        """The largest absolute curvature."""
        return 0.0

    def curve(self, x_m: float, y_m: float, heading_rad: float) -> Curve:
        """The piece from a start pose."""
        return line(x_m, y_m, heading_rad, self.length_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class ArcPiece:
    """A circular piece; it turns left where `turn_rad` is positive."""

    radius_m: float
    turn_rad: float

    def __post_init__(self) -> None:
        positive(self, "radius_m")
        if self.turn_rad == 0:
            raise ValueError("turn_rad: expected a turn, positive to the left, got 0; a straight piece is a line")

    @property
    def sharpest_per_m(self) -> float:
        """The largest absolute curvature."""
        return 1.0 / self.radius_m

    def curve(self, x_m: float, y_m: float, heading_rad: float) -> Curve:
        """The piece from a start pose."""
        curvature = math.copysign(1.0 / self.radius_m, self.turn_rad)
        return arc(x_m, y_m, heading_rad, curvature, abs(self.turn_rad) * self.radius_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class ClothoidPiece:
    """A piece whose curvature changes linearly, positive to the left."""

    start_per_m: float
    end_per_m: float
    length_m: float

    def __post_init__(self) -> None:
        positive(self, "length_m")

    @property
    def sharpest_per_m(self) -> float:
        """The largest absolute curvature."""
        return max(abs(self.start_per_m), abs(self.end_per_m))

    def curve(self, x_m: float, y_m: float, heading_rad: float) -> Curve:
        """The piece from a start pose."""
        return clothoid(x_m, y_m, heading_rad, self.start_per_m, self.end_per_m, self.length_m)


Piece = LinePiece | ArcPiece | ClothoidPiece
PIECES: dict[str, type[LinePiece] | type[ArcPiece] | type[ClothoidPiece]] = {
    "line": LinePiece,
    "arc": ArcPiece,
    "clothoid": ClothoidPiece,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackFile:
    """The contents of a track file; every value is checked on its own."""

    name: str
    closed: bool
    floor: FloorSection
    origin: OriginSection = field(default_factory=OriginSection)
    lanes: LanesSection = field(default_factory=LanesSection)
    markings: MarkingsSection = field(default_factory=MarkingsSection)
    crossings: CrossingsSection = field(default_factory=CrossingsSection)
    start: StartSection = field(default_factory=StartSection)
    broken: BrokenLines | None = None
    roadside: RoadsideSection | None = None
    widths: tuple[WidthAt, ...] = ()
    stop_lines: tuple[StopLine, ...] = ()
    gaps: tuple[Gap, ...] = ()
    obstacles: tuple[Box, ...] = ()
