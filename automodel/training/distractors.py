"""Flat objects on the ground that are no lane lines: road signs, text, seams, patches, kerbs, cables, litter."""

from __future__ import annotations

import math
import string
from collections.abc import Callable, Sequence
from functools import lru_cache

import cv2
import numpy as np

from automodel.training.cameras import Kind
from automodel.training.roads import Road
from automodel.training.shapes import Ink, Patch, Stripe, box
from automodel.types import FloatArray

Rng = np.random.Generator


def somewhere_ahead(rng: Rng, road: Road, furthest: float = 12.0) -> float:
    """A random distance along the road ahead, more often near than far."""
    return float(rng.uniform(0.3, min(furthest, 0.8 * road.reach)) * rng.uniform(0.2, 1.0))


def _paint(rng: Rng) -> Ink:
    return Ink.PAINT if rng.random() < 0.75 else Ink.SECOND_PAINT


def _placed(road: Road, outlines: list[FloatArray], ink: Ink) -> Patch:
    """A patch of outlines that are given in (along, left) of the road."""
    laid = []
    for outline in outlines:
        laid.append(road.ribbon.place(outline[:, 0], outline[:, 1]))
    return Patch(outlines=tuple(laid), ink=ink)


def zebra(rng: Rng, road: Road) -> list[Patch]:
    """A zebra crossing: bars along the road over its whole width."""
    s, long = somewhere_ahead(rng, road), rng.uniform(0.2, 1.2)
    bar = rng.uniform(0.06, 0.2)
    pitch = bar * rng.uniform(1.5, 2.5)
    places = np.arange(-road.right + 0.3 * pitch, road.left - bar, pitch)
    bars = [box(s, s + long, d, d + bar) for d in places]
    return [_placed(road, bars, _paint(rng))] if bars else []


def stop_line(rng: Rng, road: Road) -> list[Patch]:
    """A stop line across one lane or the whole road, solid or dashed."""
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
    """An arrow in a lane: straight ahead or to a side."""
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
    """Outlines (up, left) of a text of height 1, centred laterally at 0."""
    size, base = cv2.getTextSize(text, font, 2.0, 5)
    image = np.zeros((size[1] + base + 12, size[0] + 12), dtype=np.uint8)
    cv2.putText(image, text, (6, size[1] + 6), font, 2.0, (255,), 5)
    rings, _ = cv2.findContours(image, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_TC89_L1)
    height, width = image.shape
    return tuple(
        np.column_stack((1.0 - ring[:, 0, 1] / height, (0.5 * width - ring[:, 0, 0]) / height))
        for ring in rings
        if len(ring) > 2
    )


def writing(rng: Rng, road: Road) -> list[Patch]:
    """A word or a number on the road, upright or rotated."""
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


Shape = Stripe | Patch


def random_distractors(rng: Rng, road: Road) -> list[Shape]:
    """A random selection of distractors on a road."""
    chances: dict[Callable[[Rng, Road], Sequence[Shape]], float] = {
        zebra: 0.07,
        stop_line: 0.07,
        triangles: 0.03,
        arrow: 0.09,
        writing: 0.08,
        hatching: 0.05,
        _seams: 0.2,
        _slab_joints: 0.14,
        _beside_lines: 0.08,
        _repairs: 0.12,
        _kerb: {Kind.SCALE: 0.03, Kind.ROAD: 0.06, Kind.CIRCUIT: 0.45}[road.kind],
        _kerb_stone: 0.6 if not road.stripes else 0.15 if road.paved else 0.0,
        _cable: 0.1 if road.kind is Kind.SCALE else 0.02,
        _litter: 0.13,
        _tyre_marks: 0.14,
        _wheel_tracks: 0.1 if road.kind is Kind.SCALE else 0.4,
    }
    shapes: list[Shape] = []
    for draw, chance in chances.items():
        if rng.random() < chance:
            shapes += draw(rng, road)
    return shapes


def _wander(rng: Rng, road: Road, amount: float) -> FloatArray:
    """A random line (n, 2) along or across the road, in the body frame."""
    if rng.random() < 0.6:
        s = np.linspace(rng.uniform(-1.0, 3.0), min(road.reach, rng.uniform(4.0, 25.0)), 60)
        d = rng.uniform(-road.right - 0.3, road.left + 0.3) + rng.uniform(-0.25, 0.25) * (s - s[0])
    else:
        d = np.linspace(-road.right - 1.0, road.left + 1.0, 60)
        s = somewhere_ahead(rng, road) + rng.normal(0.0, 0.4) * d
    d = d + amount * np.cumsum(rng.standard_normal(60)) / 8.0
    s = s + amount * np.cumsum(rng.standard_normal(60)) / 8.0
    return road.ribbon.place(s, d)


def _seams(rng: Rng, road: Road) -> list[Shape]:
    """Tar seams, cracks and joints, mostly dark."""
    shapes: list[Shape] = []
    ink = Ink.DARK if rng.random() < 0.75 else Ink.BRIGHT
    for _ in range(int(rng.integers(1, 6))):
        shapes.append(
            Stripe(
                points=_wander(rng, road, rng.uniform(0.0, 0.3)),
                half_width=rng.uniform(0.003, 0.025) if ink is Ink.DARK else rng.uniform(0.002, 0.007),
                ink=ink,
                strength=rng.uniform(0.3, 1.0) if ink is Ink.DARK else rng.uniform(0.1, 0.5),
            )
        )
    return shapes


def _slab_joints(rng: Rng, road: Road) -> list[Shape]:
    """Joints of slabs: straight across at a regular distance, and a few along the road."""
    ink = Ink.DARK if rng.random() < 0.7 else Ink.BRIGHT
    half, strength = rng.uniform(0.002, 0.015), rng.uniform(0.3, 1.0)
    if ink is Ink.BRIGHT:
        half, strength = 0.4 * half, 0.5 * strength
    beyond = rng.uniform(0.0, 3.0)
    across = np.linspace(-road.right - beyond, road.left + beyond, 12)
    shapes: list[Shape] = []
    slant = rng.normal(0.0, 0.05)
    for s in np.arange(rng.uniform(0.0, 1.0), min(road.reach, 20.0), rng.uniform(0.8, 3.0)):
        shapes.append(
            Stripe(points=road.ribbon.place(s + slant * across, across), half_width=half, ink=ink, strength=strength)
        )
    for _ in range(int(rng.integers(0, 3))):
        points = road.ribbon.place(road.ribbon.s, rng.uniform(-road.right - beyond, road.left + beyond))
        shapes.append(Stripe(points=points, half_width=half, ink=ink, strength=strength))
    return shapes


def _beside_lines(rng: Rng, road: Road) -> list[Shape]:
    """Dark joints close to the markings, as between concrete slabs, or old paint that was blackened."""
    shapes: list[Shape] = []
    shift, half = rng.uniform(-0.12, 0.12), rng.uniform(0.003, 0.03)
    for stripe in road.stripes[:6]:
        if len(stripe.points) < 3 or rng.random() < 0.3:
            continue
        tangent = np.gradient(stripe.points, axis=0)
        normal = np.column_stack((-tangent[:, 1], tangent[:, 0])) / np.maximum(
            np.hypot(tangent[:, 0], tangent[:, 1]), 1e-9
        ).reshape(-1, 1)
        shapes.append(
            Stripe(points=stripe.points + shift * normal, half_width=half, ink=Ink.DARK, strength=rng.uniform(0.3, 1.0))
        )
    return shapes


def _repairs(rng: Rng, road: Road) -> list[Shape]:
    """Repaired rectangles of the surface."""
    shapes: list[Shape] = []
    ink = (Ink.DARK, Ink.BRIGHT, Ink.BAND)[int(rng.integers(3))]
    for _ in range(int(rng.integers(1, 5))):
        s, d = somewhere_ahead(rng, road), rng.uniform(-road.right - 0.5, road.left + 0.5)
        patch = box(s, s + rng.uniform(0.2, 3.0), d, d + rng.uniform(0.1, 1.0))
        shapes.append(
            Patch(outlines=(road.ribbon.place(patch[:, 0], patch[:, 1]),), ink=ink, strength=rng.uniform(0.15, 0.7))
        )
    return shapes


def _kerb(rng: Rng, road: Road) -> list[Shape]:
    """A kerb with blocks of two colours along an edge."""
    side = 1.0 if rng.random() < 0.5 else -1.0
    edge = road.left if side > 0 else -road.right
    half = rng.uniform(0.02, 0.07)
    start = rng.uniform(-2.0, 8.0)
    s = np.linspace(start, start + rng.uniform(3.0, 20.0), 100)
    points = road.ribbon.place(s, edge + side * (half + rng.uniform(0.02, 0.08)))
    block = rng.uniform(0.06, 0.3)
    light = Stripe(points=points, half_width=half, ink=Ink.BRIGHT, pattern=(block, block))
    dark = Stripe(points=points, half_width=half, ink=Ink.DARK, pattern=(block, block), phase=block, strength=0.8)
    return [dark, light]


def _kerb_stone(rng: Rng, road: Road) -> list[Shape]:
    """Concrete kerbs beyond the edge lines: light stones with joints, and mostly a dark gutter or shadow at the foot.

    Of a lane of 3 m, stones of 6 to 30 cm by 0.6 to 1.5 m, and a gutter of 30 cm.
    """
    shapes: list[Shape] = []
    half, gap = rng.uniform(0.01, 0.05), rng.uniform(0.0, 0.6)
    stones = (rng.uniform(0.2, 0.5), rng.uniform(0.004, 0.015)) if rng.random() < 0.5 else ()
    strength, foot = rng.uniform(0.1, 0.6), rng.uniform(0.01, 0.06) if rng.random() < 0.8 else 0.0
    for side, edge in ((1.0, road.left), (-1.0, -road.right)):
        if rng.random() < 0.75:
            place, s = edge + side * (gap + half), road.ribbon.s
            points = road.ribbon.place(s, place)
            shapes.append(Stripe(points=points, half_width=half, ink=Ink.BRIGHT, pattern=stones, strength=strength))
            if foot:
                points = road.ribbon.place(s, place - side * (half + foot))
                shapes.append(Stripe(points=points, half_width=foot, ink=Ink.DARK, strength=rng.uniform(0.2, 0.9)))
    return shapes


def _cable(rng: Rng, road: Road) -> list[Shape]:
    """A winding thin cable or hose on the floor, with its shadow."""
    half = rng.uniform(0.004, 0.014)
    turn = np.cumsum(0.35 * np.cumsum(rng.standard_normal(80)) * 0.15)
    step = rng.uniform(0.05, 0.12)
    path = np.cumsum(step * np.column_stack((np.cos(turn), np.sin(turn))), axis=0)
    angle = rng.uniform(-math.pi, math.pi)
    cos, sin = math.cos(angle), math.sin(angle)
    middle = np.array([rng.uniform(0.5, 5.0), rng.uniform(-1.5, 1.5)])
    points = (path - path.mean(axis=0)) @ np.array([[cos, sin], [-sin, cos]]) + middle
    shade = Stripe(points=points + np.array([0.0, 1.2 * half]), half_width=half, ink=Ink.DARK, strength=0.8)
    if rng.random() < 0.5:
        return [shade]
    return [shade, Stripe(points=points, half_width=half, ink=Ink.BRIGHT, strength=rng.uniform(0.5, 1.0))]


def _litter(rng: Rng, road: Road) -> list[Shape]:
    """Leaves, paper, stains: small blobs, mostly light."""
    shapes: list[Shape] = []
    for _ in range(int(rng.integers(2, 14))):
        t = np.linspace(0.0, 2.0 * math.pi, 8, endpoint=False)
        size = math.exp(rng.uniform(math.log(0.01), math.log(0.12)))
        radius = size * rng.uniform(0.5, 1.0, 8)
        middle = np.array([rng.uniform(0.3, 8.0), rng.uniform(-2.5, 2.5)])
        outline = middle + np.column_stack((radius * np.cos(t) * rng.uniform(0.4, 1.0), radius * np.sin(t)))
        ink = Ink.BRIGHT if rng.random() < 0.7 else Ink.DARK
        shapes.append(Patch(outlines=(outline,), ink=ink, strength=rng.uniform(0.4, 1.0)))
    return shapes


def _tyre_marks(rng: Rng, road: Road) -> list[Shape]:
    """Pairs of dark tyre marks that follow the road or leave it."""
    shapes: list[Shape] = []
    half, gauge = rng.uniform(0.015, 0.05), rng.uniform(0.3, 0.5)
    strength = rng.uniform(0.15, 0.6)
    start = rng.uniform(-1.0, 4.0)
    s = np.linspace(start, start + rng.uniform(2.0, 15.0), 50)
    d = rng.uniform(-0.5, 0.5) + rng.normal(0.0, 0.05) * (s - s[0]) + rng.normal(0.0, 0.01) * (s - s[0]) ** 2
    for shift in (-0.5 * gauge, 0.5 * gauge):
        shapes.append(Stripe(points=road.ribbon.place(s, d + shift), half_width=half, ink=Ink.DARK, strength=strength))
    return shapes


def _wheel_tracks(rng: Rng, road: Road) -> list[Shape]:
    """Wide faint bands along the lanes: wheel tracks, oil, a widened surface."""
    shapes: list[Shape] = []
    draw = rng.random()
    places = [(k + shift, half) for k in (-1, 0, 1) for shift, half in ((0.0, 0.18),)]
    if draw < 0.4:
        places = [(k + shift, 0.11) for k in (-1, 0, 1) for shift in (-0.25, 0.25)]
    elif draw < 0.6:
        side = 1.0 if rng.random() < 0.5 else -1.0
        edge = (road.left if side > 0 else road.right) + rng.uniform(-0.1, 0.3)
        places = [(side * (edge + 1.5), 1.5)]
    s = road.ribbon.s
    for d, half in places:
        for part in (1.0, 0.6) if half < 1.0 else (1.0,):
            stripe = road.ribbon.place(s, d)
            shapes.append(
                Stripe(
                    points=stripe,
                    half_width=half * part,
                    ink=Ink.BAND,
                    strength=0.5 if part == 1.0 and half < 1.0 else 1.0,
                )
            )
    return shapes
