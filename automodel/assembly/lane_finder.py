"""The lane in images, for programs that bring their own images and do their own driving."""

from __future__ import annotations

import math
import os

import numpy as np
from numpy.typing import ArrayLike

from automodel.assembly.registry import make_part
from automodel.config import CarConfig, load_car
from automodel.config.parts import PIPELINES
from automodel.interfaces import Pipeline
from automodel.signals import Frame, LaneEstimate, Motion, MotionSource


class LaneFinder:
    """The lane and the pose in it, image by image, by the pipeline that the car's configuration names.

        finder = LaneFinder("car.toml")
        estimate = finder.see(image, t_s)

    `car` is a car.toml, a `CarConfig` or None (the simulated car's configuration); `pipeline` replaces the one that it
    names. Raises ConfigError for a configuration that is wrong.
    """

    def __init__(self, car: str | os.PathLike[str] | CarConfig | None = None, pipeline: str | None = None) -> None:
        if isinstance(car, CarConfig):
            self.car = car
        else:
            self.car = CarConfig() if car is None else load_car(os.fspath(car))
        self._pipeline: Pipeline = make_part(PIPELINES, pipeline or self.car.pipeline.name, self.car)
        self._index = 0
        self._t_ns: int | None = None

    def see(
        self, image: ArrayLike, t_s: float, speed_mps: float | None = None, yaw_rate_radps: float | None = None
    ) -> LaneEstimate:
        """The lane in one image.

        `image` is uint8, (h, w) grey or (h, w, 3) BGR, of the size in [camera]; it must not change afterwards. `t_s`
        is the time of its capture [s], on any clock, and grows from image to image. The car's motion is used where
        both `speed_mps` (forward positive) and `yaw_rate_radps` (left positive) are given: with it the lane is
        carried through gaps, without it for a short time only.
        Raises ValueError for an image or a time that does not fit; what the image shows never raises: an estimate
        that is not there has the status LOST.
        """
        if not math.isfinite(t_s):
            raise ValueError(f"t_s: expected a finite time, got {t_s}")
        t_ns = round(t_s * 1e9)
        if self._t_ns is not None and t_ns <= self._t_ns:
            raise ValueError(f"t_s: expected a time after {self._t_ns * 1e-9:.6f}, got {t_s:.6f}")
        frame = Frame(t_ns=t_ns, index=self._index, image=np.asarray(image))
        height, width = frame.image.shape[:2]
        camera = self.car.camera
        if (width, height) != (camera.width_px, camera.height_px):
            raise ValueError(
                f"image: expected {camera.width_px}x{camera.height_px} as in [camera], got {width}x{height}"
            )
        motion = _motion(t_ns, speed_mps, yaw_rate_radps)
        self._t_ns, self._index = t_ns, self._index + 1
        return self._pipeline.step(frame, motion)

    def reset(self) -> None:
        """Forget all images; the next one may have any time."""
        self._pipeline.reset()
        self._t_ns = None


def _motion(t_ns: int, speed_mps: float | None, yaw_rate_radps: float | None) -> Motion:
    known = speed_mps is not None and yaw_rate_radps is not None
    values = (speed_mps or 0.0, yaw_rate_radps or 0.0) if known else (0.0, 0.0)
    if not all(map(math.isfinite, values)):
        raise ValueError(f"expected a finite motion, got {speed_mps} m/s and {yaw_rate_radps} rad/s")
    source = MotionSource.MEASURED if known else MotionSource.NONE
    return Motion(t_ns=t_ns, speed_mps=values[0], yaw_rate_radps=values[1], source=source)
