"""Painted signs on the road that are no lane lines: zebra bars, stop lines, arrows, writing, hatched areas."""

from __future__ import annotations

import math
import string
from functools import lru_cache

import cv2
import numpy as np

from automodel.training.roads import Road
from automodel.training.shapes import Ink, Patch, box
from automodel.types import FloatArray

Rng = np.random.Generator


def somewhere_ahead(rng: Rng, road: Road, furthest: float = 12.0) -> float:
    """A place on the road ahead, more often near than far."""
    return float(rng.uniform(0.3, min(furthest, 0.8 * road.reach)) * rng.uniform(0.2, 1.0))


def _paint(rng: Rng) -> Ink:
    return Ink.PAINT if rng.random() < 0.75 else Ink.SECOND_PAINT


def _placed(road: Road, outlines: list[FloatArray], ink: Ink) -> Patch:
    """Outlines in (along, left) of the road laid on its curve."""
    laid = []
    for outline in outlines:
        laid.append(road.ribbon.place(outline[:, 0], outline[:, 1]))
    return Patch(outlines=tuple(laid), ink=ink)


def zebra(rng: Rng, road: Road) -> list[Patch]:
    """Bars across the whole road, drawn out along it."""
    s, long = somewhere_ahead(rng, road), rng.uniform(0.2, 1.2)
    bar = rng.uniform(0.06, 0.2)
    pitch = bar * rng.uniform(1.5, 2.5)
    places = np.arange(-road.right + 0.3 * pitch, road.left - bar, pitch)
    bars = [box(s, s + long, d, d + bar) for d in places]
    return [_placed(road, bars, _paint(rng))] if bars else []


def stop_line(rng: Rng, road: Road) -> list[Patch]:
    """A bar across one lane or the whole road, whole or broken."""
    s, long = somewhere_ahead(rng, road), rng.uniform(0.04, 0.2)
    d0, d1 = (-0.5, 0.5) if rng.random() < 0.6 else (-road.right, road.left)
    pieces = [box(s, s + long, d0 + 0.03, d1 - 0.03)]
    if rng.random() < 0.2:
        places = np.arange(d0, d1 - 0.1, rng.uniform(0.15, 0.3))
        pieces = [box(s, s + long, d, d + 0.1) for d in places]
    return [_placed(road, pieces, _paint(rng))]


def triangles(rng: Rng, road: Road) -> list[Patch]:
    """A row of give-way triangles."""
    s, size = somewhere_ahead(rng, road), rng.uniform(0.1, 0.25)
    places = np.arange(-0.5, 0.5 - size, size * 1.4)
    teeth = [np.array([[s, d + 0.5 * size], [s + 1.3 * size, d], [s + 1.3 * size, d + size]]) for d in places]
    return [_placed(road, teeth, _paint(rng))]


def arrow(rng: Rng, road: Road) -> list[Patch]:
    """An arrow in a lane: straight on, or with a head turned to a side."""
    s, long, wide = somewhere_ahead(rng, road), rng.uniform(0.6, 2.0), rng.uniform(0.2, 0.4)
    middle = rng.normal(0.0, 0.08) + float(rng.choice([0.0, 0.0, -1.0, 1.0]))
    shaft, head = 0.15 * wide, 0.35 * long
    if rng.random() < 0.55:
        shape = [(0, -shaft), (long - head, -shaft), (long - head, -wide / 2), (long, 0)]
        shape += [(a, -d) for a, d in reversed(shape[:-1])]
    else:
        tip, top = rng.choice([-1.0, 1.0]) * wide, long - 0.5 * head
        shape = [(0, -shaft), (0, shaft), (top, shaft), (top, 0.5 * tip), (top - 0.4 * head, 0.5 * tip)]
        shape += [(top + 0.25 * head, tip), (top + 0.9 * head, 0.5 * tip), (top + 0.5 * head, 0.5 * tip)]
        shape += [(top + 0.5 * head, -shaft)]
    outline = np.array(shape) + np.array([s, middle])
    return [_placed(road, [outline], _paint(rng))]


@lru_cache(maxsize=64)
def _glyphs(text: str, font: int) -> tuple[FloatArray, ...]:
    """Outlines of a text, 1 high, its middle at 0: columns are (up, left)."""
    size, base = cv2.getTextSize(text, font, 2.0, 5)
    picture = np.zeros((size[1] + base + 12, size[0] + 12), dtype=np.uint8)
    cv2.putText(picture, text, (6, size[1] + 6), font, 2.0, (255,), 5)
    rings, _ = cv2.findContours(picture, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_TC89_L1)
    height, width = picture.shape
    return tuple(
        np.column_stack((1.0 - ring[:, 0, 1] / height, (0.5 * width - ring[:, 0, 0]) / height))
        for ring in rings
        if len(ring) > 2
    )


def writing(rng: Rng, road: Road) -> list[Patch]:
    """A word, a number or a speed limit on the ground, upright or turned."""
    words = ("STOP", "BUS", "SLOW", "30", "50", "80", "KEEP", "TAXI", "P", "A7", "ONLY", "XING")
    text = (
        words[int(rng.integers(len(words)))]
        if rng.random() < 0.7
        else "".join(rng.choice(list(string.ascii_uppercase), 2))
    )
    font = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX)[int(rng.integers(2))]
    rings = _glyphs(str(text), font)
    wide = max(float(np.abs(ring[:, 1]).max()) for ring in rings)
    scale = np.array([rng.uniform(0.4, 1.6), rng.uniform(0.2, 0.38) / wide])
    turn = 0.0 if rng.random() < 0.7 else rng.uniform(-math.pi, math.pi)
    turned = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    place = np.array([somewhere_ahead(rng, road), rng.normal(0.0, 0.3)])
    return [_placed(road, [ring * scale @ turned + place for ring in rings], _paint(rng))]


def hatching(rng: Rng, road: Road) -> list[Patch]:
    """Slanted bars in a wedge beside a lane."""
    side = 1.0 if rng.random() < 0.5 else -1.0
    edge = (road.left if side > 0 else -road.right) + side * rng.uniform(0.05, 0.15)
    s, long, widest = somewhere_ahead(rng, road, 6.0), rng.uniform(2.0, 8.0), rng.uniform(0.4, 1.5)
    bar = rng.uniform(0.08, 0.3)
    pitch, slant = bar * rng.uniform(2.0, 4.0), rng.uniform(-1.2, 1.2)
    bars = []
    for a in np.arange(0.1 * long, long, pitch):
        across = side * widest * min(1.0, a / long)
        bars.append(
            np.array(
                [
                    [s + a, edge],
                    [s + a + bar, edge],
                    [s + a + bar + slant * abs(across), edge + across],
                    [s + a + slant * abs(across), edge + across],
                ]
            )
        )
    return [_placed(road, bars, _paint(rng))]
