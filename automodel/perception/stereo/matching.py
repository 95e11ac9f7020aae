"""Stripes of both images matched along epipolar lines, and the matched points in space: any two calibrated cameras.

After the stereo paper's stage 3. Nothing is rectified: the ray of a left ridge is projected into the right image near
where it meets the predicted ground, and cut with the mid-lines of the stripes there. The point in space is the middle
of the shortest segment between both rays (mid-point triangulation).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from automodel.compiled import compiled
from automodel.geometry.stereo_rig import Eye, image_of
from automodel.perception.stereo.stripes import Stripes
from automodel.types import FloatArray, Ints

GLANCING = 0.2  # sine of the smallest angle at which an epipolar line cuts a stripe: there noise is five times as large
_STEP = 1e-3  # share of a ray's length over which its image is taken to be straight


@dataclass(slots=True, eq=False)
class Matches:
    """Candidate matches (m,), one for each right stripe that a left ridge's epipolar line meets.

    `left`, `right` (m,): stripes; `ridge` (m,): of the left image. `points_m` (m, 3) in the level body frame.
    `disparity_px` (m,): how far along the epipolar line the match lies from where the predicted ground puts it;
    `per_m` (m,): the same for a point of the ground that is a metre higher [px/m].
    """

    left: Ints
    right: Ints
    ridge: Ints
    points_m: FloatArray
    disparity_px: FloatArray
    per_m: FloatArray


def match(left: Stripes, right: Stripes, height_sigma_m: FloatArray, noise_px: float) -> Matches:
    """Match the stripes of a pair.

    `height_sigma_m` (n,): how well the height of the ground is known at each ridge of the left image; what lies further
    away than three times that and the noise [px] is no match.
    """
    found = _cut(
        left.eye, right.eye, left.directions, left.stripe, right.pixels, right.directions, right.stripe,
        height_sigma_m, noise_px,
    )  # fmt: skip
    return Matches(*found)


@compiled
def midpoint(one: FloatArray, along: FloatArray, other: FloatArray, across: FloatArray) -> FloatArray:
    """The middle (3,) of the shortest segment between two rays: from `one` (3,) `along`, and from `other` `across`.

    NaN for parallel rays.
    """
    aa = ab = bb = ad = bd = 0.0
    for k in range(3):
        away = other[k] - one[k]
        aa, ab, bb = aa + along[k] * along[k], ab + along[k] * across[k], bb + across[k] * across[k]
        ad, bd = ad + along[k] * away, bd + across[k] * away
    volume = aa * bb - ab * ab
    s, t = (bb * ad - ab * bd) / volume, (ab * ad - aa * bd) / volume
    return 0.5 * (one + s * along + other + t * across)


@compiled
def _cut(
    left: Eye,
    right: Eye,
    directions: FloatArray,
    stripe: Ints,
    pixels: FloatArray,
    across: FloatArray,
    other: Ints,
    height_sigma_m: FloatArray,
    noise_px: float,
) -> tuple[Ints, Ints, Ints, FloatArray, FloatArray, FloatArray]:
    """The fields of `Matches`."""
    most = len(directions) * 4
    one_stripe, other_stripe, ridge = np.empty(most, np.intp), np.empty(most, np.intp), np.empty(most, np.intp)
    points, disparity, per_m = np.empty((most, 3)), np.empty(most), np.empty(most)
    count, eye = 0, left.centre_m
    for i in range(len(directions)):
        ray = directions[i]
        if not ray[2] < 0.0:
            continue
        away = -eye[2] / ray[2]
        u, v = image_of(right, eye[0] + away * ray[0], eye[1] + away * ray[1], eye[2] + away * ray[2])
        near = (1.0 - _STEP) * away
        u1, v1 = image_of(right, eye[0] + near * ray[0], eye[1] + near * ray[1], eye[2] + near * ray[2])
        along_u, along_v = u1 - u, v1 - v
        length = math.hypot(along_u, along_v)
        if not length > 0.0:
            continue
        along_u, along_v = along_u / length, along_v / length
        rise = length / (_STEP * eye[2])  # [px/m]: a point that is nearer along the ray is higher
        room = 3.0 * math.hypot(rise * height_sigma_m[i], noise_px)
        for k in range(len(pixels) - 1):
            if other[k] != other[k + 1] or count == most:
                continue
            du, dv = pixels[k, 0] - u, pixels[k, 1] - v
            eu, ev = pixels[k + 1, 0] - u, pixels[k + 1, 1] - v
            side, beyond = along_u * dv - along_v * du, along_u * ev - along_v * eu
            if side * beyond > 0.0 or side == beyond:
                continue
            if abs(beyond - side) < GLANCING * math.hypot(eu - du, ev - dv):
                continue
            share = side / (side - beyond)
            far = along_u * (du + share * (eu - du)) + along_v * (dv + share * (ev - dv))
            if abs(far) > room:
                continue
            one_stripe[count], other_stripe[count], ridge[count] = stripe[i], other[k], i
            ray_there = across[k] + share * (across[k + 1] - across[k])
            points[count] = midpoint(eye, ray, right.centre_m, ray_there)
            disparity[count], per_m[count] = far, rise
            count += 1
    return (
        one_stripe[:count], other_stripe[:count], ridge[:count], points[:count], disparity[:count], per_m[:count]
    )  # fmt: skip
