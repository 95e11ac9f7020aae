"""The brightness of single pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from automodel.compiled import compiled
from automodel.types import Image, Ints

CHANNELS = {"blue": 0, "green": 1, "red": 2}
_ALL = -1  # the channel that is the weighted sum of all
_BLUE, _GREEN, _RED = 0.114, 0.587, 0.299  # ITU-R BT.601


class Brightness:
    """Reads single pixels: grey, one channel (`colour` "blue", "green" or "red") or the weighted sum of all ("grey").

    With `dark` markings the sign of the brightness is inverted.
    """

    def __init__(self, colour: str, dark: bool) -> None:
        self.colour, self.dark = colour, dark
        self._channel = CHANNELS.get(colour, _ALL)
        self.read(np.zeros((1, 1), np.uint8), np.zeros((1, 1), np.intp))  # compiled now: no frame waits for it

    def read(self, image: Image, pixels: Ints) -> NDArray[np.int32]:
        """The brightness of `pixels` (n, m), flat indices; those outside are clipped to the first or last pixel."""
        return read_pixels(*self.source(image), pixels)

    def source(self, image: Image) -> tuple[Image, int, bool]:
        """What `read_pixels` reads of an image (h, w) or (h, w, 3): its pixels, which channel, and whether negated."""
        grey = image.ndim == 2
        pixels = image.reshape(-1, 1 if grey else 3)
        if pixels.flags.writeable:
            pixels.flags.writeable = False  # of the one kind that is compiled
        return pixels, 0 if grey else self._channel, self.dark

    def negative(self) -> Brightness:
        """The brightness for markings of the other polarity."""
        return Brightness(self.colour, not self.dark)


@compiled
def read_pixels(image: Image, channel: int, negated: bool, pixels: Ints) -> NDArray[np.int32]:
    """The brightness (n, m) of `pixels` (n, m) of an image (h w, channels)."""
    values = np.empty(pixels.shape, np.int32)
    sign, last = -1 if negated else 1, len(image) - 1
    for i in range(pixels.shape[0]):
        for j in range(pixels.shape[1]):
            at = min(max(pixels[i, j], 0), last)
            if channel >= 0:
                values[i, j] = sign * np.int32(image[at, channel])
            else:
                grey = _BLUE * image[at, 0] + _GREEN * image[at, 1] + _RED * image[at, 2]
                values[i, j] = sign * np.int32(np.rint(grey))
    return values
