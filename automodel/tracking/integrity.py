"""The bound of a pose: the error that is exceeded in at most 1 of 1,000 frames, whatever its cause.

    bound = max over the hypotheses that may be true of |d_h - d| + K sqrt(P_dd inflation + systematic^2)

The covariance P knows the noise. `inflation` is by how much the innovations have been larger of late than they should.
What averaging never removes, the camera's pitch, yaw, roll and height, is carried through the projection (protection
levels, as satellite navigation states them: RTCA DO-229, appendix J).
"""

from __future__ import annotations

import dataclasses
import math
from statistics import NormalDist

import numpy as np

from automodel.config import CameraConfig
from automodel.geometry import GroundCamera
from automodel.signals import EXCEEDED

K = 3.5  # sigmas of a bound: a normal error exceeds 3.3 in 1 of 1,000; the tails of a vision error are heavier
# Of a camera that nobody calibrated: standard deviations of a mount set by eye with a spirit level and a ruler.
ANGLE_RAD = math.radians(0.6)
HEIGHT_SHARE = 0.03
SHARE = 0.05  # of an innovation in the running mean of their squares: about the last twenty count


def chi_square(exceeded: float) -> float:
    """What a chi-square of two degrees of freedom exceeds with a probability."""
    return -2.0 * math.log(exceeded)


MOST = chi_square(EXCEEDED * EXCEEDED)  # largest inflation: a bound five times as large as it was fills any lane


class CameraErrors:
    """Standard deviations of offset and heading due to a camera that is not quite as car.toml says.

    `offset_m` and `heading_rad` are those of a car on the middle of a straight lane. What lies to the side is also seen
    larger or smaller by `scale`, and by `wedge_per_m` more for each metre ahead.
    """

    def __init__(self, camera: CameraConfig, lane_width_m: float, reference_x_m: float) -> None:
        assumed = GroundCamera.from_config(camera)
        near = max(assumed.first_visible_x_m(), reference_x_m)
        x = np.linspace(near, near + 1.5 * lane_width_m, 8)
        half = 0.5 * lane_width_m
        mount = camera.extrinsics
        shifts, turns, scales, wedges = [], [], [], []
        for name, step in (
            ("pitch_rad", ANGLE_RAD),
            ("yaw_rad", ANGLE_RAD),
            ("roll_rad", ANGLE_RAD),
            ("z_m", HEIGHT_SHARE * mount.z_m),
        ):
            real = dataclasses.replace(mount, **{name: getattr(mount, name) + step})
            camera_as_is = GroundCamera.from_config(dataclasses.replace(camera, extrinsics=real))
            lines = []
            for side in (half, -half):
                seen = assumed.px_to_ground(camera_as_is.ground_to_px(np.column_stack((x, np.full_like(x, side)))))
                good = np.isfinite(seen).all(axis=1)
                if good.sum() < 2:
                    continue
                lines.append(np.polyfit(seen[good, 0] - reference_x_m, seen[good, 1], 1))
            if len(lines) == 2:
                (left_slope, left), (right_slope, right) = lines
                shifts.append(0.5 * (left + right))
                turns.append(0.5 * (left_slope + right_slope))
                scales.append((left - right) / lane_width_m - 1.0)
                wedges.append((left_slope - right_slope) / lane_width_m)
        self.offset_m = math.hypot(*shifts)
        self.heading_rad = math.hypot(*turns)
        self.scale = math.hypot(*scales)
        self.wedge_per_m = math.hypot(*wedges)

    def sigmas(self, aside_m: float) -> tuple[float, float]:
        """Sigmas of offset [m] and heading [rad] where the lane's middle lies so far aside of the car's path."""
        return (
            math.hypot(self.offset_m, self.scale * aside_m),
            math.hypot(self.heading_rad, self.wedge_per_m * aside_m),
        )


class Innovations:
    """By how much innovations have been larger than their covariance says, of late: a factor of at least 1."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget them."""
        self._mean = 1.0

    def add(self, normalised: float) -> None:
        """Take a normalised innovation squared, divided by its dimension: 1 on average where all is well."""
        if math.isfinite(normalised):
            self._mean += SHARE * (min(normalised, MOST) - self._mean)

    @property
    def inflation(self) -> float:
        """The factor for the covariance."""
        return max(self._mean, 1.0)


def sigmas(exceeded: float) -> float:
    """How many sigmas a normal error exceeds, to either side, with a probability."""
    return NormalDist().inv_cdf(1.0 - 0.5 * exceeded)


def bound(variance: float, systematic: float) -> float:
    """The error that is exceeded in at most 1 of 1,000 frames, by noise of this variance and a systematic sigma."""
    return K * math.sqrt(max(variance, 0.0) + systematic * systematic)
