"""Evidence for or against a calibrated pair of cameras, from corners that both see: a comparison of hypotheses.

Corners are matched by their looks alone, without regard to any calibration. Each hypothesis says where a corner of the
first image may lie in the second one: on its epipolar line, ahead of the cameras and not below the ground, and often on
the ground. It is credited with the likelihood of all matches, of which an unknown share is wrong and lies anywhere. The
second camera may be turned a little against its calibration: by normal angles, over which the likelihood is integrated.

- as calibrated: both cameras where car.toml puts them, within a calibration's error;
- exchanged: the first image is the second camera's, and the second one the first's;
- turned: as calibrated, but the angles between the cameras are those of any other mount.

Turns about the vertical axis do not move a corner off its epipolar line: they show as corners behind the cameras or
below the ground.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from automodel.compiled import compiled
from automodel.geometry import GroundCamera
from automodel.geometry.stereo_rig import Eye, StereoRig, bearings, on_ground
from automodel.types import Bools, FloatArray, Floats, Image, Ints

CORNERS = 200  # of an image at most: a look takes 10 to 20 ms of a laptop, a third at a time
_APART = (
    80.0  # corners lie at least the image's width divided by this apart: nearer ones are no more witnesses than one
)
_QUALITY = 0.01  # of the best corner's smaller eigenvalue (Shi and Tomasi 1994); weaker ones are noise
NOISE_PX = 1.0  # of a match: both corners are whole pixels
_PATCH_PX = 31.0  # of the descriptor (BRIEF, upright: Calonder et al. 2010)
_CELLS = 10.0  # in the image's width: corners of one cell lie on one thing, and are often wrong together. Where the
# angles are free, those of a cell are one witness: they agree on some turn whatever they are. Where they are known,
# n of them count as n^0.5: half way between one witness and n. Of 360 views of right pairs (sim, random light, floor
# and place, errors of 0.2 deg in half of them) the ratio then was at most 6.2 nats for exchanged cameras and 8.3 for
# turned ones; where all count alike, 1 in 22 was above 14 nats for turned ones.
_IN_A_CELL = 0.5
CANDIDATES = 3  # of a corner at most
_ALIKE_BITS = 24  # of 256 in which descriptors of one thing differ more than those of another one, by noise
_PRIOR = 0.5  # matches, right and wrong, that the share of right ones begins with: Jeffreys' prior
_ITERATIONS = 12  # at most; the last ones change the ratio by less than 0.1 nats
_EDGE = 2.0  # sigmas by which a corner at infinity, or on the ground, is within: it is as likely as one between
_NEAR = 0.04  # of the image's side: standard deviation of wrong matches that are near
_YAW_STEP_PX = 2.0  # between the turns about the vertical axis that are tried, as the image moves by them
_YAW_SIGMAS = 3.0  # they reach so far

HeightSigma = Callable[[FloatArray], FloatArray]  # how well the ground's height is known (n,) [m] at places (n, 2) [m]


class Corners(NamedTuple):
    """Corners of an image: pixels (n, 2) and descriptors (n, 32) uint8."""

    pixels: FloatArray
    looks: Image


@dataclass(frozen=True, slots=True, kw_only=True)
class PairEvidence:
    """Log-likelihood ratios [nats] of both other hypotheses to the calibrated pair; above zero speaks against that.

    `matched` corners of both images look alike; `fitting`: how many witnesses for the calibrated pair there are.
    `turned_rad` (3,): by how much the second camera is turned about the body's x, y and z axis, where it is.
    """

    matched: int
    fitting: float
    exchanged: float
    turned: float
    turned_rad: tuple[float, float, float]


def find_corners(image: Image) -> Corners:
    """The corners of a grey image."""
    apart = image.shape[1] / _APART
    found = cv2.goodFeaturesToTrack(image, CORNERS, _QUALITY, apart)
    if found is None or not len(found):
        return Corners(np.empty((0, 2)), np.empty((0, 32), np.uint8))
    points = [cv2.KeyPoint(float(u), float(v), _PATCH_PX) for u, v in found.reshape(-1, 2)]
    points, looks = cv2.ORB_create(nlevels=1).compute(image, points)  # type: ignore[attr-defined]
    if looks is None:
        return Corners(np.empty((0, 2)), np.empty((0, 32), np.uint8))
    return Corners(np.array([point.pt for point in points], np.float64).reshape(-1, 2), looks)


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """What may be the same corners: pixels (m, 2) in both images, and the first image's corner (m,) of each, in order.

    Markings look alike, so that a corner has several candidates, of which one is right at most.
    """

    one_px: FloatArray
    other_px: FloatArray
    corner: Ints


def match_corners(one: Corners, other: Corners) -> Matches:
    """The candidates: corners that look nearly as much alike as each one's most similar one."""
    if not (len(one.pixels) and len(other.pixels)):
        return Matches(np.empty((0, 2)), np.empty((0, 2)), np.empty(0, np.intp))
    bits, best = _nearest(one.looks, other.looks, CANDIDATES)
    backwards, _ = _nearest(other.looks, one.looks, 1)
    alike = (best >= 0) & (bits <= bits[:, :1] + _ALIKE_BITS) & (bits <= backwards[best, 0] + _ALIKE_BITS)
    corner, place = np.nonzero(alike)
    return Matches(one.pixels[corner], other.pixels[best[corner, place]], corner)


def _nearest(looks: Image, others: Image, count: int) -> tuple[Ints, Ints]:
    """Hamming distances (n, count) of descriptors (n, 32) from their nearest ones, and which these are; -1 for none."""
    found = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(looks, others, count)
    bits, index = np.full((len(looks), count), 256, np.intp), np.full((len(looks), count), -1, np.intp)
    for row, nearest in enumerate(found):
        for column, match in enumerate(nearest):
            bits[row, column], index[row, column] = match.distance, match.trainIdx
    return bits, index


def weigh(
    rig: StereoRig, matches: Matches, height_sigma: HeightSigma, known_rad: float, any_rad: float
) -> PairEvidence:
    """The evidence of the corners of a left and a right image.

    `height_sigma`: of the ground about the middle between the cameras; `known_rad`, `any_rad`: standard deviations
    of the angles between the cameras of a calibrated pair, and between those of any two.
    """
    given = _Seen.of(rig.left, rig.right, rig.middle_m, matches, height_sigma)
    exchanged = _Seen.of(rig.right, rig.left, rig.middle_m, matches, height_sigma)
    as_calibrated, _, fitting = given.evidence(known_rad, _IN_A_CELL)
    swapped, _, _ = exchanged.evidence(known_rad, _IN_A_CELL)
    held, _, _ = given.evidence(known_rad, 0.0)
    turned, calibrated, _ = given.evidence(any_rad, 0.0)
    return PairEvidence(
        matched=len(np.unique(given.corner)),
        fitting=fitting,
        exchanged=swapped - as_calibrated,
        turned=turned - held,
        turned_rad=(-float(calibrated[0]), -float(calibrated[1]), -float(calibrated[2])),
    )


class _Seen(NamedTuple):
    """Candidates (m,) as one hypothesis sees them.

    `corner`: those of one corner have one number, and `few`: one over how many they are; `crowd`: how many corners
    lie in the same part of the image.
    `off_px`: how far they lie off their epipolar lines, `parallax_px`: and along these, from where they were infinitely
    far away; both move by `off_per_rad`, `parallax_per_rad` (m, 3) where the second camera turns. `ground_px`: the
    parallax of the ground, infinite above the horizon, and its standard deviation `ground_sigma_px`. `size_px`: the
    image's width and height.
    """

    corner: Ints
    few: FloatArray
    crowd: FloatArray
    off_px: FloatArray
    parallax_px: FloatArray
    off_per_rad: FloatArray
    parallax_per_rad: FloatArray
    ground_px: FloatArray
    ground_sigma_px: FloatArray
    size_px: tuple[float, float]

    @classmethod
    def of(
        cls,
        one: GroundCamera,
        other: GroundCamera,
        middle_m: FloatArray,
        matches: Matches,
        height_sigma: HeightSigma,
    ) -> _Seen:
        """The candidates whose pixels are within both lens models."""
        ray = _unit(bearings(Eye.of(one), matches.one_px))
        other_ray = _unit(bearings(Eye.of(other), matches.other_px))
        known = np.isfinite(ray).all(axis=1) & np.isfinite(other_ray).all(axis=1)
        ray, other_ray, corner = ray[known], other_ray[known], matches.corner[known]
        _, first, place, counts = np.unique(corner, return_index=True, return_inverse=True, return_counts=True)
        cell = (matches.one_px[known] // (one.camera.width_px / _CELLS)) @ (1, 1000)
        _, of_cell, corners = np.unique(cell[first], return_inverse=True, return_counts=True)
        focal_px = float(other.camera.matrix[0, 0])
        normal = _unit(np.cross(other.centre_m - one.centre_m, ray))
        ground = on_ground(Eye.of(one), ray)
        down: Bools = np.asarray(np.isfinite(ground).all(axis=1))
        there = np.column_stack((np.where(down[:, None], ground, 0.0), np.zeros(len(ground))))
        ground_px = focal_px * _dot(normal, np.cross(ray, _unit(there - other.centre_m)))
        share = height_sigma(there[:, :2] - middle_m[:2]) / one.centre_m[2]
        turning = focal_px * (_dot(ray, other_ray)[:, None] * normal - _dot(normal, other_ray)[:, None] * ray)
        return cls(
            corner=corner,
            few=1.0 / counts[place],
            crowd=corners[of_cell][place].astype(np.float64),
            off_px=focal_px * _dot(normal, other_ray),
            parallax_px=focal_px * _dot(normal, np.cross(ray, other_ray)),
            off_per_rad=focal_px * np.cross(other_ray, normal),
            parallax_per_rad=turning,
            ground_px=np.where(down, ground_px, math.inf),
            ground_sigma_px=np.hypot(NOISE_PX, np.where(down, ground_px * share, 0.0)),
            size_px=(float(one.camera.width_px), float(one.camera.height_px)),
        )

    def evidence(self, sigma_rad: float, crowded: float) -> tuple[float, Floats, float]:
        """Log-likelihood beyond that of wrong matches, the calibration's likeliest turn (3,) [rad], right witnesses.

        `sigma_rad`: standard deviation of each angle; n corners of one part of the image count as n^`crowded`.
        """
        if not len(self.off_px):
            return 0.0, np.zeros(3), 0.0
        step = _YAW_STEP_PX / max(float(np.abs(self.parallax_per_rad[:, 2]).max()), 1.0)
        yaws = np.arange(-math.ceil(_YAW_SIGMAS * sigma_rad / step), math.ceil(_YAW_SIGMAS * sigma_rad / step) + 1)
        weight = np.asarray(self.crowd ** (crowded - 1.0), dtype=np.float64)
        tried: FloatArray = np.asarray(step * yaws, dtype=np.float64)
        return _integrated(self.corner, self.few, weight, *self[3:], sigma_rad, NOISE_PX, tried)


@compiled
def _upper(x: float) -> float:
    """The standard normal distribution's cumulative probability up to x."""
    return 0.5 * math.erfc(-x / math.sqrt(2.0))


@compiled
def _normal(x: float, sigma: float) -> float:
    """The normal distribution's density."""
    return math.exp(-0.5 * (x / sigma) ** 2) / (math.sqrt(math.tau) * sigma)


@compiled
def _wrong(x: float, size: float) -> float:
    """Density of how far a wrong match lies off along an image's side: half are anywhere, half near (a line's other
    corners, the next one of equal markings).
    """
    return 0.25 / size + 0.5 * _normal(x, _NEAR * size)


@compiled
def _at_parallax(parallax: float, ground: float, ground_sigma: float, noise: float, width: float) -> float:
    """Density of a right match's parallax over that of a wrong one's.

    Half of the corners lie on the ground. The others stand anywhere between infinity and there, none likelier than
    others: a whole wall at one distance says nothing of the angles between the cameras.
    """
    most, sigma = (ground, ground_sigma) if ground < width else (width, noise)
    standing = _upper(parallax / noise + _EDGE) * _upper((most - parallax) / sigma + _EDGE) / max(most, noise)
    if ground < width:
        standing = 0.5 * (standing + _normal(parallax - ground, ground_sigma))
    return standing / _wrong(parallax, width)


@compiled
def _integrated(
    corner: Ints,
    few: FloatArray,
    weight: FloatArray,
    off: FloatArray,
    parallax: FloatArray,
    off_per: FloatArray,
    parallax_per: FloatArray,
    ground: FloatArray,
    ground_sigma: FloatArray,
    size: tuple[float, float],
    sigma: float,
    noise: float,
    yaws: FloatArray,
) -> tuple[float, Floats, float]:
    """See `_Seen.evidence`: a sum over yaw; over roll and pitch by Laplace's method about each likeliest turn."""
    n, (width, height) = len(off), size
    along, best, best_turn, best_right = np.empty(n), -math.inf, np.zeros(3), 0.0
    scores = np.empty(len(yaws))
    step = yaws[1] - yaws[0] if len(yaws) > 1 else 1.0
    cells = 2.0 * noise
    count = 2 * math.ceil(height / cells) + 1
    histogram = np.empty(count)
    for k in range(len(yaws)):
        histogram[:] = 0.0
        for i in range(n):
            along[i] = (
                _at_parallax(parallax[i] - yaws[k] * parallax_per[i, 2], ground[i], ground_sigma[i], noise, width)
                * few[i]
                / _wrong(off[i], height)
            )
            cell = math.floor((off[i] - yaws[k] * off_per[i, 2] + height) / cells)
            if 0 <= cell < count:
                histogram[cell] += math.log(1.0 + along[i] / noise)
        start = np.argmax(histogram)
        scores[k] = -math.inf
        for attempt in range(2):  # from the calibrated place, and from where most matches would be right
            roll = pitch = 0.0
            if attempt == 1:
                shift = (start + 0.5) * cells - height
                top = bottom = 0.0
                for i in range(n):
                    if abs(off[i] - yaws[k] * off_per[i, 2] - shift) < cells:
                        top += off_per[i, 1] * (off[i] - yaws[k] * off_per[i, 2])
                        bottom += off_per[i, 1] ** 2
                pitch = top / (bottom + (noise / sigma) ** 2)
            score, roll, pitch, right = _climbed(
                corner, weight, off, off_per, along, yaws[k], roll, pitch, sigma, noise
            )
            if score > scores[k]:
                scores[k] = score
                if score > best:
                    best, best_right = score, right
                    best_turn[0], best_turn[1], best_turn[2] = roll, pitch, yaws[k]
    total = 0.0
    for k in range(len(yaws)):
        total += math.exp(scores[k] - best) * step / (math.sqrt(math.tau) * sigma)
    return best + math.log(total), best_turn, best_right


@compiled
def _climbed(
    corner: Ints,
    weight: FloatArray,
    off: FloatArray,
    off_per: FloatArray,
    along: FloatArray,
    yaw: float,
    roll: float,
    pitch: float,
    sigma: float,
    noise: float,
) -> tuple[float, float, float, float]:
    """Log-likelihood for one yaw, by expectation and maximisation over roll, pitch and the share of right matches.

    Returns it with the likeliest roll and pitch [rad] and the number of right matches.
    """
    n, share, right, witnesses = len(off), 0.5, 0.0, 0.0
    for i in range(n):
        if i == 0 or corner[i] != corner[i - 1]:
            witnesses += weight[i]
    odds = np.empty(n)
    rr = rp = pp = 0.0
    for _ in range(_ITERATIONS):
        rr, rp, pp = (noise / sigma) ** 2, 0.0, (noise / sigma) ** 2
        r = p = right = 0.0
        for i in range(n):
            rest = off[i] - yaw * off_per[i, 2] - roll * off_per[i, 0] - pitch * off_per[i, 1]
            odds[i] = share * along[i] * _normal(rest, noise)
        of_corner = 0.0
        for i in range(n):
            base = off[i] - yaw * off_per[i, 2]
            if i == 0 or corner[i] != corner[i - 1]:
                of_corner, k = 1.0 - share, i
                while k < n and corner[k] == corner[i]:
                    of_corner += odds[k]
                    k += 1
            mine = weight[i] * odds[i] / of_corner
            right += mine
            rr += mine * off_per[i, 0] ** 2
            rp += mine * off_per[i, 0] * off_per[i, 1]
            pp += mine * off_per[i, 1] ** 2
            r += mine * off_per[i, 0] * base
            p += mine * off_per[i, 1] * base
        volume = rr * pp - rp * rp
        new_roll, new_pitch = (pp * r - rp * p) / volume, (rr * p - rp * r) / volume
        new_share = (right + _PRIOR) / (witnesses + 2.0 * _PRIOR)
        moved = abs(new_roll - roll) + abs(new_pitch - pitch)
        roll, pitch = new_roll, new_pitch
        settled = moved < 1e-6 and abs(new_share - share) < 1e-4
        share = new_share
        if settled:
            break
    score = -0.5 * (roll**2 + pitch**2 + yaw**2) / sigma**2
    of_corner = 1.0 - share
    for i in range(n):
        rest = off[i] - yaw * off_per[i, 2] - roll * off_per[i, 0] - pitch * off_per[i, 1]
        of_corner += share * along[i] * _normal(rest, noise)
        if i == n - 1 or corner[i + 1] != corner[i]:
            score += weight[i] * math.log(of_corner)
            of_corner = 1.0 - share
    # the prior's volume over the posterior's: the information is in units of the noise
    score -= 0.5 * math.log((rr * pp - rp * rp) * (sigma / noise) ** 4)
    return score, roll, pitch, right


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _dot(one: FloatArray, other: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("ni,ni->n", one, other))
