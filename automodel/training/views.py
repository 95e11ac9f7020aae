"""Samples for the network that looks at the bird's-eye view: `make_view(seed)` gives a view and its mask.

The same drawn scenes as for pictures, warped as the car warps them: by a camera that is set about as configured, and to
a lane that is about as wide as configured.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from automodel.geometry import BirdsEye, GroundCamera
from automodel.perception.markings.network_view import network_view
from automodel.training.cameras import random_camera
from automodel.training.scenes import Rng, Sample, drawn_scene, random_kind
from automodel.training.shapes import UNKNOWN
from automodel.types import Image

PICTURES = ((480, 270), (640, 360), (800, 450))  # width, height [px]
AHEAD_LANES, HALF_LANES = 3.0, 1.8  # of a view, about
SCALE = 0.1  # relative change of each of them: the lane is as wide as configured, about (one sigma)
PITCH_RAD, HEIGHT = math.radians(0.7), 0.03  # of a camera, from what is configured; one sigma
HIDDEN = 64  # of 255: the weight of what is unknown from which a pixel of a view is unknown


def make_view(seed: int) -> Sample:
    """The training sample of a seed, the same for the same seed."""
    rng = np.random.default_rng((seed, 1))
    kind = random_kind(rng)
    camera = random_camera(rng, kind, *PICTURES[int(rng.integers(len(PICTURES)))])
    return from_above(rng, camera, drawn_scene(rng, kind, camera, uneven=0.15))


def from_above(rng: Rng, camera: GroundCamera, sample: Sample) -> Sample:
    """The bird's-eye view of a camera's picture and its mask; `UNKNOWN` where there is no picture."""
    birdseye = _believed(rng, camera)
    cover = birdseye.warp(np.where(sample.mask == UNKNOWN, 0, sample.mask).astype(np.uint8))
    hidden = birdseye.warp(np.where(sample.mask == UNKNOWN, 255, 0).astype(np.uint8))
    unknown = (birdseye.mask == 0) | ((hidden >= HIDDEN) & (cover < HIDDEN))
    mask: Image = np.where(unknown, UNKNOWN, cover).astype(np.uint8)
    return Sample(image=birdseye.warp(sample.image), mask=mask)


def _believed(rng: Rng, camera: GroundCamera) -> BirdsEye:
    """The view of a camera that is not quite set as it is believed to be."""
    ahead, half = (lanes * math.exp(rng.normal(0.0, SCALE)) for lanes in (AHEAD_LANES, HALF_LANES))
    given = camera.extrinsics
    believed = replace(
        given,
        pitch_rad=given.pitch_rad + rng.normal(0.0, PITCH_RAD),
        z_m=given.z_m * math.exp(rng.normal(0.0, HEIGHT)),
    )
    for extrinsics in (believed, given):
        seen_with = GroundCamera(camera.camera, extrinsics)
        try:
            near = seen_with.first_visible_x_m()
        except ValueError:
            continue
        if near < 2.0 * ahead:
            return BirdsEye(seen_with, network_view(near, ahead, half))
    return BirdsEye(camera, network_view(0.0, ahead, half))
