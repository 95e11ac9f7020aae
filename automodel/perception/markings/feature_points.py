"""Feature points (seed 001, section IV): the line mask from above, thresholded and cleaned."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from automodel.config import CameraConfig, Intrinsics
from automodel.geometry import BirdsEye, GroundCamera, View
from automodel.types import Image


def resized_camera(camera: CameraConfig, width_px: int, height_px: int) -> CameraConfig:
    """The camera whose pictures are those of `camera` resized: pixel centres go from u to (u + 1/2) scale - 1/2."""
    across, down = width_px / camera.width_px, height_px / camera.height_px
    seen = camera.intrinsics
    intrinsics = Intrinsics(
        fx_px=seen.fx_px * across,
        fy_px=seen.fy_px * down,
        cx_px=(seen.cx_px + 0.5) * across - 0.5,
        cy_px=(seen.cy_px + 0.5) * down - 0.5,
        distortion=seen.distortion,
    )
    return replace(camera, width_px=width_px, height_px=height_px, intrinsics=intrinsics)


class FeaturePoints:
    """Warps a line mask into a bird's-eye view, thresholds it and cleans it.

    The mask shows what the camera's picture shows, at any size of its own (a network's input is smaller); the maps of
    each size are computed when it first comes, those of `sizes_px` (width, height) at once. `visible` (h, w) is 255
    where the view shows ground that the camera sees.
    """

    OPEN, CLOSE = 0.6, 0.6  # sides of the kernels in markings: what is smaller goes, and what is smaller is filled

    def __init__(
        self,
        camera: CameraConfig,
        view: View,
        marking_width_m: float,
        threshold: float = 0.5,
        sizes_px: tuple[tuple[int, int], ...] = (),
    ) -> None:
        if not 0.0 < threshold < 1.0:
            raise ValueError(f"FeaturePoints: threshold {threshold} where 0 .. 1 is wanted")
        self.view, self._camera, self._level = view, camera, 255.0 * threshold
        self._open, self._close = (self._kernel(side * marking_width_m) for side in (self.OPEN, self.CLOSE))
        self._birdseyes: dict[tuple[int, int], BirdsEye] = {}
        for size in sizes_px:
            self._birdseye(size)
        self.visible: Image = BirdsEye(GroundCamera.from_config(camera), view).mask

    def step(self, mask: Image) -> Image:
        """The binary view (h, w), 0 or 255, of a mask (rows, columns), 0 .. 255."""
        rows, columns = mask.shape
        birdseye = self._birdseye((columns, rows))
        lines = cv2.threshold(birdseye.warp(mask), self._level, 255, cv2.THRESH_BINARY)[1]
        if self._close is not None:
            lines = cv2.morphologyEx(lines, cv2.MORPH_CLOSE, self._close)
        if self._open is not None:
            lines = cv2.morphologyEx(lines, cv2.MORPH_OPEN, self._open)
        return np.asarray(cv2.bitwise_and(lines, birdseye.mask), dtype=np.uint8)

    def _birdseye(self, size_px: tuple[int, int]) -> BirdsEye:
        if size_px not in self._birdseyes:
            camera = GroundCamera.from_config(resized_camera(self._camera, *size_px))
            self._birdseyes[size_px] = BirdsEye(camera, self.view)
        return self._birdseyes[size_px]

    def _kernel(self, side_m: float) -> Image | None:
        """A kernel with odd sides (an even one shifts what it keeps by a pixel); None where it would do nothing."""
        rows, columns = (2 * int(0.5 * side_m / m + 0.25) + 1 for m in (self.view.m_per_row, self.view.m_per_px))
        return np.ones((rows, columns), np.uint8) if max(rows, columns) > 1 else None
