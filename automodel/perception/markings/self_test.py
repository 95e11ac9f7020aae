"""The picture with two known lines that a marking network must find before it may see a road."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from automodel.types import Image

FOUND = 0.6  # share of the lines' pixels that must be marked
ELSEWHERE = 0.03  # share of all other pixels that may be marked
HALF = 128


def self_test(network: Callable[[Image], Image], width_px: int, height_px: int) -> None:
    """Raise ValueError unless `network` marks the drawn lines and little else, and leaves a black picture empty."""
    picture, lines = drawn_lines(width_px, height_px)
    mask = network(picture)
    around = cv2.dilate(lines, np.ones((9, 9), np.uint8))
    found = float((mask[lines > 0] >= HALF).mean())
    elsewhere = float((mask[around == 0] >= HALF).mean())
    if found < FOUND or elsewhere > ELSEWHERE:
        raise ValueError(
            f"it fails the self-test: marks {found:.0%} of two drawn lines ({FOUND:.0%} wanted)"
            f" and {elsewhere:.0%} of what lies beside them ({ELSEWHERE:.0%} allowed)"
        )
    black = network(np.zeros_like(picture))
    if float((black >= HALF).mean()) > ELSEWHERE:
        raise ValueError("it fails the self-test: marks a black picture")


def drawn_lines(width_px: int, height_px: int) -> tuple[Image, Image]:
    """A grey floor under a brighter wall with two bright lines that run together ahead, and the lines alone."""
    rng = np.random.default_rng(1)
    horizon = 0.3 * height_px
    rows = np.arange(height_px)[:, None] + np.zeros((1, width_px))
    grey = np.where(rows < horizon, 135.0, 70.0 + 25.0 * rows / height_px)
    lines: Image = np.zeros((height_px, width_px), np.uint8)
    top = horizon + 0.12 * height_px
    for bottom_u, top_u in ((0.18, 0.42), (0.80, 0.56)):
        half_bottom, half_top = 0.018, 0.004  # of the width
        corners = [
            ((bottom_u - half_bottom) * width_px, height_px),
            ((bottom_u + half_bottom) * width_px, height_px),
            ((top_u + half_top) * width_px, top),
            ((top_u - half_top) * width_px, top),
        ]
        cv2.fillConvexPoly(lines, np.round(corners).astype(np.int32), 255)
    grey = np.where(lines > 0, 205.0, grey)
    grey = cv2.GaussianBlur(grey, (3, 3), 0.0) + rng.normal(0.0, 3.0, grey.shape)
    return np.clip(grey, 0, 255).astype(np.uint8), lines
