"""A donkeycar tub (version 2) as a source.

A tub is a folder: `manifest.json` with five JSON lines (inputs, types, metadata, manifest metadata, catalogs),
`catalog_N.catalog` with one JSON object a line, and `images/`.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from automodel.signals import Frame
from automodel.sources.errors import EndOfSource, SourceError
from automodel.sources.pictures import read_picture

_IMAGE, _ANGLE, _THROTTLE = "cam/image_array", "user/angle", "user/throttle"


@dataclass(frozen=True, slots=True, kw_only=True)
class TubRecord:
    """One line of a catalog: the picture's file and what the person did, -1 .. 1, None where not recorded.

    Donkeycar's angle is positive to the *right*; it is given as recorded.
    """

    index: int
    picture: Path
    angle: float | None
    throttle: float | None


def is_tub(folder: str | Path) -> bool:
    """Whether the folder is a tub (of version 2)."""
    return (Path(folder) / "manifest.json").is_file()


class TubSource:
    """The pictures of a tub at a given rate: the timestamps in tubs are those of the file writer, not the camera's.

    Records in `deleted_indexes` are left out and leave a gap in time. Raises SourceError with file and line for a
    manifest or catalog that is missing or damaged, and (from `read`) for a damaged picture.
    """

    def __init__(self, folder: str | Path, rate_hz: float = 20.0, colour: bool = False) -> None:
        self.folder, self.rate_hz, self.colour = Path(folder), rate_hz, colour
        if not rate_hz > 0:
            raise ValueError(f"rate_hz: {rate_hz} where a positive number is wanted")
        self.records = read_tub(self.folder)
        self._next = 0

    def read(self, timeout_s: float) -> Frame:
        """The next picture; raises EndOfSource after the last."""
        if self._next >= len(self.records):
            raise EndOfSource
        record = self.records[self._next]
        since = record.index - self.records[0].index
        image = read_picture(record.picture, self.colour)
        frame = Frame(t_ns=round(since * 1e9 / self.rate_hz), index=self._next, image=image)
        self._next += 1
        return frame

    def record_of(self, frame: Frame) -> TubRecord:
        """What the tub says beside a frame that this source delivered."""
        return self.records[frame.index]

    def close(self) -> None:
        """No more frames."""
        self._next = len(self.records)


def read_tub(folder: Path) -> tuple[TubRecord, ...]:
    """The records of a tub in order, the deleted ones left out; raises SourceError."""
    manifest = folder / "manifest.json"
    lines = _json_lines(manifest)
    catalogs = lines[-1][1] if lines else None
    if not isinstance(catalogs, dict) or not isinstance(catalogs.get("paths"), list):
        raise SourceError(f'{manifest}: not a tub of version 2: its last line has no "paths" list')
    deleted = catalogs.get("deleted_indexes", [])
    if not isinstance(deleted, list):
        raise SourceError(f"{manifest}:{lines[-1][0]}: deleted_indexes is not a list")
    records = []
    for name in catalogs["paths"]:
        path = folder / str(name)
        records += [_record(folder, path, number, entry) for number, entry in _json_lines(path)]
    kept = tuple(r for r in records if r.index not in set(deleted))
    if not kept:
        raise SourceError(f"{folder}: the tub holds no records (or all of them are deleted)")
    return kept


def _json_lines(path: Path) -> list[tuple[int, Any]]:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise SourceError(f"{path}: no such file; is this a donkeycar tub of version 2?") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: cannot be read: {error}") from error
    values = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        try:
            values.append((number, json.loads(line)))
        except json.JSONDecodeError:
            raise SourceError(f"{path}:{number}: not JSON: the line is cut or damaged; delete it") from None
    return values


def _record(folder: Path, path: Path, number: int, entry: Any) -> TubRecord:
    if not isinstance(entry, dict) or not isinstance(entry.get(_IMAGE), str):
        raise SourceError(f"{path}:{number}: a record without {_IMAGE}")
    index = entry.get("_index")
    if not isinstance(index, int) or isinstance(index, bool):
        raise SourceError(f"{path}:{number}: a record without _index")
    return TubRecord(
        index=index,
        picture=folder / "images" / entry[_IMAGE],
        angle=_number(path, number, entry, _ANGLE),
        throttle=_number(path, number, entry, _THROTTLE),
    )


def _number(path: Path, number: int, entry: dict[str, Any], key: str) -> float | None:
    value = entry.get(key)
    if value is None:
        return None
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        raise SourceError(f"{path}:{number}: {key} is {value!r} where a number is wanted")
    return float(value)
