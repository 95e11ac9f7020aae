"""Random layouts of a road's lines: parallel lanes, forks, crossings, corners, roundabouts, unrelated lines."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from automodel.training.cameras import Kind
from automodel.training.roads import LineStyle, Road, edge_style, inner_style, painted, paved, random_ribbon
from automodel.training.shapes import Ink, Patch, Ribbon, Stripe, box
from automodel.types import FloatArray

_LANE_CHANCES = {
    Kind.SCALE: (0.4, 0.45, 0.15, 0.0, 0.0),
    Kind.ROAD: (0.1, 0.3, 0.25, 0.2, 0.15),
    Kind.CIRCUIT: (0.9, 0.1, 0.0, 0.0, 0.0),
}
_INTERRUPTED = 0.12  # share of the roads with parallel lines whose lines are interrupted for a zebra crossing
_CROSSED_ON_FOOT = 0.4  # share of the crossings of two roads with zebra crossings around them


def random_road(rng: np.random.Generator, kind: Kind) -> Road:
    """A random road with its lines, sometimes without any."""
    rarer = 0.5 if kind is Kind.ROAD else 0.0 if kind is Kind.CIRCUIT else 1.0
    chances = np.array([0.15 * rarer, 0.14 * rarer, 0.04 * rarer, 0.05 * rarer, 0.1])
    layouts: list[Callable[[np.random.Generator, Kind], Road]] = [_crossing, _corner, _roundabout, _strands, _bare]
    draw = rng.choice(6, p=[*chances, 1.0 - chances.sum()])
    road = _lanes(rng, kind) if draw == 5 else layouts[draw](rng, kind)
    if rng.random() < {Kind.SCALE: 0.25, Kind.ROAD: 0.7, Kind.CIRCUIT: 0.85}[kind]:
        road = paved(road, *(rng.uniform(0.0, 0.25, 2) if rng.random() < 0.6 else rng.uniform(0.1, 1.2, 2)))
    return road


def _offsets(rng: np.random.Generator, kind: Kind) -> FloatArray:
    """The offsets of the lines from the centre of the ego lane, from right to left."""
    count = int(rng.choice(5, p=_LANE_CHANCES[kind])) + 1
    own = int(rng.integers(count))
    widths = np.exp(rng.normal(0.0, 0.06, count))
    widths[own] = 1.0
    lines = np.concatenate(([0.0], np.cumsum(widths)))
    return lines - lines[own] - 0.5


def _lanes(rng: np.random.Generator, kind: Kind) -> Road:
    """Parallel lanes whose width may change and whose lines may diverge, end or fork."""
    offsets = _offsets(rng, kind)
    ribbon = random_ribbon(rng, kind, float(np.abs(offsets).max()))
    stripes: list[Stripe] = []
    squeeze = _squeeze(rng, ribbon)
    open_from, open_to, bars = _zebra(rng, ribbon, offsets)
    through = (ribbon.s < open_from) | (ribbon.s > open_to)
    same = inner_style(rng, kind)
    outer = edge_style(rng, kind)
    for k, offset in enumerate(offsets):
        if rng.random() < 0.07:
            continue
        if k in (0, len(offsets) - 1):
            style = outer if rng.random() < 0.7 else edge_style(rng, kind)
        else:
            style = same if rng.random() < 0.8 else inner_style(rng, kind)
        drift = rng.normal(0.0, 0.03) if rng.random() < 0.12 else 0.0
        keep = _kept(rng, ribbon)
        d = offset * squeeze + drift * np.clip(ribbon.s, 0.0, 15.0)
        points = ribbon.place(ribbon.s, d)
        for piece in (keep,) if through.all() else (keep & (ribbon.s < open_from), keep & (ribbon.s > open_to)):
            stripes += painted(rng, style, points[piece])
    if kind is not Kind.CIRCUIT and rng.random() < 0.1:
        stripes += _fork(rng, ribbon, offsets, outer)
    return Road(
        kind=kind,
        ribbon=ribbon,
        left=float(offsets[-1]),
        right=float(-offsets[0]),
        reach=float(ribbon.s[-1]),
        stripes=tuple(stripes),
        bars=bars,
    )


def _zebra(rng: np.random.Generator, ribbon: Ribbon, offsets: FloatArray) -> tuple[float, float, tuple[Patch, ...]]:
    """Where the lines are interrupted for a zebra crossing, from and to, and its bars; mostly there is none.

    The bars lie at any place across, so that some continue a line.
    """
    if rng.random() > _INTERRUPTED:
        return math.inf, math.inf, ()
    start, long, clear = rng.uniform(-0.3, 4.0), rng.uniform(0.2, 1.2), rng.uniform(0.0, 0.3)
    bar = rng.uniform(0.06, 0.2)
    pitch = bar * rng.uniform(1.5, 2.5)
    across = np.arange(float(offsets[0]) - rng.uniform(0.0, pitch), float(offsets[-1]) + 0.5 * pitch, pitch)
    outlines = [box(start, start + long, d, d + bar) for d in across]
    ink = Ink.PAINT if rng.random() < 0.75 else Ink.SECOND_PAINT
    bars = Patch(outlines=tuple(ribbon.place(each[:, 0], each[:, 1]) for each in outlines), ink=ink)
    return start - clear, start + long + clear, (bars,)


def _squeeze(rng: np.random.Generator, ribbon: Ribbon) -> FloatArray:
    """The factor of the lanes' width along the road."""
    if rng.random() > 0.2:
        return np.ones_like(ribbon.s)
    start, length = rng.uniform(-1.0, 8.0), rng.uniform(0.5, 8.0)
    t = np.clip((ribbon.s - start) / length, 0.0, 1.0)
    return 1.0 + rng.uniform(-0.35, 0.2) * t * t * (3.0 - 2.0 * t)


def _kept(rng: np.random.Generator, ribbon: Ribbon) -> NDArray[np.bool_]:
    """Which points of a line to keep: mostly all; some lines start or end in view."""
    keep = np.ones(len(ribbon.s), dtype=bool)
    draw = rng.random()
    if draw < 0.03:
        keep = ribbon.s < rng.uniform(1.0, 8.0)
    elif draw < 0.06:
        keep = ribbon.s > rng.uniform(0.5, 8.0)
    return keep


def _fork(rng: np.random.Generator, ribbon: Ribbon, offsets: FloatArray, style: LineStyle) -> list[Stripe]:
    """A line that leaves one edge or joins it, and the other line of the branch."""
    side = 1.0 if rng.random() < 0.5 else -1.0
    edge = float(offsets[-1] if side > 0 else offsets[0])
    start, length = rng.uniform(0.5, 12.0), rng.uniform(3.0, 12.0)
    grow = np.clip((ribbon.s - start) / length, 0.0, None) ** rng.uniform(1.3, 2.2)
    if rng.random() < 0.4:
        grow = np.clip((start + length - ribbon.s) / length, 0.0, None) ** 1.5
    grow = np.minimum(grow, 2.5)
    keep = grow > 0.02
    stripes: list[Stripe] = []
    for extra in (0.0, rng.uniform(0.8, 1.2)):
        if keep.sum() > 3:
            stripes += painted(rng, style, ribbon.place(ribbon.s, edge + side * (grow + extra))[keep])
    return stripes


def _rounded(corner: FloatArray, before: FloatArray, after: FloatArray, radius: float) -> FloatArray:
    """A polyline from `before` to `after` around a corner with a radius; radius 0 keeps the corner sharp."""
    u = (before - corner) / max(float(np.hypot(*(before - corner))), 1e-9)
    w = (after - corner) / max(float(np.hypot(*(after - corner))), 1e-9)
    turn = math.acos(float(np.clip(-u @ w, -1.0, 1.0)))
    cut = radius * math.tan(0.5 * turn)
    if radius <= 0.0:
        middle = corner[None]
    else:
        centre = corner + (u + w) / max(float(np.hypot(*(u + w))), 1e-9) * radius / math.cos(0.5 * turn)
        a, b = corner + cut * u - centre, corner + cut * w - centre
        angle = math.atan2(a[0] * b[1] - a[1] * b[0], float(a @ b))
        t = np.linspace(0.0, angle, 10)
        middle = centre + np.column_stack((a[0] * np.cos(t) - a[1] * np.sin(t), a[0] * np.sin(t) + a[1] * np.cos(t)))
    pieces = (_straight(before, middle[0]), middle, _straight(middle[-1], after))
    return np.concatenate((pieces[0][:-1], pieces[1], pieces[2][1:]))


def _straight(a: FloatArray, b: FloatArray) -> FloatArray:
    count = max(2, math.ceil(float(np.hypot(*(b - a))) / 0.15))
    return np.asarray(a + (b - a) * np.linspace(0.0, 1.0, min(count, 120))[:, None])


def _crossing(rng: np.random.Generator, kind: Kind) -> Road:
    """A crossing or a T junction: the road's lines end before it, the lines of the other road go to the sides."""
    offsets = _offsets(rng, kind)
    ribbon = random_ribbon(rng, kind, float(np.abs(offsets).max()), crossed=True)
    left, right = float(offsets[-1]), float(-offsets[0])
    at, half = rng.uniform(-0.3, 5.0), rng.uniform(0.4, 1.3)
    skew = math.tan(rng.normal(0.0, 0.12))
    radius = 0.0 if rng.random() < 0.5 else rng.uniform(0.1, 1.5)
    arms = [bool(rng.random() < 0.85) for _ in range(3)]  # left, right, straight on
    outer, inner = edge_style(rng, kind), inner_style(rng, kind)
    clear, long = rng.uniform(0.05, 0.4), rng.uniform(0.2, 0.8) if rng.random() < _CROSSED_ON_FOOT else 0.0
    held = clear + long + 0.1 if long else 0.0
    stripes: list[Stripe] = []

    def line(style: LineStyle, points: FloatArray) -> None:
        stripes.extend(painted(rng, style, ribbon.local(at, points)))

    far = min(18.0, float(ribbon.s[-1]) - at)
    for side, edge, arm in ((1.0, left, arms[0]), (-1.0, right, arms[1])):
        d, lean = side * edge, skew * side * edge
        if arm:
            away = side * (edge + rng.uniform(3.0, 12.0))
            for end, beyond in ((-1.0, -at - 3.0), (1.0, far)):
                corner = np.array([end * half + lean, d])
                if end > 0 and not arms[2]:
                    line(outer, _straight(np.array([half, 0.0]), np.array([half + skew * away, away])))
                    continue
                line(outer, _rounded(corner, np.array([beyond, d]), np.array([end * half + skew * away, away]), radius))
            gap = side * (edge + max(radius + rng.uniform(0.0, 0.3), held))
            line(inner, _straight(np.array([skew * gap, gap]), np.array([skew * away, away])))
        else:
            line(outer, _straight(np.array([-at - 3.0, d]), np.array([far if arms[2] else half, d])))
            if not arms[2]:
                line(outer, _straight(np.array([half, d]), np.array([half, 0.0])))
    for d in offsets[1:-1]:
        hold = half + max(radius * rng.uniform(0.0, 1.0), held)
        line(inner, _straight(np.array([-at - 3.0, d]), np.array([-hold, d])))
        if arms[2]:
            line(inner, _straight(np.array([hold, d]), np.array([far, d])))
    bars: tuple[Patch, ...] = ()
    if long:
        around = _bars_around(rng, (-half, half), (-right, left), clear, long)
        outlines = [ribbon.local(at, outline) for outline in around]
        bars = (Patch(outlines=tuple(outlines), ink=Ink.PAINT if rng.random() < 0.75 else Ink.SECOND_PAINT),)
    return Road(kind=kind, ribbon=ribbon, left=left, right=right, reach=at + far, stripes=tuple(stripes), bars=bars)


def _bars_around(
    rng: np.random.Generator, along: tuple[float, float], across: tuple[float, float], clear: float, long: float
) -> list[FloatArray]:
    """The bars (4, 2), `clear` from it, of zebra crossings on all sides of the rectangle that two roads share."""
    bar = rng.uniform(0.06, 0.2)
    pitch = bar * rng.uniform(1.5, 2.5)
    outlines = []
    for low, high in ((along[0] - clear - long, along[0] - clear), (along[1] + clear, along[1] + clear + long)):
        outlines += [box(low, high, d, d + bar) for d in np.arange(across[0] + 0.5 * pitch, across[1] - bar, pitch)]
    for low, high in ((across[0] - clear - long, across[0] - clear), (across[1] + clear, across[1] + clear + long)):
        outlines += [box(s, s + bar, low, high) for s in np.arange(along[0] + 0.5 * pitch, along[1] - bar, pitch)]
    return outlines


def _corner(rng: np.random.Generator, kind: Kind) -> Road:
    """A sharp corner of about 90 deg, or one with a small radius."""
    offsets = _offsets(rng, kind)
    ribbon = random_ribbon(rng, kind, float(np.abs(offsets).max()), straight=True)
    at, side = rng.uniform(0.3, 5.0), 1.0 if rng.random() < 0.5 else -1.0
    turn = side * math.radians(rng.uniform(50.0, 110.0))
    after = np.array([math.cos(turn), math.sin(turn)])
    round_in = 0.0 if rng.random() < 0.6 else rng.uniform(0.1, 1.0)
    outer, inner = edge_style(rng, kind), inner_style(rng, kind)
    stripes: list[Stripe] = []
    for k, d in enumerate(offsets):
        corner = np.array([-d * math.tan(0.5 * turn), d])
        radius = round_in and max(0.02, round_in - side * d + 0.6)
        points = _rounded(corner, np.array([-at - 3.0, d]), corner + after * rng.uniform(5.0, 20.0), radius)
        stripes += painted(rng, outer if k in (0, len(offsets) - 1) else inner, ribbon.local(at, points))
    left, right = float(offsets[-1]), float(-offsets[0])
    return Road(kind=kind, ribbon=ribbon, left=left, right=right, reach=at + 4.0, stripes=tuple(stripes))


def _roundabout(rng: np.random.Generator, kind: Kind) -> Road:
    """A roundabout; the car's road is one of its arms."""
    offsets = _offsets(rng, Kind.SCALE)
    ribbon = random_ribbon(rng, kind, float(np.abs(offsets).max()), straight=True)
    width, inside = rng.uniform(0.8, 1.6), rng.uniform(0.5, 2.0)
    outside = inside + width
    half = 0.5 * float(offsets[-1] - offsets[0])
    outside = max(outside, 1.3 * half)
    centre = rng.uniform(0.1, 3.5) + outside
    middle = 0.5 * float(offsets[-1] + offsets[0])
    arms = np.array([math.pi, 0.0, 0.5 * math.pi, -0.5 * math.pi])[: int(rng.integers(2, 5))]
    arms = arms + np.concatenate(([0.0], rng.normal(0.0, 0.15, len(arms) - 1)))
    outer, inner = edge_style(rng, kind), inner_style(rng, kind)
    turns = np.linspace(0.0, 2.0 * math.pi, 90)
    around = np.column_stack((np.cos(turns), np.sin(turns)))
    rings = [inside * around]
    opening = math.asin(min(0.95, half / outside))
    for start, end in _between(np.sort(np.mod(arms, 2.0 * math.pi)), opening):
        t = np.linspace(start, end, 30)
        rings.append(outside * np.column_stack((np.cos(t), np.sin(t))))
    lines = [(outer, ring) for ring in rings]
    for arm in arms:
        along, across = np.array([math.cos(arm), math.sin(arm)]), np.array([-math.sin(arm), math.cos(arm)])
        for k, d in enumerate(offsets - middle):
            start = math.sqrt(max(outside**2 - d * d, 0.0)) + rng.uniform(0.0, 0.1)
            style = outer if k in (0, len(offsets) - 1) else inner
            lines.append((style, _straight(start * along + d * across, 15.0 * along + d * across)))
    stripes: list[Stripe] = []
    for style, points in lines:
        stripes += painted(rng, style, ribbon.local(centre, points + np.array([0.0, middle])))
    left, right = float(offsets[-1]), float(-offsets[0])
    return Road(kind=kind, ribbon=ribbon, left=left, right=right, reach=centre, stripes=tuple(stripes))


def _between(arms: FloatArray, opening: float) -> list[tuple[float, float]]:
    """The arcs of a circle between arms at the given angles."""
    following = np.append(arms[1:], arms[0] + 2.0 * math.pi)
    return [(a + opening, b - opening) for a, b in zip(arms, following, strict=True) if b - a > 2.0 * opening + 0.05]


def _strands(rng: np.random.Generator, kind: Kind) -> Road:
    """Unrelated lines on independent curves, which do not form lanes."""
    ribbon = random_ribbon(rng, kind, 0.6)
    stripes: list[Stripe] = []
    for _ in range(int(rng.integers(1, 4))):
        own = random_ribbon(rng, kind, 0.6)
        points = own.place(own.s, rng.uniform(-1.5, 1.5))
        stripes += painted(rng, inner_style(rng, kind) if rng.random() < 0.4 else edge_style(rng, kind), points)
    return Road(kind=kind, ribbon=ribbon, left=0.5, right=0.5, reach=float(ribbon.s[-1]), stripes=tuple(stripes))


def _bare(rng: np.random.Generator, kind: Kind) -> Road:
    """A floor or a street without lines."""
    left, right = rng.uniform(0.4, 1.5, 2).tolist()
    ribbon = random_ribbon(rng, kind, max(left, right))
    return Road(kind=kind, ribbon=ribbon, left=left, right=right, reach=float(ribbon.s[-1]))
