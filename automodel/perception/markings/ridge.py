"""Marking evidence of a grey frame: a ridge filter as wide as a marking appears on each row.

After section 3.1 of the paper of wide-baseline stereo lane detection; `centerline` uses it instead of the network.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike

from automodel.geometry import GroundCamera
from automodel.types import FloatArray, Image


def apparent_width_px(camera: GroundCamera, marking_width_m: float) -> FloatArray:
    """The width (h,) [px] of a marking straight ahead on each row of the image, over flat ground; 0: no ground."""
    model = camera.camera
    rows = np.arange(model.height_px, dtype=np.float64)
    ground = camera.px_to_ground(np.stack((np.full(len(rows), model.matrix[0, 2]), rows), axis=-1))
    sides = [camera.ground_to_px(ground + np.array([0.0, 0.5 * side * marking_width_m])) for side in (1.0, -1.0)]
    width = np.hypot(*(sides[1] - sides[0]).T)
    return np.where(np.isfinite(width), width, 0.0)


class _Band(NamedTuple):
    """Adjacent rows with the same filter: the boxes' widths, and the lateral shift of the outer boxes."""

    rows: slice
    middle_px: int
    side_px: int
    shift_px: int


class RidgeFilter:
    """Computes how far each pixel exceeds both its sides, as a marking does.

    On each row the mean over half a marking's width is compared with the means over one marking's width on either
    side: the mean of both differences, limited to `BALANCE` times the smaller one, so that the rim of a bright area
    does not count. The threshold minimises the variance within the two classes (Otsu 1979) among equally spaced
    candidates between `contrast` and `MOST` times `contrast` [grey levels].

    `width_px_per_row` (h,) is the width of a marking on each row of an image `image_width_px` wide; 0: no ground.
    `markings` are "light" or "dark" against the ground, or "both". An image wider than `MAX_WIDTH_PX` is reduced to
    that; `size_px` is (width, height) of the evidence. Raises ValueError for widths that are not finite and a contrast
    that is not positive.
    """

    MAX_WIDTH_PX = 512
    MIN_WIDTH_PX = 0.75  # of a marking; rows where it is narrower have no evidence
    MIDDLE, SIDE, SHIFT = 0.5, 1.0, 1.75  # widths of the middle and of a side, and their distance, in markings
    BALANCE = 2.0
    MOST = 4.0
    CANDIDATES = 32
    NEXT_BAND = 1.1  # ratio of the marking's widths at which a new band starts
    LEVEL = 128  # the evidence at the threshold

    def __init__(
        self, width_px_per_row: ArrayLike, image_width_px: int, contrast: float = 12.0, markings: str = "light"
    ) -> None:
        given = np.asarray(width_px_per_row, dtype=np.float64)
        if given.ndim != 1 or not np.isfinite(given).all() or contrast <= 0.0:
            raise ValueError("RidgeFilter: expected finite widths (h,) and a positive contrast")
        scale = min(1.0, self.MAX_WIDTH_PX / image_width_px)
        self.size_px = (round(scale * image_width_px), max(round(scale * len(given)), 1))
        self._image_shape = (len(given), image_width_px)
        self._contrast, self._markings = contrast, markings
        rows = (np.arange(self.size_px[1]) + 0.5) * len(given) / self.size_px[1] - 0.5
        width = np.interp(rows, np.arange(len(given)), given) * self.size_px[0] / image_width_px
        self._bands = self._split(width)
        self._ground = slice(min(b.rows.start for b in self._bands), None) if self._bands else slice(0, 0)

    @classmethod
    def of_camera(
        cls, camera: GroundCamera, marking_width_m: float, contrast: float = 12.0, markings: str = "light"
    ) -> RidgeFilter:
        """The filter for a calibrated camera over flat ground."""
        return cls(apparent_width_px(camera, marking_width_m), camera.camera.width_px, contrast, markings)

    def _split(self, width_px: FloatArray) -> list[_Band]:
        bands: list[_Band] = []
        edges = [0]
        for row in range(1, len(width_px)):
            first = width_px[edges[-1]]
            if not max(first, width_px[row]) <= self.NEXT_BAND * max(min(first, width_px[row]), self.MIN_WIDTH_PX):
                edges.append(row)
        for first_row, end in zip(edges, [*edges[1:], len(width_px)], strict=True):
            width = float(width_px[first_row:end].mean())
            if width >= self.MIN_WIDTH_PX:
                boxes = _odd(self.MIDDLE * width), _odd(self.SIDE * width)
                bands.append(_Band(slice(first_row, end), *boxes, max(round(self.SHIFT * width), 2)))
        return bands

    def step(self, grey: Image) -> Image:
        """The evidence (height, width of `size_px`) of a grey image (h, w); `LEVEL` and more is a marking.

        Raises ValueError for an image of another size.
        """
        if grey.shape != self._image_shape:
            raise ValueError(f"RidgeFilter: expected an image {self._image_shape}, got {grey.shape}")
        if grey.shape[1] != self.size_px[0]:
            # Up to a factor of 2 bilinear sampling skips no pixel, and costs a tenth.
            method = cv2.INTER_LINEAR if 2 * self.size_px[0] >= grey.shape[1] else cv2.INTER_AREA
            grey = np.asarray(cv2.resize(grey, self.size_px, interpolation=method), dtype=np.uint8)
        if self._markings == "light":
            response = self._response(grey)
        else:
            response = self._response(np.asarray(cv2.bitwise_not(grey), dtype=np.uint8))
            if self._markings == "both":
                response = np.asarray(cv2.max(response, self._response(grey)), dtype=np.uint8)
        evidence: Image = np.zeros_like(grey)
        cv2.convertScaleAbs(response[self._ground], evidence[self._ground], self.LEVEL / self._level(response))
        return evidence

    def _response(self, grey: Image) -> Image:
        """How far each pixel exceeds its sides."""
        middle, left, right = (np.zeros_like(grey) for _ in range(3))
        for band in self._bands:
            rows = grey[band.rows]
            cv2.blur(rows, (band.middle_px, 1), middle[band.rows], borderType=cv2.BORDER_REPLICATE)
            reach = band.shift_px
            padded = cv2.copyMakeBorder(rows, 0, 0, reach, reach, cv2.BORDER_REPLICATE)
            sides = cv2.blur(padded, (band.side_px, 1), borderType=cv2.BORDER_REPLICATE)
            left[band.rows], right[band.rows] = sides[:, : grey.shape[1]], sides[:, 2 * reach :]
        above_left, above_right = cv2.subtract(middle, left), cv2.subtract(middle, right)
        mean = cv2.addWeighted(above_left, 0.5, above_right, 0.5, 0.0)
        least = cv2.convertScaleAbs(cv2.min(above_left, above_right), alpha=self.BALANCE)
        return np.asarray(cv2.min(mean, least), dtype=np.uint8)

    def _level(self, response: Image) -> float:
        """The response that separates markings from the rest."""
        counts = cv2.calcHist([response[self._ground][::2]], [0], None, [256], [0, 256]).ravel().astype(np.float64)
        values = np.arange(256.0)
        below = [np.cumsum(counts * values**power) for power in range(3)]
        at = np.unique(
            np.linspace(self._contrast, self.MOST * self._contrast, self.CANDIDATES).astype(np.intp).clip(0, 255)
        )
        within: FloatArray = np.zeros(len(at))
        for number, first, second in ([b[at - 1] for b in below], [b[-1] - b[at - 1] for b in below]):
            within = within + second - first**2 / np.maximum(number, 1.0)
        return float(at[int(within.argmin())])


def _odd(width_px: float) -> int:
    """The nearest odd number of pixels."""
    return 2 * int(0.5 * width_px) + 1
