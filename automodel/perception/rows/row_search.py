"""Measurements of a clothoid pair's nodes: ridges on two short runs of image rows about each; nothing else is read.

After the active contour of Smith 2024: only the model is projected into the image, never the image onto the ground.
A node is a short piece of line. Its ridge is searched on two rows, which also gives its direction, so that a line with
another direction (another road's, a reflection) is rejected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from automodel.compiled import compiled
from automodel.geometry.line_projection import LineProjection, View, project_lines
from automodel.perception.markings.ridge_noise import FALSE_SAMPLES, least_ridge
from automodel.perception.rows.brightness import Brightness, read_pixels
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

Measured = tuple[Ints, Floats, Floats, Floats]  # the fields of `NodeMeasurements`

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


class _Runs(NamedTuple):
    """How nodes are searched: half the distance along the line between a node's two rows, a sample [m]; the image's
    size; how many times `GATE` a run may reach, and for each the noises that a ridge exceeds; a contrast that it
    exceeds instead, if above 0; and how far apart [samples] (2 n,) a node and the next one may be found."""

    half_m: float
    sample_m: float
    height_px: int
    width_px: int
    wider: Ints
    noises: FloatArray
    contrast: float
    tear: Floats


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
        self._projection, self._brightness, sample_m = projection, brightness, marking_m / PER_MARKING
        most = 0.5 * lane_width_m / (GATE * sample_m)  # beyond the lane's middle lies the other line
        wider = 2 ** np.arange(math.ceil(math.log2(max(most, 1.0))) + 1)  # times `GATE`
        places = [(2 * GATE * times + 1) / FALSE_SAMPLES for times in wider.tolist()]
        # A false node is a false ridge in both of its runs, at places that agree by chance.
        agree = 2.0 * MAX_TURN * self.HALF_LENGTH * PER_MARKING / FALSE_SAMPLES
        noises = [least_ridge(n * math.sqrt(2 * len(nodes_m) * min(agree / n, 1.0))) for n in places]
        tear = np.diff(nodes_m, append=nodes_m[-1]) * (MAX_TURN / sample_m)
        tear[-1] = -1.0  # the next node is the other line's
        self._runs = _Runs(
            half_m=self.HALF_LENGTH * marking_m,
            sample_m=sample_m,
            height_px=size[0],
            width_px=size[1],
            wider=wider.astype(np.intp),
            noises=np.array(noises),
            contrast=float(contrast),
            tear=np.tile(tear, 2).astype(projection.dtype),
        )
        self._once: Ints = np.ones(2 * len(nodes_m), np.intp)
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
        view, pixels, runs = self._projection.view, self._brightness.source(image), self._runs
        lines, min_edge = (shape.place, shape.along, half_m), BLURRED * self._usual
        close = measure_nodes(view, pixels, *lines, runs, self._once, min_edge)
        times, most = _further(close[0], close[2], half_m, reach_m, runs)
        if most > 1:
            far = measure_nodes(view, pixels, *lines, runs, times, min_edge)
            _take_over(close, far, times)
        return NodeMeasurements(*close)

    def learn(self, measured: NodeMeasurements, inliers: Bools) -> None:
        """Remember how sharp the ridges of the `inliers` (k,) are."""
        edge, count = _mean(measured.edge, inliers)
        if count:
            self._usual += (self.LEARN if self._usual > 0.0 else 1.0) * (edge - self._usual)
        else:
            self._usual *= 1.0 - self.LEARN


@compiled
def _further(nodes: Ints, found: Floats, half_m: Floats, reach_m: Floats, runs: _Runs) -> tuple[Ints, int]:
    """How many times `GATE` away from each node (2 n,) a line is searched of which nothing was found, and the most."""
    count = len(half_m)
    times, most = np.ones(2 * count, np.intp), 1
    missing_left = missing_right = True
    for i in range(len(nodes)):
        if found[i] > 0.0 and nodes[i] < count:
            missing_left = False
        elif found[i] > 0.0:
            missing_right = False
    for i in range(2 * count):
        if missing_left if i < count else missing_right:
            further = np.ceil(min(reach_m[i], half_m[i % count]) / (GATE * runs.sample_m))
            times[i] = int(min(max(further, 1.0), runs.wider[-1]))
            most = max(most, times[i])
    return times, most


@compiled
def _take_over(close: Measured, far: Measured, times: Ints) -> None:
    """Take what was measured further away than once `GATE`."""
    nodes, residual, found, edge = close
    _, residual_far, found_far, edge_far = far
    k = len(nodes)
    for i in range(k):
        if times[nodes[i]] > 1:
            residual[i], residual[k + i] = residual_far[i], residual_far[k + i]
            found[i], found[k + i] = found_far[i], found_far[k + i]
            edge[i] = edge_far[i]


@compiled
def measure_nodes(
    view: View,
    pixels: tuple[Image, int, bool],
    place: Complexes,
    along: Complexes,
    half_m: Floats,
    runs: _Runs,
    times: Ints,
    min_edge: float,
) -> Measured:
    """The fields of `NodeMeasurements` within so many `times` (2 n,) `GATE` of each node.

    The lines lie `half_m` (n,) beside the places; `pixels` as `read_pixels` takes them.
    """
    gates, wider, most = times * GATE, 0, times.max()
    while runs.wider[wider] < most:
        wider += 1
    reach, size = REACH + (runs.wider[wider] - 1) * GATE, (runs.height_px, runs.width_px)
    nodes, at, column, step, along_m = lay_nodes(view, place, along, half_m, (runs.half_m, runs.sample_m), reach, size)
    # Where a run leaves the image it reads what lies there in memory; `_agree` rejects what is found there.
    image, channel, negated = pixels
    values = read_pixels(image, channel, negated, at).astype(np.float32)
    if runs.contrast > 0.0:
        least = np.full(len(values), runs.contrast * WINDOW, np.float32)
    else:
        least = run_thresholds(values, runs.noises[wider])
    found, residual, edge = _agree(
        values, least, nodes, column, step, along_m, runs.tear, runs.sample_m, min_edge, runs.width_px, gates
    )
    return nodes, residual, found, edge


@compiled
def lay_nodes(
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
    """The fields `found`, `residual` and `edge` of `NodeMeasurements`, from values (2 k, s) of the runs of `lay_nodes`.

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
