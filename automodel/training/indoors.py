"""Backdrops under a roof: halls with lamps and people, rooms with doors and furniture."""

from __future__ import annotations

import cv2
import numpy as np

from automodel.training import noise
from automodel.training.sketching import bar, box, low_strip, unit, windows
from automodel.types import Image

Rng = np.random.Generator


def hall(picture: Image, foot: int, rng: Rng) -> None:
    """A sports or exhibition hall: lamps and beams above, bright windows, stands and people at the floor's edge."""
    width = picture.shape[1]
    picture[:] = int(rng.choice((rng.uniform(2, 45), rng.uniform(60, 200))))
    if rng.random() < 0.6:
        box(picture, 0, foot * rng.uniform(0.2, 0.8), width, foot, rng.uniform(10, 235))
    if rng.random() < 0.5:
        top = foot * rng.uniform(0, 0.5)
        windows(picture, (0, top, width, top + rng.uniform(0.15, 0.5) * foot + 3), rng)
    for _ in range(int(rng.integers(0, 8))):  # beams
        start, end = (rng.uniform(-0.2, 1.2, 2) * (width, foot) for _ in range(2))
        bar(picture, tuple(start), (end[0], min(end[1], foot)), rng.uniform(20, 255), rng.uniform(1, 5))
    _ceiling_lamps(picture, foot, rng)
    if rng.random() < 0.5:
        _many_lamps(picture, foot, rng)
    if rng.random() < 0.7:
        _furniture(picture, foot, rng)
    if rng.random() < 0.6:
        _people(picture, foot, rng)
    if rng.random() < 0.4:
        low_strip(picture, foot, rng)


def _ceiling_lamps(picture: Image, foot: int, rng: Rng) -> None:
    """Rows of tubes or round lamps that shrink towards the horizon."""
    height, width = picture.shape
    round_ones, grey = rng.random() < 0.5, rng.uniform(190, 255)
    for _ in range(int(rng.integers(1, 5))):
        u0, u1 = rng.uniform(-0.3, 1.3, 2) * width
        v0, v1 = rng.uniform(-0.3, 0.6) * foot, rng.uniform(0.4, 0.95) * foot
        for far in 1.0 - 0.75 ** np.arange(int(rng.integers(2, 12))):
            u, v = u0 + (u1 - u0) * far, v0 + (v1 - v0) * far
            size = max(1.0, (1.0 - far) * height * 0.09)
            if round_ones:
                cv2.ellipse(picture, (int(u), int(v)), (int(size) + 1, int(size / 2) + 1), 0, 0, 360, grey, -1)
            else:
                bar(picture, (u - size * 1.5, v), (u + size * 1.5, v + size * 0.1), grey, size / 3)


def _many_lamps(picture: Image, foot: int, rng: Rng) -> None:
    """A large hall's many small lamps in rows, and bright odds and ends lower down."""
    width = picture.shape[1]
    rows = foot * (1.0 - np.sort(rng.uniform(0.0, 1.0, int(rng.integers(2, 7))) ** 2))
    size, grey = rng.uniform(0.006, 0.02) * width, rng.uniform(170, 255)
    for v in rows:
        wide = size * (0.3 + 1.2 * max(foot - v, 0.0) / max(foot, 1))
        for u in np.arange(rng.uniform(-20, 20), width, wide * rng.uniform(3.0, 9.0)):
            centre = (int(u + rng.normal(0, wide)), int(v + rng.normal(0, 0.02) * foot))
            axes = (int(wide * rng.uniform(0.5, 1.2)) + 1, int(wide * 0.35) + 1)
            cv2.ellipse(picture, centre, axes, 0, 0, 360, float(grey), -1)
    for _ in range(int(rng.integers(0, 40))):
        u, v = rng.uniform(0, width), foot * rng.uniform(0.5, 1.0)
        box(picture, u, v, u + rng.uniform(1, 9), min(v + rng.uniform(1, 9), foot), rng.uniform(0, 255))


def _furniture(picture: Image, foot: int, rng: Rng) -> None:
    """Tables, chairs, fences and flags along the floor's far edge: many thin bars."""
    width = picture.shape[1]
    size = unit(picture, foot, rng) * 0.5
    grey = rng.choice((rng.uniform(0, 70), rng.uniform(150, 255)))
    for _ in range(int(rng.integers(1, 14))):
        u, wide, tall = rng.uniform(0, width), size * rng.uniform(0.3, 2.0), size * rng.uniform(0.4, 1.2)
        box(picture, u, foot - tall, u + wide, foot - tall * rng.uniform(0.75, 0.93), grey + rng.normal(0, 20))
        for part in np.linspace(0, 1, int(rng.integers(2, 5))):
            bar(picture, (u + wide * part, foot - tall), (u + wide * part, foot), grey, rng.uniform(0.5, 4.0))
        if rng.random() < 0.2:
            bar(picture, (u, foot - tall * 0.3), (u + wide, foot - tall * 0.3), grey, rng.uniform(0.5, 3))


def _people(picture: Image, foot: int, rng: Rng) -> None:
    """Standing people, or only their legs when the camera is low."""
    width = picture.shape[1]
    size = unit(picture, foot, rng) * rng.choice((0.6, 1.0, 3.0))
    for _ in range(int(rng.integers(1, 9))):
        u, tall = rng.uniform(0, width), size * rng.uniform(0.8, 1.2)
        trousers, shirt = rng.uniform(0, 190), rng.uniform(0, 255)
        for side in (-1, 1):
            leg = tall * 0.05
            bar(picture, (u + side * tall * 0.06, foot), (u + side * leg, foot - tall * 0.5), trousers, tall * 0.09)
            box(picture, u + side * leg - leg, foot - leg, u + side * leg + leg * 1.6, foot, rng.uniform(0, 255))
        box(picture, u - tall * 0.12, foot - tall * 0.85, u + tall * 0.12, foot - tall * 0.45, shirt)
        centre = (int(u), int(foot - tall * 0.92))
        cv2.ellipse(picture, centre, (int(tall * 0.06) + 1, int(tall * 0.08) + 1), 0, 0, 360, rng.uniform(20, 210), -1)


def room(picture: Image, foot: int, rng: Rng) -> None:
    """A wall with a skirting board, doors, windows, posters, sockets, and furniture before it."""
    height, width = picture.shape
    wall = rng.uniform(40, 245)
    picture[:] = int(wall)
    noise.add(picture, noise.fractal(1.4, noise.variant(rng)), rng.uniform(1, 8), rng)
    for _ in range(int(rng.integers(0, 3))):  # corners of the room: another wall's tone
        u = rng.uniform(0, width)
        box(picture, u, 0, width, height, wall + rng.normal(0, 25))
        bar(picture, (u, 0), (u, foot), wall - rng.uniform(0, 40), 1)
    size = unit(picture, foot, rng)
    for _ in range(int(rng.integers(0, 5))):
        u, v = rng.uniform(0, width), rng.uniform(-0.3, 0.7) * foot
        box(
            picture,
            u,
            v,
            u + size * rng.uniform(0.1, 1.2),
            min(v + size * rng.uniform(0.1, 0.9), foot),
            rng.uniform(0, 255),
        )
    if rng.random() < 0.4:
        u, top = rng.uniform(-0.2, 0.9) * width, rng.uniform(-0.5, 0.4) * foot
        windows(picture, (u, top, u + rng.uniform(0.1, 0.6) * width, top + rng.uniform(0.3, 0.5) * foot + 3), rng)
    if rng.random() < 0.4:
        u, wide = rng.uniform(0, width), size * rng.uniform(0.4, 1.0)
        box(picture, u - 2, foot * rng.uniform(-0.2, 0.3), u + wide + 2, foot, rng.uniform(80, 255))
        box(picture, u, foot * rng.uniform(0, 0.35), u + wide, foot, rng.uniform(20, 230))
    if rng.random() < 0.6:
        tall = rng.uniform(0.01, 0.05) * height + 1
        box(picture, 0, foot - tall, width, foot, rng.choice((rng.uniform(180, 255), rng.uniform(0, 110))))
        bar(picture, (0, foot - tall), (width, foot - tall), wall - rng.uniform(-20, 60), 1)
    if rng.random() < 0.5:
        _furniture(picture, foot, rng)
    if rng.random() < 0.3:
        _people(picture, foot, rng)
