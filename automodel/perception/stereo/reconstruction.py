"""Lines on the ground from the stripes of both images: all knots re-projected onto the plane, matched or not.

After the stereo paper's stage 5. A stripe that one camera alone sees counts like one that both see, which counts once.
A stripe whose matches do not lie on the plane is another vehicle's, a rail, a kerb, or a lamp that a wet road mirrors.
"""

from __future__ import annotations

import numpy as np

from automodel.compiled import compiled
from automodel.geometry.stereo_rig import Eye, on_ground
from automodel.perception.markings.reflections import ReflectionConfig
from automodel.perception.stereo.matching import Matches
from automodel.perception.stereo.stripes import Stripes
from automodel.types import Bools, FloatArray, Ints

ON_PLANE = 0.5  # of a stripe's matched ridges: where fewer lie on the plane, the stripe does not


def reconstruct(
    left: Stripes,
    right: Stripes,
    seen_by: tuple[Eye, Eye],
    matches: Matches,
    inliers: Bools,
    below: Matches,
    spacing_m: float,
) -> list[FloatArray]:
    """The lines' knots (k, 2) [m] in the level body frame, near to far, `spacing_m` apart at most where they are seen.

    `left`, `right`: stripes with directions over the filtered plane, on which the cameras are `seen_by`; `inliers`
    (m,): the matches on that plane; `below`: those beneath it.
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
    off |= _mirrored(below, pairs[votes >= 2], left, right)
    points = np.concatenate((on_ground(seen_by[0], left.directions), on_ground(seen_by[1], right.directions)))
    stripe = np.concatenate((left.stripe, right.stripe + lefts))
    lines = []
    for one in np.unique(label[~off]):
        mine = (label[stripe] == one) & ~off[stripe] & np.isfinite(points[:, 0])
        if mine.any():
            lines.append(_knots(points[mine], spacing_m))
    return lines


def _mirrored(below: Matches, on_plane: Ints, left: Stripes, right: Stripes) -> Bools:
    """Which stripes, the right ones after the left ones, are images in a floor that shines.

    They are where a stripe in either image points to its own camera, fits the other one beneath the ground, and neither
    fits any on the ground: `on_plane` (k, 2), pairs of stripes that do.
    """
    lefts = left.count
    off = np.zeros(lefts + right.count, np.bool_)
    free = ~(np.isin(below.left, on_plane[:, 0]) | np.isin(below.right, on_plane[:, 1]))
    pairs, votes = np.unique(np.column_stack((below.left, below.right))[free], axis=0, return_counts=True)
    for (one, other), count in zip(pairs.tolist(), votes.tolist(), strict=True):
        shorter = min(np.count_nonzero(left.stripe == one), np.count_nonzero(right.stripe == other))
        if count >= max(3, ON_PLANE * shorter) and _points_to_camera(left, one) and _points_to_camera(right, other):
            off[[one, lefts + other]] = True
    return off


def _points_to_camera(stripes: Stripes, one: int) -> bool:
    """Whether a stripe runs to the ground below its camera, as the image of a lamp that an uneven floor stretches."""
    points = on_ground(stripes.eye, stripes.directions[stripes.stripe == one])
    away = points[np.isfinite(points[:, 0])] - stripes.eye.centre_m[:2]
    if len(away) < 3:
        return False
    away = away[np.argsort(np.hypot(*away.T))]
    third = len(away) // 3
    near, middle, far = away[:third].mean(axis=0), away.mean(axis=0), away[-third:].mean(axis=0)
    along = far - near
    across = middle[0] * along[1] - middle[1] * along[0]
    return bool(abs(across) < 3.0 * ReflectionConfig().pointing_rad * np.hypot(*middle) * np.hypot(*along))


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
