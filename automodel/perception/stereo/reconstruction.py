"""Lines on the ground from the stripes of both images: all knots re-projected onto the plane, matched or not.

After the stereo paper's stage 5. What both cameras see counts once. A stripe whose place both images show is on the
ground where both show it there: otherwise it is another vehicle's, a rail, a kerb, or a lamp that the floor mirrors. Of
one whose place one camera alone sees, nothing is known, and it counts.
"""

from __future__ import annotations

import math

import numpy as np

from automodel.compiled import compiled
from automodel.geometry.stereo_rig import on_ground
from automodel.perception.stereo.matching import Matches
from automodel.perception.stereo.stripes import Stripes
from automodel.types import Bools, FloatArray, Ints

# How often the other image shows a ridge where the ground puts it: one of paint, and one of anything else by chance.
OF_PAINT, BY_CHANCE = 0.8, 0.1
FOR, AGAINST = math.log(OF_PAINT / BY_CHANCE), math.log1p(-OF_PAINT) - math.log1p(-BY_CHANCE)  # [nats] that it is paint


def log_odds(stripes: Stripes, witnesses: Ints) -> FloatArray:
    """How much likelier [nats] the other image is if each stripe (k,) is paint on the ground, as if ridges were
    independent; `witnesses` (n,): what that says of each ridge."""
    nats = np.where(witnesses > 0, FOR, np.where(witnesses < 0, AGAINST, 0.0))
    found: FloatArray = np.bincount(stripes.stripe, nats, minlength=stripes.count).astype(np.float64)
    return found


@compiled
def radial(ground_m: FloatArray, stripe: Ints, foot_m: FloatArray, sigma_rad: float) -> FloatArray:
    """The shares (k,) of the stripes' sections that point to a foot (2,) [m], as the reflection of a lamp does.

    `ground_m` (n, 2): their ridges, stripe by stripe; `foot_m`: the ground below the camera; `sigma_rad`: of a
    section's direction.
    """
    n = len(stripe)
    count = stripe[n - 1] + 1 if n else 0
    pointing, sections = np.zeros(count), np.zeros(count)
    for i in range(2, n):
        k = stripe[i]
        if stripe[i - 2] != k:
            continue
        ex, ey = ground_m[i, 0] - ground_m[i - 2, 0], ground_m[i, 1] - ground_m[i - 2, 1]
        x, y = ground_m[i - 1, 0] - foot_m[0], ground_m[i - 1, 1] - foot_m[1]
        off = abs(ex * y - ey * x) / math.sqrt((ex * ex + ey * ey) * (x * x + y * y))
        pointing[k] += off < 3.0 * sigma_rad
        sections[k] += 1.0
    for k in range(count):
        pointing[k] /= max(sections[k], 1.0)
    return pointing


def reconstruct(
    left: Stripes,
    right: Stripes,
    matches: Matches,
    inliers: Bools,
    odds: FloatArray,
    spacing_m: float,
) -> list[FloatArray]:
    """The lines' knots (k, 2) [m] in the level body frame, near to far, `spacing_m` apart at most where they are seen.

    `left`, `right`: stripes with eyes and directions over the filtered plane; `inliers` (m,): the matches on that
    plane; `odds` (k,) [nats] that each stripe is paint on the ground, those of the left image first.
    """
    lefts = left.count
    label, off = np.arange(lefts + right.count), odds < 0.0
    votes = np.bincount((matches.left * right.count + matches.right)[inliers])
    for pair in np.flatnonzero(votes >= 2).tolist():
        one, other = divmod(pair, right.count)
        if off[one] == off[other + lefts]:
            label[label == label[other + lefts]] = label[one]
    points = np.concatenate((on_ground(left.eye, left.directions), on_ground(right.eye, right.directions)))
    stripe = np.concatenate((left.stripe, right.stripe + lefts))
    line = np.where(off[stripe] | ~np.isfinite(points[:, 0]), -1, label[stripe])
    order = np.lexsort((points[:, 0], line))[np.count_nonzero(line < 0) :]
    knots, ends = _knots(points[order], line[order], spacing_m)
    return np.split(knots, ends[:-1]) if len(ends) else []


@compiled
def _knots(points: FloatArray, line: Ints, spacing_m: float) -> tuple[FloatArray, Ints]:
    """The means (k, 2) of points (n, 2), line by line and near to far, in sections of `spacing_m` along x.

    Also the end (l,) of each line among them.
    """
    knots, ends = np.empty((len(points), 2)), np.empty(len(points), np.intp)
    lines = count = first = 0
    for i in range(1, len(points) + 1):
        over = i == len(points) or line[i] != line[first]
        if over or points[i, 0] - points[first, 0] >= spacing_m:
            for k in range(2):
                knots[count, k] = points[first:i, k].mean()
            count, first = count + 1, i
        if over:
            ends[lines] = count
            lines += 1
    return knots[:count], ends[:lines]
