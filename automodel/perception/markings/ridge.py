"""The ridge filter: the mean of a window less the brighter of the means of two windows beside it.

An edge (a shadow, a kerb) has one bright side and gives nothing. `ridge_sums` filters rows of samples, for searches and
calibrations; `ridge_image` filters images. `RidgeFilter` filters an image with the width that a marking has on each
row, after section 3.1 of the paper of wide-baseline stereo lane detection: `centerline` uses it instead of the network.
"""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from automodel.geometry import GroundCamera
from automodel.perception.markings.ridge_noise import FALSE_SAMPLES, MANY, least_ridge_over_many
from automodel.types import FloatArray, Image

BESIDE = 1.5  # markings from the middle of one to the middle of what is beside it
FAINT = 0.5  # share of a marking's height: what is lower is none


def ridge_sums(sums: NDArray[Any], window: int, apart: int) -> NDArray[Any]:
    """The filter times `window` (r, k - 2 apart - window) of rows by their cumulative sums (r, k), which start with 0.

    The windows are `window` samples long, and the outer ones `apart` from the middle one.
    """
    windows = sums[:, window:] - sums[:, :-window]
    height = np.maximum(windows[:, : -2 * apart], windows[:, 2 * apart :])
    return np.subtract(windows[:, apart:-apart], height, out=height)


def ridge_image(image: Image, middle_px: int, side_px: int, apart_px: int) -> Image:
    """The filter on the rows of an image (h, w), 0 where it is negative; the windows' lengths are odd."""
    middle = image
    if middle_px > 1:
        middle = np.asarray(cv2.blur(image, (middle_px, 1), borderType=cv2.BORDER_REPLICATE), dtype=np.uint8)
    padded = cv2.copyMakeBorder(image, 0, 0, apart_px, apart_px, cv2.BORDER_REPLICATE)
    sides = cv2.blur(padded, (side_px, 1), borderType=cv2.BORDER_REPLICATE) if side_px > 1 else padded
    brighter = cv2.max(sides[:, : image.shape[1]], sides[:, 2 * apart_px :])
    return np.asarray(cv2.subtract(middle, brighter), dtype=np.uint8)


def apparent_width_px(camera: GroundCamera, marking_width_m: float) -> FloatArray:
    """The width (h,) [px] of a marking straight ahead on each row of the image, over flat ground; 0: no ground."""
    model = camera.camera
    rows = np.arange(model.height_px, dtype=np.float64)
    ground = camera.px_to_ground(np.stack((np.full(len(rows), model.matrix[0, 2]), rows), axis=-1))
    sides = [camera.ground_to_px(ground + np.array([0.0, 0.5 * side * marking_width_m])) for side in (1.0, -1.0)]
    width = np.hypot(*(sides[1] - sides[0]).T)
    return np.where(np.isfinite(width), width, 0.0)


class _Band(NamedTuple):
    """Adjacent rows with the same filter."""

    rows: slice
    middle_px: int
    side_px: int
    apart_px: int


class RidgeFilter:
    """Computes how far each pixel exceeds both its sides, as a marking does.

    The threshold minimises the variance within the two classes (Otsu 1979) among all from
    `contrast` [grey levels] on, or, where that is 0, from what noise exceeds at `FALSE_ALARMS` places.

    `width_px_per_row` (h,) is the width of a marking on each row of an image `image_width_px` wide; 0: no ground.
    `markings` are "light" or "dark" against the ground, or "both". An image wider than `MAX_WIDTH_PX` is reduced to
    that; `size_px` is (width, height) of the evidence. Raises ValueError for widths that are not finite and a negative
    contrast.
    """

    MAX_WIDTH_PX = 512
    MIN_WIDTH_PX = 0.75  # of a marking; rows where it is narrower have no evidence
    MIDDLE = 0.5  # length of the middle window, in markings: a short one gives evidence as wide as the marking
    LEVEL = 128  # the evidence at the threshold

    def __init__(
        self, width_px_per_row: ArrayLike, image_width_px: int, contrast: float = 0.0, markings: str = "light"
    ) -> None:
        given = np.asarray(width_px_per_row, dtype=np.float64)
        if given.ndim != 1 or not np.isfinite(given).all() or contrast < 0.0:
            raise ValueError("RidgeFilter: expected finite widths (h,) and a contrast >= 0")
        scale = min(1.0, self.MAX_WIDTH_PX / image_width_px)
        self.size_px = (round(scale * image_width_px), max(round(scale * len(given)), 1))
        self._image_shape = (len(given), image_width_px)
        self._contrast, self._markings = contrast, markings
        rows = (np.arange(self.size_px[1]) + 0.5) * len(given) / self.size_px[1] - 0.5
        width = np.interp(rows, np.arange(len(given)), given) * self.size_px[0] / image_width_px
        self._bands = self._split(width)
        area = sum((band.rows.stop - band.rows.start) * self.size_px[0] for band in self._bands)
        self._least = least_ridge_over_many(area / FALSE_SAMPLES, math.sqrt(self.MIDDLE))
        self._ground = slice(min(b.rows.start for b in self._bands), None) if self._bands else slice(0, 0)

    @classmethod
    def of_camera(
        cls, camera: GroundCamera, marking_width_m: float, contrast: float = 0.0, markings: str = "light"
    ) -> RidgeFilter:
        """The filter for a calibrated camera over flat ground."""
        return cls(apparent_width_px(camera, marking_width_m), camera.camera.width_px, contrast, markings)

    def _split(self, width_px: FloatArray) -> list[_Band]:
        windows = [
            (_odd(self.MIDDLE * width), _odd(width), max(round(BESIDE * width), 2))
            if width >= self.MIN_WIDTH_PX
            else None
            for width in width_px.tolist()
        ]
        bands: list[_Band] = []
        for found, rows in itertools.groupby(range(len(windows)), key=windows.__getitem__):
            if found is not None:
                first, *others = rows
                bands.append(_Band(slice(first, first + len(others) + 1), *found))
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
        response = np.zeros_like(grey)
        for band in self._bands:
            response[band.rows] = ridge_image(grey[band.rows], *band[1:])
        return response

    def _level(self, response: Image) -> float:
        """The response that separates markings from the rest."""
        counts = cv2.calcHist([response[self._ground][::2]], [0], None, [256], [0, 256]).ravel().astype(np.float64)
        values = np.arange(256.0)
        below = [np.cumsum(counts * values**power) for power in range(3)]
        least, most = self._contrast or self._noise_level(response), float(np.searchsorted(below[0], below[0][-1]))
        lowest = min(max(round(least), 1), 255)
        at = np.arange(lowest, max(lowest, min(round(most), 255)) + 1)
        within: FloatArray = np.zeros(len(at))
        for number, first, second in ([b[at - 1] for b in below], [b[-1] - b[at - 1] for b in below]):
            within = within + second - first**2 / np.maximum(number, 1.0)
        return float(at[int(within.argmin())])

    def _noise_level(self, response: Image) -> float:
        """The response that noise exceeds at `FALSE_ALARMS` places.

        It is measured on the farther half of the ground, where the windows are shortest.
        """
        ground = response[self._ground]
        counts = cv2.calcHist([ground[: len(ground) // 2 + 1]], [0], None, [256], [0, 256]).ravel()
        shares = np.cumsum(counts.astype(np.float64)) / max(float(counts.sum()), 1.0)
        return self._least * float(np.interp(1.0 - MANY, shares, np.arange(256.0) + 0.5))


def _odd(width_px: float) -> int:
    """The nearest odd number of pixels."""
    return 2 * int(0.5 * width_px) + 1
