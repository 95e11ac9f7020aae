"""Linear equations of a few unknowns, compiled: what the estimators' least squares come down to."""

from __future__ import annotations

from automodel.compiled import compiled
from automodel.types import Floats


@compiled
def solve(matrix: Floats, right: Floats) -> Floats:
    """X (m, k) of `matrix` (m, m) X = `right` (m, k), by Gaussian elimination with row pivots; overwrites both.

    For matrices of this size the call of a library's solver would take longer than the elimination.
    """
    m, k = right.shape
    for c in range(m):
        pivot = c
        for r in range(c + 1, m):
            if abs(matrix[r, c]) > abs(matrix[pivot, c]):
                pivot = r
        for j in range(c, m):
            matrix[c, j], matrix[pivot, j] = matrix[pivot, j], matrix[c, j]
        for j in range(k):
            right[c, j], right[pivot, j] = right[pivot, j], right[c, j]
        for r in range(c + 1, m):
            share = matrix[r, c] / matrix[c, c]
            for j in range(c + 1, m):
                matrix[r, j] -= share * matrix[c, j]
            for j in range(k):
                right[r, j] -= share * right[c, j]
    for c in range(m - 1, -1, -1):
        for j in range(k):
            for r in range(c + 1, m):
                right[c, j] -= matrix[c, r] * right[r, j]
            right[c, j] /= matrix[c, c]
    return right
