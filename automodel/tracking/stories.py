"""Which of a frame's lines play which roles: the likeliest assignments of lines to the roles of a believed lane.

Each line is looked at in every role that it may play, as a whole and, where it goes on as another thing, in part; the
assignments are searched line by line, of which the likeliest few go on (beam search). A lane in doubt asks this of each
of its hypotheses in each frame, so all of it is compiled.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from automodel.compiled import compiled
from automodel.geometry.lane_path import OFFSET, THETA, WIDTH, curvature
from automodel.tracking.evidence import Equations, Prior, Streak, change, innovation, own_thing, settled
from automodel.types import FloatArray, Ints

LEFT, RIGHT, LEFT_FAR, RIGHT_FAR = 0.5, -0.5, 1.5, -1.5  # roles: lane widths to the left of the centerline
ROLES = (LEFT, RIGHT, LEFT_FAR, RIGHT_FAR)


class Things(NamedTuple):
    """What lines are like, as lines of a road and as things of their own; odds are logarithms [nats].

    `anywhere`: a thing of its own, with `corners` less likely by so much, its points `sigma_m` aside, or a `streak`. A
    painted length is likelier as a line's by `length` and, a lane width, by `length_per_lane`; `neighbour` is what a
    line of another lane costs. At `most` so many assignments go on from line to line.
    """

    anywhere: Prior
    streak: Streak
    sigma_m: float
    corners: float
    length: float
    length_per_lane: float
    neighbour: float
    lane_width_m: float
    most: int


class Found(NamedTuple):
    """Looks (n,) at lines, and stories (m,) of them, the likeliest first; odds are logarithms [nats].

    `line`, `role`, `start`, `stop`: of a look, which points of which line play a role. `looks` (m, lines): those of a
    story, -1 beyond the last. `odds`: against clutter, as if all were news, and `counted`.
    """

    line: Ints
    role: FloatArray
    start: Ints
    stop: Ints
    looks: Ints
    odds: FloatArray
    counted: FloatArray


@compiled
def departure(prior: Prior, squares: float, z: FloatArray, points: FloatArray, role: float, corners: float) -> int:
    """The point from which on a line (k, 2) fits its role otherwise than before, by `change`; 0 where all of it fits.

    It must fit so badly, by its squared innovation, that it is likelier to have a corner, which costs so many nats.
    """
    return 0 if squares < len(points) + 2.0 * corners else change(prior, points, role, z)


@compiled
def beside_lane(prior: Prior, points: FloatArray) -> tuple[float, float, float]:
    """How far to the left of the middle of a straight lane a line (k, 2) begins, how far the lane bends there, and by
    how much both may be wrong [m].
    """
    state, x, y = prior.state, points[0, 0] - prior.reference_x_m, points[0, 1]
    left = y * math.cos(state[THETA]) - x * math.sin(state[THETA]) + state[OFFSET]
    bend = 0.5 * curvature(state, prior.start_m, prior.spacing_m) * (x * x + y * y)
    offset = abs(prior.root[OFFSET, OFFSET])
    theta = math.hypot(prior.root[THETA, OFFSET], prior.root[THETA, THETA])
    return left, bend, 4.0 * offset + 4.0 * theta * abs(x)


@compiled
def possible(prior: Prior, points: FloatArray, role: float, lane_width_m: float) -> bool:
    """Whether a line (k, 2) may play a role: what lies too far aside need not be weighed."""
    left, bend, sigma = beside_lane(prior, points)
    return abs(left - role * prior.state[WIDTH]) < sigma + 0.5 * lane_width_m + abs(bend)


@compiled
def stories(
    prior: Prior,
    things: Things,
    points: FloatArray,
    ends: Ints,
    painted_m: FloatArray,
    clutter: FloatArray,
    reflections: FloatArray,
    kinds: FloatArray,
    news: FloatArray,
) -> Found:
    """The likeliest assignments of lines to roles, and the one that assigns none.

    The points (k, 2) of line i end at `ends[i]`, near to far. `clutter` (m,): how likely it is as a thing of its own;
    `reflections` (m,): how many times as likely as one it is a streak; `kinds` (m, 4): how much likelier its kind is in
    each of `ROLES`; `news` (m,): the share of it that is news.
    """
    lines, full, count = len(ends), len(prior.root), 0
    room = 2 * len(ROLES) * lines
    line, start, stop = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room, np.int64)
    role, own, length = np.empty(room), np.empty(room), np.empty(room)
    information, vector = np.empty((room, full, full)), np.empty((room, full))
    misfit, log_volume, alone = np.empty(room), np.empty(room), np.empty(room)
    room = (things.most + 1) * (2 * len(ROLES) + 1)
    looks, size = np.full((room, lines), -1), np.zeros(room, np.int64)
    odds, counted, kept = np.zeros(room), np.zeros(room), 1
    for i in range(lines):
        first, begin, end = count, ends[i - 1] if i else 0, ends[i]
        for k in range(len(ROLES)):
            its = points[begin:end]
            if not possible(prior, its, ROLES[k], things.lane_width_m):
                continue
            line[count], role[count], start[count], stop[count] = i, ROLES[k], begin, end
            own[count] = kinds[i, k]
            count += 1
        whole = count
        for look in range(first, whole):  # and the part of each that plays the role better than the whole
            equations, z = _looked(prior, points, begin, end, role[look])
            _keep(equations, look, information, vector, misfit, log_volume)
            squares, volume = innovation(equations)
            alone[look] = -0.5 * (squares + volume)
            at = departure(prior, squares, z, points[begin:end], role[look], things.corners)
            middle = begin + abs(at)
            if at == 0 or (middle - begin if at > 0 else end - middle) < 2:
                continue
            line[count], role[count] = i, role[look]
            start[count], stop[count] = (begin, middle) if at > 0 else (middle, end)
            other = points[middle:end] if at > 0 else points[begin:middle]
            equations, _ = _looked(prior, points, start[count], stop[count], role[look])
            _keep(equations, count, information, vector, misfit, log_volume)
            squares, volume = innovation(equations)
            alone[count] = -0.5 * (squares + volume)
            own[count] = -things.corners + own_thing(
                things.anywhere, things.streak, other, things.sigma_m, things.corners, reflections[i]
            )
            count += 1
        for look in range(first, count):
            share = (stop[look] - start[look]) / (end - begin)
            length[look] = things.length + share * painted_m[i] / things.lane_width_m * things.length_per_lane
            own[look] += length[look] - clutter[i] - (things.neighbour if abs(role[look]) > 1.0 else 0.0)
        grown = kept
        for look in range(first, count):
            for story in range(kept):
                if _any_beside(points, start, stop, role, looks[story, : size[story]], look):
                    continue
                both = np.append(looks[story, : size[story]], look)
                likely = alone[look]
                if len(both) > 1:
                    squares, volume = innovation(
                        Equations(information[both], vector[both], misfit[both], log_volume[both])
                    )
                    likely = -0.5 * (squares + volume)
                for one in both:
                    likely += own[one]
                if likely - length[look] > odds[story] - 1.0:  # however long, it must fit
                    looks[grown, : len(both)], looks[grown, len(both) :], size[grown] = both, -1, len(both)
                    odds[grown] = likely
                    counted[grown] = counted[story] + news[i] * (likely - odds[story])
                    grown += 1
        order = np.argsort(-odds[:grown], kind="mergesort")[: things.most]
        kept = len(order)
        looks[:kept], size[:kept] = looks[order], size[order]
        odds[:kept], counted[:kept] = odds[order], counted[order]
    if size[:kept].all():
        looks[kept], odds[kept], counted[kept] = -1, 0.0, 0.0
        kept += 1
    return Found(line[:count], role[:count], start[:count], stop[:count], looks[:kept], odds[:kept], counted[:kept])


@compiled
def _looked(prior: Prior, points: FloatArray, start: int, stop: int, role: float) -> tuple[Equations, FloatArray]:
    """The equations of one line's points in a role, and where it puts the lane."""
    its = points[start:stop]
    return settled(prior, its, np.array((len(its),)), np.array((role,)), np.ones(1))


@compiled
def _keep(
    equations: Equations,
    at: int,
    information: FloatArray,
    vector: FloatArray,
    misfit: FloatArray,
    log_volume: FloatArray,
) -> None:
    """Put the equations of one line among those of all looks."""
    information[at], vector[at] = equations.information[0], equations.vector[0]
    misfit[at], log_volume[at] = equations.misfit[0], equations.log_volume[0]


@compiled
def _any_beside(points: FloatArray, start: Ints, stop: Ints, role: FloatArray, looks: Ints, look: int) -> bool:
    """Whether any of the looks shows a line next to that of another one, in the same role."""
    for one in looks:
        low = max(points[start[one], 0], points[start[look], 0])
        high = min(points[stop[one] - 1, 0], points[stop[look] - 1, 0])
        if role[one] == role[look] and high > low:
            return True
    return False
