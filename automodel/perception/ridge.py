"""Marking evidence in a grey picture by a ridge filter as wide as a marking looks (seed 002, marking extraction)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from automodel.geometry import GroundCamera
from automodel.types import FloatArray, Image


def apparent_width_px(camera: GroundCamera, marking_width_m: float) -> FloatArray:
    """How many pixels (h,) broad a marking ahead looks on each row of the picture, over flat ground; 0: no ground."""
    model = camera.camera
    rows = np.arange(model.height_px, dtype=np.float64)
    ground = camera.px_to_ground(np.stack((np.full(len(rows), model.matrix[0, 2]), rows), axis=-1))
    sides = [camera.ground_to_px(ground + np.array([0.0, 0.5 * side * marking_width_m])) for side in (1.0, -1.0)]
    width = np.hypot(*(sides[1] - sides[0]).T)
    return np.where(np.isfinite(width), width, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Band:
    """Neighbouring rows that share their filter: the boxes' widths, and how far aside the outer ones lie."""

    rows: slice
    middle_px: int
    side_px: int
    shift_px: int


class RidgeMarkings:
    """Tells how far each pixel stands above both its sides, as a marking does.

    On each row the mean over half a marking's width is compared with the means over a whole one beyond either side:
    half of twice the middle less left less right, and at most `BALANCE` times what it stands above the brighter side,
    so that the rim of a bright area does not count. The level of a marking is that of equally spaced candidates for
    which the variance within the two classes is least (Otsu), but at least `contrast` grey levels and at most `MOST`
    times that.

    `width_px_per_row` (h,) is the width of a marking on each row of a picture `picture_width_px` broad; 0: no ground.
    `dark`: markings are darker than the ground. A picture broader than `MAX_WIDTH_PX` is reduced to that; `size_px`
    is (width, height) of the evidence.
    """

    MAX_WIDTH_PX = 512
    MIN_WIDTH_PX = 0.75  # of a marking; rows where it is narrower have no evidence
    MIDDLE, SIDE, ASIDE = (
        0.5,
        1.0,
        1.75,
    )  # widths of the middle and of a side, and way from one to the other, in markings
    BALANCE = 2.0
    MOST = 4.0
    CANDIDATES = 32
    NEXT_BAND = 1.1  # a band ends where the width is so much larger than at its far end
    LEVEL = 128  # the evidence of what reaches the level

    def __init__(
        self, width_px_per_row: ArrayLike, picture_width_px: int, contrast: float = 12.0, dark: bool = False
    ) -> None:
        given = np.asarray(width_px_per_row, dtype=np.float64)
        if given.ndim != 1 or not np.isfinite(given).all() or contrast <= 0.0:
            raise ValueError("RidgeMarkings: finite widths (h,) and a positive contrast are wanted")
        scale = min(1.0, self.MAX_WIDTH_PX / picture_width_px)
        self.size_px = (round(scale * picture_width_px), max(round(scale * len(given)), 1))
        self._picture_shape = (len(given), picture_width_px)
        self._contrast, self._dark = contrast, dark
        rows = (np.arange(self.size_px[1]) + 0.5) * len(given) / self.size_px[1] - 0.5
        width = np.interp(rows, np.arange(len(given)), given) * self.size_px[0] / picture_width_px
        self._bands = self._split(width)
        self._ground = slice(min(b.rows.start for b in self._bands), None) if self._bands else slice(0, 0)

    @classmethod
    def of_camera(
        cls, camera: GroundCamera, marking_width_m: float, contrast: float = 12.0, dark: bool = False
    ) -> RidgeMarkings:
        """The filter for a calibrated camera over flat ground."""
        return cls(apparent_width_px(camera, marking_width_m), camera.camera.width_px, contrast, dark)

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
                bands.append(
                    _Band(
                        rows=slice(first_row, end),
                        middle_px=_odd(self.MIDDLE * width),
                        side_px=_odd(self.SIDE * width),
                        shift_px=max(round(self.ASIDE * width), 2),
                    )
                )
        return bands

    def step(self, grey: Image) -> Image:
        """The evidence (height, width of `size_px`) of a grey picture (h, w); `LEVEL` and more is a marking.

        Raises ValueError for a picture of another size.
        """
        if grey.shape != self._picture_shape:
            raise ValueError(f"RidgeMarkings: a picture {grey.shape} where {self._picture_shape} is wanted")
        if grey.shape[1] != self.size_px[0]:
            little = (
                2 * self.size_px[0] >= grey.shape[1]
            )  # then bilinear sampling leaves nothing out, and costs a tenth
            method = cv2.INTER_LINEAR if little else cv2.INTER_AREA
            grey = np.asarray(cv2.resize(grey, self.size_px, interpolation=method), dtype=np.uint8)
        response = self._response(grey)
        evidence: Image = np.zeros_like(grey)
        cv2.convertScaleAbs(response[self._ground], evidence[self._ground], self.LEVEL / self._level(response))
        return evidence

    def _response(self, grey: Image) -> Image:
        """How far each pixel stands above its sides."""
        middle, left, right = (np.zeros_like(grey) for _ in range(3))
        for band in self._bands:
            rows = cv2.bitwise_not(grey[band.rows]) if self._dark else grey[band.rows]
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
        """The response that tells markings from the rest."""
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
