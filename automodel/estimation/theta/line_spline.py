"""A smoothing cubic spline through the ordered points of one line, and its samples in the s-theta plane.

Cudrano et al. 2020, section IV: the points of a line are "temporarily fit to a cubic spline model to filter out the
small noise", the spline is sampled, and eq. (1) gives arc length s and direction theta of each sample.

The spline is c(t) = sum_j c_j B_j(t) on equidistant knots, t the chord length. It minimises
sum_i |c(t_i) - p_i|^2 / sigma_i^2 + sum_k |c'''_k|^2 / q^2, with c'''_k the third derivative in interval k. As a
prior that is a random walk of the curvature with steps of about q [1/m^2]. Quadratics, which are nearly arcs, cost
nothing, so the ends of a bend are not straightened. One small linear system gives x and y; its inverse gives the
covariance of the samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from automodel.estimation.theta.heading_polynomial import ORDER
from automodel.types import FloatArray

MIN_POINTS = ORDER  # as a cubic has coefficients
FAR_M = 1e4  # coordinates and sigmas beyond are not used

# Cubic B-splines on an interval: rows are powers 0 .. 3 of the place 0 .. 1 in it, columns the four splines there
_PIECES = np.array([[1.0, 4.0, 1.0, 0.0], [-3.0, 0.0, 3.0, 0.0], [3.0, -6.0, 3.0, 0.0], [-1.0, 3.0, -3.0, 1.0]]) / 6.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampledLine:
    """Samples of one line, in order; n >= 2, all finite.

    `s_m` (n,) arc length from the first sample, rising; `theta_rad` (n,) direction, continuous; `points_m` (n, 2);
    `theta_sigma_rad` (n,) and `lateral_sigma_m` (n,) their standard deviations. The errors of neighbouring samples are
    correlated: n samples weigh as `independence` times n.
    """

    s_m: FloatArray
    theta_rad: FloatArray
    points_m: FloatArray
    theta_sigma_rad: FloatArray
    lateral_sigma_m: FloatArray
    independence: float

    @property
    def length_m(self) -> float:
        """Arc length [m] from the first sample to the last."""
        return float(self.s_m[-1])


def smooth(
    points_m: FloatArray, sigma_m: FloatArray, step_m: float, knot_m: float, curvature_rate_per_m2: float
) -> SampledLine | None:
    """The line through points (n, 2) [m] of standard deviations (n,) [m], sampled every `step_m` or a little less.

    `knot_m` is the spacing of the spline's knots, `curvature_rate_per_m2` is q. There are at most as many knots as
    points: on a line of few they lie farther apart. Points that are not finite are ignored, and a line that turns back
    ends there. None with fewer than four distinct points, or without length.
    """
    points, sigma = _usable(points_m, sigma_m)
    if len(points) < MIN_POINTS:
        return None
    t = _chord_lengths(points, knot_m)
    length = float(t[-1])
    if length < step_m or np.count_nonzero(t[1:] - t[:-1] > 1e-6 * length) < MIN_POINTS - 1:
        return None
    intervals = min(max(math.ceil(length / knot_m), 1), len(points))
    spacing = length / intervals
    basis = _basis(t / spacing, intervals)
    penalty = _third_differences(intervals) / (spacing**6 * curvature_rate_per_m2**2)
    weighted = (basis / (sigma * sigma)[:, None]).T
    data = weighted @ basis
    normal = data + penalty
    normal.flat[:: len(normal) + 1] += 1e-12 * normal.trace()
    control = np.linalg.solve(normal, weighted @ points)
    return _sampled(control, normal, data, spacing, math.ceil(min(spacing, knot_m) / step_m))


def _usable(points_m: FloatArray, sigma_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    away = np.abs(points_m)
    good = (away[:, 0] < FAR_M) & (away[:, 1] < FAR_M) & (sigma_m > 0.0) & (sigma_m < FAR_M)
    return (points_m, sigma_m) if good.all() else (points_m[good], sigma_m[good])


def _chord_lengths(points: FloatArray, knot_m: float) -> FloatArray:
    """Chord length (n,) along the line to each point [m].

    Where points are dense a step counts along the direction of its neighbourhood, at most half a knot to either side,
    so that noise across the line does not lengthen it; a step backwards counts 0.
    """
    steps = points[1:] - points[:-1]
    count = len(steps)
    t = np.zeros(count + 1)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    total = float(lengths.sum())
    wide = int(0.5 * knot_m * count / total) if total > 0.0 else 0
    if wide == 0 or count <= 2 * wide:
        t[1:] = lengths
    else:
        chords = np.empty_like(steps)
        chords[wide:-wide] = points[2 * wide + 1 :] - points[: -2 * wide - 1]
        chords[:wide] = chords[wide]
        chords[-wide:] = chords[-wide - 1]
        length = np.maximum(np.hypot(chords[:, 0], chords[:, 1]), 1e-12)
        np.maximum(np.einsum("ij,ij->i", steps, chords) / length, 0.0, out=t[1:])
    return t.cumsum()


def _sampled(
    control: FloatArray, normal: FloatArray, data: FloatArray, spacing: float, per_interval: int
) -> SampledLine | None:
    both = _sample_basis(len(control) - 3, per_interval)
    count = len(both) // 2
    placed = both @ control
    points, rate = placed[:count], placed[count:] / spacing
    before, after = rate[:-1], rate[1:]
    onwards = np.einsum("ij,ij->i", before, after)
    turn = np.arctan2(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], onwards)
    folds = onwards <= 0.0
    end = int(folds.argmax()) + 1 if folds.any() else len(points)
    steps = points[1:end] - points[: end - 1]
    turn = turn[: end - 1]
    length = np.hypot(steps[:, 0], steps[:, 1]) * (1.0 + turn * turn / 24.0)  # an arc is longer than its chord
    if end < MIN_POINTS or not (length > 0.0).all():
        return None
    s, theta = np.zeros(end), np.empty(end)
    np.cumsum(length, out=s[1:])
    theta[0] = np.arctan2(rate[0, 1], rate[0, 0])
    theta[1:] = theta[0] + np.cumsum(turn)
    covariance = np.linalg.solve(normal, np.eye(len(control)))
    spread = np.sqrt(np.einsum("ij,ij->i", both @ covariance, both))
    bearing = spread[count:] / (spacing * np.maximum(np.hypot(rate[:, 0], rate[:, 1]), 1e-3))
    if not math.isfinite(float(s[-1] + theta[-1] + bearing.sum())):
        return None
    return SampledLine(
        s_m=s,
        theta_rad=theta,
        points_m=points[:end],
        theta_sigma_rad=bearing[:end],
        lateral_sigma_m=spread[:end],
        independence=min(float(np.einsum("ij,ij->", covariance, data)) / count, 1.0),
    )


def _basis(u: FloatArray, intervals: int) -> FloatArray:
    """The splines' values (n, intervals + 3) at u in 0 .. intervals."""
    which = np.minimum(u.astype(np.intp), intervals - 1)
    place = u - which
    powers = np.empty((len(u), 4))
    powers[:, 0] = 1.0
    powers[:, 1] = place
    powers[:, 2] = place * place
    powers[:, 3] = powers[:, 2] * place
    out = np.zeros((len(u), intervals + 3))
    first = np.arange(len(u)) * (intervals + 3) + which
    out.reshape(-1)[first[:, None] + np.arange(4)] = powers @ _PIECES
    return out


@lru_cache(maxsize=256)
def _sample_basis(intervals: int, per_interval: int) -> FloatArray:
    """Values and, below them, slopes per interval (2 n, intervals + 3) of the splines at equidistant places."""
    u = np.linspace(0.0, intervals, intervals * per_interval + 1)
    slopes = np.zeros((len(u), intervals + 3))
    which = np.minimum(u.astype(np.intp), intervals - 1)
    place = (u - which)[:, None]
    pieces = _PIECES[1] + place * (2.0 * _PIECES[2] + place * 3.0 * _PIECES[3])
    slopes[np.arange(len(u))[:, None], which[:, None] + np.arange(4)] = pieces
    return np.vstack((_basis(u, intervals), slopes))


@lru_cache(maxsize=256)
def _third_differences(intervals: int) -> FloatArray:
    difference = np.diff(np.eye(intervals + 3), 3, axis=0)
    return np.asarray(difference.T @ difference)
