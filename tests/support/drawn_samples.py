"""Samples for training that are told apart by their grey values."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from automodel.training.dataset import HEIGHT_PX, WIDTH_PX


def drawn(seed: int) -> SimpleNamespace:
    """A sample whose grey values say which it is, and a mask that is the sample's bright part."""
    image = np.full((HEIGHT_PX, WIDTH_PX), seed % 100 + 20, np.uint8)
    mask = np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8)
    left = 40 + 16 * (seed % 16)
    image[:, left : left + 20], mask[:, left : left + 20] = 250, 255
    return SimpleNamespace(image=image, mask=mask)
