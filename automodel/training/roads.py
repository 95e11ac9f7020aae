"""Random roads: their curves and the styles of their lines. Lengths in lane widths, car at the origin."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from automodel.geometry import SE2
from automodel.training.cameras import Kind
from automodel.training.shapes import Ink, Patch, Ribbon, Stripe
from automodel.types import FloatArray

_BEHIND = 4.0  # length of a road behind the car


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Road:
    """A road around the car: its curve, the extent of its lanes to the left and right, and its stripes.

    `paved` are the stripes that its surface covers; empty for a road without a surface of its own. `bars` are painted
    where its lines are interrupted.
    """

    kind: Kind
    ribbon: Ribbon
    left: float
    right: float
    reach: float
    stripes: tuple[Stripe, ...] = ()
    paved: tuple[Stripe, ...] = field(default=())
    bars: tuple[Patch, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class LineStyle:
    """The style of one line: half width, patterns and spacing of its stripes."""

    half_width: float
    ink: Ink
    patterns: tuple[tuple[float, ...], ...]  # one per stripe; () is solid
    spacing: float = 0.0  # between the centres of the stripes of a double line
    label: tuple[float, ...] | None = None  # the pattern of the label if it differs from that of the paint


def random_ribbon(
    rng: np.random.Generator, kind: Kind, room: float, *, straight: bool = False, crossed: bool = False
) -> Ribbon:
    """A random centerline of the ego lane, in the body frame of a car at a random pose in the lane.

    `room` is the largest offset of lines from it, which limits its curvature.
    """
    reach = rng.uniform(*{Kind.SCALE: (8.0, 40.0), Kind.ROAD: (40.0, 110.0), Kind.CIRCUIT: (15.0, 60.0)}[kind])
    tightest = max(1.5, 1.2 * room)
    radius = {Kind.SCALE: (tightest, 15.0), Kind.ROAD: (max(8.0, tightest), 250.0), Kind.CIRCUIT: (tightest, 60.0)}[
        kind
    ]
    knots_s, knots_k = _curvature(rng, kind, reach, radius)
    if straight or crossed or rng.random() < 0.12:
        knots_k = knots_k * (0.03 if crossed else 0.0)
    tight = float(np.abs(knots_k).max())
    growth = 0.012 if tight > 0.08 else 0.04
    count = math.ceil(math.log1p(reach * growth / 0.08) / growth)
    ahead = np.expm1(growth * np.arange(1, count + 1)) * 0.08 / growth
    s = np.concatenate((np.arange(-_BEHIND, 0.04, 0.08), ahead))
    s -= s[np.argmin(np.abs(s))]
    return _from_body(rng, s, np.interp(s, knots_s, knots_k), room)


def _curvature(
    rng: np.random.Generator, kind: Kind, reach: float, radius: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Knots of a piecewise linear curvature (clothoids)."""
    longest = {Kind.SCALE: 5.0, Kind.ROAD: 40.0, Kind.CIRCUIT: 15.0}[kind]
    s, k = [-_BEHIND], [0.0]
    side = 1.0 if rng.random() < 0.5 else -1.0
    while s[-1] < reach:
        if rng.random() < 0.35:
            side = -side
        held = 0.0 if rng.random() < 0.35 else side / math.exp(rng.uniform(*np.log(radius)))
        s.append(s[-1] + longest * rng.uniform(0.05, 0.5))
        k.append(held)
        s.append(s[-1] + longest * rng.uniform(0.05, 0.9))
        k.append(held)
    if rng.random() < 0.5:
        k[0] = k[1]
    return np.array(s), np.array(k)


def _from_body(rng: np.random.Generator, s: FloatArray, curvature: FloatArray, room: float) -> Ribbon:
    """Integrate the curvature, and transform the curve to the frame of a car near s = 0."""
    steps = np.diff(s)
    heading = np.concatenate(([0.0], np.cumsum(0.5 * (curvature[1:] + curvature[:-1]) * steps)))
    middle = 0.5 * (heading[1:] + heading[:-1])
    xy = np.concatenate(
        (np.zeros((1, 2)), np.cumsum(np.column_stack((np.cos(middle), np.sin(middle))) * steps[:, None], axis=0))
    )
    here = int(np.argmin(np.abs(s)))
    origin = SE2(xy[here, 0], xy[here, 1], heading[here])
    offset = rng.normal(0.0, 0.12) if rng.random() < 0.8 else rng.uniform(-0.6, 0.6) * min(room, 1.5)
    turned = rng.random()
    widest = 45.0 if turned < 0.94 else 80.0  # lines that are nearly level in the image
    yaw = math.radians(rng.normal(0.0, 6.0) if turned < 0.78 else rng.uniform(-widest, widest))
    body_from_road = (origin @ SE2(0.0, offset, yaw)).inverse()
    return Ribbon(s, body_from_road.apply(xy), heading + body_from_road.yaw_rad)


def edge_style(rng: np.random.Generator, kind: Kind) -> LineStyle:
    """The style of a line at a road's edge: mostly solid."""
    half = _half_width(rng, kind)
    draw = rng.random()
    ink = Ink.SECOND_PAINT if rng.random() < 0.25 else Ink.PAINT
    if draw < 0.88:
        return LineStyle(half_width=half, ink=ink, patterns=((),))
    if draw < 0.94:
        return LineStyle(half_width=half, ink=ink, patterns=(_dashes(rng, kind),))
    return _double(rng, kind, half, ink)


def inner_style(rng: np.random.Generator, kind: Kind) -> LineStyle:
    """The style of a line between two lanes: dashed, solid, double or dotted."""
    half = _half_width(rng, kind)
    draw = rng.random()
    ink = Ink.SECOND_PAINT if rng.random() < 0.35 else Ink.PAINT
    if kind is Kind.ROAD and rng.random() < 0.25:
        return _studs(rng, ink)
    if draw < 0.7:
        return LineStyle(half_width=half, ink=ink, patterns=(_dashes(rng, kind),))
    if draw < 0.8:
        return LineStyle(half_width=half, ink=ink, patterns=((),))
    if draw < 0.9:
        return _double(rng, kind, half, ink)
    return LineStyle(half_width=half, ink=ink, patterns=(_dots(rng, half),))


def _double(rng: np.random.Generator, kind: Kind, half: float, ink: Ink) -> LineStyle:
    half = min(half, 0.035)
    dashes = _dashes(rng, kind)
    choices: list[tuple[tuple[float, ...], ...]] = [((), ()), ((), dashes), (dashes, ()), (dashes, dashes)]
    picked = choices[int(rng.choice(4, p=[0.55, 0.2, 0.15, 0.1]))]
    return LineStyle(half_width=half, ink=ink, patterns=picked, spacing=2.0 * half * rng.uniform(1.6, 3.2))


def _half_width(rng: np.random.Generator, kind: Kind) -> float:
    low, high = {Kind.SCALE: (0.03, 0.1), Kind.ROAD: (0.025, 0.07), Kind.CIRCUIT: (0.009, 0.03)}[kind]
    if kind is Kind.SCALE and rng.random() < 0.08:
        low, high = 0.1, 0.28  # bands of tape or paint: more than 40 px wide in the foreground
    if rng.random() < 0.12:
        low, high = low * 0.6, high * 1.6
    return 0.5 * float(rng.uniform(low, high))


def _dashes(rng: np.random.Generator, kind: Kind) -> tuple[float, ...]:
    if kind is Kind.SCALE or rng.random() < 0.2:
        paint = math.exp(rng.uniform(math.log(0.1), math.log(1.2)))
        return paint, paint * math.exp(rng.uniform(math.log(0.3), math.log(3.0)))
    known = [(0.85, 2.5), (1.7, 3.4), (1.6, 1.6), (0.85, 0.85), (0.4, 0.4), (0.27, 0.27), (1.2, 2.4)]
    paint, gap = known[int(rng.integers(len(known)))]
    return paint * rng.uniform(0.8, 1.25), gap * rng.uniform(0.8, 1.25)


def _dots(rng: np.random.Generator, half: float) -> tuple[float, ...]:
    """The pattern of groups of square dots."""
    size, gap = 2.0 * half, rng.uniform(0.15, 0.5)
    dots = (size, gap) * int(rng.integers(1, 5))
    return (*dots[:-1], gap + rng.uniform(0.0, 2.0))


def _studs(rng: np.random.Generator, ink: Ink) -> LineStyle:
    """Raised dots of about 10 cm instead of paint: a continuous row, or groups in place of dashes."""
    size, gap = rng.uniform(0.025, 0.05), rng.uniform(0.15, 0.4)
    if rng.random() < 0.35:
        return LineStyle(half_width=0.5 * size, ink=ink, patterns=((size, gap),), label=())
    count, space = int(rng.integers(2, 6)), rng.uniform(0.8, 2.6)
    pattern = ((size, gap) * count)[:-1]
    return LineStyle(half_width=0.5 * size, ink=ink, patterns=((*pattern, space),), label=(sum(pattern), space))


def painted(rng: np.random.Generator, style: LineStyle, points: FloatArray) -> list[Stripe]:
    """The stripes of one line along a polyline (n, 2); none for fewer than two points."""
    stripes: list[Stripe] = []
    if len(points) < 2:
        return stripes
    tangent = np.gradient(points, axis=0)
    tangent /= np.maximum(np.hypot(tangent[:, 0], tangent[:, 1]), 1e-9)[:, None]
    normal = np.column_stack((-tangent[:, 1], tangent[:, 0]))
    ragged = rng.uniform(0.0, 0.12) if rng.random() < 0.4 else 0.0
    for k, pattern in enumerate(style.patterns):
        shift = (k - 0.5 * (len(style.patterns) - 1)) * style.spacing
        half: float | FloatArray = style.half_width
        if ragged:
            half = style.half_width * np.clip(1.0 + ragged * rng.standard_normal(len(points)), 0.5, 1.5)
        stripes.append(
            Stripe(
                points=points + shift * normal,
                half_width=half,
                ink=style.ink,
                pattern=pattern,
                phase=rng.uniform(0.0, sum(pattern)) if pattern else 0.0,
                marking=True,
                label_pattern=style.label,
            )
        )
    return stripes


def paved(road: Road, margin_left: float, margin_right: float) -> Road:
    """The road with a surface of its own that extends beyond its outer lines by the margins."""
    left, right = road.left + margin_left, road.right + margin_right
    bed = Stripe(
        points=road.ribbon.place(road.ribbon.s, 0.5 * (left - right)),
        half_width=0.5 * (left + right),
        ink=Ink.ROADBED,
    )
    return replace(road, paved=(*road.paved, bed))
