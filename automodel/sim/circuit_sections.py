"""The sections of a track file that real circuits need: a width that changes, broken lines, the ground beside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from automodel.config.toml_reader import not_negative, positive
from automodel.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class WidthAt:
    """The width of a single lane at `s_m` of the reference line; in between it changes smoothly."""

    s_m: float
    width_m: float

    def __post_init__(self) -> None:
        not_negative(self, "s_m")
        positive(self, "width_m")


@dataclass(frozen=True, slots=True, kw_only=True)
class BrokenLines:
    """Stretches over which an edge line has gone, drawn from a seed.

    `share` of either line is missing, in pieces from `shortest_m` to `longest_m` long, at times on both sides at once.
    """

    share: float = 0.07
    shortest_m: float = 2.0
    longest_m: float = 15.0
    seed: int = 0

    def __post_init__(self) -> None:
        positive(self, "share", "shortest_m")
        not_negative(self, "seed")
        if self.share > 0.3:
            raise ValueError(f"share: {self.share} where 0.3 at most is wanted")
        if self.longest_m < self.shortest_m:
            raise ValueError(f"longest_m: {self.longest_m} is less than shortest_m")


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadsideSection:
    """The ground beside a track.

    `asphalt_m` of asphalt lie outside the edge lines' middles; what is further out has the surroundings' colour. Bends
    sharper than `kerb_radius_m` have a kerb of red and white blocks, `block_m` long, on their inside, and over
    `kerb_exit_m` after them on their outside.
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
    """The width [m] at arc length s of a reference line `length_m` long, through given places; constant in slope there.

    Between two places it follows a step of the fifth degree, so that the edges' curvature does not jump. On a closed
    line the last place leads on to the first; on an open one the end values go on.
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
