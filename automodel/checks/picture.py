"""Whether a camera's pictures are pictures of the road: right in size, alive, and showing anything at all."""

from __future__ import annotations

import cv2
import numpy as np

from automodel.types import Image

FLAT_LEVELS = 6  # grey levels between the brightest and the darkest part of a picture that shows nothing
_COARSE_PX = (16, 9)  # each of these parts is the mean of many pixels, so that noise makes none of them stand out


class PictureCheck:
    """Counts only pictures that show something new; says what is wrong when the last of those is too old.

    A sensor's noise never comes twice: a picture that is the one before to the last bit was not taken anew, whatever
    its time says, and whether the car moves or not. A simulated camera without noise does repeat itself, where the car
    stands or there is nothing to see; `noiseless` allows that. A lens that is covered, blinded or unplugged gives a
    picture without any contrast.

    One bad picture is as one that was dropped: only `timeout_s` without a good one is worth a word.
    """

    def __init__(self, width_px: int, height_px: int, timeout_s: float, *, noiseless: bool = False) -> None:
        self._shape = (height_px, width_px)
        self._timeout_ns = round(timeout_s * 1e9)
        self._noiseless = noiseless
        self._before: Image | None = None
        self._good_ns: int | None = None  # when the newest good picture was taken

    def misfit(self, image: Image) -> str | None:
        """Why nothing can be made of the picture, None where its size is the camera's."""
        height, width = image.shape[:2]
        if (height, width) == self._shape:
            return None
        return f"the picture has {width}x{height} pixels where the camera has {self._shape[1]}x{self._shape[0]}"

    def step(self, image: Image, t_ns: int) -> str | None:
        """What is wrong with the pictures up to this one, taken at `t_ns`; None while all is well, or may still be."""
        wrong = self._wrong(image)
        if wrong is None:
            self._good_ns = t_ns
            return None
        if self._good_ns is None:
            return wrong
        age_ns = t_ns - self._good_ns
        return None if age_ns < self._timeout_ns else f"{wrong} for {age_ns * 1e-9:.3f} s"

    def _wrong(self, image: Image) -> str | None:
        before, self._before = self._before, image
        if contrast(image) < FLAT_LEVELS:
            return "the picture is blank"
        if before is not None and not self._noiseless and _same(before, image):
            return "the camera repeats the same picture"
        return None


def contrast(image: Image) -> int:
    """Grey levels between the brightest and the darkest part of a picture, of the channel with the most."""
    coarse = cv2.resize(image, _COARSE_PX, interpolation=cv2.INTER_AREA).reshape(_COARSE_PX[0] * _COARSE_PX[1], -1)
    return int((coarse.max(axis=0).astype(np.int64) - coarse.min(axis=0)).max())


def _same(a: Image, b: Image) -> bool:
    if a.shape != b.shape:
        return False
    return np.array_equal(a[::32], b[::32]) and np.array_equal(a, b)  # a few rows tell nearly always
