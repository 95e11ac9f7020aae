"""Which pixels of a network's mask are markings: sure ones, and less sure ones that stand out from what is around."""

from __future__ import annotations

import cv2
import numpy as np

from automodel.types import Image

SURE, LEAST = 160, 70  # of 255: probabilities that count by themselves, and with what is around
ABOVE = 34  # by how much the less sure ones must exceed the mean around them
AROUND_PX = (21, 7)  # of a mask 512 px wide: lines run up a picture, so to the sides more than along


def standing_out(probability: Image) -> Image:
    """The mask (h, w) with what counts raised to 128 or more, and the rest lowered to 127 or less.

    Worn and faint lines have a low probability and yet a sharp one, while light strips of a road, kerbs and edges have
    a low one far and wide.
    """
    scale = probability.shape[1] / 512.0
    width, height = (2 * round(0.5 * (side * scale - 1.0)) + 1 for side in AROUND_PX)
    above = np.asarray(cv2.subtract(cv2.blur(probability, (3, 3)), cv2.blur(probability, (width, height))))
    counts = ((above > ABOVE) & (probability > LEAST)) | (probability > SURE)
    raised = np.maximum(probability, 128) * counts.view(np.uint8)
    return np.maximum(np.minimum(probability, 127), raised)
