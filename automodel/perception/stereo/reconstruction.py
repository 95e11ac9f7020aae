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
FOR, AGAINST = math.log(OF_PAINT / BY_CHANCE), math.log((1.0 - OF_PAINT) / (1.0 - BY_CHANCE))  # [nats] that it is paint


def log_odds(stripes: Stripes, witnesses: Ints) -> FloatArray:
    """How much likelier [nats] the other image is if each stripe (k,) is paint on the ground, as if ridges were
    independent; `witnesses` (n,): what that says of each ridge."""
    nats = np.where(witnesses > 0, FOR, np.where(witnesses < 0, AGAINST, 0.0))
    found: FloatArray = np.bincount(stripes.stripe, nats, minlength=stripes.count).astype(np.float64)
    return found


def radial(away_m: FloatArray, sigma_rad: float) -> float:
    """The share of a stripe's sections that point to the ground below its camera, as the reflection of a lamp does.

    `away_m` (n, 2): its ridges from there; `sigma_rad`: of a section's direction.
    """
    along, middle = away_m[2:] - away_m[:-2], away_m[1:-1]
    across = along[:, 0] * middle[:, 1] - along[:, 1] * middle[:, 0]
    pointing = np.abs(across) < 3.0 * sigma_rad * np.hypot(*along.T) * np.hypot(*middle.T)
    return float(pointing.mean()) if len(pointing) else 0.0


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
    label = np.arange(lefts + right.count)
    off = odds < 0.0
    votes = np.bincount((matches.left * right.count + matches.right)[inliers])
    for pair in np.flatnonzero(votes >= 2).tolist():
        one, other = divmod(pair, right.count)
        if off[one] == off[other + lefts]:
            label[label == label[other + lefts]] = label[one]
    points = np.concatenate((on_ground(left.eye, left.directions), on_ground(right.eye, right.directions)))
    stripe = np.concatenate((left.stripe, right.stripe + lefts))
    lines = []
    for one in np.unique(label[~off]):
        mine = (label[stripe] == one) & ~off[stripe] & np.isfinite(points[:, 0])
        if mine.any():
            lines.append(_knots(points[mine], spacing_m))
    return lines


@compiled
def _knots(points: FloatArray, spacing_m: float) -> FloatArray:
    """The means (k, 2) of points (n, 2) in sections of `spacing_m` along x, near to far."""
    order = np.argsort(points[:, 0])
    knots = np.empty((len(points), 2))
    count, start, sums, number = 0, points[order[0], 0], np.zeros(2), 0
    for i in range(len(order)):
        point = points[order[i]]
        if point[0] - start >= spacing_m:
            knots[count] = sums / number
            count, start, number = count + 1, point[0], 0
            sums[:] = 0.0
        sums += point
        number += 1
    knots[count] = sums / number
    return knots[: count + 1]
