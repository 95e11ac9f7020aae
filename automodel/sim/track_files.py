"""Reads tracks: track files (TOML) and centrelines of full-scale race tracks (CSV).

The CSV is a closed line with the columns of TUM's racetrack database: `x_m,y_m,w_tr_right_m,w_tr_left_m`.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from automodel.config.toml_reader import ConfigError, parse_toml, read_section, read_text, where
from automodel.curves import Curve, JoinedCurve, OffsetCurve, SplineCurve
from automodel.geometry import SE2
from automodel.sim.paint import (
    Grain,
    Paint,
    broken_spans,
    build_roadside,
    find_crossings,
    on_line,
    paint_line,
    paint_road,
)
from automodel.sim.track import Lane, Obstacle, Track, constant, lane_between, reversed_lane
from automodel.sim.track_sections import (
    PIECES,
    ArcPiece,
    Box,
    BrokenLines,
    Gap,
    LanesSection,
    LaneWidth,
    Marking,
    OriginSection,
    Piece,
    RoadsideSection,
    StopLine,
    TrackFile,
    WidthAt,
)
from automodel.types import FloatArray

CLOSING_GAP_M = 1e-3
CLOSING_TURN_RAD = math.radians(0.1)
_LISTS: dict[str, type[StopLine] | type[Gap] | type[Box] | type[WidthAt]] = {
    "stop_lines": StopLine,
    "gaps": Gap,
    "obstacles": Box,
    "widths": WidthAt,
}
COLUMNS = ("x_m", "y_m", "w_tr_right_m", "w_tr_left_m")
EDGE = Marking(style="solid", width_m=0.15)
MARGIN_M = 20.0  # floor around the track
_MAX_HALF_WIDTH = 0.85  # of half a road's width, as a share of the bend's radius
_TAPER = 3  # points over which a road narrows


def load_track(path_or_name: str | Path) -> Track:
    """A shipped track by its name ("tmr"), a track file (.toml) or the centreline of a race track (.csv).

    Raises ConfigError with file, line, key and reason.
    """
    path = Path(path_or_name)
    if path.suffix == ".csv":
        return read_racetrack(path)
    if path.suffix == ".toml":
        return parse_track(read_text(path), str(path))
    shipped = {
        Path(entry.name).stem: entry for entry in resources.files("tracks").iterdir() if entry.name.endswith(".toml")
    }
    entry = shipped.get(str(path_or_name))
    if entry is None:
        raise ConfigError(
            f"{path_or_name}: no such track; expected one of {', '.join(sorted(shipped))},"
            " or the path of a .toml or .csv file"
        )
    return parse_track(entry.read_text(encoding="utf-8"), f"tracks/{entry.name}")


def parse_track(text: str, file: str) -> Track:
    """The track in the text of a track file; `file` is its name in error messages. Raises ConfigError."""
    sections, road = read_track(text, file)
    try:
        return build_track(sections, road)
    except ValueError as error:  # errors that only show on the whole road
        key = "broken" if str(error).startswith("share") else "widths"
        raise ConfigError(f"{where(text, file, (), key)}: {error}") from None


def build_track(sections: TrackFile, road: Curve) -> Track:
    """The track around the reference line `road`; ValueError where an edge folds back or the gaps do not fit."""
    forward, reverse, edges = _lanes(sections, road)
    crossings = find_crossings(road, 0.25 * sections.lanes.half_road_m)
    start = sections.start
    lane = forward if start.direction == "forward" else reverse
    return Track(
        name=sections.name,
        road=road,
        forward=forward,
        reverse=reverse,
        floor=(sections.floor.x0_m, sections.floor.y0_m, sections.floor.x1_m, sections.floor.y1_m),
        start=lane.pose(start.s_m, start.offset_m, start.heading_rad),
        start_direction=start.direction,
        obstacles=tuple(_obstacle(box) for box in sections.obstacles),
        crossings=crossings,
        painted=tuple(paint_road(sections, (edges[0], road, edges[1]), crossings)),
        roadside=_roadside(sections, road, forward),
    )


def join_pieces(pieces: Sequence[Piece], origin: OriginSection, closed: bool) -> JoinedCurve:
    """The reference line of a road, its pieces end to end from `origin` on."""
    x_m, y_m, heading_rad = origin.x_m, origin.y_m, origin.heading_rad
    curves: list[Curve] = []
    for piece in pieces:
        curve = piece.curve(x_m, y_m, heading_rad)
        curves.append(curve)
        x_m, y_m = (float(v) for v in curve.position(curve.length_m))
        heading_rad = float(curve.heading(curve.length_m))
    return JoinedCurve(curves, closed)


def closing_error(road: JoinedCurve) -> tuple[float, float]:
    """Distance [m] and angle [rad] by which the road's end misses its start."""
    first, last = road.pieces[0], road.pieces[-1]
    gap_m = float(np.hypot(*(last.position(last.length_m) - first.position(0.0))))
    turn_rad = math.remainder(float(last.heading(last.length_m)) - float(first.heading(0.0)), 2.0 * math.pi)
    return gap_m, abs(turn_rad)


def _lanes(sections: TrackFile, road: Curve) -> tuple[Lane, Lane, tuple[Curve, Curve]]:
    """The forward and the reverse lane, and the road's left and right edge; ValueError if an edge folds back."""
    width_m, half_m = sections.lanes.width_m, sections.lanes.half_road_m
    if sections.widths:
        width = LaneWidth(sections.widths, road.length_m, road.closed)
        forward = lane_between(road, width)
        return forward, reversed_lane(forward), (forward.left, forward.right)
    left, right = OffsetCurve(road, half_m), OffsetCurve(road, -half_m)
    if sections.lanes.count == 2:
        middle = (OffsetCurve(road, -0.5 * width_m), OffsetCurve(road, 0.5 * width_m))
        forward = Lane(centerline=middle[0], left=road, right=right, width_m=constant(width_m))
        reverse = reversed_lane(Lane(centerline=middle[1], left=left, right=road, width_m=constant(width_m)))
    else:
        forward = Lane(centerline=road, left=left, right=right, width_m=constant(width_m))
        reverse = reversed_lane(forward)
    return forward, reverse, (left, right)


def _roadside(sections: TrackFile, road: Curve, forward: Lane) -> tuple[Paint, ...]:
    if sections.roadside is None:
        return ()
    width = forward.width_m if sections.lanes.count == 1 else constant(2.0 * sections.lanes.width_m)
    return build_roadside(road, width, sections.roadside, sections.markings.left.width_m)


def _obstacle(box: Box) -> Obstacle:
    half = 0.5 * np.array([box.length_m, box.width_m])
    corners = half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    outline = SE2(box.x_m, box.y_m, box.heading_rad).apply(corners)
    return Obstacle(polygon_m=outline, height_m=box.height_m, grey=box.grey)


def read_track(text: str, file: str) -> tuple[TrackFile, JoinedCurve]:
    """The sections of a track file and the reference line of its road; `file` is its name in error messages.

    Raises ConfigError.
    """
    table = parse_toml(text, file)
    raw = {name: _tables(table.pop(name, []), name, text, file) for name in ("pieces", *_LISTS)}
    if not raw["pieces"]:
        raise ConfigError(f"{where(text, file, (), 'pieces')}: expected at least one [[pieces]], got none")
    sections = read_section(TrackFile, table, text, file)
    if sections.lanes.count == 1:
        if "centre" in table.get("markings", {}) and sections.markings.centre.style != "none":
            place = where(text, file, ("markings", "centre"), "style")
            raise ConfigError(f"{place}: a single lane has no centre line; remove it")
        none = dataclasses.replace(sections.markings, centre=Marking(style="none"))
        sections = dataclasses.replace(sections, markings=none)
    pieces = [_read_piece(entry, part, file, sections.lanes) for entry, part in raw["pieces"]]
    road = join_pieces(pieces, sections.origin, sections.closed)
    if sections.closed:
        _check_closed(road, where(text, file, (), "closed"))
    lists: dict[str, Any] = {}
    for name, cls in _LISTS.items():
        lists[name] = tuple(read_section(cls, entry, part, file, (name,)) for entry, part in raw[name])
        for item, (_, part) in zip(lists[name], raw[name], strict=True):
            key = {"stop_lines": "s_m", "gaps": "from_m", "widths": "s_m"}.get(name)
            if key and not 0 <= getattr(item, key) <= road.length_m:
                place = where(part, file, (name,), key)
                raise ConfigError(f"{place}: {getattr(item, key)} is off the road, 0 .. {road.length_m:.3f} m")
    if lists["widths"] and sections.lanes.count != 1:
        raise ConfigError(f"{where(text, file, (), 'widths')}: only a single lane may have widths; remove them")
    return dataclasses.replace(sections, **lists), road


def _tables(raw: Any, name: str, text: str, file: str) -> list[tuple[dict[str, Any], str]]:
    """Each table of an array, with the text for finding its lines: all lines but its own are blank."""
    if not isinstance(raw, list) or not all(isinstance(entry, dict) for entry in raw):
        raise ConfigError(f"{where(text, file, (), name)}: expected a list of tables, each under [[{name}]]")
    lines = text.splitlines()
    heads = [i for i, row in enumerate(lines) if re.match(rf"\s*\[\[\s*{name}\s*\]\]", row)]
    if len(heads) != len(raw):
        return [(entry, text) for entry in raw]
    ends = [*heads[1:], len(lines)]
    return [(raw[i], "\n" * head + "\n".join(lines[head : ends[i]])) for i, head in enumerate(heads)]


def _read_piece(raw: dict[str, Any], text: str, file: str, lanes: LanesSection) -> Piece:
    kind = raw.get("kind")
    cls = PIECES.get(kind) if isinstance(kind, str) else None
    if cls is None:
        place = where(text, file, ("pieces",), "kind")
        raise ConfigError(f"{place}: expected one of {', '.join(PIECES)}, got {kind!r}")
    piece: Piece = read_section(cls, {k: v for k, v in raw.items() if k != "kind"}, text, file, ("pieces",))
    if piece.sharpest_per_m * lanes.half_road_m >= 1.0:
        place = where(text, file, ("pieces",), "radius_m" if isinstance(piece, ArcPiece) else "start_per_m")
        raise ConfigError(
            f"{place}: a bend of radius {1.0 / piece.sharpest_per_m:.3g} m folds the edge of a road that is"
            f" {2.0 * lanes.half_road_m:.3g} m wide; expected more than {lanes.half_road_m:.3g} m"
        )
    return piece


def _check_closed(road: JoinedCurve, place: str) -> None:
    gap_m, turn_rad = closing_error(road)
    if gap_m > CLOSING_GAP_M or turn_rad > CLOSING_TURN_RAD:
        raise ConfigError(
            f"{place}: true, but the road's end misses its start by {1e3 * gap_m:.2f} mm and"
            f" {math.degrees(turn_rad):.3f} deg; at most {1e3 * CLOSING_GAP_M:.0f} mm and"
            f" {math.degrees(CLOSING_TURN_RAD):.1f} deg are allowed"
        )


def read_racetrack(
    path: str | Path, broken: BrokenLines | None = None, roadside: RoadsideSection | None = None
) -> Track:
    """The track in a CSV file; raises ConfigError with file and line.

    There is one lane, driven in both directions, with a solid white line at each edge. The line of the file need not be
    in the middle between the edges; the lane's centerline is. `broken` removes stretches of the lines, `roadside` adds
    kerbs; without `roadside` the asphalt extends to the floor's edge.
    """
    rows, numbers = _read_rows(read_text(path), str(path))
    try:
        middle, width_m = recentred(rows[:, :2], rows[:, 3], rows[:, 2])
        road = SplineCurve(middle, closed=True)
        forward = lane_between(road, _periodic_width(road, width_m))
        painted = _painted(forward, float(width_m.mean()), broken)
    except ValueError as error:
        raise ConfigError(f"{path}:{numbers[0]}: these points and widths do not form a road: {error}") from None
    edges = (forward.left, forward.right)
    outline = np.vstack([line.position(np.linspace(0.0, line.length_m, 4 * len(rows))) for line in edges])
    low, high = outline.min(axis=0) - MARGIN_M, outline.max(axis=0) + MARGIN_M
    return Track(
        name=Path(path).stem,
        road=road,
        forward=forward,
        reverse=reversed_lane(forward),
        floor=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
        start=forward.pose(0.0),
        painted=painted,
        roadside=() if roadside is None else build_roadside(road, forward.width_m, roadside, EDGE.width_m),
    )


def _painted(lane: Lane, mean_width_m: float, broken: BrokenLines | None) -> tuple[Paint, ...]:
    """Both edge lines, without their broken stretches."""
    spans = {} if broken is None else broken_spans(lane.centerline.length_m, broken)
    painted: list[Paint] = []
    for name, line in (("left", lane.left), ("right", lane.right)):
        gaps = [(on_line(line, start), on_line(line, end)) for start, end in spans.get(name, [])]
        painted += paint_line(line, EDGE, gaps, Grain.of_lane(mean_width_m))
    return tuple(painted)


def recentred(points_m: FloatArray, left_m: FloatArray, right_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The centreline (n, 2) between the edges of a closed line of points (n, 2), and the width (n,) across it [m].

    `left_m`, `right_m` (n,) are the distances of the edges from the line of points along its normals. The road is
    narrowed in hairpins where an edge would fold back.
    """
    line = SplineCurve(points_m, closed=True)
    theta = line.heading(line.knots_m[:-1])
    normal = np.stack((-np.sin(theta), np.cos(theta)), axis=-1)
    middle = points_m + 0.5 * (left_m - right_m)[:, None] * normal
    course = SplineCurve(middle, closed=True)
    lean = course.heading(course.knots_m[:-1]) - theta  # the angle between the normals
    return middle, _narrowed(course, (left_m + right_m) * np.cos(lean))


def _narrowed(course: SplineCurve, width_m: FloatArray) -> FloatArray:
    """The widths (n,), smoothly reduced where an edge would fold back."""
    s = np.linspace(0.0, course.length_m, 8 * len(width_m), endpoint=False)
    bend = np.abs(course.curvature(s)).reshape(len(width_m), 8)
    sharpest = np.maximum(bend.max(axis=1), np.roll(bend, 1, axis=0).max(axis=1))
    allowed = 2.0 * _MAX_HALF_WIDTH / np.maximum(sharpest, 1e-9)
    if (width_m <= allowed).all():
        return width_m
    around = range(-_TAPER, _TAPER + 1)
    lowest = np.min([np.roll(np.minimum(width_m, allowed), k) for k in around], axis=0)
    tapered = np.mean([np.roll(lowest, k) for k in around], axis=0)
    near = np.any([np.roll(width_m > allowed, k) for k in range(-2 * _TAPER, 2 * _TAPER + 1)], axis=0)
    return np.where(near, np.minimum(tapered, width_m), width_m)


def _periodic_width(road: SplineCurve, width_m: FloatArray) -> Callable[[ArrayLike], FloatArray]:
    from scipy.interpolate import CubicSpline  # takes 0.3 s

    spline = CubicSpline(road.knots_m, np.append(width_m, width_m[0]), bc_type="periodic")
    return lambda s_m: np.asarray(spline(np.asarray(s_m, dtype=np.float64) % road.length_m), dtype=np.float64)


def _read_rows(text: str, file: str) -> tuple[FloatArray, list[int]]:
    """The numbers (n, 4) and their line numbers; a first line with the column names is optional."""
    rows: list[list[float]] = []
    numbers: list[int] = []
    for number, row in enumerate(text.splitlines(), 1):
        content = row.lstrip("# ").strip()
        if not content or (not rows and [c.strip() for c in content.split(",")] == list(COLUMNS)):
            continue
        if row.lstrip().startswith("#"):
            continue
        rows.append(_read_row(row, f"{file}:{number}"))
        numbers.append(number)
    if len(rows) > 1 and rows[0][:2] == rows[-1][:2]:  # the closing point may be repeated
        del rows[-1], numbers[-1]
    if len(rows) < 4:
        raise ConfigError(f"{file}: expected at least 4 lines of {','.join(COLUMNS)}, got {len(rows)}")
    for previous, current, number in zip(rows, rows[1:], numbers[1:], strict=False):
        if previous[:2] == current[:2]:
            raise ConfigError(f"{file}:{number}: repeats the point of the previous line")
    return np.array(rows), numbers


def _read_row(row: str, place: str) -> list[float]:
    cells = row.split(",")
    if len(cells) != len(COLUMNS):
        raise ConfigError(f"{place}: expected the columns {','.join(COLUMNS)}, got {len(cells)}")
    values = []
    for name, cell in zip(COLUMNS, cells, strict=True):
        try:
            value = float(cell)
        except ValueError:
            raise ConfigError(f"{place}: {name}: {cell.strip()!r} is not a number") from None
        if not math.isfinite(value):
            raise ConfigError(f"{place}: {name}: expected a finite number, got {cell.strip()}")
        values.append(value)
    if min(values[2:]) < 0 or values[2] + values[3] <= 0:
        raise ConfigError(f"{place}: w_tr_right_m, w_tr_left_m: the widths must not be negative, nor both be 0")
    return values
