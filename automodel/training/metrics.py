"""How well a network's masks agree with the masks of drawn samples."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from automodel.training.shapes import UNKNOWN
from automodel.types import Bools, Image

HALF = 128  # probability and coverage of one half
FAINT = 26  # coverage of a tenth: a mark near such a pixel is not false
NEAR_PX = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Metrics:
    """Shares of pixels, 0..1; 0 if there is nothing to count."""

    precision: float  # of marked pixels, those that are labelled
    recall: float  # of labelled pixels, those that are marked
    iou: float
    near_precision: float  # of marked pixels, those with a label (even a faint one) within NEAR_PX
    near_recall: float  # of labelled pixels, those with a mark within NEAR_PX

    @property
    def score(self) -> float:
        """The harmonic mean of `near_precision` and `near_recall`, for comparing networks."""
        return _share(2.0 * self.near_precision * self.near_recall, self.near_precision + self.near_recall)


def measured(network: Callable[[Image], Image], samples: Iterable[Image]) -> Metrics:
    """The metrics of a network (grey image to mask) on samples (2, h, w) of grey image and true mask."""
    counts = np.zeros(6)
    for grey, truth in samples:
        marked, labelled = (network(grey) >= HALF) & (truth != UNKNOWN), truth >= HALF
        near_label = _widened(truth >= FAINT)
        counts += (
            np.count_nonzero(marked & labelled),
            np.count_nonzero(marked),
            np.count_nonzero(labelled),
            np.count_nonzero(marked | labelled),
            np.count_nonzero(marked & near_label),
            np.count_nonzero(labelled & _widened(marked)),
        )
    both, marks, labels, either, near_marks, near_labels = counts.tolist()
    return Metrics(
        precision=_share(both, marks),
        recall=_share(both, labels),
        iou=_share(both, either),
        near_precision=_share(near_marks, marks),
        near_recall=_share(near_labels, labels),
    )


def _widened(pixels: Bools) -> Bools:
    """The pixels within NEAR_PX (Euclidean) of those given."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * NEAR_PX + 1, 2 * NEAR_PX + 1))
    return np.asarray(cv2.dilate(pixels.view(np.uint8), disc)) > 0


def _share(part: float, whole: float) -> float:
    return part / whole if whole else 0.0
