"""Two ways to the least of 1/2 x^T P^-1 x + 1/2 x^T A x - x^T b, the prior and the weighted squared distances.

Gauss-Newton solves for it in one step. Plain gradient descent is the thesis's choice (Smith, section 1.3): many cheap
steps. Both give x (m,), its covariance (A + P^-1)^-1 (m, m), and the number of iterations.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]

MOST_STEPS = 1000
CONVERGED = 1e-5  # of a prior's sigma: steps below that are the end


def posterior(information: Floats, covariance: Floats, one: Floats) -> Floats:
    """(A + P^-1)^-1 = (1 + P A)^-1 P, where 1 + P A has no eigenvalue below 1; `one` is the unit matrix.

    By OpenCV's solver: numpy's takes three times as long for matrices of this size, most of it for its arguments.
    """
    both = cv2.solve(one + covariance @ information, covariance)[1]
    return np.asarray(0.5 * (both + both.T))


def gauss_newton(information: Floats, pull: Floats, covariance: Floats, one: Floats) -> tuple[Floats, Floats, int]:
    """The least itself."""
    after = posterior(information, covariance, one)
    return after @ pull, after, 1


def gradient_descent(information: Floats, pull: Floats, covariance: Floats, one: Floats) -> tuple[Floats, Floats, int]:
    """Steps down the gradient, each parameter in units of its prior's sigma, until a step is small."""
    sigma = np.sqrt(covariance.diagonal())
    units = np.outer(sigma, sigma)
    hessian = np.linalg.solve(covariance / units, one) + information * units
    slope, at = pull * sigma, np.zeros_like(pull)
    rate = 1.0 / float(np.abs(hessian).sum(axis=0).max())  # no eigenvalue is larger (Gershgorin)
    count = 0
    while count < MOST_STEPS:
        step = rate * (slope - hessian @ at)
        at, count = at + step, count + 1
        if float(np.abs(step).max()) < CONVERGED:
            break
    return at * sigma, posterior(information, covariance, one), count


LAWS: dict[str, Callable[[Floats, Floats, Floats, Floats], tuple[Floats, Floats, int]]] = {
    "gauss_newton": gauss_newton,
    "gradient_descent": gradient_descent,
}
