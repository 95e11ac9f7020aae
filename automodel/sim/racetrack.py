"""Race tracks at full scale, in the form of TUM's racetrack database: `x_m,y_m,w_tr_right_m,w_tr_left_m`, closed."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from automodel.config.toml_reader import ConfigError, read_text
from automodel.curves import SplineCurve
from automodel.sim.paint import Grain, Paint, broken_spans, on_line, paint_line
from automodel.sim.roadside import build_roadside
from automodel.sim.track import Lane, Track, lane_between, reversed_lane
from automodel.sim.track_sections import BrokenLines, Marking, RoadsideSection
from automodel.types import FloatArray

COLUMNS = ("x_m", "y_m", "w_tr_right_m", "w_tr_left_m")
EDGE = Marking(style="solid", width_m=0.15)
MARGIN_M = 20.0  # of floor around the track
_SHARPEST = 0.85  # half a road's width, as a share of the bend's radius, at most
_TAPER = 3  # points over which a road becomes narrower


def read_racetrack(
    path: str | Path, broken: BrokenLines | None = None, roadside: RoadsideSection | None = None
) -> Track:
    """The track in a CSV file; raises ConfigError with file and line.

    The file's line need not be in the middle between its edges; the lane's centerline is. There is one lane, driven
    in both directions, with a solid white line at each edge. `broken` takes stretches of the lines away, `roadside`
    lays kerbs; without it the asphalt goes on to the floor's edge.
    """
    rows, numbers = _read_rows(read_text(path), str(path))
    try:
        middle, width_m = recentred(rows[:, :2], rows[:, 3], rows[:, 2])
        road = SplineCurve(middle, closed=True)
        forward = lane_between(road, _periodic_width(road, width_m))
        painted = _painted(forward, float(width_m.mean()), broken)
    except ValueError as error:
        raise ConfigError(f"{path}:{numbers[0]}: these points and widths make no road: {error}") from None
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
        gaps = [(on_line(line, begin), on_line(line, end)) for begin, end in spans.get(name, [])]
        painted += paint_line(line, EDGE, gaps, Grain.of_lane(mean_width_m))
    return tuple(painted)


def recentred(points_m: FloatArray, left_m: FloatArray, right_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The middle (n, 2) between the edges of a closed line of points (n, 2), and the width (n,) across the middle [m].

    `left_m`, `right_m` (n,) are the distances of the edges from the line of points, along its normals. Where a hairpin
    is so tight that an edge would fold back, the road is made narrower.
    """
    line = SplineCurve(points_m, closed=True)
    theta = line.heading(line.knots_m[:-1])
    normal = np.stack((-np.sin(theta), np.cos(theta)), axis=-1)
    middle = points_m + 0.5 * (left_m - right_m)[:, None] * normal
    course = SplineCurve(middle, closed=True)
    lean = course.heading(course.knots_m[:-1]) - theta  # the middle's normals lean by so much
    return middle, _narrowed(course, (left_m + right_m) * np.cos(lean))


def _narrowed(course: SplineCurve, width_m: FloatArray) -> FloatArray:
    """The widths (n,) with those cut that would fold an edge back, changing smoothly along the road."""
    s = np.linspace(0.0, course.length_m, 8 * len(width_m), endpoint=False)
    bend = np.abs(course.curvature(s)).reshape(len(width_m), 8)
    sharpest = np.maximum(bend.max(axis=1), np.roll(bend, 1, axis=0).max(axis=1))
    allowed = 2.0 * _SHARPEST / np.maximum(sharpest, 1e-9)
    if (width_m <= allowed).all():
        return width_m
    around = range(-_TAPER, _TAPER + 1)
    lowest = np.min([np.roll(np.minimum(width_m, allowed), k) for k in around], axis=0)
    tapered = np.mean([np.roll(lowest, k) for k in around], axis=0)
    near = np.any([np.roll(width_m > allowed, k) for k in range(-2 * _TAPER, 2 * _TAPER + 1)], axis=0)
    return np.where(near, np.minimum(tapered, width_m), width_m)


def _periodic_width(road: SplineCurve, width_m: FloatArray) -> Callable[[ArrayLike], FloatArray]:
    spline = CubicSpline(road.knots_m, np.append(width_m, width_m[0]), bc_type="periodic")
    return lambda s_m: np.asarray(spline(np.asarray(s_m, dtype=np.float64) % road.length_m), dtype=np.float64)


def _read_rows(text: str, file: str) -> tuple[FloatArray, list[int]]:
    """The numbers (n, 4) and the lines that they stand in; a first line with the columns' names may be there."""
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
        raise ConfigError(f"{file}: {len(rows)} points; a closed track has 4 or more lines of {','.join(COLUMNS)}")
    for previous, current, number in zip(rows, rows[1:], numbers[1:], strict=False):
        if previous[:2] == current[:2]:
            raise ConfigError(f"{file}:{number}: repeats the point of the line before")
    return np.array(rows), numbers


def _read_row(row: str, place: str) -> list[float]:
    cells = row.split(",")
    if len(cells) != len(COLUMNS):
        raise ConfigError(f"{place}: {len(cells)} columns where {','.join(COLUMNS)} are wanted")
    values = []
    for name, cell in zip(COLUMNS, cells, strict=True):
        try:
            value = float(cell)
        except ValueError:
            raise ConfigError(f"{place}: {name}: {cell.strip()!r} is not a number") from None
        if not math.isfinite(value):
            raise ConfigError(f"{place}: {name}: {cell.strip()} where a finite number is wanted")
        values.append(value)
    if min(values[2:]) < 0 or values[2] + values[3] <= 0:
        raise ConfigError(f"{place}: w_tr_right_m, w_tr_left_m: the widths must not be negative, nor both be 0")
    return values
