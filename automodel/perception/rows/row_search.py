"""Where the nodes of a clothoid pair really lie: two short runs of image rows about each, and nothing else is read.

Only the model is projected into the picture, never the picture onto the ground. A node is a short piece of line: its
ridge is looked for on two rows, so that its direction is measured too, and what runs elsewhere (another road's line, a
reflection) is told from the line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from automodel.compiled import compiled
from automodel.estimation.clothoid.clothoid_pair import PairShape
from automodel.geometry.line_projection import LineProjection, View, project_lines
from automodel.perception.rows.row_ridges import BAR, LINE, MARGIN, PER_MARKING, REACH, RunRidges, best_ridges, lay_run
from automodel.types import Bools, Complexes, Float32Array, FloatArray, Floats, Image, Ints

FLATTEST = 6.0  # pixels across for one down: a line that lies flatter in the picture is not looked at
TURN, SLACK = 0.4, 0.5  # how much a ridge may be turned [rad], and be torn (samples): else it is another line's
EDGE = 0.05  # of the picture's height: rows there are not read about a node, but for a node's second
BESIDE = 0.1  # of the picture's width: how far outside it a node may lie and still be looked for


@dataclass(slots=True, eq=False)
class NodeMeasurements:
    """What one frame shows around a pair of n nodes a line.

    `nodes` (k,) are those that were looked for, of 2 n, the left line's first. `residual` (2 k,): how far to the left
    of them the line was found [m], and how far it is turned to the left of them [rad], where `found` (2 k,) is 1.
    `edge` (k,): how sharp their ridges are, as `Ridges` has it, the less sharp one.
    """

    nodes: Ints
    residual: Floats
    found: Floats
    edge: Floats

    def count(self, shape: PairShape, carrying: Bools) -> tuple[int, int]:
        """How many of the `carrying` nodes (k,) are the left line's and the right line's."""
        return _count(carrying, self.nodes, len(shape.place))

    def points(self, shape: PairShape, carrying: Bools, half_m: float) -> tuple[FloatArray, FloatArray]:
        """The ridges (j, 2) [m] of `carrying` nodes (k,), left and right line's; lines lie `half_m` from `shape`."""
        return _points(shape.place, shape.along, self.nodes, self.residual, carrying, half_m)


class RowSearch:
    """Looks for nodes at arc lengths `nodes_m` (n,) on each line in pictures of `size` (height, width) px.

    It remembers how sharp markings are, so that what is much less so (a reflection) is not taken for one.
    `forget` drops that.
    """

    HALF_LENGTH = 0.5  # markings: half the way along the line between a node's two rows, a row apart at least
    BLURRED = 0.5  # of the usual edge: what has less is no paint
    LEARN, FADE = 0.1, 0.02  # share a frame
    FEWEST = 3  # nodes from which the usual edge is learnt

    def __init__(
        self, projection: LineProjection, ridges: RunRidges, nodes_m: Floats, marking_m: float, size: tuple[int, int]
    ) -> None:
        self._projection, self._ridges = projection, ridges
        self._half_m, self._sample_m = self.HALF_LENGTH * marking_m, marking_m / PER_MARKING
        self._size = size
        tear = np.diff(nodes_m, append=nodes_m[-1]) * (TURN / self._sample_m)
        tear[-1] = -1.0  # what comes next is the other line
        self._tear: Floats = np.tile(tear, 2).astype(projection.dtype)
        self.forget()

    def forget(self, edge: float = 0.0) -> None:
        """Forget how sharp markings are, or start anew with an `edge` as `Ridges` has it."""
        self._usual = edge

    def look(self, image: Image, shape: PairShape, width_m: float) -> NodeMeasurements:
        """The pair `shape` with lines `width_m` apart."""
        nodes, pixels, column, step, half_m = _lay(
            self._projection.view, shape.place, shape.along, 0.5 * width_m, self._half_m, self._sample_m, self._size
        )
        values = self._ridges.read(image, pixels)
        least, tear, width = self.BLURRED * self._usual, self._tear, self._size[1]
        found, residual, edge = _agree(
            values, self._ridges.contrast, nodes, column, step, half_m, tear, self._sample_m, least, width
        )
        return NodeMeasurements(nodes=nodes, residual=residual, found=found, edge=edge)

    def learn(self, sighting: NodeMeasurements, carrying: Bools) -> None:
        """Remember how sharp the ridges are of the nodes (k,) that carry the lane."""
        edge, count = _mean(sighting.edge, carrying)
        if count >= self.FEWEST:
            self._usual += (self.LEARN if self._usual > 0.0 else 1.0) * (edge - self._usual)
        else:
            self._usual *= 1.0 - self.FADE


@compiled
def _lay(
    view: View,
    place: Complexes,
    along: Complexes,
    aside_m: float,
    most_half_m: float,
    sample_m: float,
    size: tuple[int, int],
) -> tuple[Ints, Ints, Floats, Floats, Floats]:
    """The runs about the nodes that can be looked for: they lie in the picture, and their line is steep there.

    The lines lie `aside_m` beside the nodes, as in `LineProjection.project`. Nodes (k,), and of their runs: pixels
    (2 k, s), all upper ones first; the lower one's middle column (k,); the way from sample to sample (k,) [px], to the
    left; how far along the line they lie from the node (k,) [m].
    """
    line = project_lines(view, place, along, aside_m)
    height, width = size
    margin = EDGE * height
    most_u, most_v = (0.5 + BESIDE) * width, 0.5 * (height - 1) - margin
    nodes = np.empty(line.shape[1], np.intp)
    k = 0
    for i in range(line.shape[1]):
        u, v, along_u, along_v, _ = line[:, i]
        near = abs(u - 0.5 * (width - 1)) <= most_u and abs(v - 0.5 * (height - 1)) <= most_v
        if near and abs(along_u) < -FLATTEST * along_v:
            nodes[k] = i
            k += 1
    pixels, column = np.empty((2 * k, 2 * REACH + 1), np.intp), np.empty(k, line.dtype)
    step, half_m = np.empty(k, line.dtype), np.empty(k, line.dtype)
    for i in range(k):
        u, v, along_u, along_v, area = line[:, nodes[i]]
        down = max(min(along_v * most_half_m, -1.0), -margin)  # the further ahead, the higher up
        step[i] = -sample_m * area / along_v  # area / along_v is below 0: to the left
        for end in range(2):
            row = np.rint(v + (down if end == 0 else -down))
            column[i] = u + (row - v) * along_u / along_v + 0.5
            lay_run(pixels[end * k + i], row * width + column[i], step[i])
        half_m[i] = down / along_v
    return nodes[:k], pixels, column, step, half_m


@compiled
def _agree(
    values: Float32Array,
    contrast: float,
    nodes: Ints,
    column: Floats,
    step: Floats,
    half_m: Floats,
    tear: Floats,
    sample_m: float,
    least_edge: float,
    width: int,
) -> tuple[Floats, Floats, Floats]:
    """What is a line's: nodes (k,) in the picture whose two ridges agree, next to another such node.

    `values` (2 k, s) are those of the runs of `_lay`. `found`, `residual` and `edge` as `NodeMeasurements` has them.
    """
    place, _, edge, flags = best_ridges(values, contrast)
    k = len(nodes)
    found, residual, edges = np.zeros(2 * k, step.dtype), np.empty(2 * k, step.dtype), np.empty(k, edge.dtype)
    marks, means = np.zeros(k, np.bool_), np.empty(k, step.dtype)
    for i in range(k):
        far, near = place[i], place[k + i]
        means[i], tilt = 0.5 * (far + near), far - near
        residual[i], residual[k + i] = means[i] * sample_m, tilt * sample_m / (2.0 * half_m[i])
        edges[i] = min(edge[i], edge[k + i])
        margin = -step[i] * MARGIN
        inside = margin < column[i] + step[i] * near < width - margin
        straight = abs(tilt) <= 2.0 * half_m[i] * TURN / sample_m + 2.0 * SLACK
        if inside and straight and edges[i] > least_edge:
            marks[i] = flags[LINE, i] and flags[LINE, k + i]
            found[k + i] = flags[BAR, i] and flags[BAR, k + i]
    for i in range(k - 1):
        if marks[i] and marks[i + 1] and abs(means[i + 1] - means[i]) < tear[nodes[i]]:
            found[i] = found[i + 1] = found[k + i] = found[k + i + 1] = 1.0
    return found, residual, edges


@compiled
def _points(
    place: Complexes, along: Complexes, nodes: Ints, residual: Floats, carrying: Bools, half_m: float
) -> tuple[FloatArray, FloatArray]:
    """As `NodeMeasurements.points`."""
    n, lefts = len(place), 0
    points, count = np.empty((len(nodes), 2)), 0
    for i in range(len(nodes)):
        if not carrying[i]:
            continue
        left = nodes[i] < n
        aside = residual[i] + (half_m if left else -half_m)
        at, t = place[nodes[i] % n], along[nodes[i] % n]
        points[count, 0], points[count, 1] = at.real - aside * t.imag, at.imag + aside * t.real
        count += 1
        lefts += left
    return points[:lefts], points[lefts:count]


@compiled
def _mean(values: Floats, chosen: Bools) -> tuple[float, int]:
    """The mean of the `chosen` values (k,), and how many they are."""
    total, count = 0.0, 0
    for i in range(len(values)):
        if chosen[i]:
            total += values[i]
            count += 1
    return total / max(count, 1), count


@compiled
def _count(chosen: Bools, nodes: Ints, n: int) -> tuple[int, int]:
    left = right = 0
    for i in range(len(nodes)):
        if chosen[i]:
            left += nodes[i] < n
            right += nodes[i] >= n
    return left, right
