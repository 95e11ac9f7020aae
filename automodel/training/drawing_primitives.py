"""Strokes that backdrops are drawn with, on grey pictures (h, w) uint8 in place; all positions in pixels."""

from __future__ import annotations

import cv2
import numpy as np

from automodel.types import Image

Rng = np.random.Generator


def box(picture: Image, left: float, top: float, right: float, bottom: float, grey: float) -> None:
    """A filled upright rectangle."""
    cv2.rectangle(picture, (int(left), int(top)), (int(right), int(bottom)), float(np.clip(grey, 0, 255)), -1)


def bar(picture: Image, start: tuple[float, float], end: tuple[float, float], grey: float, width: float) -> None:
    """A straight bar `width` thick between two points (u, v)."""
    ends = [(round(u * 16), round(v * 16)) for u, v in (start, end)]
    cv2.line(picture, ends[0], ends[1], float(np.clip(grey, 0, 255)), max(1, round(width)), cv2.LINE_AA, 4)


def unit(picture: Image, foot: int, rng: Rng) -> float:
    """A random size [px] to scale things by, tied to the picture and not only to the strip above the horizon."""
    return float(max(6.0, rng.uniform(0.35, 1.0) * max(foot, picture.shape[0] / 5)))


def windows(picture: Image, area: tuple[float, float, float, float], rng: Rng) -> None:
    """Rows of windows with frames in a rectangle (left, top, right, bottom)."""
    left, top, right, bottom = area
    columns, rows = int(rng.integers(1, 9)), int(rng.integers(1, 5))
    wide, tall = (right - left) / columns, (bottom - top) / rows
    share_u, share_v = rng.uniform(0.3, 0.95), rng.uniform(0.3, 0.9)
    glass, frame, bright = rng.uniform(0, 255), rng.uniform(60, 255), rng.random() < 0.6
    thick = max(1.0, wide * rng.uniform(0.03, 0.1))
    for j in range(rows):
        for i in range(columns):
            u, v = left + (i + 0.5) * wide, top + (j + 0.5) * tall
            du, dv = wide * share_u / 2, tall * share_v / 2
            box(picture, u - du, v - dv, u + du, v + dv, glass + rng.normal(0, 15))
            if bright and wide > 6:
                bar(picture, (u, v - dv), (u, v + dv), frame, thick)
                bar(picture, (u - du, v + dv), (u + du, v + dv), frame, thick)


def low_strip(picture: Image, foot: int, rng: Rng) -> None:
    """What is far away and low: a wall, a fence, parked cars, a guard rail, bright roofs."""
    height, width = picture.shape
    tall = rng.uniform(0.02, 0.12) * height
    if rng.random() < 0.6:
        box(picture, 0, foot - tall, width, foot, rng.uniform(10, 220))
        if rng.random() < 0.5:
            bar(picture, (0, foot - tall), (width, foot - tall), rng.uniform(100, 255), rng.uniform(1, 3))
    for _ in range(int(rng.integers(0, 25))):
        u, wide = rng.uniform(0, width), rng.uniform(2, 30)
        v = foot - tall * rng.uniform(0, 1)
        box(picture, u, v - tall * rng.uniform(0.1, 0.8), u + wide, v, rng.uniform(0, 255))
