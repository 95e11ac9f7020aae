"""Drives along simulated lanes with two cameras, rendered and estimated pair by pair."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from automodel.config import CarConfig, SecondCamera
from automodel.geometry import SE2
from automodel.pipelines.stereo import Stereo
from automodel.signals import StereoFrame
from automodel.sim.appearance import Appearance
from automodel.sim.renderer import Renderer
from automodel.types import Image
from tests.support.rendered_drives import RenderedDrive, camera


def stereo_car(baseline_m: float = 0.25, height_px: int = 480, **options: Any) -> CarConfig:
    """The default car with two cameras beside each other, which are neither parallel nor alike."""
    half = 0.5 * baseline_m
    left = camera(640, height_px, 480.0, y_m=half, yaw_rad=-0.05, roll_rad=0.02)
    right = camera(640, height_px, 500.0, y_m=-half, yaw_rad=0.04, z_m=0.19, pitch_rad=0.28, roll_rad=-0.01)
    second = SecondCamera(intrinsics=right.intrinsics, extrinsics=right.extrinsics)
    return CarConfig(camera=dataclasses.replace(left, right=second), **options)


@dataclass(kw_only=True)
class StereoDrive(RenderedDrive):
    """A `RenderedDrive` with two cameras, which nod by up to `nod_rad` at `nod_hz`.

    `blind` maps an eye (0: left, 1: right) to the pairs' indices from and to which its image is black.
    """

    nod_rad: float = 0.0
    nod_hz: float = 1.5
    blind: dict[int, tuple[int, int]] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        self.pipeline = self.pipeline or Stereo(self.car)
        super().__post_init__()
        rig, look = Stereo.rig(self.car), self.look or Appearance()
        self.eyes = [
            Renderer(
                self.track.paint(),
                self.track.floor,
                self.track.obstacles,
                eye,
                dataclasses.replace(look, noise_seed=look.noise_seed + k),
                nod_max_rad=self.nod_rad,
            )
            for k, eye in enumerate((rig.left, rig.right))
        ]

    def nod(self, index: int) -> float:
        """The cameras' pitch beyond their place on the car at a pair [rad]."""
        return self.nod_rad * math.sin(math.tau * self.nod_hz * index / self.rate_hz)

    def picture(self, pose: SE2, yaw_rate_radps: float, t_ns: int, index: int) -> Any:
        """A `StereoFrame`."""
        images: list[Image] = []
        for k, eye in enumerate(self.eyes):
            image = eye.render(
                pose.x_m, pose.y_m, pose.yaw_rad, self.speed_mps, yaw_rate_radps, index, nod_rad=self.nod(index)
            )
            first, last = self.blind.get(k, (0, 0))
            images.append(np.zeros_like(image) if first <= index < last else image)
        return StereoFrame(t_ns=t_ns, index=index, left=images[0], right=images[1])
