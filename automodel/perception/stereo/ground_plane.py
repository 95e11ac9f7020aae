"""The ground plane from matched stripes: deterministic and robust, after the stereo paper's stage 4.

Chains are the matches of a left stripe with a right one, the longest first. Each two of them propose a plane, together
with what is known of it; the plane on which most matches lie is fitted again to all chains on it. What a match says is
weighed in the image, where its noise is the same near and far.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from automodel.compiled import compiled
from automodel.geometry.elimination import solve
from automodel.perception.stereo.matching import Matches
from automodel.types import Bools, FloatArray, Floats, Ints

ROUNDS = 3  # of the fit
CHAINS = 8  # the longest ones, which propose planes: 28 pairs


@dataclass(slots=True, eq=False)
class PlaneFit:
    """A plane by the matches of a frame and what was known before.

    `step` (3,): height [m], pitch and roll [rad] of the cameras beyond the predicted plane, with its `covariance`
    (3, 3). `inliers` (m,): the matches on it. `residual_px`: their root mean square distance from it; NaN for none.
    """

    step: Floats
    covariance: Floats
    inliers: Bools
    residual_px: float


def fit_plane(
    matches: Matches,
    eyes_m: FloatArray,
    middle_m: FloatArray,
    prior: FloatArray,
    noise_px: float,
    witnesses: float,
) -> PlaneFit:
    """The plane of the matches.

    `eyes_m` (2, 3): the left and the right camera, over the predicted plane; `middle_m` (3,): about which they turn;
    `prior` (3, 3): covariance of the predicted plane; `noise_px`: of a match, at least: a larger one is measured;
    `witnesses`: the share of a match that counts, since neighbouring ridges have their errors in common.
    """
    chain = matches.left * (1 + int(matches.right.max(initial=0))) + matches.right
    known = np.linalg.solve(prior, np.eye(3))
    level = middle_m * (1.0, 1.0, 0.0)
    points, eyes = matches.points_m - level, eyes_m - level
    step, covariance, inliers, residual = _fit(
        points, eyes, matches.left_share, matches.per_m, matches.disparity_px, chain, known, noise_px, witnesses
    )
    return PlaneFit(step=step, covariance=covariance, inliers=inliers, residual_px=residual)


@compiled
def _normal_equations(
    rows: FloatArray, value: FloatArray, chosen: Bools, weight: float, known: Floats
) -> tuple[Floats, Floats]:
    """Information (3, 3) and vector (3, 1) of the chosen rows (m, 3) with those of the prior."""
    information, vector = known.copy(), np.zeros((3, 1))
    for k in range(len(rows)):
        if chosen[k]:
            for i in range(3):
                vector[i, 0] += weight * rows[k, i] * value[k]
                for j in range(3):
                    information[i, j] += weight * rows[k, i] * rows[k, j]
    return information, vector


@compiled
def _on_plane(rows: FloatArray, value: FloatArray, chain: Ints, chains: Ints, step: Floats, room: float) -> Bools:
    """The matches (m,) near a plane whose chain lies on it on average."""
    inside = np.zeros(len(rows), np.bool_)
    rest = value - (rows[:, 0] * step[0] + rows[:, 1] * step[1] + rows[:, 2] * step[2])
    for c in chains:
        total, count = 0.0, 0
        for k in range(len(rows)):
            if chain[k] == c:
                total, count = total + rest[k], count + 1
        if abs(total) <= room * count:
            for k in range(len(rows)):
                if chain[k] == c and abs(rest[k]) <= 2.0 * room:
                    inside[k] = True
    return inside


@compiled
def _rows(points: FloatArray, eyes: FloatArray, left_share: FloatArray, per_m: FloatArray, step: Floats) -> FloatArray:
    """What each match (m, 3) says of the plane (m, 3) [px]: at the place where its rays meet the plane of a `step`.

    Both rays meet it at places of their own where the match is off; `left_share` (m,) counts of the left one's.

    A plane that is h higher and rises by p ahead and by q to the left is seen from cameras that are lower by h, and
    look down by p and lean to the left by q more.
    """
    rows, slope_x, slope_y = np.empty(points.shape), step[1], -step[2]
    for k in range(len(points)):
        ahead = aside = 0.0
        for i in range(2):
            eye, share = eyes[i], left_share[k] if i == 0 else 1.0 - left_share[k]
            above = eye[2] + step[0] - slope_x * eye[0] - slope_y * eye[1]
            x, y, z = points[k] - eye
            down = slope_x * x + slope_y * y - z
            far = above / down if down > 0.0 else 1.0  # of the way to the match
            ahead += share * (eye[0] + far * x)
            aside += share * (eye[1] + far * y)
        rows[k, 0] = -per_m[k]
        rows[k, 1] = per_m[k] * ahead
        rows[k, 2] = -per_m[k] * aside
    return rows


@compiled
def _fit(
    points: FloatArray,
    eyes: FloatArray,
    left_share: FloatArray,
    per_m: FloatArray,
    value: FloatArray,
    chain: Ints,
    known: Floats,
    noise: float,
    witnesses: float,
) -> tuple[Floats, Floats, Bools, float]:
    """See `fit_plane`; points and `eyes` from the ground below the middle of both.

    Where a match lies is as noisy as its height, and with it: a plane through the places of matches leans, and so does
    one through places of the left rays. So what it says is taken where both its rays meet the plane of the round
    before, in that mean of theirs whose error has nothing to do with its height's.
    """
    rows = np.column_stack((-per_m, per_m * points[:, 0], -per_m * points[:, 1]))
    chains = np.unique(chain)
    sizes = np.array([-np.count_nonzero(chain == c) for c in chains])
    longest = chains[np.argsort(sizes, kind="mergesort")][:CHAINS]
    weight, room = witnesses / noise**2, 2.0 * noise
    best, most = np.zeros(len(rows), np.bool_), 0
    for i in range(len(longest)):
        for j in range(i, len(longest)):
            both = (chain == longest[i]) | (chain == longest[j])
            information, vector = _normal_equations(rows, value, both, weight, known)
            inside = _on_plane(rows, value, chain, chains, solve(information, vector)[:, 0], room)
            count = int(inside.sum())
            if count > most:
                best, most = inside, count
    squares = 0.0
    for _ in range(ROUNDS):
        information, vector = _normal_equations(rows, value, best, weight, known)
        step = solve(information, vector)[:, 0]
        rows = _rows(points, eyes, left_share, per_m, step)
        best = _on_plane(rows, value, chain, chains, step, room)
        squares = 0.0
        for k in range(len(rows)):
            if best[k]:
                squares += (value[k] - rows[k, 0] * step[0] - rows[k, 1] * step[1] - rows[k, 2] * step[2]) ** 2
        weight = witnesses / max(noise**2, squares / max(best.sum(), 1.0))
    information, vector = _normal_equations(rows, value, best, weight, known)
    covariance = solve(information.copy(), np.eye(3))
    residual = math.sqrt(squares / best.sum()) if best.any() else math.nan
    return (covariance @ vector)[:, 0].copy(), covariance, best, residual
