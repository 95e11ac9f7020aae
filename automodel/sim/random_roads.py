"""Random closed roads: a polygon with rounded corners, some of which are loops in which the road crosses itself.

A corner of a ring may become a loop: the road goes on straight, turns the other way round and crosses itself at a right
or an oblique angle, as on the floor of the AutoModelCar contest. All lengths are drawn in lane widths.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from automodel.curves import JoinedCurve
from automodel.sim.paint import RoadCrossing, find_crossings
from automodel.sim.track_files import CLOSING_GAP_M, CLOSING_TURN_RAD, closing_error, join_pieces
from automodel.sim.track_sections import ArcPiece, ClothoidPiece, LinePiece, OriginSection, Piece
from automodel.types import FloatArray

TRIES = 2000  # polygons that are drawn before giving up; about one in five is a road


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadRanges:
    """What a road is drawn from, each uniformly between (low, high); lengths in lane widths, angles in radians."""

    corners: tuple[int, int] = (4, 7)  # of the ring
    size: tuple[float, float] = (8.0, 16.0)  # radius of the ring's outermost corner
    depth: tuple[float, float] = (0.55, 1.0)  # radius of each other corner, as a share of that: low ones turn inwards
    jitter: tuple[float, float] = (-0.25, 0.25)  # of each corner's direction, in steps from corner to corner
    radius: tuple[float, float] = (2.6, 8.0)  # of bends (tmr has 3.5); fewer lane widths fold the inner edge of two
    easing: tuple[float, float] = (0.2, 0.7)  # share of a bend's turn that lies in its two clothoids, where it has some
    eased: float = 0.5  # share of roads with clothoids
    loop: tuple[float, float] = (7.0, 11.0)  # side of a loop
    loop_turn: tuple[float, float] = (math.radians(60), math.radians(120))  # corners that may become loops: its angle
    straight: float = 0.4  # least length of a straight piece
    clear: float = (
        0.75  # least distance between two passes of the road beside each other, and of a bend from a crossing
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RandomRoad:
    """A closed reference line, its pieces, and the places where it crosses itself."""

    pieces: tuple[Piece, ...]
    origin: OriginSection
    line: JoinedCurve
    crossings: tuple[RoadCrossing, ...]


def random_road(rng: Generator, width_m: float, lanes: int, loops: int, ranges: RoadRanges) -> RandomRoad:
    """A closed road of `lanes` lanes of `width_m` that crosses itself `loops` times and touches itself nowhere else.

    Raises RuntimeError where none is found in `TRIES` draws.
    """
    for _ in range(TRIES):
        corners = _with_loops(rng, _ring(rng, ranges), loops, ranges)
        if corners is None:
            continue
        pieces = _rounded(rng, corners, ranges)
        if pieces is None:
            continue
        start = corners[0] + 0.5 * (corners[1] - corners[0])
        along = corners[1] - corners[0]
        origin = OriginSection(
            x_m=width_m * start[0], y_m=width_m * start[1], heading_rad=math.atan2(along[1], along[0])
        )
        scaled = tuple(_scaled(piece, width_m) for piece in pieces)
        line = join_pieces(scaled, origin, True)
        gap_m, turn_rad = closing_error(line)
        if gap_m > CLOSING_GAP_M or turn_rad > CLOSING_TURN_RAD:
            continue
        half_m = 0.5 * lanes * width_m
        crossings = find_crossings(line, 0.5 * half_m)
        if len(crossings) == loops and _is_clear(line, crossings, half_m, ranges.clear * width_m):
            return RandomRoad(pieces=scaled, origin=origin, line=line, crossings=crossings)
    raise RuntimeError(f"no road with {loops} loops found in {TRIES} draws")


def _ring(rng: Generator, ranges: RoadRanges) -> FloatArray:
    """Corners (n, 2) around the origin, anticlockwise."""
    count = int(rng.integers(ranges.corners[0], ranges.corners[1] + 1))
    low, high = ranges.jitter
    angle = (np.arange(count) + rng.uniform(low, high, count)) * (math.tau / count)
    radius = rng.uniform(*ranges.size) * rng.uniform(*ranges.depth, count)
    stretch = float(rng.uniform(1.0, 1.6))
    return np.stack((stretch * radius * np.cos(angle), radius * np.sin(angle)), axis=-1)


def _with_loops(rng: Generator, ring: FloatArray, loops: int, ranges: RoadRanges) -> FloatArray | None:
    """The ring with as many of its corners replaced by the three corners of a loop; None where too few allow one."""
    turns = _turns(ring)
    low, high = ranges.loop_turn
    allowed = [k for k in range(len(ring)) if low <= turns[k] <= high]
    if len(allowed) < loops:
        return None
    chosen = {int(k) for k in rng.permutation(allowed)[:loops]} if loops else set()
    corners: list[FloatArray] = []
    for k, corner in enumerate(ring):
        if k not in chosen:
            corners.append(corner)
            continue
        come, go = _unit(corner - ring[k - 1]), _unit(ring[(k + 1) % len(ring)] - corner)
        side = rng.uniform(*ranges.loop, 2)
        corners += [corner + side[0] * come, corner + side[0] * come - side[1] * go, corner - side[1] * go]
    return np.array(corners)


def _turns(corners: FloatArray) -> FloatArray:
    """The change of direction (n,) [rad] at each corner, left positive."""
    along = np.roll(corners, -1, axis=0) - corners
    heading = np.arctan2(along[:, 1], along[:, 0])
    return np.asarray((heading - np.roll(heading, 1) + math.pi) % math.tau - math.pi)


def _unit(v: FloatArray) -> FloatArray:
    return np.asarray(v / np.hypot(*v))


def _rounded(rng: Generator, corners: FloatArray, ranges: RoadRanges) -> list[Piece] | None:
    """The pieces [lane widths] from the middle of the first side on; None where a bend or a straight has no room."""
    turns = _turns(corners)
    low, high = ranges.radius
    wanted = np.exp(rng.uniform(math.log(low), math.log(high), len(corners)))
    eased = rng.random() < ranges.eased
    easing = rng.uniform(*ranges.easing, len(corners)) if eased else np.zeros(len(corners))
    if (np.abs(turns) > math.radians(150.0)).any() or (np.abs(turns) < math.radians(4.0)).any():
        return None
    reach = np.array([_tangent(turn, share) for turn, share in zip(turns.tolist(), easing.tolist(), strict=True)])
    sides = np.hypot(*(np.roll(corners, -1, axis=0) - corners).T)
    room = 0.5 * (np.minimum(sides, np.roll(sides, 1)) - ranges.straight)
    radius = np.minimum(wanted, room / reach)
    if (radius < ranges.radius[0]).any():
        return None
    straight = sides - radius * reach - np.roll(radius * reach, -1)  # of the side from each corner to the next
    pieces: list[Piece] = [LinePiece(length_m=0.5 * float(sides[0]) - float(radius[1] * reach[1]))]
    for k in [*range(1, len(corners)), 0]:
        pieces += _bend(float(turns[k]), float(radius[k]), float(easing[k]))
        length = float(straight[k]) if k else 0.5 * float(sides[0]) - float(radius[0] * reach[0])
        pieces.append(LinePiece(length_m=length))
    return pieces


def _bend(turn: float, radius: float, easing: float) -> list[Piece]:
    """An arc with a clothoid at each end that takes half the share `easing` of the turn."""
    if not easing:
        return [ArcPiece(radius_m=radius, turn_rad=turn)]
    bend, length = math.copysign(1.0 / radius, turn), easing * abs(turn) * radius
    return [
        ClothoidPiece(start_per_m=0.0, end_per_m=bend, length_m=length),
        ArcPiece(radius_m=radius, turn_rad=(1.0 - easing) * turn),
        ClothoidPiece(start_per_m=bend, end_per_m=0.0, length_m=length),
    ]


def _tangent(turn: float, easing: float) -> float:
    """The distance from the corner to the start of a bend of radius 1."""
    end = join_pieces(_bend(turn, 1.0, easing), OriginSection(), False)
    return float(np.hypot(*end.position(end.length_m))) / (2.0 * math.cos(0.5 * turn))


def _scaled(piece: Piece, scale: float) -> Piece:
    if isinstance(piece, LinePiece):
        return LinePiece(length_m=scale * piece.length_m)
    if isinstance(piece, ArcPiece):
        return ArcPiece(radius_m=scale * piece.radius_m, turn_rad=piece.turn_rad)
    start, end = piece.start_per_m / scale, piece.end_per_m / scale
    return ClothoidPiece(start_per_m=start, end_per_m=end, length_m=scale * piece.length_m)


def _is_clear(line: JoinedCurve, crossings: Sequence[RoadCrossing], half_m: float, clear_m: float) -> bool:
    """Whether passes of the road keep apart except at crossings, which lie on straight pieces."""
    s = np.linspace(0.0, line.length_m, max(math.ceil(line.length_m / (0.25 * half_m)), 16), endpoint=False)
    points = line.position(s)
    apart = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
    along = np.abs(s[:, None] - s[None])
    along = np.minimum(along, line.length_m - along)
    close = (apart < 2.0 * half_m + clear_m) & (along > 5.0 * half_m + clear_m)
    for crossing in crossings:
        if crossing.angle_rad < math.radians(55.0):
            return False
        reach_m = half_m / math.sin(crossing.angle_rad) + half_m / math.tan(crossing.angle_rad) + clear_m
        places = (crossing.s_first_m, crossing.s_second_m)
        near = [np.abs((s - place + 0.5 * line.length_m) % line.length_m - 0.5 * line.length_m) for place in places]
        if any((np.abs(line.curvature(s[away < reach_m])) > 1e-9).any() for away in near):
            return False
        mine = (near[0] < 3.0 * reach_m)[:, None] & (near[1] < 3.0 * reach_m)[None]
        close &= ~(mine | mine.T)
    return not close.any()
