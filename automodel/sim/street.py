"""Line-like things on the ground that mark no lane: kerbs, gutters, tar seams, cracks, shadows of rails."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from automodel.curves import Curve
from automodel.sim.paint import Grain, Paint, strip
from automodel.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class StreetRanges:
    """What a street is drawn from, uniformly between (low, high); in widths of a lane, counts per ten of them."""

    half: tuple[float, float] = (0.9, 1.7)  # from the middle of the street to its kerbs, which mark no lane
    kerb: tuple[float, float] = (0.03, 0.08)  # width of the kerb stones; 0.12 m beside a lane of 3 m
    stone: tuple[float, float] = (0.22, 0.4)  # length of a kerb stone; 1 m
    jointed: float = 0.7  # share of kerbs whose stones have visible joints
    joint: tuple[float, float] = (0.004, 0.015)  # width of such a joint
    pale: float = 0.5  # share of kerbs that are hardly lighter than the street
    gutter: tuple[float, float] = (0.05, 0.12)  # width of the gutter beside them; 0.3 m
    gutters: float = 0.7  # share of kerbs with a gutter
    seam: tuple[float, float] = (0.008, 0.03)  # width of a tar seam
    seams: tuple[int, int] = (0, 3)  # tar seams along the street
    wander: tuple[float, float] = (0.0, 0.05)  # of a seam to its sides
    joints: tuple[float, float] = (0.0, 1.5)  # tar seams across the street
    crack: tuple[float, float] = (0.004, 0.012)  # width of a crack
    cracks: tuple[float, float] = (0.5, 4.0)
    rail: tuple[float, float] = (0.015, 0.06)  # width of the shadow of a rail
    rails: tuple[int, int] = (0, 3)  # rails side by side
    rail_gap: tuple[float, float] = (0.12, 0.3)  # between two rails
    post: tuple[float, float] = (0.6, 2.0)  # from post to post


def street(road: Curve, width_m: float, rng: Generator) -> tuple[Paint, ...]:
    """A paved street around `road` with kerbs at its sides and with `ground_lines`.

    `width_m` is the width of a lane, to which everything is in proportion.
    """
    ranges, grain = StreetRanges(), Grain.of_lane(width_m)
    half_m = width_m * float(rng.uniform(*ranges.half))
    made = list(_along(road, (-half_m, half_m), "asphalt", grain))
    for side in (1.0, -1.0):
        made += _kerb(road, side, half_m, width_m, rng)
    return (*made, *ground_lines(road, half_m, width_m, rng))


def _kerb(road: Curve, side: float, half_m: float, width_m: float, rng: Generator) -> Iterator[Paint]:
    """The stones of one side, the joints between them, and the gutter."""
    ranges, grain = StreetRanges(), Grain.of_lane(width_m)
    size_m, stone_m, joint_m, gutter_m = (
        width_m * float(rng.uniform(*limits)) for limits in (ranges.kerb, ranges.stone, ranges.joint, ranges.gutter)
    )
    colour = "pale" if rng.random() < ranges.pale else "stone"
    between = _ordered(side * half_m, side * (half_m + size_m))
    yield from _along(road, between, colour, grain)
    if rng.random() < ranges.jointed:
        for s_m in np.arange(0.0, road.length_m - joint_m, stone_m).tolist():
            joint = strip(road, (s_m, s_m + joint_m), between, grain.error_m)
            yield Paint(polygon_m=joint, colour="crack", kind="ground")
    if rng.random() < ranges.gutters:
        yield from _along(road, _ordered(side * (half_m - gutter_m), side * half_m), "gutter", grain)


def ground_lines(road: Curve, half_m: float, width_m: float, rng: Generator, rails: bool = True) -> tuple[Paint, ...]:
    """Seams and cracks on the road, and with `rails` the shadows of rails."""
    ranges, grain = StreetRanges(), Grain.of_lane(width_m)
    tens = road.length_m / (10.0 * width_m)
    made: list[Paint] = []
    for _ in range(int(rng.integers(ranges.seams[0], ranges.seams[1] + 1))):
        made += _seam(road, half_m, width_m, rng)
    for _ in range(int(rng.poisson(tens * rng.uniform(*ranges.joints)))):
        s_m, size_m = rng.uniform(0.0, road.length_m), width_m * float(rng.uniform(*ranges.seam))
        across = strip(road, (s_m, s_m + size_m), (-half_m, half_m), grain.error_m)
        made.append(Paint(polygon_m=across, colour="tar", kind="ground"))
    for _ in range(int(rng.poisson(tens * rng.uniform(*ranges.cracks)))):
        place = road.offset_position(rng.uniform(0.0, road.length_m), rng.uniform(-half_m, half_m))
        made += _crack(place, width_m, rng)
    return (*made, *(_rails(road, half_m, width_m, rng) if rails else ()))


def _ordered(a: float, b: float) -> tuple[float, float]:
    return min(a, b), max(a, b)


def _along(road: Curve, between: tuple[float, float], colour: str, grain: Grain) -> Iterator[Paint]:
    """The whole road between two signed distances from its reference line."""
    cuts = np.linspace(0.0, road.length_m, max(math.ceil(road.length_m / grain.length_m), 1) + 1)
    for span in itertools.pairwise(cuts.tolist()):
        yield Paint(polygon_m=strip(road, span, between, grain.error_m), colour=colour, kind="ground")


def _seam(road: Curve, half_m: float, width_m: float, rng: Generator) -> Iterator[Paint]:
    """A tar seam along a part of the road."""
    ranges = StreetRanges()
    d_m, size_m = float(rng.uniform(-half_m, half_m)), width_m * float(rng.uniform(*ranges.seam))
    aside_m, phase = width_m * float(rng.uniform(*ranges.wander)), rng.uniform(0.0, math.tau, 2)
    start_m, length_m = rng.uniform(0.0, road.length_m), rng.uniform(0.2, 1.0) * road.length_m
    s = np.arange(0.0, length_m, 0.25 * width_m)
    bend = np.sin(s / (1.7 * width_m) + phase[0]) + 0.6 * np.sin(s / (0.61 * width_m) + phase[1])
    middle = np.clip(d_m + aside_m * bend, size_m - half_m, half_m - size_m)
    for part in range(0, len(s) - 1, 8):
        at = slice(part, part + 9)
        sides = [road.offset_position(start_m + s[at], middle[at] + k * size_m) for k in (-0.5, 0.5)]
        yield Paint(polygon_m=np.concatenate((sides[0], sides[1][::-1])), colour="tar", kind="ground")


def _crack(place_m: FloatArray, width_m: float, rng: Generator) -> Iterator[Paint]:
    """A crack that wanders from a point on."""
    size_m, step_m = width_m * float(rng.uniform(*StreetRanges().crack)), 0.08 * width_m
    count = int(rng.integers(4, 30))
    drift, jag = rng.normal(0.0, 0.12, count), rng.normal(0.0, 0.5, count)  # rad a step, rad
    heading = rng.uniform(0.0, math.tau) + np.cumsum(drift) + jag
    steps = step_m * np.stack((np.cos(heading), np.sin(heading)), axis=-1)
    points = place_m + np.concatenate((np.zeros((1, 2)), np.cumsum(steps, axis=0)))
    for a, b in itertools.pairwise(points):
        along = (b - a) / step_m
        aside = 0.5 * size_m * np.array([-along[1], along[0]])
        a, b = a - 0.5 * size_m * along, b + 0.5 * size_m * along
        yield Paint(polygon_m=np.array([a - aside, b - aside, b + aside, a + aside]), colour="crack", kind="ground")


def _rails(road: Curve, half_m: float, width_m: float, rng: Generator) -> Iterator[Paint]:
    """The shadow of a railing: rails along a part of the road, and posts across them."""
    ranges, grain = StreetRanges(), Grain.of_lane(width_m)
    count = int(rng.integers(ranges.rails[0], ranges.rails[1] + 1))
    size_m, gap_m = width_m * float(rng.uniform(*ranges.rail)), width_m * float(rng.uniform(*ranges.rail_gap))
    first_m, pitch_m = float(rng.uniform(-half_m, half_m)), width_m * float(rng.uniform(*ranges.post))
    start_m, length_m = float(rng.uniform(0.0, road.length_m)), float(rng.uniform(0.2, 0.7)) * road.length_m
    side = 1.0 if rng.random() < 0.5 else -1.0
    pieces = max(math.ceil(length_m / grain.length_m), 1)
    for k in range(count):
        d_m = first_m + side * k * gap_m
        for i in range(pieces):
            span = (start_m + i * length_m / pieces, start_m + (i + 1) * length_m / pieces)
            polygon = strip(road, span, (d_m - 0.5 * size_m, d_m + 0.5 * size_m), grain.error_m)
            yield Paint(polygon_m=polygon, colour="shade", kind="ground")
    if count:
        between = _ordered(first_m, first_m + side * 4.0 * gap_m)
        for s_m in np.arange(start_m, start_m + length_m, pitch_m).tolist():
            polygon = strip(road, (s_m, s_m + 0.7 * size_m), between, grain.error_m)
            yield Paint(polygon_m=polygon, colour="shade", kind="ground")
