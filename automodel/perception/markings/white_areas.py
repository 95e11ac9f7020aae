"""Binarisation of the bird's-eye view, and the white-areas filter of seed 003 (section IV-B), in metres."""

from __future__ import annotations

import cv2
import numpy as np

from automodel.geometry import BirdsEye
from automodel.types import Image


class WhiteAreas:
    """Keeps what is about as wide as a marking.

    `step` gives two binary views (h, w), 0 or 255: everything brighter than its surroundings, and of this only the
    runs along a row whose length lies between `narrow` and `wide` marking widths (a slanted line is cut wider than it
    is). The threshold is local, against the mean of a box five markings wide, so that light that changes slowly over
    the floor has no say; it follows the picture's own contrast between `contrast` and six times of it.
    """

    NARROW, WIDE = 0.45, 2.4
    SIDES = 0.6  # share of the level that a marking stands above what lies beside it
    SHARE = 0.35  # of the contrast of the brightest hundredth, that a marking has at least

    def __init__(self, birdseye: BirdsEye, marking_width_m: float, contrast: float, dark: bool = False) -> None:
        self.contrast, self.dark = contrast, dark
        marking_px = marking_width_m / birdseye.view.m_per_px
        self._box = 2 * int(2.5 * marking_px) + 1
        self._reach = round(1.6 * marking_px)
        # Odd kernels: opening with an even one shifts what it keeps by a pixel.
        self._narrow = np.ones((1, 2 * int(0.5 * self.NARROW * marking_px) + 1), np.uint8)
        self._wide = np.ones((1, 2 * int(0.5 * self.WIDE * marking_px) + 1), np.uint8)
        edge = np.ones((3, 2 * int(0.5 * marking_px) + 3), np.uint8)
        padded = cv2.copyMakeBorder(birdseye.mask, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=[0])
        self.mask: Image = np.asarray(cv2.erode(padded, edge)[1:-1, 1:-1], dtype=np.uint8)
        self._thinned = np.ascontiguousarray(self.mask[::3])
        self._visible_px = max(int(np.count_nonzero(self._thinned)), 1)

    def step(self, view: Image) -> tuple[Image, Image]:
        """(all bright areas, line-wide bright areas) of a grey view (h, w)."""
        around = cv2.blur(view, (self._box, self._box), borderType=cv2.BORDER_REPLICATE)
        stands_out = cv2.subtract(around, view) if self.dark else cv2.subtract(view, around)
        counts = cv2.calcHist([stands_out[::3]], [0], self._thinned, [256], [0, 256]).ravel()  # a third of the rows
        above = np.cumsum(counts[::-1])
        brightest = 255 - int(np.searchsorted(above, 0.01 * self._visible_px))
        level = min(max(self.SHARE * brightest, self.contrast), 6.0 * self.contrast)
        bright = cv2.threshold(stands_out, level, 255, cv2.THRESH_BINARY)[1]
        ridge = cv2.threshold(self._above_sides(view), self.SIDES * level, 255, cv2.THRESH_BINARY)[1]
        no_specks = cv2.morphologyEx(cv2.bitwise_and(bright, ridge), cv2.MORPH_OPEN, self._narrow)
        too_wide = cv2.morphologyEx(no_specks, cv2.MORPH_OPEN, self._wide)
        # Masked only now: what the picture's edge cuts repeats beyond it and counts as wide, not as narrow.
        lines = cv2.bitwise_and(cv2.subtract(no_specks, too_wide), self.mask)
        return np.asarray(cv2.bitwise_and(bright, self.mask), dtype=np.uint8), np.asarray(lines, dtype=np.uint8)

    def _above_sides(self, view: Image) -> Image:
        """How far each pixel stands above the brighter of its neighbours to the left and right, 0 where it does not.

        The rim of a bright patch stands above one side only.
        """
        reach = self._reach
        padded = cv2.copyMakeBorder(view, 0, 0, reach, reach, cv2.BORDER_REPLICATE)
        left, right = padded[:, : view.shape[1]], padded[:, 2 * reach :]
        if self.dark:
            return np.asarray(cv2.subtract(cv2.min(left, right), view), dtype=np.uint8)
        return np.asarray(cv2.subtract(view, cv2.max(left, right)), dtype=np.uint8)
