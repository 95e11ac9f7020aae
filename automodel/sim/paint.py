"""The paint of a road as polygons (lines and gaps, crossings, zebra bars, stop lines), and a circuit's roadside."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from automodel.curves import Curve, OffsetCurve
from automodel.curves.foot import newton_steps
from automodel.sim.track_sections import LINES, BrokenLines, Marking, RoadsideSection, StopLine, TrackFile, ZebraPattern
from automodel.types import FloatArray

Span = tuple[float, float]  # of arc length [m]
Width = Callable[[ArrayLike], FloatArray]

_MAX_SAMPLES = 1000
# of eight broken stretches three are on the left only, three on the right only, two on both sides
_SIDES = (("left",), ("left",), ("left",), ("right",), ("right",), ("right",), ("left", "right"), ("left", "right"))
_LINES_EACH = 5.0 / 8.0  # the share of the stretches that affect one line
_APART_M = 5.0  # minimum distance between two stretches
_PIECE_M = 20.0  # length of a piece of asphalt
_STEP_M = 2.0  # between the corners of a polygon of asphalt
_FOLD = 0.95  # the inside of a bend is paved up to this share of its radius


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadCrossing:
    """Two passes of one road over the same ground.

    `s_first_m` < `s_second_m` are their arc lengths [m] on the reference line, `angle_rad` is the angle between the
    two lines, 0 .. pi/2.
    """

    s_first_m: float
    s_second_m: float
    angle_rad: float


def find_crossings(road: Curve, step_m: float) -> tuple[RoadCrossing, ...]:
    """The places where the reference line crosses itself: searched on chords of about `step_m`, then refined."""
    count = min(max(int(np.ceil(road.length_m / step_m)), 8), _MAX_SAMPLES)
    s = np.linspace(0.0, road.length_m, count + 1)
    points = road.position(s)
    first, second = _crossing_chords(points, road.closed)
    found: list[RoadCrossing] = []
    for i, j in zip(first, second, strict=True):
        crossing = _refine(road, 0.5 * (s[i] + s[i + 1]), 0.5 * (s[j] + s[j + 1]))
        if not any(abs(crossing.s_first_m - other.s_first_m) < step_m for other in found):
            found.append(crossing)
    return tuple(sorted(found, key=lambda c: c.s_first_m))


def _crossing_chords(points: FloatArray, closed: bool) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Index pairs i < j of the chords that cross, without neighbours."""
    start, along = points[:-1], np.diff(points, axis=0)
    first, second = np.triu_indices(len(start), 2)
    if closed:
        apart = (first > 0) | (second < len(start) - 1)
        first, second = first[apart], second[apart]
    between = start[second] - start[first]
    a, b = along[first], along[second]
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    crosses = np.abs(cross) > 1e-3 * np.hypot(a[:, 0], a[:, 1]) * np.hypot(b[:, 0], b[:, 1])  # not parallel
    safe = np.where(crosses, cross, np.inf)
    u = (between[:, 0] * b[:, 1] - between[:, 1] * b[:, 0]) / safe
    v = (between[:, 0] * a[:, 1] - between[:, 1] * a[:, 0]) / safe
    hit = crosses & (u >= 0.0) & (u < 1.0) & (v >= 0.0) & (v < 1.0)
    return first[hit], second[hit]


def _refine(road: Curve, s_first: float, s_second: float) -> RoadCrossing:
    s = np.array([s_first, s_second])
    for _ in range(8):
        (a, b), theta = road.position(s), road.heading(s)
        tangents = np.array([[np.cos(theta[0]), -np.cos(theta[1])], [np.sin(theta[0]), -np.sin(theta[1])]])
        s = s + np.linalg.solve(tangents, b - a)
    s = np.sort(s % road.length_m if road.closed else s)
    turn = float(np.diff(road.heading(s))[0])
    return RoadCrossing(
        s_first_m=float(s[0]), s_second_m=float(s[1]), angle_rad=float(np.arcsin(min(abs(np.sin(turn)), 1.0)))
    )


def distance_beside(curve: Curve, points_m: ArrayLike, near_s_m: float) -> FloatArray:
    """Signed distances (n,) [m], left positive, of points (n, 2) from the part of a curve around `near_s_m`."""
    points = np.asarray(points_m, dtype=np.float64)
    s = np.full(len(points), near_s_m)
    for _ in range(6):  # Newton's method for all points at once: they lie within a road's width of the curve
        s = s + newton_steps(points - curve.position(s), curve.heading(s), curve.curvature(s))[0]
    return newton_steps(points - curve.position(s), curve.heading(s), curve.curvature(s))[1]


def broken_spans(length_m: float, broken: BrokenLines) -> dict[str, list[Span]]:
    """Spans of the reference line over which the "left" and the "right" edge line are missing."""
    rng = np.random.default_rng((broken.seed, 31))
    mean_m = 0.5 * (broken.shortest_m + broken.longest_m)
    count = round(broken.share / _LINES_EACH * length_m / mean_m)
    # all lengths and sides are equally frequent, so that the missing share is the requested one
    drawn = (rng.permutation(count) + rng.uniform(0.0, 1.0, count)) / max(count, 1)
    lengths = broken.shortest_m + (broken.longest_m - broken.shortest_m) * drawn
    free_m = length_m - float((lengths + _APART_M).sum())
    if free_m < 0.0:
        raise ValueError(f"share: {broken.share} in pieces of {mean_m} m does not fit a road of {length_m:.0f} m")
    starts = np.sort(rng.uniform(0.0, free_m, count)) + np.cumsum(lengths + _APART_M) - lengths
    sides = [_SIDES[k % len(_SIDES)] for k in rng.permutation(count)]
    spans: dict[str, list[Span]] = {"left": [], "right": []}
    for start, length, names in zip(starts.tolist(), lengths.tolist(), sides, strict=True):
        for name in names:
            spans[name].append((start, start + length))
    return spans


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Paint:
    """One painted polygon (n, 2) [m] of the world frame.

    `colour` is "white" or "yellow", `kind` is "line", "dash", "zebra" or "stop"; beside a circuit also "red" and
    "asphalt", "kerb" and "ground". Polygons are at most about five lane widths long (2 m at scale, 20 m at
    full scale), so that bounding circles are tight.
    """

    polygon_m: FloatArray
    colour: str
    kind: str

    def __post_init__(self) -> None:
        polygon = np.array(self.polygon_m, dtype=np.float64)
        polygon.flags.writeable = False
        object.__setattr__(self, "polygon_m", polygon)


@dataclass(frozen=True, slots=True, kw_only=True)
class Grain:
    """The resolution of polygons: their greatest length, and their greatest distance from the exact border [m]."""

    length_m: float
    error_m: float

    @classmethod
    def of_lane(cls, width_m: float) -> Grain:
        """2 m and 0.24 mm for a lane of 0.4 m, in proportion to the width."""
        return cls(length_m=min(max(5.0 * width_m, 2.0), 20.0), error_m=6e-4 * width_m)


def strip(curve: Curve, span: Span, between: Span, error_m: float) -> FloatArray:
    """The polygon (n, 2) between the two signed distances `between` from a curve, along `span` of its arc length."""
    bend = float(np.abs(curve.curvature(np.linspace(*span, 33))).max())
    steps = max(int(np.ceil((span[1] - span[0]) * np.sqrt(bend / (8.0 * error_m)))), 1)
    s = np.linspace(*span, steps + 1)
    d = np.repeat(between, steps + 1)
    return curve.offset_position(np.concatenate((s, s[::-1])), d)


def paint_line(line: Curve, marking: Marking, gaps: Sequence[Span], grain: Grain) -> Iterator[Paint]:
    """A marking along `line` except inside `gaps` (spans of its arc length; they may extend over the ends)."""
    if marking.style == "none":
        return
    half = 0.5 * marking.width_m
    kind = "dash" if marking.style == "dashed" else "line"
    for start, end in _without(_spans(line, marking), gaps, line):
        if kind == "dash" and end - start < marking.width_m:
            continue
        cuts = np.linspace(start, end, max(int(np.ceil((end - start) / grain.length_m)), 1) + 1)
        for piece in itertools.pairwise(cuts.tolist()):
            yield Paint(polygon_m=strip(line, piece, (-half, half), grain.error_m), colour=marking.colour, kind=kind)


def _spans(line: Curve, marking: Marking) -> list[Span]:
    """The stretches of the marking without gaps."""
    if marking.style == "solid":
        return [(0.0, line.length_m)]
    period, dash = marking.dash_m + marking.gap_m, marking.dash_m
    if line.closed:  # the pattern is stretched slightly to fit a whole number of periods
        count = max(round(line.length_m / period), 1)
        dash, period = dash * line.length_m / (count * period), line.length_m / count
    else:
        count = int(np.ceil(line.length_m / period))
    return [(i * period, min(i * period + dash, line.length_m)) for i in range(count)]


def _without(spans: list[Span], gaps: Sequence[Span], line: Curve) -> list[Span]:
    laps = (-line.length_m, 0.0, line.length_m) if line.closed else (0.0,)
    for gap_start, gap_end in [(a + lap, b + lap) for a, b in gaps for lap in laps]:
        left = []
        for start, end in spans:
            if gap_end <= start or gap_start >= end:
                left.append((start, end))
                continue
            if start < gap_start:
                left.append((start, gap_start))
            if gap_end < end:
                left.append((gap_end, end))
        spans = left
    return spans


def on_line(line: Curve, s_road_m: float) -> float:
    """Arc length on a line of the road at arc length `s_road_m` of the reference line."""
    return float(line.s_of(s_road_m)) if isinstance(line, OffsetCurve) else s_road_m


def inside_crossing(line: Curve, road: Curve, own_and_other_s: Span, half_m: float) -> Span:
    """The span of `line` within `half_m` of the reference line of the pass that it crosses.

    `own_and_other_s` are the arc lengths [m] of the crossing on the pass of `line` and on the other one.
    """
    own, other = own_and_other_s
    centre = on_line(line, own)
    lean = abs(np.sin(float(road.heading(own)) - float(road.heading(other))))
    reach = 3.0 * half_m / max(lean, 0.2)
    s = np.linspace(centre - reach, centre + reach, 601)
    beyond = np.abs(distance_beside(road, line.position(s), other)) - half_m
    middle = int(np.argmin(beyond))
    before = np.flatnonzero(beyond[:middle] > 0.0)
    after = middle + np.flatnonzero(beyond[middle:] > 0.0)
    if beyond[middle] > 0.0 or not len(before) or not len(after):
        return centre - half_m, centre + half_m
    i, j = int(before[-1]), int(after[0])
    start = s[i] + (s[i + 1] - s[i]) * beyond[i] / (beyond[i] - beyond[i + 1])
    end = s[j] - (s[j] - s[j - 1]) * beyond[j] / (beyond[j] - beyond[j - 1])
    return float(start), float(end)


def paint_zebra(
    road: Curve, start_m: float, pattern: ZebraPattern, half_clear_m: float, grain: Grain
) -> Iterator[Paint]:
    """Bars along the road from arc length `start_m` on, as many as fit within `half_clear_m` of the reference line."""
    pitch = pattern.bar_width_m + pattern.bar_gap_m
    side = int((half_clear_m - 0.5 * pattern.bar_width_m) // pitch)
    span = (start_m, start_m + pattern.length_m)
    for d in [k * pitch for k in range(-side, side + 1)]:
        between = (d - 0.5 * pattern.bar_width_m, d + 0.5 * pattern.bar_width_m)
        yield Paint(polygon_m=strip(road, span, between, grain.error_m), colour=pattern.colour, kind="zebra")


def paint_stop_line(road: Curve, stop: StopLine, between: Span, grain: Grain) -> Paint:
    """A bar between the two signed distances `between` from the reference line."""
    span = (stop.s_m - 0.5 * stop.width_m, stop.s_m + 0.5 * stop.width_m)
    return Paint(polygon_m=strip(road, span, between, grain.error_m), colour=stop.colour, kind="stop")


def paint_road(
    sections: TrackFile, lines: tuple[Curve, Curve, Curve], crossings: Sequence[RoadCrossing]
) -> Iterator[Paint]:
    """All paint of a track file; `lines` are the road's left edge, reference line and right edge."""
    road, half_m = lines[1], sections.lanes.half_road_m
    marked = sections.markings
    # at a crossing, a line ends flush with the inner border of the edge line that it meets
    inner_m = half_m - 0.5 * max(_painted_width_m(marked.left), _painted_width_m(marked.right))
    grain = Grain.of_lane(sections.lanes.width_m)
    gaps = _missing(sections, lines)
    both = [(c.s_first_m, c.s_second_m) for c in crossings]
    for own_and_other_s in [one for pair in both for one in (pair, pair[::-1])]:
        if sections.crossings.interrupt_lines:
            for line, mine in zip(lines, gaps, strict=True):
                mine.append(inside_crossing(line, road, own_and_other_s, inner_m))
        zebra = sections.crossings.zebra
        if zebra is not None:
            start, end = _arms(lines, own_and_other_s, half_m + zebra.distance_m)
            clear_m = zebra.length_m + zebra.distance_m
            gaps[1].append((start - clear_m, end + clear_m))
            for start_m in (start - zebra.length_m, end):
                yield from paint_zebra(road, start_m, zebra, inner_m, grain)
    for line, marking, mine in zip(lines, (marked.left, marked.centre, marked.right), gaps, strict=True):
        yield from paint_line(line, marking, mine, grain)
    for stop in sections.stop_lines:
        side_m = inner_m if not sections.widths else inner_m + _half_m(lines, stop.s_m) - half_m
        near_m = 0.5 * _painted_width_m(marked.centre) if sections.lanes.count == 2 else -side_m
        between = (-side_m, -near_m) if stop.direction == "forward" else (near_m, side_m)
        yield paint_stop_line(road, stop, between, grain)


def _missing(sections: TrackFile, lines: tuple[Curve, Curve, Curve]) -> list[list[Span]]:
    """For each line, the spans of its own arc length that the track file leaves unpainted."""
    broken = {} if sections.broken is None else broken_spans(lines[1].length_m, sections.broken)
    missing = []
    for name, line in zip(LINES, lines, strict=True):
        spans = [(gap.from_m, gap.to_m) for gap in sections.gaps if name in gap.lines] + broken.get(name, [])
        missing.append([(on_line(line, start), on_line(line, end)) for start, end in spans])
    return missing


def _half_m(lines: tuple[Curve, Curve, Curve], s_m: float) -> float:
    """The distance from the reference line to the left edge at arc length `s_m` of the reference line."""
    return float(np.hypot(*(lines[0].position(on_line(lines[0], s_m)) - lines[1].position(s_m))))


def _arms(lines: tuple[Curve, Curve, Curve], own_and_other_s: Span, half_m: float) -> Span:
    """The span of the reference line over which any of the lines is within `half_m` of the crossing pass."""
    spans = np.array([inside_crossing(line, lines[1], own_and_other_s, half_m) for line in lines])
    on_road = [
        line.base_s(span) if isinstance(line, OffsetCurve) else span for line, span in zip(lines, spans, strict=True)
    ]
    return float(np.min(on_road)), float(np.max(on_road))


def _painted_width_m(marking: Marking) -> float:
    return marking.width_m if marking.style != "none" else 0.0


def build_roadside(road: Curve, width_m: Width, section: RoadsideSection, marking_m: float) -> tuple[Paint, ...]:
    """The asphalt and the kerbs of a lane around `road` with edge lines of width `marking_m`."""
    return (*_asphalt(road, width_m, section), *_kerbs(road, width_m, section, 0.5 * marking_m))


def _asphalt(road: Curve, width_m: Width, section: RoadsideSection) -> Iterator[Paint]:
    cuts = np.linspace(0.0, road.length_m, max(round(road.length_m / _PIECE_M), 1) + 1)
    for start, end in itertools.pairwise(cuts.tolist()):
        s = np.linspace(start, end, round((end - start) / _STEP_M) + 1)
        left, right = (_beside(road, width_m, s, side, section.asphalt_m) for side in (1.0, -1.0))
        yield Paint(polygon_m=np.concatenate((right, left[::-1])), colour="asphalt", kind="ground")


def _kerbs(road: Curve, width_m: Width, section: RoadsideSection, from_m: float) -> Iterator[Paint]:
    """Alternating red and white blocks."""
    count = 2 * max(round(0.5 * road.length_m / section.block_m), 1)
    edges = np.linspace(0.0, road.length_m, count + 1)
    bend = road.curvature(0.5 * (edges[1:] + edges[:-1])) * max(section.kerb_radius_m, 1e-9)
    for side in (1.0, -1.0):
        inside, opposite = side * bend > 1.0, side * bend < -1.0
        after = _shortly_after(opposite, round(section.kerb_exit_m / section.block_m), road.closed)
        for start, end in _runs(inside | after):
            s = edges[start : end + 1]
            near, far = (_beside(road, width_m, s, side, d) for d in (from_m, from_m + section.kerb_width_m))
            for k in np.flatnonzero(np.hypot(*(far - near).T)[:-1] > from_m).tolist():
                polygon = np.stack((near[k], near[k + 1], far[k + 1], far[k]))
                yield Paint(polygon_m=polygon, colour=("red", "white")[(start + k) % 2], kind="kerb")


def _shortly_after(mask: NDArray[np.bool_], count: int, closed: bool) -> NDArray[np.bool_]:
    """The up to `count` places after each run of True, across the seam of a closed road."""
    before = mask[len(mask) - count :] if closed else np.zeros(count, np.bool_)
    seen = np.cumsum(np.concatenate((before, mask)))
    return np.asarray((seen[count:] > np.concatenate(([0], seen))[: len(mask)]) & ~mask)


def _beside(road: Curve, width_m: Width, s: FloatArray, side: float, beyond_m: float) -> FloatArray:
    """Points (n, 2) at `beyond_m` outside the edge of one side, limited to where the road's normals meet."""
    d = 0.5 * width_m(s) + beyond_m
    towards = np.maximum(side * road.curvature(s), 1e-9)
    return road.offset_position(s, side * np.minimum(d, _FOLD / towards))


def _runs(mask: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Start and end of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(np.int8)))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
