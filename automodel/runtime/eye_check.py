"""Which of the two cameras of a pair can be looked through: one that is dark or stuck is left out."""

from __future__ import annotations

from automodel.runtime.input_checks import FLAT_LEVELS, contrast
from automodel.signals import SIDES, Frame, StereoFrame, same_image
from automodel.types import Image

BLANK = "the image is blank"
REPEATED = "the same image again and again"


class EyeCheck:
    """Leaves the image of a bad eye out of a pair, from the first bad one on, as if that camera were missing.

    An eye is bad where its image is blank (`ImageCheck`), or the one before to the last bit while the other eye's is
    not: a sensor's noise never comes twice, and two simulated cameras without noise repeat their images together. A
    repeated image is known by the pair that it is in, so that no image of another time is taken for half of a pair.

    A pair of two bad eyes stays as it is: the car's input checks judge that. `trouble` is why the last frame lacks one
    of its images, in one line; it stays while both eyes are bad.
    """

    def __init__(self) -> None:
        self.trouble = ""
        self._before: list[Image | None] = [None, None]
        self._counts = {(side, why): 0 for why in (BLANK, REPEATED) for side in SIDES}

    @property
    def warning(self) -> str:
        """How many images of which eye were left out, in one line for people; "" without any."""
        left_out = [
            f"{count} images of the {side} camera were left out: {why}"
            for (side, why), count in self._counts.items()
            if count
        ]
        return "; ".join(left_out)

    def step(self, frame: Frame | StereoFrame) -> Frame | StereoFrame:
        """The frame to look at: the pair, or its good eye's image alone, at the pair's time."""
        if isinstance(frame, Frame):
            self._before[frame.eye], self.trouble = frame.image, ""
            return frame
        images = frame.left, frame.right
        wrong = [self._wrong(image, before) for image, before in zip(images, self._before, strict=True)]
        self._before = [*images]
        if all(wrong):
            return frame
        if not any(wrong):
            self.trouble = ""
            return frame
        good = 1 if wrong[0] else 0
        side, why = SIDES[1 - good], wrong[1 - good]
        self._counts[side, why] += 1
        self.trouble = f"{side} camera: {why}"
        return Frame(t_ns=frame.t_ns, index=frame.index, image=images[good], eye=good)

    @staticmethod
    def _wrong(image: Image, before: Image | None) -> str:
        if contrast(image) < FLAT_LEVELS:
            return BLANK
        return REPEATED if before is not None and same_image(before, image) else ""
