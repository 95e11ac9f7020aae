"""Track files: TOML -> checked sections and the road's reference line."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Any

import numpy as np

from automodel.config.toml_reader import ConfigError, parse_toml, read_section, where
from automodel.curves import Curve, JoinedCurve
from automodel.sim.track_sections import (
    PIECES,
    ArcPiece,
    Box,
    Gap,
    LanesSection,
    Marking,
    Piece,
    StopLine,
    TrackFile,
    WidthAt,
)

CLOSING_GAP_M = 1e-3
CLOSING_TURN_RAD = math.radians(0.1)
_LISTS: dict[str, type[StopLine] | type[Gap] | type[Box] | type[WidthAt]] = {
    "stop_lines": StopLine,
    "gaps": Gap,
    "obstacles": Box,
    "widths": WidthAt,
}


def read_track(text: str, file: str) -> tuple[TrackFile, JoinedCurve]:
    """The sections of a track file and its road's reference line; `file` is its name in errors.

    Raises ConfigError.
    """
    table = parse_toml(text, file)
    raw = {name: _tables(table.pop(name, []), name, text, file) for name in ("pieces", *_LISTS)}
    if not raw["pieces"]:
        raise ConfigError(f"{where(text, file, (), 'pieces')}: empty; one [[pieces]] or more is wanted")
    sections = read_section(TrackFile, table, text, file)
    if sections.lanes.count == 1:
        if "centre" in table.get("markings", {}) and sections.markings.centre.style != "none":
            place = where(text, file, ("markings", "centre"), "style")
            raise ConfigError(f"{place}: a single lane has no centre line; leave it out")
        none = dataclasses.replace(sections.markings, centre=Marking(style="none"))
        sections = dataclasses.replace(sections, markings=none)
    road = _join([_read_piece(entry, part, file, sections.lanes) for entry, part in raw["pieces"]], sections)
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
        raise ConfigError(f"{where(text, file, (), 'widths')}: a single lane alone has widths; leave them out")
    return dataclasses.replace(sections, **lists), road


def _tables(raw: Any, name: str, text: str, file: str) -> list[tuple[dict[str, Any], str]]:
    """Each table of an array, with the text in which its line is found: all but its own lines left blank."""
    if not isinstance(raw, list) or not all(isinstance(entry, dict) for entry in raw):
        raise ConfigError(f"{where(text, file, (), name)}: a list of tables is wanted, each under [[{name}]]")
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
        raise ConfigError(f"{place}: {kind!r} where one of {', '.join(PIECES)} is wanted")
    piece: Piece = read_section(cls, {k: v for k, v in raw.items() if k != "kind"}, text, file, ("pieces",))
    if piece.sharpest_per_m * lanes.half_road_m >= 1.0:
        place = where(text, file, ("pieces",), "radius_m" if isinstance(piece, ArcPiece) else "start_per_m")
        raise ConfigError(
            f"{place}: a bend of radius {1.0 / piece.sharpest_per_m:.3g} m folds the edge of a road that is"
            f" {2.0 * lanes.half_road_m:.3g} m wide; more than {lanes.half_road_m:.3g} m is wanted"
        )
    return piece


def _join(pieces: list[Piece], sections: TrackFile) -> JoinedCurve:
    x_m, y_m, heading_rad = sections.origin.x_m, sections.origin.y_m, sections.origin.heading_rad
    curves: list[Curve] = []
    for piece in pieces:
        curve = piece.curve(x_m, y_m, heading_rad)
        curves.append(curve)
        x_m, y_m = (float(v) for v in curve.position(curve.length_m))
        heading_rad = float(curve.heading(curve.length_m))
    return JoinedCurve(curves, sections.closed)


def _check_closed(road: JoinedCurve, place: str) -> None:
    first, last = road.pieces[0], road.pieces[-1]
    gap_m = float(np.hypot(*(last.position(last.length_m) - first.position(0.0))))
    turn_rad = abs(math.remainder(float(last.heading(last.length_m)) - float(first.heading(0.0)), 2.0 * math.pi))
    if gap_m > CLOSING_GAP_M or turn_rad > CLOSING_TURN_RAD:
        raise ConfigError(
            f"{place}: true, but the road's end misses its beginning by {1e3 * gap_m:.2f} mm and"
            f" {math.degrees(turn_rad):.3f} deg; at most {1e3 * CLOSING_GAP_M:.0f} mm and"
            f" {math.degrees(CLOSING_TURN_RAD):.1f} deg are allowed"
        )
