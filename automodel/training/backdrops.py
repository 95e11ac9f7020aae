"""What stands above the horizon: skies, trees, houses, halls and rooms, with many bright bars that are no lines."""

from __future__ import annotations

import cv2
import numpy as np

from automodel.training.indoors import hall, room
from automodel.training.outdoors import outdoors
from automodel.training.sketching import bar, box
from automodel.types import Image

Rng = np.random.Generator


def backdrop(rng: Rng, width_px: int, height_px: int, horizon_v: float) -> Image:
    """A whole picture (h, w) uint8 to be seen where there is no ground.

    `horizon_v` is the row [px] of the horizon; it may lie above or below the picture.
    """
    picture = np.full((height_px, width_px), int(rng.integers(10, 120)), dtype=np.uint8)
    foot = int(np.clip(horizon_v + rng.uniform(0, 6), 0, height_px))
    if foot < 2:
        return picture
    kind = rng.random()
    if kind < 0.5:
        outdoors(picture, foot, rng)
    elif kind < 0.75:
        hall(picture, foot, rng)
    elif kind < 0.92:
        room(picture, foot, rng)
    else:
        _clutter(picture, foot, rng)
    if rng.random() < 0.35:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.5, 2.5)), dtype=np.uint8)
    return picture


def _clutter(picture: Image, foot: int, rng: Rng) -> None:
    """Anything: boxes and bars of every grey, so that only the horizon tells them from lines."""
    width = picture.shape[1]
    for _ in range(int(rng.integers(5, 40))):
        u, v = rng.uniform(0, width), rng.uniform(0, foot)
        grey, size = rng.uniform(0, 255), rng.uniform(2, 80)
        if rng.random() < 0.5:
            box(picture, u, v, u + size, min(v + rng.uniform(2, 60), foot), grey)
        else:
            end = (u + rng.normal(0, 1) * size * 2, min(v + rng.normal(0, 1) * size, float(foot)))
            bar(picture, (u, v), end, grey, rng.uniform(0.5, 6.0))
