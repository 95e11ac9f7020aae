"""Lines on the ground from the stripes of both images: all knots re-projected onto the plane, matched or not.

After the stereo paper's stage 5. A stripe that one camera alone sees counts like one that both see, which counts once.
A stripe whose matches do not lie on the plane is another vehicle's, a rail, a kerb, or a lamp that a wet road mirrors.
"""

from __future__ import annotations

import numpy as np

from automodel.compiled import compiled
from automodel.geometry.stereo_rig import Eye, on_ground
from automodel.perception.stereo.matching import Matches
from automodel.perception.stereo.stripes import Stripes
from automodel.types import Bools, FloatArray

ON_PLANE = 0.5  # of a stripe's matched ridges: where fewer lie on the plane, the stripe does not


def reconstruct(
    left: Stripes,
    right: Stripes,
    seen_by: tuple[Eye, Eye],
    matches: Matches,
    inliers: Bools,
    spacing_m: float,
) -> list[FloatArray]:
    """The lines' knots (k, 2) [m] in the level body frame, near to far, `spacing_m` apart at most where they are seen.

    `left`, `right`: stripes with directions over the filtered plane, on which the cameras are `seen_by`; `inliers`
    (m,): the matches on that plane.
    """
    lefts = left.count
    label = np.arange(lefts + right.count)
    off = np.zeros(len(label), np.bool_)
    for stripes, shift in ((matches.left, 0), (matches.right, lefts)):
        for one in np.unique(stripes):
            its = stripes == one
            ridges = len(np.unique(matches.ridge[its]))
            off[one + shift] = ridges >= 3 and len(np.unique(matches.ridge[its & inliers])) < ON_PLANE * ridges
    pairs, votes = np.unique(np.column_stack((matches.left, matches.right))[inliers], axis=0, return_counts=True)
    for one, other in pairs[votes >= 2].tolist():
        if off[one] == off[other + lefts]:
            label[label == label[other + lefts]] = label[one]
    points = np.concatenate((on_ground(seen_by[0], left.directions), on_ground(seen_by[1], right.directions)))
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
