"""Line initialisation: the nearest visible piece of the lane's two lines, from one binary bird's-eye view.

The histogram initialisation of Cudrano et al. 2020, section IV, generalised to arcs: histograms of the near part's
pixels are taken over several directions and curvatures.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from automodel.geometry import View
from automodel.types import Bools, Float32Array, FloatArray, Image, Ints


@dataclass(frozen=True, slots=True)
class LineStart:
    """The nearest visible piece of a line: a point (x, y) [m], body frame; direction and curvature there."""

    point_m: tuple[float, float]
    direction_rad: float
    curvature_per_m: float = 0.0


class _Arcs:
    """Arcs through one body point (x, 0) [m]: their directions (a,) there, and their curvatures (a,)."""

    def __init__(self, x_m: float, directions_rad: FloatArray, curvatures_per_m: FloatArray) -> None:
        self.x_m, self.directions_rad, self.curvatures_per_m = x_m, directions_rad, curvatures_per_m

    def select(self, which: Bools) -> _Arcs:
        """The arcs where `which` (a,) is True."""
        return _Arcs(self.x_m, self.directions_rad[which], self.curvatures_per_m[which])

    def relative(self, points_m: FloatArray) -> tuple[Float32Array, Float32Array]:
        """Body points (n, 2) relative to each arc, (a, n) [m]: along its tangent, and distance to its left.

        The distance is infinite for points beyond the arc's centre.
        """
        cos, sin = (f(self.directions_rad)[:, None].astype(np.float32) for f in (np.cos, np.sin))
        x, y = (points_m - np.array([self.x_m, 0.0])).T.astype(np.float32)
        along, left = cos * x + sin * y, cos * y - sin * x
        across = left.copy()
        curved = self.curvatures_per_m != 0.0
        kappa = self.curvatures_per_m[curved, None].astype(np.float32)
        out = 1.0 - kappa * left[curved]
        across[curved] = np.where(out > 0.0, (1.0 - np.hypot(kappa * along[curved], out)) / kappa, np.float32(np.inf))
        return along, across

    def headings_rad(self, x_m: float) -> FloatArray:
        """Directions (a,) of the lines parallel to each arc through the body point (x, 0) [m]."""
        ahead = x_m - self.x_m
        along, left = np.cos(self.directions_rad) * ahead, -np.sin(self.directions_rad) * ahead
        return self.directions_rad + np.arctan2(self.curvatures_per_m * along, 1.0 - self.curvatures_per_m * left)

    def point(self, arc: int, along_m: float, across_m: float) -> tuple[float, float, float]:
        """The body point (x, y) [m] and the direction [rad] on a parallel of an arc; inverse of `relative`."""
        direction, kappa = float(self.directions_rad[arc]), float(self.curvatures_per_m[arc])
        out = math.sqrt(max((1.0 - kappa * across_m) ** 2 - (kappa * along_m) ** 2, 0.0))
        left = (1.0 - out) / kappa if kappa else across_m
        cos, sin = math.cos(direction), math.sin(direction)
        turn = math.atan2(kappa * along_m, out)
        return self.x_m + cos * along_m - sin * left, sin * along_m + cos * left, direction + turn


class _Line(NamedTuple):
    """A parallel of an arc: its histogram bin, its place left of the car and its length in lane widths, and what a fit
    corrects of it: lateral place [m], slope, and half the curvature [1/m]."""

    peak: int
    lateral: float
    score: float
    correction: tuple[float, float, float]


class LineInitialisation:
    """Finds the pair of lines left and right of the car about a lane width apart, else one line.

    The near part's pixels are sorted by their distance from arcs of several directions and curvatures. All lines of a
    road are parallel, so the arc with the sharpest histogram gives the road's course; its peaks are the lines. A bin
    counts the length along which a line is visible (dashes count, a blob does not), less what lies close beside it.
    """

    NEAR_LANES = 2.0  # depth of the near part
    DIRECTION_RAD, DIRECTIONS = math.radians(60.0), 13  # at the near part's middle: the largest, and how many are tried
    CURVATURE, CURVATURES = 0.5, 5  # there, in 1 / lane width: likewise
    HALF_LANES = 1.6  # lateral reach to each side, at the near part's middle
    CELL_LANES = 0.15  # length of the pieces along the arc, each of which counts once
    WIDTH_TOLERANCE = 0.35  # of a pair, in lane widths
    NEAREST, FARTHEST = 0.02, 0.9  # distances of a line from the reference point, in lane widths
    MAX_HEADING_RAD = math.radians(50.0)  # at the reference point
    PAIR_LANES = 0.3  # minimum length of each line of a pair; a single one has as much as both
    AREA = 2.2  # markings: what is as large as this in both directions is no line
    BARS = 0.6  # lane widths: largest spacing of a zebra's bars
    MAX_PIXELS = 500

    def __init__(self, view: View, lane_width_m: float, marking_width_m: float, reference_x_m: float = 0.0) -> None:
        self.view, self._lane_m = view, lane_width_m
        depth = min(self.NEAR_LANES * lane_width_m, view.x_far_m - view.x_near_m)
        self._first_row = max(view.height_px - round(depth / view.m_per_row), 0)
        self._bin_m = 0.5 * marking_width_m
        self._bins = 2 * math.ceil(self.HALF_LANES * lane_width_m / self._bin_m)
        self._cell_m = self.CELL_LANES * lane_width_m
        self._cells = 2 * math.ceil(0.65 * depth / self._cell_m)
        self._cell_px = 0.6 * self._cell_m * self._bin_m / (view.m_per_px * view.m_per_row)  # pixels of a full cell
        sides = [2 * round(0.5 * self.AREA * marking_width_m / m) + 1 for m in (view.m_per_row, view.m_per_px)]
        self._area = np.ones(sides, np.uint8)
        self._places: FloatArray = np.arange(0.5 - 0.5 * self._bins, 0.5 * self._bins) * self._bin_m
        bend = self.CURVATURE / lane_width_m
        directions, kappas = np.meshgrid(
            np.linspace(-self.DIRECTION_RAD, self.DIRECTION_RAD, self.DIRECTIONS),
            np.linspace(-bend, bend, self.CURVATURES),
            indexing="ij",
        )
        arcs = _Arcs(view.x_near_m + 0.5 * depth, directions.ravel(), kappas.ravel())
        self._arcs = arcs.select(np.abs(arcs.headings_rad(reference_x_m)) <= self.MAX_HEADING_RAD)
        heading = np.abs(self._arcs.headings_rad(reference_x_m))
        self._reference_along, reference = self._arcs.relative(np.array([[reference_x_m, 0.0]]))
        self._lateral = (self._places - reference) / lane_width_m  # (arcs, bins) of the line, in lane widths
        # Among equals the straightest arc wins.
        self._weight = 1.0 - 0.1 * heading - 0.2 * np.abs(self._arcs.curvatures_per_m) * lane_width_m

    def step(self, features: Image) -> tuple[LineStart | None, LineStart | None]:
        """The starts of the left and the right line in a binary view (h, w), None for a line that is not found."""
        near = features[self._first_row :]
        found = cv2.findNonZero(cv2.subtract(near, cv2.morphologyEx(near, cv2.MORPH_OPEN, self._area)))
        if found is None:
            return None, None
        pixels = found.reshape(-1, 2)  # OpenCV 4 gives (n, 1, 2), OpenCV 5 (n, 2)
        thinning = 1 + len(pixels) // self.MAX_PIXELS
        points = self.view.to_body(pixels[::thinning] + np.array([0, self._first_row]))
        coverage = self._coverage(points, thinning)
        score = self._score(coverage)
        arc = int(((score**2).sum(axis=1) * self._weight).argmax())
        peaks = np.flatnonzero((score[arc] >= np.roll(score[arc], 1)) & (score[arc] > np.roll(score[arc], -1)))
        peaks = peaks[score[arc, peaks] >= self.PAIR_LANES]
        if len(peaks) == 0:
            return None, None
        every = self._lines(points, arc, peaks, score[arc, peaks])
        lines = [line for line in every if not self._is_bar(line, every)]
        chosen = self._pair(lines) or self._single(lines)
        left, right = (None if line is None else self._start(arc, line, coverage) for line in chosen)
        return left, right

    def _lines(self, points_m: FloatArray, arc: int, peaks: Ints, score: Float32Array) -> list[_Line]:
        """The lines at an arc's peaks, refined by a least-squares fit of their pixels.

        Directions and curvatures are tried in coarse steps. The fit corrects one slope and one curvature for all
        lines, and the lateral place of each.
        """
        one = np.zeros(len(self._weight), np.bool_)
        one[arc] = True
        along, across = (a[0].astype(np.float64) for a in self._arcs.select(one).relative(points_m))
        off = across[:, None] - self._places[peaks]
        nearest = np.abs(off).argmin(axis=1)
        off = off[np.arange(len(off)), nearest]
        near = np.abs(off) <= 2.5 * self._bin_m
        along, off, nearest = along[near], off[near], nearest[near]
        sigma = 0.5 * self._bin_m
        matrix = np.zeros((len(along) + 2, 2 + len(peaks)))
        matrix[:-2, 0], matrix[:-2, 1] = along, along**2
        matrix[np.arange(len(along)), 2 + nearest] = 1.0
        matrix[-2, 0], matrix[-1, 1] = sigma / 0.1, sigma * self._lane_m / 0.08  # prior: the errors of coarse steps
        solution = np.linalg.lstsq(matrix, np.append(off, (0.0, 0.0)), rcond=None)[0].tolist()
        back, (slope, bend, *laterals) = float(self._reference_along[arc, 0]), solution
        return [
            _Line(
                peak,
                float(self._lateral[arc, peak]) + (lateral + (slope + bend * back) * back) / self._lane_m,
                float(length),
                (lateral, slope, bend),
            )
            for peak, length, lateral in zip(peaks.tolist(), score, laterals, strict=True)
        ]

    def _coverage(self, points_m: FloatArray, thinning: int) -> Float32Array:
        """How far each piece of each line is covered (arcs, cells, bins), 0 .. 1."""
        along, across = self._arcs.relative(points_m)
        cell = along / np.float32(self._cell_m) + np.float32(self._cells // 2)
        place = across / np.float32(self._bin_m) + np.float32(self._bins // 2)
        inside = (cell >= 0.0) & (cell < self._cells) & (place >= 0.0) & (place < self._bins)
        arc = np.nonzero(inside)[0]
        index = (arc * self._cells + cell[inside].astype(np.int32)) * self._bins + place[inside].astype(np.int32)
        shape = (len(cell), self._cells, self._bins)
        counts = np.bincount(index, minlength=math.prod(shape)).reshape(shape).astype(np.float32)
        smooth = counts.copy()
        smooth[..., 1:] += 0.5 * counts[..., :-1]
        smooth[..., :-1] += 0.5 * counts[..., 1:]
        return np.minimum(smooth * np.float32(thinning / self._cell_px), np.float32(1.0))

    def _score(self, coverage: Float32Array) -> Float32Array:
        """The length of each line (arcs, bins) [lane widths], less what lies one and two markings beside it."""
        length = coverage.sum(axis=1) * np.float32(self.CELL_LANES)
        padded = np.pad(length, ((0, 0), (4, 4)))
        right, left = np.minimum(padded[:, 2:-6], padded[:, :-8]), np.minimum(padded[:, 6:-2], padded[:, 8:])
        return np.maximum(length - np.maximum(left, right), np.float32(0.0))

    def _is_bar(self, line: _Line, every: list[_Line]) -> bool:
        """Whether others lie close by on both sides: a zebra's bars."""
        beside = [other.lateral - line.lateral for other in every]
        return any(0.0 < d < self.BARS for d in beside) and any(-self.BARS < d < 0.0 for d in beside)

    def _pair(self, lines: list[_Line]) -> tuple[_Line, _Line] | None:
        """The two lines on both sides of the car, about a lane width apart."""
        best, found = 0.0, None
        for left, right in itertools.permutations(lines, 2):
            width = left.lateral - right.lateral
            between = left.lateral >= self.NEAREST and right.lateral <= -self.NEAREST
            if between and abs(width - 1.0) <= self.WIDTH_TOLERANCE:
                both = min(left.score, 2.0 * right.score) + min(right.score, 2.0 * left.score)
                if both * (1.0 - abs(width - 1.0)) > best:
                    best, found = both * (1.0 - abs(width - 1.0)), (left, right)
        return found

    def _single(self, lines: list[_Line]) -> tuple[_Line | None, _Line | None]:
        """The line nearest to the car, of those at least 0.4 times as long as the longest."""
        near = [line for line in lines if self.NEAREST <= abs(line.lateral) <= self.FARTHEST]
        longest = max((line.score for line in near), default=0.0)
        if longest < 2.0 * self.PAIR_LANES:
            return None, None
        line = min((line for line in near if line.score >= 0.4 * longest), key=lambda line: abs(line.lateral))
        return (line, None) if line.lateral > 0.0 else (None, line)

    def _start(self, arc: int, line: _Line, coverage: Float32Array) -> LineStart:
        """The nearest covered piece of a line."""
        cell = int(np.flatnonzero(coverage[arc, :, line.peak] >= 0.5)[0])
        along = (cell + 0.5 - self._cells // 2) * self._cell_m
        lateral, slope, bend = line.correction
        across = float(self._places[line.peak]) + lateral + (slope + bend * along) * along
        x, y, direction = self._arcs.point(arc, along, across)
        kappa = float(self._arcs.curvatures_per_m[arc])
        curvature = kappa / (1.0 - kappa * across) + 2.0 * bend
        return LineStart((x, y), direction + math.atan(slope + 2.0 * bend * along), curvature)
