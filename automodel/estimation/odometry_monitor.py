"""Whether the reported motion of the car agrees with the lines that are followed.

An odometer that stands still or counts backwards moves the predicted lane away from the real one, while what lies
below the car never changes. Lines that are found far from their predicted places in many frames reveal it.
"""

from __future__ import annotations

import numpy as np

from automodel.compiled import compiled
from automodel.types import Floats, Ints


class OdometryMonitor:
    """Notices that lines contradict the odometry.

    `sigma_m` (n,): standard deviation of each node's measured place [m]. A frame in which fewer than `least` nodes were
    found says nothing.
    """

    SHARE = 0.3  # of a frame in the running mean
    FAR = 1.7  # [sigmas] running mean that is a contradiction; a frame counts twice that at most

    def __init__(self, sigma_m: Floats, least: int) -> None:
        self._sigma, self._least = sigma_m, least
        self.reset()

    def reset(self) -> None:
        """Forget every residual."""
        self._mean = 0.0

    def contradicted(self, predicted_m: Floats, nodes: Ints, residual: Floats, found: Floats) -> bool:
        """Whether the lines contradict it with this frame, whose lane it predicted. If so, they start anew.

        `predicted_m` (n,): standard deviation of the nodes' predicted places [m]. `nodes` (k,) were searched for.
        `residual` (k or more,) [m] is their distance from the predicted place where `found` is above 0. The frame
        counts with the median of their residuals in sigmas: of an even number the smaller middle one, because half of
        the nodes may lie on a thing that is no line.
        """
        median, count = _median(np.hypot(self._sigma, predicted_m), nodes, residual, found)
        if count >= self._least:
            self._mean += self.SHARE * (min(median, 2.0 * self.FAR) - self._mean)
        far = self._mean >= self.FAR
        if far:
            self.reset()
        return far


@compiled
def _median(sigma: Floats, nodes: Ints, residual: Floats, found: Floats) -> tuple[float, int]:
    """The median size [sigmas] of the residuals of the nodes that were found, and the number of these nodes."""
    sizes, count = np.empty(len(nodes)), 0
    for i in range(len(nodes)):
        if found[i] > 0.0:
            size, at = abs(residual[i] / sigma[nodes[i]]), count
            while at > 0 and sizes[at - 1] > size:
                sizes[at] = sizes[at - 1]
                at -= 1
            sizes[at] = size
            count += 1
    return (sizes[(count - 1) // 2] if count else 0.0), count
