"""Cars and lorries as a camera behind or beside them sees them. Lengths are in lane widths."""

from __future__ import annotations

import math

import numpy as np

from automodel.training.solids import Builder, Solid, box_faces, rectangle

Rng = np.random.Generator


def _wheels(build: Builder, length: float, half: float, tall: float) -> None:
    """Four dark boxes under the ends."""
    for x in (0.72 * length, 0.1 * length):
        for side in (-1.0, 1.0):
            y0, y1 = sorted((side * half * 0.62, side * half * 0.97))
            build.box((x, y0, 0), (x + tall, y1, tall), 14, (tall * 0.2, tall * 0.2, 0.0))


def _flanks(build: Builder, length: float, half: float, tall: float) -> None:
    """The wheels as they show on the sides: dark octagons with a lighter rim."""
    angle = np.arange(4) * math.pi / 4 + math.pi / 8
    radius = tall / 2.0
    for x in (0.72 * length, 0.1 * length):
        for side in (-1.0, 1.0):
            middle = np.array([x + radius, side * (half + 0.004), radius])
            spoke = np.column_stack((-side * np.cos(angle), np.zeros(4), np.sin(angle)))
            for size, grey in ((radius, 12.0), (radius * 0.55, 95.0)):
                rim = middle + size * np.concatenate((spoke, -spoke))
                for i in (0, 2, 4):  # a fan of three quads fills the octagon
                    build.face((rim[0], rim[i + 1], rim[i + 2], rim[(i + 3) % 8]), grey)


def car(rng: Rng, x: float, y: float, yaw_rad: float) -> Solid:
    """A car, van or pick-up: body, cabin, windows, wheels, lamps, number plate."""
    build = Builder(x, y, yaw_rad)
    scale, slant = rng.uniform(0.85, 1.15), rng.uniform(0.0, 1.0)
    half, length, tall = 0.25 * scale, rng.uniform(0.9, 1.4) * scale, rng.uniform(0.34, 0.5) * scale
    paint, glass = rng.uniform(8, 240), rng.uniform(5, 110)
    waist, floor, dark = tall * rng.uniform(0.55, 0.68), tall * rng.uniform(0.1, 0.18), rng.uniform(0.3, 0.9)
    _wheels(build, length, half, tall * 0.42)
    low, high, inset = (0, -half, floor), (length, half, waist), (0.02, 0.05, 0.015)
    build.box(low, high, paint, inset)
    rear = box_faces((-0.003, -half, floor), high, inset)["rear"]
    lamp, plate = rng.uniform(20, 255), rng.uniform(100, 255)
    for part, grey in (
        ((0.0, 1.0, 0.0, 0.3), paint * dark * 0.7),
        ((0.02, 0.2, 0.55, 0.85), lamp),
        ((0.8, 0.98, 0.55, 0.85), lamp),
        ((0.38, 0.62, 0.35, 0.55), plate),
    ):
        build.face(rear, grey, part)
    _flanks(build, length, half, tall * 0.42)
    start, stop = length * rng.uniform(0.01, 0.25), length * rng.uniform(0.65, 0.9)
    drawn_in = (tall * 0.5 * slant, tall * 0.6, half * 0.2)
    build.box((start, -half * 0.95, waist), (stop, half * 0.95, tall), paint, drawn_in)
    shell = box_faces((start - 0.004, -half * 0.95 - 0.004, waist), (stop, half * 0.95 + 0.004, tall), drawn_in)
    for name in ("left", "right", "rear"):
        build.face(shell[name], glass, (0.06, 0.94, 0.1, 0.85))
        if name != "rear":
            build.face(shell[name], paint * 0.7, (0.45, 0.5, 0.1, 0.85))
    if rng.random() < 0.4:
        build.face(shell["rear"], glass + 90, (0.2, 0.6, 0.5, 0.8))  # the sky in the window
    return build.solid(rectangle(-0.06, length, half * 1.1))


def truck(rng: Rng, x: float, y: float, yaw_rad: float) -> Solid:
    """A lorry from behind: a tall box on wheels, with doors and a bumper."""
    build = Builder(x, y, yaw_rad)
    half, length, tall, floor = rng.uniform(0.3, 0.37), rng.uniform(1.5, 4.5), rng.uniform(0.8, 1.15), 0.3
    grey = rng.uniform(25, 245)
    _wheels(build, length * 0.5, half, floor)
    build.box((0, -half, floor * 0.8), (length, half, tall), grey)
    faces = box_faces((-0.003, -half - 0.003, floor * 0.8), (length, half + 0.003, tall))
    for name in ("left", "right"):
        build.face(faces[name], rng.uniform(0, 255), (rng.uniform(0, 0.4), rng.uniform(0.5, 1), 0.3, 0.8))
        build.face(faces[name], grey * 0.3, (0.0, 1.0, 0.0, 0.06))
    build.face(faces["rear"], grey * 0.4, (0.0, 1.0, 0.0, 0.06))
    build.face(faces["rear"], grey * 0.5, (0.495, 0.505, 0.06, 1.0))
    for part in ((0.0, 0.12, 0.0, 0.06), (0.88, 1.0, 0.0, 0.06)):
        build.face(faces["rear"], rng.uniform(90, 255), part)
    _flanks(build, length * 0.5, half, floor)
    return build.solid(rectangle(-0.1, length, half * 1.15))
