"""Pipelines whose image slides sideways: a camera that turns on its mount, a network that draws its mask elsewhere."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from automodel.pipelines.contour import Contour
from automodel.pipelines.windows import Windows
from automodel.signals import Frame
from tests.pipelines.test_wrong_odometry import drive
from tests.support.rendered_drives import CAR

RIGHT, SLIDES, PERIOD_S = 110, 15, 1.0 / 30.0  # frames before, frames that slide


def slid(frame: Frame, right_px: float) -> Frame:
    height, width = frame.image.shape[:2]
    moved = np.array(((1.0, 0.0, right_px), (0.0, 1.0, 0.0)))
    image = cv2.warpAffine(frame.image, moved, (width, height), borderMode=cv2.BORDER_REPLICATE)
    return replace(frame, image=np.asarray(image, np.uint8))


@pytest.mark.parametrize("pipeline", [Contour, Windows])
@pytest.mark.parametrize("rate_px", [200.0, -200.0])
@pytest.mark.parametrize("place", [("oval", "reverse", 0.5, 6.0), ("chicane", "reverse", 0.5, 6.0)])
def test_an_image_that_slides_is_no_bend(
    place: tuple[str, str, float, float], rate_px: float, pipeline: type[Contour | Windows]
) -> None:
    """The paint turns and the car does not: the lane may still be where the odometry has it."""
    tested, before_rad, after_rad = pipeline(CAR), 0.0, 0.0
    for k, one in enumerate(drive(*place)[: RIGHT + SLIDES]):
        pose = tested.step(slid(one.frame, rate_px * PERIOD_S * max(k - RIGHT + 1, 0)), one.motion).pose
        assert pose is not None
        assert abs(pose.heading_rad - one.truth.heading_rad) <= pose.heading_bound_rad
        assert abs(pose.offset_m - one.truth.offset_m) <= pose.offset_bound_m
        before_rad, after_rad = (pose.heading_bound_rad, 0.0) if k < RIGHT else (before_rad, pose.heading_bound_rad)
    assert after_rad > 2.0 * before_rad
