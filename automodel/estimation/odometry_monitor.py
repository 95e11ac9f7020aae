"""Whether what a car is told of its own motion agrees with what the camera sees.

An odometer that stands still or counts backwards carries the lane to where it is not, and what lies below the car
never changes. Lines that lie far from where the motion puts them, frame after frame, tell that it is wrong.
"""

from __future__ import annotations

import numpy as np

from automodel.compiled import compiled
from automodel.types import Floats, Ints


class OdometryMonitor:
    """Trust in the motion that is told; `sigma_m` (n,): how well the place of each node is measured [m]."""

    MIN_NODES = 3  # nodes that tell something
    SHARE, MOST = 0.3, 6.0  # of a frame in the mean, and what it counts at most [sigmas]
    REJECTED = 2.5  # the mean from which on motion is not trusted
    RETRY_NS, RETRY_SHARE = (
        5_000_000_000,
        0.5,
    )  # after which it gets another chance, and the share of `REJECTED` it begins with

    def __init__(self, sigma_m: Floats) -> None:
        self._sigma = sigma_m
        self.reset()

    def reset(self) -> None:
        """Trust."""
        self._mean = 0.0
        self._rejected_ns: int | None = None

    def trusted(self, t_ns: int) -> bool:
        """Whether the motion up to `t_ns` may be used."""
        if self._rejected_ns is not None and not 0 <= t_ns - self._rejected_ns < self.RETRY_NS:
            self._mean, self._rejected_ns = self.RETRY_SHARE * self.REJECTED, None
        return self._rejected_ns is None

    def rejects(self, t_ns: int, nodes: Ints, residual: Floats, found: Floats) -> bool:
        """Whether trust breaks with this frame, whose lane the motion predicted.

        `nodes` (k,) were looked for, and found `residual` (k or more,) [m] beside their place where `found` is above 0.
        """
        usual, count = _usual(self._sigma, nodes, residual, found)
        if count >= self.MIN_NODES:
            self._mean += self.SHARE * (min(usual, self.MOST) - self._mean)
        if self._mean < self.REJECTED:
            return False
        self._rejected_ns = t_ns
        return True


@compiled
def _usual(sigma: Floats, nodes: Ints, residual: Floats, found: Floats) -> tuple[float, int]:
    """The median [sigmas] of the residuals of the nodes that were found, and how many they are."""
    sizes, count = np.empty(len(nodes)), 0
    for i in range(len(nodes)):
        if found[i] > 0.0:
            size, at = abs(residual[i] / sigma[nodes[i]]), count
            while at > 0 and sizes[at - 1] > size:
                sizes[at] = sizes[at - 1]
                at -= 1
            sizes[at] = size
            count += 1
    return (0.5 * (sizes[count // 2] + sizes[(count - 1) // 2]) if count else 0.0), count
