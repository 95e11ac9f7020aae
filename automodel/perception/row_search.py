"""Where the nodes of a clothoid pair really lie: two short runs of image rows about each, and nothing else is read.

Only the model is projected into the picture, never the picture onto the ground. A node is a short piece of line: its
ridge is looked for on two rows, so that its direction is measured too, and what runs elsewhere (another road's line, a
reflection) is told from the line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from automodel.estimation.clothoid_pair import PairShape
from automodel.geometry.line_projection import LineProjection, ProjectedLine
from automodel.perception.ridges import BAR, LINE, MARGIN, PER_MARKING, Judged
from automodel.perception.row_ridges import RowRidges
from automodel.signals import Image

Floats = NDArray[np.floating[Any]]
FloatArray = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]


@dataclass(slots=True, eq=False)
class Sighting:
    """What one frame shows around a pair of n nodes a line.

    `nodes` (k,) are those that were looked for, of 2 n, the left line's first. `residual` (2 k,): how far to the left
    of them the line was found [m], and how far it is turned to the left of them [rad], where `found` (2 k,) is 1.
    `height` (k,): how far the ridges stand out.
    """

    nodes: Ints
    residual: Floats
    found: Floats
    height: Floats

    def points(self, shape: PairShape, carrying: Bools, half_m: float) -> tuple[FloatArray, FloatArray]:
        """The ridges (j, 2) [m] of `carrying` nodes (k,), left and right line's; lines lie `half_m` from `shape`."""
        mine = carrying.nonzero()[0]
        at, n = self.nodes.take(mine), len(shape.place)
        lefts = int(at.searchsorted(n))
        aside = self.residual.take(mine)
        aside[:lefts] += half_m
        aside[lefts:] -= half_m
        ridges = shape.place.take(at, mode="wrap") + shape.along.take(at, mode="wrap") * (1j * aside)
        points = ridges.astype(np.complex128, copy=False).view(np.float64).reshape(-1, 2)
        return points[:lefts], points[lefts:]


class RowSearch:
    """Looks for nodes at arc lengths `nodes_m` (n,) on each line in pictures of `size` (height, width) px.

    It remembers how far markings stand out, so that what is much fainter or brighter is not taken for one. `forget`
    drops that.
    """

    HALF_LENGTH = 0.5  # markings: half the way along the line between a node's two rows, a row apart at least
    FLATTEST = 6.0  # pixels across for one down: a line that lies flatter in the picture is not looked at
    TURN, SLACK = 0.4, 0.5  # how much a ridge may be turned [rad], and be torn (samples): else it is another line's
    FAINT, GLARING = 0.5, 2.5  # of the usual height: what stands out less is no paint, or more
    LEARN, FADE = 0.1, 0.02  # share a frame
    LINE_NODES, NEW_NODES = 2, 3  # fewer ridges than that make no line; one that was not seen in the frame before
    EDGE = 0.05  # of the picture's height: rows there are not read about a node, but for a node's second
    BESIDE = 0.1  # of the picture's width: how far outside it a node may lie and still be looked for

    def __init__(
        self, projection: LineProjection, ridges: RowRidges, nodes_m: Floats, marking_m: float, size: tuple[int, int]
    ) -> None:
        self._projection, self._ridges, self._count = projection, ridges, len(nodes_m)
        self._half_m, self._sample_m = self.HALF_LENGTH * marking_m, marking_m / PER_MARKING
        height, self._width = size
        self._margin = self.EDGE * height
        dtype = projection.dtype
        self._middle: Floats = np.array([[0.5 * (self._width - 1)], [0.5 * (height - 1)]], dtype)
        self._reach: Floats = np.array(
            [[(0.5 + self.BESIDE) * self._width], [0.5 * (height - 1) - self._margin]], dtype
        )
        self._ends: Floats = np.array([[1.0], [-1.0]], dtype)
        tear = np.diff(nodes_m, append=nodes_m[-1]) * (self.TURN / self._sample_m)
        tear[-1] = -1.0  # what comes next is the other line
        self._tear: Floats = np.tile(tear, 2).astype(dtype)
        self.forget()

    def forget(self, height: float = 0.0) -> None:
        """Forget how far markings stand out, or start anew with a `height` as `Judged` has it."""
        self._least = [self.LINE_NODES, self.LINE_NODES]
        self._usual = self._faint = 2.0 * height  # of a node's two ridges together

    def look(self, image: Image, shape: PairShape, width_m: float) -> Sighting:
        """The pair `shape` with lines `width_m` apart."""
        line = self._projection.project(shape.place, shape.along, 0.5 * width_m)
        nodes = self._in_picture(line)
        u, v, along_u, along_v, area = line.values.take(nodes, axis=1)
        slope = along_u / along_v
        down = np.minimum(along_v * self._half_m, -1.0)  # the further ahead, the higher up
        np.maximum(down, -self._margin, out=down)
        rows = np.rint(self._ends * down + v)
        step = area / along_v  # below 0: to the left
        step *= -self._sample_m
        first = rows * (slope + self._width)
        v *= slope
        u -= v
        first += u + 0.5
        ridges = self._ridges.find(image, first, step)
        middle = first[1] - rows[1] * self._width  # of the run that is nearer to the car
        middle -= 0.5 * self._width
        middle += step * ridges.place[len(nodes) :]
        inside = np.abs(middle) < step * MARGIN + 0.5 * self._width
        return self._judge(ridges, nodes, inside, down / along_v)

    def learn(self, sighting: Sighting, carrying: Bools) -> None:
        """Remember which lines are seen and how far the ridges of the nodes (k,) that carry the lane stand out."""
        count = int(np.count_nonzero(carrying))
        left = int(np.count_nonzero(carrying[: sighting.nodes.searchsorted(self._count)]))
        self._least = [self.LINE_NODES if seen >= self.LINE_NODES else self.NEW_NODES for seen in (left, count - left)]
        if count > self.LINE_NODES:
            height = float(carrying @ sighting.height) / count
            self._usual += (self.LEARN if self._usual > 0.0 else 1.0) * (height - self._usual)
            self._faint = self._usual
        else:
            self._faint *= 1.0 - self.FADE

    def _in_picture(self, line: ProjectedLine) -> Ints:
        """The nodes (k,) that can be looked for: they lie in the picture, and their line is steep there."""
        near, far = np.abs(line.place - self._middle) <= self._reach
        near &= far
        along_u, along_v = line.along
        near &= np.abs(along_u) < along_v * -self.FLATTEST
        return near.nonzero()[0]

    def _judge(self, ridges: Judged, nodes: Ints, inside: Bools, half_m: Floats) -> Sighting:
        """What is a line's: nodes (k,) `inside` the picture whose two ridges agree, next to another such node.

        The ridges (2 k,) lie `half_m` (k,) further ahead than the nodes, and as much nearer.
        """
        k, sample = len(nodes), self._sample_m
        far, near = ridges.place[:k], ridges.place[k:]
        mean, tilt = far + near, far - near
        mean *= 0.5
        tilt *= 0.5
        height = ridges.height[:k] + ridges.height[k:]
        both = ridges.flags[:, :k] & ridges.flags[:, k:]
        sound = np.abs(tilt) <= half_m * (self.TURN / sample) + self.SLACK
        sound &= ridges.height[:k] > 0.5 * self.FAINT * self._faint
        if self._usual > 0.0:
            sound &= height < self.GLARING * self._usual
        sound &= inside
        both &= sound
        mark = both[LINE]
        agree = np.abs(mean[1:] - mean[:-1]) < self._tear.take(nodes[:-1])
        agree &= mark[1:]
        agree &= mark[:-1]
        found = np.zeros((2, k), half_m.dtype)
        found[0, 1:] = agree
        np.maximum(found[0, :-1], agree, out=found[0, :-1])
        lefts = int(nodes.searchsorted(self._count))
        for side, least in zip((found[0, :lefts], found[0, lefts:]), self._least, strict=True):
            if np.count_nonzero(side) < least:
                side[:] = 0.0
        np.maximum(found[0], both[BAR], out=found[1])
        residual = np.empty((2, k), half_m.dtype)
        np.multiply(mean, sample, out=residual[0])
        np.multiply(tilt, sample / half_m, out=residual[1])
        return Sighting(nodes=nodes, residual=residual.reshape(-1), found=found.reshape(-1), height=height)
