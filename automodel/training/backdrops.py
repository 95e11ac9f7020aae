"""Backdrops above the horizon: landscapes, halls and rooms, with many bright bars that are no lane lines.

All functions draw into grey images (h, w) uint8 in place; positions are in pixels, `foot` is the row of the horizon.
"""

from __future__ import annotations

import cv2
import numpy as np

from automodel.training import noise
from automodel.types import Image

Rng = np.random.Generator


def box(image: Image, left: float, top: float, right: float, bottom: float, grey: float) -> None:
    """A filled upright rectangle."""
    cv2.rectangle(image, (int(left), int(top)), (int(right), int(bottom)), float(np.clip(grey, 0, 255)), -1)


def bar(image: Image, start: tuple[float, float], end: tuple[float, float], grey: float, width: float) -> None:
    """A straight bar of thickness `width` between two points (u, v)."""
    ends = [(round(u * 16), round(v * 16)) for u, v in (start, end)]
    cv2.line(image, ends[0], ends[1], float(np.clip(grey, 0, 255)), max(1, round(width)), cv2.LINE_AA, 4)


def unit(image: Image, foot: int, rng: Rng) -> float:
    """A random length [px] for scaling objects, in proportion to the image and the height of the horizon."""
    return float(max(6.0, rng.uniform(0.35, 1.0) * max(foot, image.shape[0] / 5)))


def windows(image: Image, area: tuple[float, float, float, float], rng: Rng) -> None:
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
            box(image, u - du, v - dv, u + du, v + dv, glass + rng.normal(0, 15))
            if bright and wide > 6:
                bar(image, (u, v - dv), (u, v + dv), frame, thick)
                bar(image, (u - du, v + dv), (u + du, v + dv), frame, thick)


def low_strip(image: Image, foot: int, rng: Rng) -> None:
    """Low distant objects: a wall, a fence, parked cars, a guard rail, bright roofs."""
    height, width = image.shape
    tall = rng.uniform(0.02, 0.12) * height
    if rng.random() < 0.6:
        box(image, 0, foot - tall, width, foot, rng.uniform(10, 220))
        if rng.random() < 0.5:
            bar(image, (0, foot - tall), (width, foot - tall), rng.uniform(100, 255), rng.uniform(1, 3))
    for _ in range(int(rng.integers(0, 25))):
        u, wide = rng.uniform(0, width), rng.uniform(2, 30)
        v = foot - tall * rng.uniform(0, 1)
        box(image, u, v - tall * rng.uniform(0.1, 0.8), u + wide, v, rng.uniform(0, 255))


def hall(image: Image, foot: int, rng: Rng) -> None:
    """A sports or exhibition hall: lamps and beams, bright windows, furniture and people at the edge of the floor."""
    width = image.shape[1]
    image[:] = int(rng.choice((rng.uniform(2, 45), rng.uniform(60, 200))))
    if rng.random() < 0.6:
        box(image, 0, foot * rng.uniform(0.2, 0.8), width, foot, rng.uniform(10, 235))
    if rng.random() < 0.5:
        top = foot * rng.uniform(0, 0.5)
        windows(image, (0, top, width, top + rng.uniform(0.15, 0.5) * foot + 3), rng)
    for _ in range(int(rng.integers(0, 8))):  # beams
        start, end = (rng.uniform(-0.2, 1.2, 2) * (width, foot) for _ in range(2))
        bar(image, tuple(start), (end[0], min(end[1], foot)), rng.uniform(20, 255), rng.uniform(1, 5))
    _ceiling_lamps(image, foot, rng)
    if rng.random() < 0.5:
        _many_lamps(image, foot, rng)
    if rng.random() < 0.7:
        _furniture(image, foot, rng)
    if rng.random() < 0.6:
        _people(image, foot, rng)
    if rng.random() < 0.4:
        low_strip(image, foot, rng)


def _ceiling_lamps(image: Image, foot: int, rng: Rng) -> None:
    """Rows of tubes or round lamps that shrink towards the horizon."""
    height, width = image.shape
    round_ones, grey = rng.random() < 0.5, rng.uniform(190, 255)
    for _ in range(int(rng.integers(1, 5))):
        u0, u1 = rng.uniform(-0.3, 1.3, 2) * width
        v0, v1 = rng.uniform(-0.3, 0.6) * foot, rng.uniform(0.4, 0.95) * foot
        for far in 1.0 - 0.75 ** np.arange(int(rng.integers(2, 12))):
            u, v = u0 + (u1 - u0) * far, v0 + (v1 - v0) * far
            size = max(1.0, (1.0 - far) * height * 0.09)
            if round_ones:
                cv2.ellipse(image, (int(u), int(v)), (int(size) + 1, int(size / 2) + 1), 0, 0, 360, grey, -1)
            else:
                bar(image, (u - size * 1.5, v), (u + size * 1.5, v + size * 0.1), grey, size / 3)


def _many_lamps(image: Image, foot: int, rng: Rng) -> None:
    """Rows of many small lamps of a large hall, and small bright and dark objects below them."""
    width = image.shape[1]
    rows = foot * (1.0 - np.sort(rng.uniform(0.0, 1.0, int(rng.integers(2, 7))) ** 2))
    size, grey = rng.uniform(0.006, 0.02) * width, rng.uniform(170, 255)
    for v in rows:
        wide = size * (0.3 + 1.2 * max(foot - v, 0.0) / max(foot, 1))
        for u in np.arange(rng.uniform(-20, 20), width, wide * rng.uniform(3.0, 9.0)):
            centre = (int(u + rng.normal(0, wide)), int(v + rng.normal(0, 0.02) * foot))
            axes = (int(wide * rng.uniform(0.5, 1.2)) + 1, int(wide * 0.35) + 1)
            cv2.ellipse(image, centre, axes, 0, 0, 360, float(grey), -1)
    for _ in range(int(rng.integers(0, 40))):
        u, v = rng.uniform(0, width), foot * rng.uniform(0.5, 1.0)
        box(image, u, v, u + rng.uniform(1, 9), min(v + rng.uniform(1, 9), foot), rng.uniform(0, 255))


def _furniture(image: Image, foot: int, rng: Rng) -> None:
    """Tables, chairs, fences and flags along the far edge of the floor: many thin bars."""
    width = image.shape[1]
    size = unit(image, foot, rng) * 0.5
    grey = rng.choice((rng.uniform(0, 70), rng.uniform(150, 255)))
    for _ in range(int(rng.integers(1, 14))):
        u, wide, tall = rng.uniform(0, width), size * rng.uniform(0.3, 2.0), size * rng.uniform(0.4, 1.2)
        box(image, u, foot - tall, u + wide, foot - tall * rng.uniform(0.75, 0.93), grey + rng.normal(0, 20))
        for part in np.linspace(0, 1, int(rng.integers(2, 5))):
            bar(image, (u + wide * part, foot - tall), (u + wide * part, foot), grey, rng.uniform(0.5, 4.0))
        if rng.random() < 0.2:
            bar(image, (u, foot - tall * 0.3), (u + wide, foot - tall * 0.3), grey, rng.uniform(0.5, 3))


def _people(image: Image, foot: int, rng: Rng) -> None:
    """Standing people, or only their legs if the camera is low."""
    width = image.shape[1]
    size = unit(image, foot, rng) * rng.choice((0.6, 1.0, 3.0))
    for _ in range(int(rng.integers(1, 9))):
        u, tall = rng.uniform(0, width), size * rng.uniform(0.8, 1.2)
        trousers, shirt = rng.uniform(0, 190), rng.uniform(0, 255)
        for side in (-1, 1):
            leg = tall * 0.05
            bar(image, (u + side * tall * 0.06, foot), (u + side * leg, foot - tall * 0.5), trousers, tall * 0.09)
            box(image, u + side * leg - leg, foot - leg, u + side * leg + leg * 1.6, foot, rng.uniform(0, 255))
        box(image, u - tall * 0.12, foot - tall * 0.85, u + tall * 0.12, foot - tall * 0.45, shirt)
        centre = (int(u), int(foot - tall * 0.92))
        cv2.ellipse(image, centre, (int(tall * 0.06) + 1, int(tall * 0.08) + 1), 0, 0, 360, rng.uniform(20, 210), -1)


def room(image: Image, foot: int, rng: Rng) -> None:
    """A wall with a skirting board, doors, windows, posters and sockets, and furniture in front of it."""
    height, width = image.shape
    wall = rng.uniform(40, 245)
    image[:] = int(wall)
    noise.add(image, noise.fractal(1.4, noise.variant(rng)), rng.uniform(1, 8), rng)
    for _ in range(int(rng.integers(0, 3))):  # corners of the room: walls of another tone
        u = rng.uniform(0, width)
        box(image, u, 0, width, height, wall + rng.normal(0, 25))
        bar(image, (u, 0), (u, foot), wall - rng.uniform(0, 40), 1)
    size = unit(image, foot, rng)
    for _ in range(int(rng.integers(0, 5))):
        u, v = rng.uniform(0, width), rng.uniform(-0.3, 0.7) * foot
        box(
            image,
            u,
            v,
            u + size * rng.uniform(0.1, 1.2),
            min(v + size * rng.uniform(0.1, 0.9), foot),
            rng.uniform(0, 255),
        )
    if rng.random() < 0.4:
        u, top = rng.uniform(-0.2, 0.9) * width, rng.uniform(-0.5, 0.4) * foot
        windows(image, (u, top, u + rng.uniform(0.1, 0.6) * width, top + rng.uniform(0.3, 0.5) * foot + 3), rng)
    if rng.random() < 0.4:
        u, wide = rng.uniform(0, width), size * rng.uniform(0.4, 1.0)
        box(image, u - 2, foot * rng.uniform(-0.2, 0.3), u + wide + 2, foot, rng.uniform(80, 255))
        box(image, u, foot * rng.uniform(0, 0.35), u + wide, foot, rng.uniform(20, 230))
    if rng.random() < 0.6:
        tall = rng.uniform(0.01, 0.05) * height + 1
        box(image, 0, foot - tall, width, foot, rng.choice((rng.uniform(180, 255), rng.uniform(0, 110))))
        bar(image, (0, foot - tall), (width, foot - tall), wall - rng.uniform(-20, 60), 1)
    if rng.random() < 0.5:
        _furniture(image, foot, rng)
    if rng.random() < 0.3:
        _people(image, foot, rng)


def outdoors(image: Image, foot: int, rng: Rng) -> None:
    """A sky with hills, houses, trees, bridges, poles and traffic under it."""
    sky = _sky(image, rng)
    if rng.random() < 0.5:
        _skyline(image, foot, rng.uniform(0.05, 0.5), sky * rng.uniform(0.35, 0.95), 1.8, rng)  # hills
    if rng.random() < 0.45:
        for _ in range(int(rng.integers(1, 6))):
            _house(image, foot, rng)
    if rng.random() < 0.6:
        _trees(image, foot, rng)
    if rng.random() < 0.25:
        _bridge(image, foot, rng)
    if rng.random() < 0.5:
        _poles(image, foot, rng)
    if rng.random() < 0.2:
        _gantry(image, foot, rng)
    if rng.random() < 0.3:
        _wires(image, foot, rng)
    if rng.random() < 0.3:
        _traffic(image, foot, rng)
    if rng.random() < 0.4:
        low_strip(image, foot, rng)


def _sky(image: Image, rng: Rng) -> float:
    """A gradient with clouds over the whole image; gives its grey at the bottom."""
    height, width = image.shape
    top = rng.uniform(2, 40) if rng.random() < 0.12 else rng.uniform(70, 245)
    low = float(np.clip(top + rng.normal(15, 40), 2, 255))
    image[:] = np.linspace(top, low, height).astype(np.uint8)[:, None]
    if rng.random() < 0.6:
        clouds = noise.crop(noise.fractal(1.8, noise.variant(rng)), rng, 128, 256)
        wide = np.asarray(cv2.resize(clouds, (width, height)), dtype=np.uint8)
        gain = rng.uniform(0.1, 0.9)
        cv2.addWeighted(image, 1.0, wide, gain, -noise.MIDDLE * gain, dst=image)
    return low


def _skyline(image: Image, foot: int, tall: float, grey: float, slope: float, rng: Rng) -> None:
    """A filled silhouette with a random upper edge; `tall` is its share of the height above the horizon."""
    height, width = image.shape
    row = noise.crop(noise.fractal(slope, noise.variant(rng)), rng, 1, min(width, noise.SIDE_PX))[0].astype(np.float32)
    wave = np.interp(np.linspace(0, len(row) - 1, width // 3 + 2), np.arange(len(row)), (row - noise.MIDDLE) / 90.0)
    top = foot - tall * max(foot, height / 6) * np.clip(0.6 + wave, 0.02, 2.0)
    u = np.linspace(0, width, len(top))
    outline = np.concatenate((np.column_stack((u, top)), [[width, foot], [0, foot]]))
    cv2.fillPoly(image, [np.rint(outline * 16).astype(np.int32)], float(np.clip(grey, 0, 255)), cv2.LINE_AA, 4)


def _trees(image: Image, foot: int, rng: Rng) -> None:
    """A row of trees or single trees, with a texture of leaves."""
    height, width = image.shape
    mask = np.zeros((height, width), dtype=np.uint8)
    if rng.random() < 0.6:
        _skyline(mask, foot, rng.uniform(0.1, 1.0), 255, 1.2, rng)
    for _ in range(int(rng.integers(0, 12))):
        u, tall = rng.uniform(0, width), rng.uniform(0.1, 0.9) * max(foot, height / 5)
        crown = (int(tall * rng.uniform(0.2, 0.6)) + 1, int(tall * rng.uniform(0.3, 0.6)) + 1)
        cv2.ellipse(mask, (int(u), int(foot - tall + crown[1])), crown, 0, 0, 360, 255, -1)
        bar(mask, (u, foot), (u, foot - tall + crown[1]), 255, tall * 0.06)
    dark = rng.uniform(5, 110)
    leafy = np.full((height, width), int(dark), dtype=np.uint8)
    noise.add(leafy, noise.fractal(0.8, noise.variant(rng)), rng.uniform(2, 8) + 0.15 * dark, rng)
    noise.add(leafy, noise.leaves(noise.variant(rng)), rng.uniform(0, 4), rng)
    if rng.random() < 0.7:  # the sky is visible through the edge
        ragged = np.full_like(mask, 96)
        noise.add(ragged, noise.band(64.0, 1.0, noise.variant(rng)), 40.0, rng)
        soft = cv2.blur(mask, (9, 9))
        mask = np.where(soft > ragged, np.uint8(255), np.uint8(0))
    mask[foot:] = 0
    cv2.copyTo(leafy, mask, image)


def _house(image: Image, foot: int, rng: Rng) -> None:
    height, width = image.shape
    tall = rng.uniform(0.15, 1.1) * max(foot, height / 5)
    left, wide = rng.uniform(-0.2, 1.0) * width, rng.uniform(0.08, 0.5) * width
    wall = rng.uniform(30, 230)
    box(image, left, foot - tall, left + wide, foot, wall)
    if rng.random() < 0.4:
        roof = np.array([[left - 4, foot - tall], [left + wide + 4, foot - tall], [left + wide / 2, foot - tall * 1.4]])
        cv2.fillPoly(image, [roof.astype(np.int32)], float(rng.uniform(20, 140)))
    if rng.random() < 0.85:
        windows(image, (left, foot - tall, left + wide, foot), rng)


def _poles(image: Image, foot: int, rng: Rng) -> None:
    """Lamp posts, flag poles, white posts; with arms, lamps and signs."""
    height, width = image.shape
    grey, count = rng.choice((rng.uniform(0, 80), rng.uniform(150, 255))), int(rng.integers(1, 8))
    for _ in range(count):
        u, tall = rng.uniform(0, width), rng.uniform(0.2, 1.2) * max(foot, height / 5)
        thick = rng.uniform(0.5, 5.0)
        lean = rng.normal(0, 0.03) * tall
        bar(image, (u, foot), (u + lean, foot - tall), grey, thick)
        end = rng.random()
        if end < 0.3:
            arm = rng.normal(0, 0.25) * tall
            bar(image, (u + lean, foot - tall), (u + lean + arm, foot - tall * 1.04), grey, thick)
        elif end < 0.5:
            s = tall * rng.uniform(0.06, 0.25) + 2
            box(image, u + lean - s, foot - tall - s, u + lean + s, foot - tall + s, rng.uniform(20, 255))
            box(image, u + lean - s / 2, foot - tall - s / 4, u + lean + s / 2, foot - tall, rng.uniform(20, 255))


def _gantry(image: Image, foot: int, rng: Rng) -> None:
    """Signs with text over the road, on a frame of thin bars."""
    height, width = image.shape
    top = foot - rng.uniform(0.3, 0.9) * max(foot, height / 4)
    left, right = sorted(rng.uniform(-0.1, 1.1, 2) * width)
    grey, deep = rng.uniform(20, 220), rng.uniform(3, 16)
    for v in (top, top + deep):
        bar(image, (left, v), (right, v), grey, rng.uniform(1, 3))
    for u in np.arange(left, right, deep * 1.5):
        bar(image, (u, top), (u + deep * 0.75, top + deep), grey, 1)
    for u in (left, right):
        bar(image, (u, top), (u, foot), grey, rng.uniform(1, 5))
    for _ in range(int(rng.integers(1, 4))):
        u, wide, tall = rng.uniform(left, right), rng.uniform(15, 80), rng.uniform(10, 35)
        board = rng.uniform(20, 120)
        box(image, u, top - tall / 2, u + wide, top + tall / 2, 230)
        box(image, u + 1, top - tall / 2 + 1, u + wide - 1, top + tall / 2 - 1, board)
        for row in range(int(tall // 8)):
            v = top - tall / 2 + 5 + 8 * row
            bar(image, (u + 4, v), (u + 4 + (wide - 8) * rng.uniform(0.3, 1), v), 235, rng.uniform(1, 3))


def _bridge(image: Image, foot: int, rng: Rng) -> None:
    """A bridge across the image: a deck with a railing on piers."""
    height, width = image.shape
    tall = rng.uniform(0.15, 0.8) * max(foot, height / 5)
    deep = rng.uniform(0.08, 0.4) * tall
    tilt, grey = rng.normal(0, 0.06) * width, rng.uniform(20, 200)
    v = foot - tall
    deck = np.array([[0, v], [width, v + tilt], [width, v + tilt + deep], [0, v + deep]])
    cv2.fillPoly(image, [deck.astype(np.int32)], float(grey))
    bar(image, (0, v), (width, v + tilt), grey + rng.uniform(-60, 90), rng.uniform(1, 4))
    bar(image, (0, v + deep), (width, v + tilt + deep), grey * 0.4, rng.uniform(1, 4))
    for _ in range(int(rng.integers(0, 5))):
        u, wide = rng.uniform(0, width), rng.uniform(3, 25)
        box(image, u, v + deep + tilt * u / width, u + wide, foot, grey * rng.uniform(0.5, 1.1))


def _traffic(image: Image, foot: int, rng: Rng) -> None:
    """Distant cars of a few pixels: dark below, with a roof or window above."""
    height, width = image.shape
    size = rng.uniform(0.01, 0.05) * height + 2
    for _ in range(int(rng.integers(2, 25))):
        u, wide, grey = rng.uniform(0, width), size * rng.uniform(1.0, 2.2), rng.uniform(10, 240)
        v = foot + 1
        box(image, u, v - size, u + wide, v - size * 0.3, grey)
        box(image, u + wide * 0.15, v - size * 1.4, u + wide * 0.85, v - size, rng.uniform(5, 120))
        box(image, u, v - size * 0.35, u + wide, v, rng.uniform(0, 50))


def _wires(image: Image, foot: int, rng: Rng) -> None:
    """Sagging power lines across the image."""
    width = image.shape[1]
    grey, count = rng.uniform(0, 90), int(rng.integers(1, 6))
    start, end = rng.uniform(0, 0.8, 2) * foot
    u = np.linspace(0, 1, 12)
    sag = rng.uniform(0, 0.3) * foot * 4 * u * (1 - u)
    for i in range(count):
        v = start + (end - start) * u + sag + i * rng.uniform(2, 12)
        path = np.column_stack((u * width, np.minimum(v, foot)))
        cv2.polylines(image, [np.rint(path * 16).astype(np.int32)], False, grey, 1, cv2.LINE_AA, 4)


def backdrop(rng: Rng, width_px: int, height_px: int, horizon_v: float) -> Image:
    """A random backdrop (h, w) uint8; `horizon_v` is the row [px] of the horizon, which may be outside the image."""
    image = np.full((height_px, width_px), int(rng.integers(10, 120)), dtype=np.uint8)
    foot = int(np.clip(horizon_v + rng.uniform(0, 6), 0, height_px))
    if foot < 2:
        return image
    kind = rng.random()
    if kind < 0.5:
        outdoors(image, foot, rng)
    elif kind < 0.75:
        hall(image, foot, rng)
    elif kind < 0.92:
        room(image, foot, rng)
    else:
        _clutter(image, foot, rng)
    if rng.random() < 0.35:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), rng.uniform(0.5, 2.5)), dtype=np.uint8)
    return image


def _clutter(image: Image, foot: int, rng: Rng) -> None:
    """Random boxes and bars of any grey, which only the horizon distinguishes from lane lines."""
    width = image.shape[1]
    for _ in range(int(rng.integers(5, 40))):
        u, v = rng.uniform(0, width), rng.uniform(0, foot)
        grey, size = rng.uniform(0, 255), rng.uniform(2, 80)
        if rng.random() < 0.5:
            box(image, u, v, u + size, min(v + rng.uniform(2, 60), foot), grey)
        else:
            end = (u + rng.normal(0, 1) * size * 2, min(v + rng.normal(0, 1) * size, float(foot)))
            bar(image, (u, v), end, grey, rng.uniform(0.5, 6.0))
