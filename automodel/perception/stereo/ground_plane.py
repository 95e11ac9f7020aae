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


def fit_plane(matches: Matches, middle_m: FloatArray, prior: FloatArray, noise_px: float, witnesses: float) -> PlaneFit:
    """The plane of the matches.

    `middle_m` (3,): about which the cameras turn; `prior` (3, 3): covariance of the predicted plane; `noise_px`: of a
    match, at least: a larger one is measured; `witnesses`: the share of a match that counts, since
    neighbouring ridges have their errors in common.
    """
    ahead = matches.points_m[:, :2] - middle_m[:2]
    # A plane that is h higher and rises by p ahead and by q to the left, seen from cameras that are lower by h, and
    # look down by p and lean to the left by q more.
    rows = np.column_stack((-np.ones(len(ahead)), ahead[:, 0], -ahead[:, 1])) * matches.per_m[:, None]
    chain = matches.left * (1 + int(matches.right.max(initial=0))) + matches.right
    known = np.linalg.solve(prior, np.eye(3))
    step, covariance, inliers = _fit(rows, matches.disparity_px, chain, known, noise_px, witnesses)
    rest = matches.disparity_px[inliers] - rows[inliers] @ step
    residual = math.sqrt(float(rest @ rest) / len(rest)) if len(rest) else math.nan
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
def _fit(
    rows: FloatArray, value: FloatArray, chain: Ints, known: Floats, noise: float, witnesses: float
) -> tuple[Floats, Floats, Bools]:
    """See `fit_plane`."""
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
    for _ in range(2):
        information, vector = _normal_equations(rows, value, best, weight, known)
        step = solve(information, vector)[:, 0]
        best = _on_plane(rows, value, chain, chains, step, room)
        squares = 0.0
        for k in range(len(rows)):
            if best[k]:
                squares += (value[k] - rows[k, 0] * step[0] - rows[k, 1] * step[1] - rows[k, 2] * step[2]) ** 2
        weight = witnesses / max(noise**2, squares / max(best.sum(), 1.0))
    information, vector = _normal_equations(rows, value, best, weight, known)
    covariance = solve(information.copy(), np.eye(3))
    return (covariance @ vector)[:, 0].copy(), covariance, best
