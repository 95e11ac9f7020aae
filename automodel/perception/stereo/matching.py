"""Stripes of both images matched along epipolar lines, and the matched points in space: any two calibrated cameras.

After the stereo paper's stage 3. Nothing is rectified: the ray of a left ridge is projected into the right image near
where it meets the predicted ground, and cut with the mid-lines of the stripes there. The point in space is the middle
of the shortest segment between both rays (mid-point triangulation).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from automodel.compiled import compiled
from automodel.geometry.stereo_rig import Eye, image_of
from automodel.perception.markings.ridge import BESIDE, FAINT
from automodel.perception.rows.row_ridges import PER_MARKING
from automodel.perception.stereo.points import GATE
from automodel.perception.stereo.stripes import Field, Stripes, Traces
from automodel.types import Bools, FloatArray, Image, Ints

GLANCING = 0.2  # sine of the smallest angle at which an epipolar line cuts a stripe: there noise is five times as large
_FAR_M = 1e4  # as good as infinitely far
_PROFILE = round(BESIDE * PER_MARKING)  # samples of a profile on each side of a ridge, over `BESIDE` of its widths
_LEAST = 0.5  # share of a profile that both images must show: one flank and the ridge itself
_BRIGHTER = 1.25  # than all of a profile: what the other image shows there is another thing
_ON_PX = 1e-6  # from an epipolar line: a ridge that is nearer lies on it
_STEP = 1e-3  # share of a ray's length over which its image is taken to be straight


@dataclass(slots=True, eq=False)
class Matches:
    """Candidate matches (m,), one for each right stripe that a left ridge's epipolar line meets.

    `left`, `right` (m,): stripes; `ridge` (m,): of the left image. `points_m` (m, 3) in the level body frame.
    `disparity_px` (m,): how far along the epipolar line the match lies from where the predicted ground puts it;
    `per_m` (m,): the same for each metre by which the point is higher than that [px/m]. `left_share` (m,): the share of
    the left ray in that mean of both rays' places whose error the disparity's tells nothing of.
    """

    left: Ints
    right: Ints
    ridge: Ints
    points_m: FloatArray
    disparity_px: FloatArray
    per_m: FloatArray
    left_share: FloatArray


def match(left: Stripes, right: Stripes, height_sigma_m: FloatArray, noise_px: float) -> Matches:
    """Match the stripes of a pair.

    `height_sigma_m` (n,): how well the height of the ground is known at each ridge of the left image; what lies further
    away than `GATE` sigmas of both that and the noise [px] is no match.
    """
    found = _cut(
        left.eye, right.eye, left.directions, left.stripe, right.pixels, right.directions, right.stripe,
        height_sigma_m, noise_px,
    )  # fmt: skip
    return Matches(*found)


def witnesses(
    one: Stripes, other: Stripes, images: tuple[Image, Image], height_sigma_m: FloatArray, noise_px: float
) -> Ints:
    """What the other image says of each ridge (n,) of an image: 1, it shows one where the ground puts this one;
    -1, it shows plain ground there; 0, something else, the place is out of its view, or the epipolar line runs along
    the stripe.

    `images`: this one and the other, grey. `height_sigma_m` (n,): how well the height of the ground is known at each
    ridge.
    """
    return _borne_out(one.eye, other.eye, _Ridges.of(one), other.traces, other.field, images, height_sigma_m, noise_px)


def mirrored(one: Stripes, ridges: Bools, image: Image, other: Eye, other_image: Image) -> float:
    """How much the other image looks like this one about some ridges (n,), seen as infinitely far: correlation -1 .. 1.

    Both images show the reflection of a lamp so, on whatever floor; 0 where the other one does not reach.
    """
    alike = _likeness(image, other_image, one.pixels[ridges], one.width_px[ridges], one.directions[ridges], other)
    known = alike[np.isfinite(alike)]
    return float(known.mean()) if len(known) else 0.0


@compiled
def _likeness(
    image: Image, other_image: Image, pixels: FloatArray, width_px: FloatArray, directions: FloatArray, other: Eye
) -> FloatArray:
    """The correlation (n,) of both images about each ridge; NaN where the other one does not reach. See `mirrored`."""
    found, samples = np.full(len(pixels), math.nan), 2 * _PROFILE + 1
    profiles, last = np.empty((2, samples)), image.shape[1] - 1
    for i in range(len(pixels)):
        way = directions[i] * _FAR_M
        u, v = image_of(other, other.centre_m[0] + way[0], other.centre_m[1] + way[1], other.centre_m[2] + way[2])
        if not (0.0 <= v <= image.shape[0] - 1.0 and 0.0 <= u <= last):
            continue
        brightest, count = 0.0, 0
        for k in range(samples):
            here = math.floor(pixels[i, 0] + BESIDE * width_px[i] * (k - _PROFILE) / _PROFILE + 0.5)
            if 0 <= here <= last:
                brightest = max(brightest, float(image[int(pixels[i, 1]), here]))
        for k in range(samples):
            away = BESIDE * width_px[i] * (k - _PROFILE) / _PROFILE
            here, there = math.floor(pixels[i, 0] + away + 0.5), math.floor(u + away + 0.5)
            if min(here, there) < 0 or max(here, there) > last:
                continue
            profiles[0, count] = image[int(pixels[i, 1]), here]
            profiles[1, count] = other_image[int(v + 0.5), there]
            if profiles[1, count] < _BRIGHTER * brightest:  # else paint lies there, in front of what is mirrored
                count += 1
        if count < _LEAST * samples:
            continue
        one_mean, other_mean = profiles[0, :count].mean(), profiles[1, :count].mean()
        both = one = another = 0.0
        for k in range(count):
            a, b = profiles[0, k] - one_mean, profiles[1, k] - other_mean
            both, one, another = both + a * b, one + a * a, another + b * b
        found[i] = both / math.sqrt(max(one * another, 1.0))
    return found


@compiled
def _in_view(u: float, v: float, field: Field) -> bool:
    """Whether a ridge would be found at a pixel: between two rows and their ends."""
    rows, ends = field
    for r in range(len(rows) - 1):
        if rows[r + 1] - _ON_PX <= v <= rows[r] + _ON_PX:
            low = max(ends[r, 0], ends[r + 1, 0])
            return low <= u <= min(ends[r, 1], ends[r + 1, 1])
    return False


class _Line(NamedTuple):
    """An epipolar line: the image of a ray of one camera in the other one, about where that meets the ground.

    `u`, `v`: the image of that place; `along_u`, `along_v`: unit direction towards points of the ray that are higher;
    `rise`: how far a point lies along it that is a metre higher [px/m]. NaN where it is out of the image.
    """

    u: float
    v: float
    along_u: float
    along_v: float
    rise: float


@compiled
def _epipolar_line(one: Eye, other: Eye, ray: FloatArray) -> _Line:
    """That of a ray (3,) from `one`; NaN also for a ray that does not meet the ground."""
    eye = one.centre_m
    away = -eye[2] / ray[2] if ray[2] < 0.0 else math.nan
    u, v = image_of(other, eye[0] + away * ray[0], eye[1] + away * ray[1], 0.0)
    near = (1.0 - _STEP) * away
    u1, v1 = image_of(other, eye[0] + near * ray[0], eye[1] + near * ray[1], eye[2] + near * ray[2])
    along_u, along_v = u1 - u, v1 - v
    length = math.hypot(along_u, along_v)
    if not length > 0.0:
        return _Line(math.nan, math.nan, math.nan, math.nan, math.nan)
    return _Line(u, v, along_u / length, along_v / length, length / (_STEP * eye[2]))


@compiled
def _side(line: _Line, pixel: FloatArray) -> float:
    """How far [px] a pixel (2,) lies beside an epipolar line: positive to one side, 0 on it."""
    beside = line.along_u * (pixel[1] - line.v) - line.along_v * (pixel[0] - line.u)
    return beside if abs(beside) > _ON_PX else 0.0


@compiled
def _crossing(
    line: _Line, pixels: FloatArray, chain: Ints, k: int, side: float, beyond: float
) -> tuple[float, float, float]:
    """Where an epipolar line crosses a chain between ridges k and k + 1, which lie `side` and `beyond` [px] beside it.

    Returns the share of the way between both, how far along the line from where the ground puts it [px], and the sine
    of the angle; NaN for no crossing. A line through a ridge crosses the chain once: images that are rectified have the
    same rows, and there it is rounding alone that tells on which side of it a ridge lies.
    """
    none = math.nan, math.nan, math.nan
    if side == beyond or not side * beyond <= 0.0:
        return none
    if beyond == 0.0 and k + 2 < len(pixels) and chain[k + 2] == chain[k + 1]:
        return none  # the next section begins there
    du, dv = pixels[k, 0] - line.u, pixels[k, 1] - line.v
    eu, ev = pixels[k + 1, 0] - line.u, pixels[k + 1, 1] - line.v
    share = side / (side - beyond)
    far = line.along_u * (du + share * (eu - du)) + line.along_v * (dv + share * (ev - dv))
    return share, far, abs(beyond - side) / math.hypot(eu - du, ev - dv)


class _Ridges(NamedTuple):
    """Of `Stripes`, for compiled functions."""

    pixels: FloatArray
    width_px: FloatArray
    directions: FloatArray
    stripe: Ints

    @classmethod
    def of(cls, stripes: Stripes) -> _Ridges:
        return cls(stripes.pixels, stripes.width_px, stripes.directions, stripes.stripe)


@compiled
def _standing_out(image: Image, pixel: FloatArray, width_px: float) -> float:
    """By how much [grey levels] a ridge is brighter, or darker, than the ground beside it."""
    row, last = image[int(pixel[1])], image.shape[1] - 1
    quarter, beside = 0.25 * width_px, (width_px, 1.5 * width_px)
    top, tops, ground, grounds = 0.0, 0, 0.0, 0
    for k in range(max(math.ceil(pixel[0] - beside[1]), 0), min(int(pixel[0] + beside[1]), last) + 1):
        away = abs(k - pixel[0])
        if away <= max(quarter, 0.5):
            top, tops = top + row[k], tops + 1
        elif away >= beside[0]:
            ground, grounds = ground + row[k], grounds + 1
    return abs(top / tops - ground / grounds) if tops and grounds else math.nan


@compiled
def _contrast(image: Image, line: _Line, reach_px: float) -> float:
    """The range [grey levels] of an image along an epipolar line, about where the ground puts a ridge.

    NaN where it leaves the image. A sample is the mean of nine pixels.
    """
    height, width = image.shape
    least, most, away = math.inf, -math.inf, -reach_px
    while away <= reach_px:
        u, v = int(line.u + away * line.along_u + 0.5), int(line.v + away * line.along_v + 0.5)
        if not (1 <= u < width - 1 and 1 <= v < height - 1):
            return math.nan
        mean = 0.0
        for i in range(-1, 2):
            for j in range(-1, 2):
                mean += image[v + i, u + j] / 9.0
        least, most, away = min(least, mean), max(most, mean), away + 1.0
    return most - least


@compiled
def _borne_out(
    one: Eye,
    other: Eye,
    ridges: _Ridges,
    traces: Traces,
    field: Field,
    images: tuple[Image, Image],
    height_sigma_m: FloatArray,
    noise_px: float,
) -> Ints:
    """See `witnesses`."""
    n = len(ridges.stripe)
    found = np.zeros(n, np.intp)
    lines = [_epipolar_line(one, other, ridges.directions[i]) for i in range(n)]
    for i in range(n):
        line = lines[i]
        if not (line.rise > 0.0 and _in_view(line.u, line.v, field)):
            continue
        before, after = max(i - 1, 0), min(i + 1, n - 1)
        before = before if ridges.stripe[before] == ridges.stripe[i] else i
        after = after if ridges.stripe[after] == ridges.stripe[i] else i
        du, dv = lines[after].u - lines[before].u, lines[after].v - lines[before].v
        if not abs(line.along_u * dv - line.along_v * du) > GLANCING * math.hypot(du, dv):
            continue
        room = GATE * math.hypot(line.rise * height_sigma_m[i], noise_px)
        reach = room + ridges.width_px[i]
        nearest, beyond = math.inf, _side(line, traces.pixels[0]) if len(traces.pixels) else 0.0
        for k in range(len(traces.pixels) - 1):
            side, beyond = beyond, _side(line, traces.pixels[k + 1])
            if side * beyond <= 0.0 and traces.chain[k] == traces.chain[k + 1]:
                away = abs(_crossing(line, traces.pixels, traces.chain, k, side, beyond)[1])
                nearest = away if away < nearest else nearest
        if nearest <= room:
            found[i] = 1
        elif nearest <= reach:
            found[i] = -1
        else:
            here = _standing_out(images[0], ridges.pixels[i], ridges.width_px[i])
            found[i] = -1 if _contrast(images[1], line, reach) < FAINT * here else 0
    return found


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
) -> tuple[Ints, Ints, Ints, FloatArray, FloatArray, FloatArray, FloatArray]:
    """The fields of `Matches`."""
    most = len(directions) * 4
    one_stripe, other_stripe, ridge = np.empty(most, np.intp), np.empty(most, np.intp), np.empty(most, np.intp)
    points, disparity, per_m, left_share = np.empty((most, 3)), np.empty(most), np.empty(most), np.empty(most)
    count = 0
    for i in range(len(directions)):
        line = _epipolar_line(left, right, directions[i])
        room = GATE * math.hypot(line.rise * height_sigma_m[i], noise_px)
        beyond = _side(line, pixels[0]) if len(pixels) else 0.0
        for k in range(len(pixels) - 1 if line.rise > 0.0 else 0):
            side, beyond = beyond, _side(line, pixels[k + 1])
            if side * beyond > 0.0 or other[k] != other[k + 1] or count == most:
                continue
            share, far, sine = _crossing(line, pixels, other, k, side, beyond)
            if not (sine >= GLANCING and abs(far) <= room):
                continue
            one_stripe[count], other_stripe[count], ridge[count] = stripe[i], other[k], i
            ray_there = across[k] + share * (across[k + 1] - across[k])
            points[count] = midpoint(left.centre_m, directions[i], right.centre_m, ray_there)
            high = points[count, 2] / left.centre_m[2]
            disparity[count], per_m[count] = far, far / points[count, 2] if abs(high) > _STEP else line.rise
            # The disparity is the left ridge's error less the right one's: a mean between two ridges, of so much of
            # the variance of one. By the inverse variances it is uncorrelated with the mean of both places.
            variance = share**2 + (1.0 - share) ** 2
            left_share[count] = variance / (1.0 + variance)
            count += 1
    return (
        one_stripe[:count], other_stripe[:count], ridge[:count], points[:count], disparity[:count], per_m[:count],
        left_share[:count],
    )  # fmt: skip
