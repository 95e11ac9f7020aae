"""The brightness of single pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from automodel.types import Floats, Image, Ints

CHANNELS = {"blue": 0, "green": 1, "red": 2}
_GREY = (0.114, 0.587, 0.299)  # of blue, green, red: ITU-R BT.601


class Brightness:
    """Reads single pixels: grey, one channel (`colour` "blue", "green" or "red") or the weighted sum of all ("grey").

    With `dark` markings the sign of the brightness is inverted.
    """

    def __init__(self, colour: str, dark: bool) -> None:
        self.colour, self.dark = colour, dark
        self._channel = CHANNELS.get(colour)
        self._grey: Floats = np.array(_GREY)

    def read(self, image: Image, pixels: Ints) -> NDArray[Any]:
        """The brightness of `pixels`, flat indices; those outside the image are clipped to its first or last pixel."""
        values: NDArray[Any]
        if image.ndim == 2:
            values = image.reshape(-1).take(pixels, mode="clip")
        elif self._channel is not None:
            values = image.reshape(-1, 3)[:, self._channel].take(pixels, mode="clip")
        else:
            values = np.rint(image.reshape(-1, 3).take(pixels, axis=0, mode="clip") @ self._grey).astype(np.int32)
        return -values.astype(np.int32) if self.dark else values

    def negative(self) -> Brightness:
        """The brightness for markings of the other polarity."""
        return Brightness(self.colour, not self.dark)
