"""What is painted on the ground, as polygons."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from automodel.curves import Curve, OffsetCurve
from automodel.sim.broken_lines import broken_spans
from automodel.sim.crossings import RoadCrossing, distance_beside
from automodel.sim.track_sections import LINES, Marking, StopLine, TrackFile, ZebraPattern
from automodel.types import FloatArray

Span = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Paint:
    """One painted polygon (n, 2) [m] of the world frame.

    `colour` is "white" or "yellow", `kind` is "line", "dash", "zebra" or "stop"; beside a circuit (roadside.py) also
    "red" and "asphalt", "kerb" and "ground". No polygon is longer than about five lane widths (2 m at scale, 20 m at
    most), so that a bounding box says well where it is.
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
    """How finely polygons follow the curves: their greatest length, and the distance from the true border [m]."""

    length_m: float
    error_m: float

    @classmethod
    def of_lane(cls, width_m: float) -> Grain:
        """2 m and 0.24 mm for a lane of 0.4 m, growing with the width."""
        return cls(length_m=min(max(5.0 * width_m, 2.0), 20.0), error_m=6e-4 * width_m)


def strip(curve: Curve, span: Span, between: Span, error_m: float) -> FloatArray:
    """The polygon (n, 2) between two distances `between` beside a curve, along `span` of its arc length."""
    bend = float(np.abs(curve.curvature(np.linspace(*span, 33))).max())
    steps = max(int(np.ceil((span[1] - span[0]) * np.sqrt(bend / (8.0 * error_m)))), 1)
    s = np.linspace(*span, steps + 1)
    d = np.repeat(between, steps + 1)
    return curve.offset_position(np.concatenate((s, s[::-1])), d)


def paint_line(line: Curve, marking: Marking, gaps: Sequence[Span], grain: Grain) -> Iterator[Paint]:
    """A marking along the whole of `line`, not inside `gaps` (of its arc length; they may reach over the ends)."""
    if marking.style == "none":
        return
    half = 0.5 * marking.width_m
    kind = "dash" if marking.style == "dashed" else "line"
    for begin, end in _without(_spans(line, marking), gaps, line):
        if kind == "dash" and end - begin < marking.width_m:
            continue
        cuts = np.linspace(begin, end, max(int(np.ceil((end - begin) / grain.length_m)), 1) + 1)
        for piece in itertools.pairwise(cuts.tolist()):
            yield Paint(polygon_m=strip(line, piece, (-half, half), grain.error_m), colour=marking.colour, kind=kind)


def _spans(line: Curve, marking: Marking) -> list[Span]:
    """The stretches that the marking would cover if nothing interrupted it."""
    if marking.style == "solid":
        return [(0.0, line.length_m)]
    period, dash = marking.dash_m + marking.gap_m, marking.dash_m
    if line.closed:  # the pattern is stretched a little so that it meets itself
        count = max(round(line.length_m / period), 1)
        dash, period = dash * line.length_m / (count * period), line.length_m / count
    else:
        count = int(np.ceil(line.length_m / period))
    return [(i * period, min(i * period + dash, line.length_m)) for i in range(count)]


def _without(spans: list[Span], gaps: Sequence[Span], line: Curve) -> list[Span]:
    laps = (-line.length_m, 0.0, line.length_m) if line.closed else (0.0,)
    for gap_begin, gap_end in [(a + lap, b + lap) for a, b in gaps for lap in laps]:
        left = []
        for begin, end in spans:
            if gap_end <= begin or gap_begin >= end:
                left.append((begin, end))
                continue
            if begin < gap_begin:
                left.append((begin, gap_begin))
            if gap_end < end:
                left.append((gap_end, end))
        spans = left
    return spans


def on_line(line: Curve, s_road_m: float) -> float:
    """Arc length on a line of the road at arc length `s_road_m` of the reference line."""
    return float(line.s_of(s_road_m)) if isinstance(line, OffsetCurve) else s_road_m


def passes(crossings: Sequence[RoadCrossing]) -> list[Span]:
    """Every pass of every crossing: its own arc length and that of the pass it crosses."""
    both = [((c.s_first_m, c.s_second_m), (c.s_second_m, c.s_first_m)) for c in crossings]
    return [one for pair in both for one in pair]


def inside_crossing(line: Curve, road: Curve, own_and_other_s: Span, half_m: float) -> Span:
    """The span of `line` that lies within `half_m` of the reference line of the pass that it crosses."""
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
    begin = s[i] + (s[i + 1] - s[i]) * beyond[i] / (beyond[i] - beyond[i + 1])
    end = s[j] - (s[j] - s[j - 1]) * beyond[j] / (beyond[j] - beyond[j - 1])
    return float(begin), float(end)


def paint_zebra(
    road: Curve, begin_m: float, pattern: ZebraPattern, half_clear_m: float, grain: Grain
) -> Iterator[Paint]:
    """Bars along the road from arc length `begin_m` on, as many as fit within `half_clear_m` of the reference line."""
    pitch = pattern.bar_width_m + pattern.bar_gap_m
    side = int((half_clear_m - 0.5 * pattern.bar_width_m) // pitch)
    span = (begin_m, begin_m + pattern.length_m)
    for d in [k * pitch for k in range(-side, side + 1)]:
        between = (d - 0.5 * pattern.bar_width_m, d + 0.5 * pattern.bar_width_m)
        yield Paint(polygon_m=strip(road, span, between, grain.error_m), colour=pattern.colour, kind="zebra")


def paint_stop_line(road: Curve, stop: StopLine, between: Span, grain: Grain) -> Paint:
    """A bar across the distances `between` beside the reference line."""
    span = (stop.s_m - 0.5 * stop.width_m, stop.s_m + 0.5 * stop.width_m)
    return Paint(polygon_m=strip(road, span, between, grain.error_m), colour=stop.colour, kind="stop")


def paint_road(
    sections: TrackFile, lines: tuple[Curve, Curve, Curve], crossings: Sequence[RoadCrossing]
) -> Iterator[Paint]:
    """All paint of a track file; `lines` are the road's left edge, reference line and right edge."""
    road, half_m = lines[1], sections.lanes.half_road_m
    marked = sections.markings
    # a line ends flush with the inner border of the edge line that it meets at a crossing
    inner_m = half_m - 0.5 * max(_painted_width_m(marked.left), _painted_width_m(marked.right))
    grain = Grain.of_lane(sections.lanes.width_m)
    gaps = _missing(sections, lines)
    for own_and_other_s in passes(crossings):
        if sections.crossings.interrupt_lines:
            for line, mine in zip(lines, gaps, strict=True):
                mine.append(inside_crossing(line, road, own_and_other_s, inner_m))
        zebra = sections.crossings.zebra
        if zebra is not None:
            begin, end = _arms(lines, own_and_other_s, half_m + zebra.distance_m)
            clear_m = zebra.length_m + zebra.distance_m
            gaps[1].append((begin - clear_m, end + clear_m))
            for start in (begin - zebra.length_m, end):
                yield from paint_zebra(road, start, zebra, inner_m, grain)
    for line, marking, mine in zip(lines, (marked.left, marked.centre, marked.right), gaps, strict=True):
        yield from paint_line(line, marking, mine, grain)
    for stop in sections.stop_lines:
        side_m = inner_m if not sections.widths else inner_m + _half_m(lines, stop.s_m) - half_m
        near_m = 0.5 * _painted_width_m(marked.centre) if sections.lanes.count == 2 else -side_m
        between = (-side_m, -near_m) if stop.direction == "forward" else (near_m, side_m)
        yield paint_stop_line(road, stop, between, grain)


def _missing(sections: TrackFile, lines: tuple[Curve, Curve, Curve]) -> list[list[Span]]:
    """For each line the spans of its own arc length that the file leaves out."""
    broken = {} if sections.broken is None else broken_spans(lines[1].length_m, sections.broken)
    missing = []
    for name, line in zip(LINES, lines, strict=True):
        spans = [(gap.from_m, gap.to_m) for gap in sections.gaps if name in gap.lines] + broken.get(name, [])
        missing.append([(on_line(line, begin), on_line(line, end)) for begin, end in spans])
    return missing


def _half_m(lines: tuple[Curve, Curve, Curve], s_m: float) -> float:
    """From the reference line to the left edge at arc length `s_m` of the reference line."""
    return float(np.hypot(*(lines[0].position(on_line(lines[0], s_m)) - lines[1].position(s_m))))


def _arms(lines: tuple[Curve, Curve, Curve], own_and_other_s: Span, half_m: float) -> Span:
    """The span of the reference line over which any of the lines lies within `half_m` of the crossing pass."""
    spans = np.array([inside_crossing(line, lines[1], own_and_other_s, half_m) for line in lines])
    on_road = [
        line.base_s(span) if isinstance(line, OffsetCurve) else span for line, span in zip(lines, spans, strict=True)
    ]
    return float(np.min(on_road)), float(np.max(on_road))


def _painted_width_m(marking: Marking) -> float:
    return marking.width_m if marking.style != "none" else 0.0
