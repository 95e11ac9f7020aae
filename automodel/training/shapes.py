"""What lies flat on the ground in a training picture: stripes along curves and filled outlines, in lane widths."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike

from automodel.types import FloatArray

UNKNOWN = 1  # in a mask: a marking is there, but the picture does not show it; neither answer is wrong


class Ink(IntEnum):
    """What a shape is made of; later ones lie over earlier ones."""

    ROADBED = 0  # not paint: where the road's own surface lies, the roadside elsewhere
    BAND = 1  # a faint change of the surface's tone: wheel tracks, oil, a shoulder
    DARK = 2  # tar, joints, tyre marks
    BRIGHT = 3  # kerbs, cables, paper, light joints
    SECOND_PAINT = 4
    PAINT = 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stripe:
    """A stripe along a polyline (n, 2) of the body frame.

    `half_width` is a number or one a point (n,); `pattern` alternates lengths of paint and of gap, empty for a solid
    stripe; `phase` is where in the pattern the first point lies. A `marking` is to be found, the rest is not;
    `label_pattern` is where, when that is not where the paint is (None).
    """

    points: FloatArray
    half_width: float | FloatArray
    ink: Ink
    pattern: tuple[float, ...] = ()
    phase: float = 0.0
    marking: bool = False
    strength: float = 1.0
    label_pattern: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patch:
    """Closed outlines, each (n, 2) of the body frame, filled by the even-odd rule; never a marking."""

    outlines: tuple[FloatArray, ...]
    ink: Ink
    strength: float = 1.0


class Ribbon:
    """A curve on the ground with its left normals: places (s, d) along and beside it in the body frame."""

    def __init__(self, s: FloatArray, points: FloatArray, heading_rad: FloatArray) -> None:
        self.s = s
        self.points = points
        self.heading_rad = heading_rad
        self._rows = np.column_stack((points, -np.sin(heading_rad), np.cos(heading_rad)))

    def place(self, s: ArrayLike, d: ArrayLike) -> FloatArray:
        """Ground points (n, 2) at `s` along the curve and `d` to its left."""
        along, across = np.broadcast_arrays(np.asarray(s, dtype=np.float64), np.asarray(d, dtype=np.float64))
        x, y, nx, ny = (np.interp(along, self.s, self._rows[:, k]) for k in range(4))
        return np.stack((x + across * nx, y + across * ny), axis=-1)

    def local(self, s: float, points: ArrayLike) -> FloatArray:
        """Ground points (n, 2) of points (along, left) in the straight frame that touches the curve at `s`."""
        p = np.asarray(points, dtype=np.float64)
        origin = self.place(s, 0.0)
        heading = float(np.interp(s, self.s, self.heading_rad))
        cos, sin = np.cos(heading), np.sin(heading)
        return np.asarray(origin + p @ np.array([[cos, sin], [-sin, cos]]))

    def between(self, start: float, end: float) -> FloatArray:
        """The curve's own samples from `start` to `end`, both ends included."""
        inner = self.s[(self.s > start) & (self.s < end)]
        return np.concatenate(([start], inner, [end]))


def dense(outline: ArrayLike, pieces: int = 4) -> FloatArray:
    """A closed outline (n, 2) with every edge cut into `pieces`, so that a bent lens shows it bent."""
    corners = np.asarray(outline, dtype=np.float64)
    following = np.roll(corners, -1, axis=0)
    t = np.arange(pieces)[:, None] / pieces
    return np.concatenate([a + (b - a) * t for a, b in zip(corners, following, strict=True)])


def box(s0: float, s1: float, d0: float, d1: float) -> FloatArray:
    """The outline of a rectangle in (along, left)."""
    return np.array([[s0, d0], [s1, d0], [s1, d1], [s0, d1]])
