"""Where lines were seen: what was seen before is no new witness.

What moves a line's points aside, worn paint or a lamp, moves them again when the same place is seen again soon; a place
that comes into view is a new witness.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np

from automodel.compiled import compiled
from automodel.geometry import SE2
from automodel.perception.line_scan import SightedLine
from automodel.tracking.belief import RoadModel
from automodel.types import FloatArray, Ints


class SeenPlaces:
    """Where lines were seen, and how far the car has driven since; places closer than `same_lanes` are one."""

    def __init__(self, same_lanes: float) -> None:
        warm_up()
        self._same_lanes = same_lanes
        self._points, self._ways = np.empty((0, 2)), np.empty(0)  # of all lines, each from near to far; lane widths
        self._lines = np.empty(0, np.int64)  # to which the points belong
        self._way: float | None = None  # since the last frame, once it is not known where its places are now

    def move(self, distance_m: float, turn_rad: float, way: float, known: bool) -> None:
        """The car has moved, by so many lane widths as far as news are concerned."""
        self._ways = self._ways + way
        if self._way is not None:
            self._way += way
        elif known:
            self._points = SE2.arc(distance_m, turn_rad).inverse().apply(self._points)
        elif len(self._ways):
            self._way = float(self._ways.min())

    def see(self, lines: Sequence[SightedLine], road: RoadModel) -> list[float]:
        """The share of each of a frame's lines that is news, 0 .. 1."""
        if self._way is not None:
            share, self._way = min(self._way / road.news, 1.0), 0.0
            return [share] * len(lines)
        recent = self._ways < road.news
        points, ways, numbers = self._points[recent], self._ways[recent], self._lines[recent]
        since, reach_m, news = ways.copy(), self._same_lanes * road.lane_width_m, []
        fresh, first = [(points, since, numbers)], int(numbers.max(initial=0)) + 1
        for line in lines:
            again = seen_again(line.points_m.copy(), points, ways, numbers, since, reach_m)
            news.append(float(np.minimum(again / road.news, 1.0).mean()))
            if not np.isfinite(again).all():  # it goes on where none was seen
                fresh.append((line.points_m, np.zeros(len(again)), np.full(len(again), first)))
                first += 1
        self._points, self._ways, self._lines = (np.concatenate(each) for each in zip(*fresh, strict=True))
        return news


@compiled
def seen_again(
    points: FloatArray, places: FloatArray, ways: FloatArray, lines: Ints, since: FloatArray, reach_m: float
) -> FloatArray:
    """For each point (n, 2) of a line the way since its place was seen, infinite if it was not.

    Places (m, 2) are points of `lines` (m,), near to far, seen `ways` (m,) ago; `since` (m,) is set to 0 for those that
    are seen again.
    """
    again = np.full(len(points), np.inf)
    for k in range(len(places)):
        after = k + 1 if k + 1 < len(places) and lines[k + 1] == lines[k] else k
        along_x, along_y = places[after, 0] - places[k, 0], places[after, 1] - places[k, 1]
        square = along_x * along_x + along_y * along_y
        for i in range(len(points)):
            away_x, away_y = points[i, 0] - places[k, 0], points[i, 1] - places[k, 1]
            share = min(max((away_x * along_x + away_y * along_y) / square, 0.0), 1.0) if square > 0.0 else 0.0
            if math.hypot(away_x - share * along_x, away_y - share * along_y) < reach_m:
                again[i] = min(again[i], ways[k], ways[after])
                since[k if share < 0.5 else after] = 0.0
    return again


@functools.cache
def warm_up() -> None:
    """Compile what is compiled, or load it, before the first frame: a car that drives cannot wait for it."""
    one = np.zeros((1, 2))
    seen_again(one, one, np.zeros(1), np.zeros(1, np.int64), np.zeros(1), 1.0)
