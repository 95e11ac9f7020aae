"""Polynomial regression by the normal equations (Balbuena Palma et al. 2020, eq. (1)-(3), (6))."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from automodel.types import FloatArray


def fit_polynomial(x: ArrayLike, y: ArrayLike, degree: int, weights: ArrayLike | None = None) -> FloatArray:
    """Coefficients (degree + 1,), lowest power first, of the least-squares polynomial y(x).

    The paper solves the normal equations on image rows, which are ill-conditioned; here x is scaled to -1 .. 1 first
    and the coefficients are transformed back. The degree is less than the number of distinct x. Raises ValueError
    without points.
    """
    xs, ys = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if len(xs) == 0:
        raise ValueError("x: no point to fit")
    low, high = float(xs.min()), float(xs.max())
    centre, scale = 0.5 * (low + high), max(0.5 * (high - low), 1e-12)
    degree = min(degree, len(set(xs.tolist())) - 1)
    t = (xs - centre) / scale
    powers = np.empty((degree + 1, len(xs)))
    powers[0] = 1.0
    for k in range(1, degree + 1):
        powers[k] = powers[k - 1] * t
    weighted = powers if weights is None else powers * np.asarray(weights, dtype=np.float64)
    normal = weighted @ powers.T
    normal.flat[:: degree + 2] += 1e-12
    return shift_polynomial(np.linalg.solve(normal, weighted @ ys), centre, scale)


def shift_polynomial(local: FloatArray, centre: float, scale: float) -> FloatArray:
    """Coefficients in x of sum local_k ((x - centre) / scale)^k, by Horner's scheme on polynomials."""
    out = [float(local[-1])]
    for coefficient in local[-2::-1].tolist():  # out(x) <- out(x) (x - centre) / scale + coefficient
        rise = [value / scale for value in out]
        out = [a - b * centre for a, b in zip([0.0, *rise], [*rise, 0.0], strict=True)]
        out[0] += coefficient
    return np.array(out)
