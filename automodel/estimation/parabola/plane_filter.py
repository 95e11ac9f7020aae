"""The ground plane over time: the cameras' height, pitch and roll over it, as a filter's state.

After the stereo paper's stage 4: the plane is filtered first, and only the filtered one goes on. It takes in the car's
pitching and bounce, the slope of the road, and what the calibration of the mount got wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from automodel.geometry.stereo_rig import Plane
from automodel.types import FloatArray, Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaneFilterConfig:
    """Sigmas of the plane about the calibrated one, and how fast it gets there.

    `angle_rad`: of pitch and roll: a mount that is wrong by half a degree, and a body that brakes or bounces by two.
    `height_share`: of the height, likewise. `settles_s`: the time in which a body on its springs moves as far.
    """

    angle_rad: float = math.radians(1.0)
    height_share: float = 0.05
    settles_s: float = 0.5


class PlaneFilter:
    """A walk about the calibrated plane (Ornstein-Uhlenbeck), measured by the matches of each pair of images.

    What matches do not tell, as the roll where they lie on one line, so returns to the calibrated value.

    `plane` is the filtered plane and `covariance` (3, 3) that of height [m], pitch and roll [rad].
    """

    def __init__(self, height_m: float, config: PlaneFilterConfig | None = None) -> None:
        self.config = config or PlaneFilterConfig()
        angle = self.config.angle_rad
        self._most: FloatArray = np.diag(np.square((self.config.height_share * height_m, angle, angle)))
        self.reset()

    def reset(self) -> None:
        """Forget all but the calibration."""
        self.plane, self.covariance = Plane(), self._most.copy()

    def predict(self, dt_s: float, held: bool = False) -> None:
        """Time goes by: the plane is known less well. It stays where it was where it is `held`: nothing measures it."""
        kept = math.exp(-dt_s / self.config.settles_s)
        self.covariance = kept**2 * self.covariance + (1.0 - kept**2) * self._most
        if not held:
            self.plane = Plane(*(kept * np.array(self.plane)).tolist())

    def update(self, step: Floats, covariance: Floats) -> None:
        """Take the plane that a frame's matches and the prediction make together, `step` (3,) beyond the predicted."""
        self.plane = Plane(*(np.array(self.plane) + step).tolist())
        self.covariance = np.asarray(covariance, dtype=np.float64)

    @property
    def off_calibration(self) -> float:
        """Squared Mahalanobis distance of the plane from the calibrated one: chi-square of three degrees of freedom.

        By what a body that pitches and bounces does, and by what is not known of the plane.
        """
        plane = np.array(self.plane)
        return float(plane @ np.linalg.solve(self._most + self.covariance, plane))

    @property
    def chance(self) -> float:
        """How often the plane over a calibrated pair is as far off: that quantile of chi-square."""
        half = 0.5 * self.off_calibration
        return math.erfc(math.sqrt(half)) + 2.0 * math.sqrt(half / math.pi) * math.exp(-half)

    def height_sigma_m(self, ahead_m: FloatArray) -> FloatArray:
        """How well the ground's height is known (n,) [m] at places (n, 2) [m] ahead and to the left of the cameras."""
        rows = np.column_stack((-np.ones(len(ahead_m)), ahead_m[:, 0], -ahead_m[:, 1]))
        return np.sqrt(((rows @ self.covariance) * rows).sum(axis=1))
