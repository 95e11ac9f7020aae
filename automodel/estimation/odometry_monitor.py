"""Whether the reported motion of the car agrees with what the camera sees.

An odometer that stands still or counts backwards moves the predicted lane away from the real one, while what lies
below the car never changes. Lines that are found far from their predicted places in many frames reveal it.
"""

from __future__ import annotations

from statistics import median

import numpy as np

from automodel.types import Floats, Ints


class OdometryMonitor:
    """Rejects the odometry while lines contradict it; `sigma_m` (n,): standard deviation of each node's place [m]."""

    MIN_NODES = 3  # found in a frame, so that it counts
    SHARE, MOST = 0.3, 6.0  # of a frame in the running mean; the most [sigmas] that it counts
    REJECTED = 2.5  # [sigmas] running mean from which on the odometry is rejected
    RETRY_NS = 5_000_000_000  # after this time the odometry is used again,
    RETRY_SHARE = 0.5  # with the running mean at this share of `REJECTED`

    def __init__(self, sigma_m: Floats) -> None:
        self._sigma = sigma_m
        self.reset()

    def reset(self) -> None:
        """Forget every residual; the odometry is trusted."""
        self._mean = 0.0
        self._rejected_ns: int | None = None

    def trusted(self, t_ns: int) -> bool:
        """Whether the motion up to `t_ns` may be used."""
        if self._rejected_ns is not None and not 0 <= t_ns - self._rejected_ns < self.RETRY_NS:
            self._mean, self._rejected_ns = self.RETRY_SHARE * self.REJECTED, None
        return self._rejected_ns is None

    def rejects(self, t_ns: int, nodes: Ints, residual: Floats, found: Floats) -> bool:
        """Whether the odometry is rejected with this frame, whose lane it predicted.

        `nodes` (k,) were searched for. `residual` (k or more,) [m] is their distance from the predicted place where
        `found` is above 0. The frame counts with the median of their residuals in sigmas.
        """
        k = len(nodes)
        sigmas = np.abs(residual[:k] / self._sigma[nodes])[found[:k] > 0.0].tolist()
        if len(sigmas) >= self.MIN_NODES:
            self._mean += self.SHARE * (min(median(sigmas), self.MOST) - self._mean)
        if self._mean < self.REJECTED:
            return False
        self._rejected_ns = t_ns
        return True
