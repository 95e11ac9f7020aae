"""Measurements of a clothoid pair's nodes: ridges on two short runs of image rows about each; nothing else is read.

After the active contour of Smith 2024: only the model is projected into the image, never the image onto the ground.
A node is a short piece of line. Its ridge is searched on two rows, which also gives its direction, so that a line with
another direction (another road's, a reflection) is rejected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from automodel.compiled import compiled
from automodel.geometry.line_projection import LineProjection, View, project_lines
from automodel.perception.markings.ridge_noise import FALSE_SAMPLES, least_ridge
from automodel.perception.rows.brightness import Brightness
from automodel.perception.rows.row_ridges import (
    BAR,
    BLURRED,
    GATE,
    LINE,
    MARGIN,
    PER_MARKING,
    REACH,
    WINDOW,
    best_ridges,
    lay_run,
    run_thresholds,
)
from automodel.types import Bools, Complexes, Float32Array, FloatArray, Floats, Image, Ints

MAX_SLANT = 6.0  # columns per row: lines that are flatter in the image are not searched
MAX_TURN = 0.4  # [rad] of a ridge from the node's direction


class Nodes(Protocol):
    """The centerline at n nodes in the body frame: x + i y [m], and the unit tangent, as complex numbers."""

    @property
    def place(self) -> Complexes:
        """(n,)."""

    @property
    def along(self) -> Complexes:
        """(n,)."""


@dataclass(slots=True, eq=False)
class NodeMeasurements:
    """One frame's measurements of a pair with n nodes on each line.

    `nodes` (k,) are the indices of the nodes that were searched, of 2 n, the left line's first. Where `found` (2 k,) is
    1, `residual` (2 k,) is the line's offset to the left of the node [m], and then its turn to the left [rad].
    `edge` (k,): the less sharp edge of a node's two ridges, as in `Ridges`.
    """

    nodes: Ints
    residual: Floats
    found: Floats
    edge: Floats

    def count(self, shape: Nodes, inliers: Bools) -> tuple[int, int]:
        """The number of `inliers` (k,) on the left and on the right line."""
        return _count(inliers, self.nodes, len(shape.place))

    def points(self, shape: Nodes, inliers: Bools, half_m: Floats) -> tuple[FloatArray, FloatArray]:
        """The points (j, 2) [m] of `inliers` (k,) on the left and on the right line, `half_m` (n,) from `shape`."""
        return _points(shape.place, shape.along, self.nodes, self.residual, inliers, half_m)


class RowSearch:
    """Searches nodes at arc lengths `nodes_m` (n,) on each line in images of `size` (height, width) px.

    `contrast` [grey levels] is a ridge's minimum; 0: it follows the noise. The search remembers how sharp markings are,
    so that a much blurrier ridge (a reflection) is rejected; `forget` drops that.
    """

    HALF_LENGTH = 0.5  # markings: half the distance along the line between a node's two rows; one row at least
    LEARN = 0.1  # share of a frame in the usual edge

    def __init__(
        self,
        projection: LineProjection,
        brightness: Brightness,
        contrast: float,
        nodes_m: Floats,
        marking_m: float,
        lane_width_m: float,
        size: tuple[int, int],
    ) -> None:
        self._projection, self._brightness, self._contrast = projection, brightness, contrast
        self._half_m, self._sample_m = self.HALF_LENGTH * marking_m, marking_m / PER_MARKING
        self._size = size
        most = 0.5 * lane_width_m / (GATE * self._sample_m)  # beyond the lane's middle lies the other line
        self._wider = 2 ** np.arange(math.ceil(math.log2(max(most, 1.0))) + 1)  # times `GATE`
        places = [(2 * GATE * times + 1) / FALSE_SAMPLES for times in self._wider.tolist()]
        # A false node is a false ridge in both of its runs, at places that agree by chance.
        agree = 2.0 * MAX_TURN * self.HALF_LENGTH * PER_MARKING / FALSE_SAMPLES
        self._noises = [least_ridge(n * math.sqrt(2 * len(nodes_m) * min(agree / n, 1.0))) for n in places]
        tear = np.diff(nodes_m, append=nodes_m[-1]) * (MAX_TURN / self._sample_m)
        tear[-1] = -1.0  # the next node is the other line's
        self._tear: Floats = np.tile(tear, 2).astype(projection.dtype)
        self.forget()

    def forget(self, edge: float = 0.0, dark: bool | None = None) -> None:
        """Forget how sharp markings are, or start again with an `edge` as in `Ridges`; `dark`: their polarity."""
        self._usual = edge
        if dark is not None and dark != self._brightness.dark:
            self._brightness = self._brightness.negative()

    @property
    def dark(self) -> bool:
        """Whether it looks for markings that are darker than the ground."""
        return self._brightness.dark

    def look(self, image: Image, shape: Nodes, half_m: Floats, reach_m: Floats) -> NodeMeasurements:
        """Measure the pair `shape`, half of whose width at the nodes is `half_m` (n,).

        `reach_m` (2 n,): how far from the places of the left line's nodes, then of the right line's, the line may be.
        A line of which nothing is found close by is searched so far away.
        """
        count = len(half_m)
        seen = self._measure(image, shape, half_m, np.ones(2 * count, np.intp))
        k = len(seen.nodes)
        left = np.arange(2 * count) < count
        missing = [not (seen.found[:k] * (left[seen.nodes] == side)).any() for side in (True, False)]
        reach_m = np.minimum(reach_m, np.tile(half_m, 2))
        times = np.ceil(reach_m / (GATE * self._sample_m)).clip(1, self._wider[-1]).astype(np.intp)
        times[~np.where(left, *missing)] = 1
        if times.max() == 1:
            return seen
        further = self._measure(image, shape, half_m, times)
        other = np.tile(times[seen.nodes] == 1, 2)
        further.found[other], further.residual[other] = seen.found[other], seen.residual[other]
        further.edge[other[:k]] = seen.edge[other[:k]]
        return further

    def _measure(self, image: Image, shape: Nodes, half_m: Floats, times: Ints) -> NodeMeasurements:
        """Measure within so many `times` (2 n,) `GATE` of each node."""
        gates = times * GATE
        wider = int(np.searchsorted(self._wider, times.max()))
        reach = REACH + (int(self._wider[wider]) - 1) * GATE
        nodes, pixels, column, step, along_m = _lay(
            self._projection.view, shape.place, shape.along, half_m, (self._half_m, self._sample_m), reach, self._size
        )
        # Where a run leaves the image it reads what lies there in memory; `_agree` rejects what is found there.
        values = self._brightness.read(image, pixels).astype(np.float32)
        if self._contrast > 0.0:
            least = np.full(len(values), self._contrast * WINDOW, np.float32)
        else:
            least = run_thresholds(values, self._noises[wider])
        min_edge, tear, width = BLURRED * self._usual, self._tear, self._size[1]
        found, residual, edge = _agree(
            values, least, nodes, column, step, along_m, tear, self._sample_m, min_edge, width, gates
        )
        return NodeMeasurements(nodes=nodes, residual=residual, found=found, edge=edge)

    def learn(self, measured: NodeMeasurements, inliers: Bools) -> None:
        """Remember how sharp the ridges of the `inliers` (k,) are."""
        edge, count = _mean(measured.edge, inliers)
        if count:
            self._usual += (self.LEARN if self._usual > 0.0 else 1.0) * (edge - self._usual)
        else:
            self._usual *= 1.0 - self.LEARN


@compiled
def _lay(
    view: View,
    place: Complexes,
    along: Complexes,
    left_m: Floats,
    lengths_m: tuple[float, float],
    reach: int,
    size: tuple[int, int],
) -> tuple[Ints, Ints, Floats, Floats, Floats]:
    """The runs about the nodes that can be searched: they lie in the image, and their line is steep enough there.

    The lines lie `left_m` (n,) beside the nodes, as in `LineProjection.project`; `lengths_m`: half the distance along
    the line between a node's rows, and a sample; `reach`: samples on each side of a run's middle. Returns the nodes
    (k,), and of their runs: pixels (2 k, s), all upper ones first; the lower one's middle column (k,); the signed
    distance between samples (k,) [px], to the left; and their distance along the line from the node (k,) [m].
    """
    line = project_lines(view, place, along, left_m)
    max_half_m, sample_m = lengths_m
    height, width = size
    nodes = np.empty(line.shape[1], np.intp)
    k = 0
    for i in range(line.shape[1]):
        u, v, along_u, along_v, _ = line[:, i]
        inside = 0.0 <= u <= width - 1.0 and 1.0 <= v <= height - 2.0
        if inside and abs(along_u) < -MAX_SLANT * along_v:
            nodes[k] = i
            k += 1
    pixels, column = np.empty((2 * k, 2 * reach + 1), np.intp), np.empty(k, line.dtype)
    step, half_m = np.empty(k, line.dtype), np.empty(k, line.dtype)
    for i in range(k):
        u, v, along_u, along_v, area = line[:, nodes[i]]
        down = max(min(along_v * max_half_m, -1.0), -min(v, height - 1.0 - v))  # the further ahead, the higher up
        step[i] = -sample_m * area / along_v  # area / along_v is negative: to the left
        for end in range(2):
            row = np.rint(v + (down if end == 0 else -down))
            column[i] = u + (row - v) * along_u / along_v + 0.5
            lay_run(pixels[end * k + i], row * width + column[i], step[i])
        half_m[i] = down / along_v
    return nodes[:k], pixels, column, step, half_m


@compiled
def _agree(
    values: Float32Array,
    least: Float32Array,
    nodes: Ints,
    column: Floats,
    step: Floats,
    half_m: Floats,
    tear: Floats,
    sample_m: float,
    min_edge: float,
    width: int,
    gates: Ints,
) -> tuple[Floats, Floats, Floats]:
    """The fields `found`, `residual` and `edge` of `NodeMeasurements`, from the values (2 k, s) of the runs of `_lay`.

    A node is found if its two ridges agree and lie in the image, next to another such node.
    """
    k = len(nodes)
    place, _, edge, flags = best_ridges(values, least, np.concatenate((gates[nodes], gates[nodes])))
    found, residual, edges = np.zeros(2 * k, step.dtype), np.empty(2 * k, step.dtype), np.empty(k, edge.dtype)
    marks, means = np.zeros(k, np.bool_), np.empty(k, step.dtype)
    for i in range(k):
        far, near = place[i], place[k + i]
        means[i], tilt = 0.5 * (far + near), far - near
        residual[i], residual[k + i] = means[i] * sample_m, tilt * sample_m / (2.0 * half_m[i])
        edges[i] = min(edge[i], edge[k + i])
        margin = -step[i] * MARGIN
        inside = margin < column[i] + step[i] * near < width - margin
        straight = abs(tilt) <= 2.0 * half_m[i] * MAX_TURN / sample_m
        if inside and straight and edges[i] > min_edge:
            marks[i] = flags[LINE, i] and flags[LINE, k + i]
            found[k + i] = flags[BAR, i] and flags[BAR, k + i]
    for i in range(k - 1):
        if marks[i] and marks[i + 1] and abs(means[i + 1] - means[i]) < tear[nodes[i]]:
            found[i] = found[i + 1] = found[k + i] = found[k + i + 1] = 1.0
    return found, residual, edges


@compiled
def _points(
    place: Complexes, along: Complexes, nodes: Ints, residual: Floats, inliers: Bools, half_m: Floats
) -> tuple[FloatArray, FloatArray]:
    """See `NodeMeasurements.points`."""
    n, lefts = len(place), 0
    points, count = np.empty((len(nodes), 2)), 0
    for i in range(len(nodes)):
        if not inliers[i]:
            continue
        left = nodes[i] < n
        half = half_m[nodes[i] % n]
        lateral = residual[i] + (half if left else -half)
        at, t = place[nodes[i] % n], along[nodes[i] % n]
        points[count, 0], points[count, 1] = at.real - lateral * t.imag, at.imag + lateral * t.real
        count += 1
        lefts += left
    return points[:lefts], points[lefts:count]


@compiled
def _mean(values: Floats, chosen: Bools) -> tuple[float, int]:
    """The mean of the `chosen` values (k,), and their number."""
    total, count = 0.0, 0
    for i in range(len(values)):
        if chosen[i]:
            total += values[i]
            count += 1
    return total / max(count, 1), count


@compiled
def _count(chosen: Bools, nodes: Ints, n: int) -> tuple[int, int]:
    """See `NodeMeasurements.count`."""
    left = right = 0
    for i in range(len(nodes)):
        if chosen[i] and nodes[i] < n:
            left += 1
        elif chosen[i]:
            right += 1
    return left, right
