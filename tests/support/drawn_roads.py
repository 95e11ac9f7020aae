"""Lines of roads for drawn views: lanes on arcs, crossings with corners, zebras, and where their lines truly lie."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from automodel.perception.windows.window_tracker import ExpectedLine
from tests.support.drawn_views import Shape

LANE_M, MARKING_M = 0.4, 0.03


@dataclass(frozen=True, kw_only=True)
class Road:
    """A lane whose centre leaves the body frame's (0, `aside_m`) with a heading, on an arc."""

    curvature_per_m: float = 0.0
    heading_rad: float = 0.0
    aside_m: float = 0.0

    def beside(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """How far points lie to the left of the lane's centre."""
        normal = (-math.sin(self.heading_rad), math.cos(self.heading_rad))
        left = x * normal[0] + (y - self.aside_m) * normal[1]
        if self.curvature_per_m == 0.0:
            return left
        radius = 1.0 / self.curvature_per_m
        centre = (radius * normal[0], self.aside_m + radius * normal[1])
        return np.sign(radius) * (abs(radius) - np.hypot(x - centre[0], y - centre[1]))

    def along(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Arc length of the points' feet on the lane's centre."""
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        ahead, left = x * cos + (y - self.aside_m) * sin, (y - self.aside_m) * cos - x * sin
        if self.curvature_per_m == 0.0:
            return ahead
        sign, radius = math.copysign(1.0, self.curvature_per_m), 1.0 / abs(self.curvature_per_m)
        return radius * np.arctan2(ahead, radius - sign * left)

    def line(self, d_m: float, width_m: float = MARKING_M) -> Shape:
        """A line `d_m` to the left of the lane's centre."""
        return lambda x, y: np.abs(self.beside(x, y) - d_m) <= 0.5 * width_m

    def dashed(self, d_m: float, dash_m: float, gap_m: float, from_m: float = 0.0) -> Shape:
        """A dashed line; dashes and gaps count along the lane's centre."""
        line = self.line(d_m)
        return lambda x, y: line(x, y) & ((self.along(x, y) - from_m) % (dash_m + gap_m) < dash_m)

    def expected(self, d_m: float, behind_m: float = 0.4, ahead_m: float = 2.6) -> ExpectedLine:
        """The line `d_m` to the left as a model would tell it, sampled along the lane's centre."""
        s = np.linspace(-behind_m, ahead_m, 60)
        bend = self.curvature_per_m
        if bend == 0.0:
            x, y, turn = s, np.full_like(s, d_m), np.zeros_like(s)
        else:
            x, y, turn = (
                (1.0 / bend - d_m) * np.sin(bend * s),
                (1.0 - (1.0 - bend * d_m) * np.cos(bend * s)) / bend,
                bend * s,
            )
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        points = np.stack((cos * x - sin * y, sin * x + cos * y + self.aside_m), axis=-1)
        return ExpectedLine(points_m=points, heading_rad=turn + self.heading_rad)


STRAIGHT = Road()


def within(shape: Shape, from_m: float, to_m: float) -> Shape:
    """The part of a shape from x to x."""
    return lambda x, y: shape(x, y) & (x >= from_m) & (x <= to_m)


def zebra(x_m: float, length_m: float = 0.2, shift_m: float = 0.0, bar_m: float = 0.05) -> Shape:
    """Bars along a straight road, as wide as the gaps between them; one lies at y = `shift_m`."""
    return lambda x, y: (x >= x_m) & (x <= x_m + length_m) & ((y - shift_m + 0.5 * bar_m) % (2.0 * bar_m) < bar_m)


def crossing(x_m: float, gap_m: float, corner_m: float) -> list[Shape]:
    """A straight lane's lines, broken by a crossing road into which they turn with corners of a radius."""
    shapes: list[Shape] = []
    for side in (1.0, -1.0):
        line = STRAIGHT.line(side * 0.5 * LANE_M)
        shapes += [within(line, -9.0, x_m - corner_m), within(line, x_m + gap_m + corner_m, 9.0)]
        for edge, away in ((x_m, -1.0), (x_m + gap_m, 1.0)):
            shapes.append(_across(edge, side, corner_m))
            if corner_m > 0.0:
                shapes.append(_corner(edge + away * corner_m, side, corner_m, away))
    return shapes


def _across(x_m: float, side: float, corner_m: float) -> Shape:
    return lambda x, y: (np.abs(x - x_m) <= 0.5 * MARKING_M) & (side * y >= 0.5 * LANE_M + corner_m - 0.5 * MARKING_M)


def _corner(x_m: float, side: float, radius_m: float, away: float) -> Shape:
    centre_y = side * (0.5 * LANE_M + radius_m)

    def painted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        ring = np.abs(np.hypot(x - x_m, y - centre_y) - radius_m) <= 0.5 * MARKING_M
        return ring & ((x - x_m) * away <= 0.0) & (side * (y - centre_y) <= 0.0)

    return painted
