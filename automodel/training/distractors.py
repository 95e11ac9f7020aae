"""Flat things on the ground that are no lane lines: zebra bars, arrows, text, seams, patches, kerbs, cables, litter."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from automodel.training.cameras import Kind
from automodel.training.roads import Road
from automodel.training.shapes import Ink, Patch, Stripe, box
from automodel.training.signs import arrow, hatching, somewhere_ahead, stop_line, triangles, writing, zebra
from automodel.types import FloatArray

Shape = Stripe | Patch
Rng = np.random.Generator


def random_distractors(rng: Rng, road: Road) -> list[Shape]:
    """A random few of them, where they would lie on this road."""
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
        _kerb_stone: 0.0 if not road.paved else 0.07,
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
    """A line (n, 2) that wanders along or over the road, in the body frame."""
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
    """Tar seams, cracks and joints: dark, a few light."""
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
    """Joints straight across at even distances, and a few along."""
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
    """Dark joints close beside the markings, as where concrete slabs meet at a lane's edge; old paint blackened out."""
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
    """Rectangles of newer or older surface."""
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
    """Blocks of two colours along an edge."""
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
    """A light kerb of concrete with a shaded foot, beyond the edge lines."""
    shapes: list[Shape] = []
    half, gap = rng.uniform(0.02, 0.08), rng.uniform(0.1, 0.6)
    for side, edge in ((1.0, road.left), (-1.0, -road.right)):
        if rng.random() < 0.6:
            place = edge + side * (gap + half)
            s = road.ribbon.s
            shapes.append(
                Stripe(
                    points=road.ribbon.place(s, place), half_width=half, ink=Ink.BRIGHT, strength=rng.uniform(0.15, 0.6)
                )
            )
            foot = road.ribbon.place(s, place - side * half)
            shapes.append(Stripe(points=foot, half_width=0.4 * half, ink=Ink.DARK, strength=0.8))
    return shapes


def _cable(rng: Rng, road: Road) -> list[Shape]:
    """A thin cable or hose that winds over the floor, with its shade."""
    half = rng.uniform(0.004, 0.014)
    turn = np.cumsum(0.35 * np.cumsum(rng.standard_normal(80)) * 0.15)
    step = rng.uniform(0.05, 0.12)
    way = np.cumsum(step * np.column_stack((np.cos(turn), np.sin(turn))), axis=0)
    angle = rng.uniform(-math.pi, math.pi)
    cos, sin = math.cos(angle), math.sin(angle)
    middle = np.array([rng.uniform(0.5, 5.0), rng.uniform(-1.5, 1.5)])
    points = (way - way.mean(axis=0)) @ np.array([[cos, sin], [-sin, cos]]) + middle
    shade = Stripe(points=points + np.array([0.0, 1.2 * half]), half_width=half, ink=Ink.DARK, strength=0.8)
    if rng.random() < 0.5:
        return [shade]
    return [shade, Stripe(points=points, half_width=half, ink=Ink.BRIGHT, strength=rng.uniform(0.5, 1.0))]


def _litter(rng: Rng, road: Road) -> list[Shape]:
    """Leaves, paper, stains: small blots, mostly light."""
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
    """Pairs of dark tracks that follow the road, or leave it."""
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
    """Wide faint bands along the lanes: where wheels run, where oil drips, where the surface was widened."""
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
