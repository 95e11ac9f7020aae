"""All checks of a run's inputs together, as the loop calls them."""

from __future__ import annotations

from automodel.checks.lane_jump import LaneJumpCheck
from automodel.checks.picture import PictureCheck
from automodel.checks.steering import SteeringCheck
from automodel.config import CarConfig
from automodel.signals import Frame, LaneEstimate, Motion, StereoFrame, VehicleState
from automodel.types import Image


class InputChecks:
    """Implements `Checks`. They outlive a reset of the chain: what they remember is bounded in time.

    `noiseless` is for a simulated camera whose pictures have no noise.
    """

    def __init__(self, car: CarConfig, *, noiseless: bool = False) -> None:
        size, timeout_s = (car.camera.width_px, car.camera.height_px), car.safety.frame_timeout_s
        self._pictures = tuple(PictureCheck(*size, timeout_s, noiseless=noiseless) for _ in range(2))
        self._lane_jump = LaneJumpCheck()
        self._steering = SteeringCheck(car.vehicle.wheelbase_m)

    def misfit(self, frame: Frame | StereoFrame) -> str | None:
        """Why nothing can be made of the frame, None where it can be looked at."""
        return next(filter(None, map(PictureCheck.misfit, self._pictures, _images(frame))), None)

    def of_frame(self, frame: Frame | StereoFrame) -> tuple[str, ...]:
        """What is wrong with a frame that fits."""
        pictures = zip(self._pictures, _images(frame), strict=False)  # a single camera leaves one check idle
        return tuple(filter(None, (check.step(image, frame.t_ns) for check, image in pictures)))

    def of_estimate(self, estimate: LaneEstimate, motion: Motion, state: VehicleState | None) -> tuple[str, ...]:
        """What is wrong with the lane, or with how the car moves."""
        return tuple(filter(None, (self._lane_jump.step(estimate), self._steering.step(motion, state))))


def _images(frame: Frame | StereoFrame) -> tuple[Image, ...]:
    return (frame.left, frame.right) if isinstance(frame, StereoFrame) else (frame.image,)
