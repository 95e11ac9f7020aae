"""Writes what a calibration found into car.toml: the whole of it or nothing, comments kept, a backup beside it."""

from __future__ import annotations

import contextlib
import datetime
import errno
import os
import re
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from automodel.config import ConfigError, parse_car
from automodel.config.toml_reader import parse_toml, read_text

__all__ = ["RECORD_OF_SECTION", "check_car_file", "update_car_file"]

Values = Mapping[str, Mapping[str, object]]

RECORD_OF_SECTION = {  # the record [calibration.<what>] that vouches for a section of car.toml
    "camera.intrinsics": "camera",
    "camera.extrinsics": "ground",
    "camera.right.intrinsics": "stereo",
    "camera.right.extrinsics": "stereo",
    "link.servo": "servo",
    "link.motor": "odometry",
    "vehicle": "odometry",
}
_HEADER = re.compile(r"\s*\[\[?\s*([\w.\"' -]+?)\s*\]\]?\s*(#.*)?$")


def update_car_file(path: Path, values: Values, *, residual: str, date: datetime.date, method: str) -> Path | None:
    """Set keys of car.toml: `values` maps a section ("camera.intrinsics") to its keys.

    Also writes the record `[calibration.<what>]` with date, method and residual for every calibration whose section is
    among the values (`RECORD_OF_SECTION`). Comments and order stay; sections and the file itself are made where they
    are missing. The new text must load as a car before it takes the file's place in one step; the old file is kept
    beside it (`car.toml.bak`, then `car.toml.bak.2`, ...). Returns the backup's path, None where there was no file.

    Raises ConfigError, with everything as it was, where the file is wrong already, would be wrong afterwards or cannot
    be written; ValueError where no section is one of a calibration.
    """
    records = dict.fromkeys(RECORD_OF_SECTION[name] for name in values if name in RECORD_OF_SECTION)
    if not records:
        raise ValueError(f"values: of {', '.join(values)} none is a section that a calibration writes")
    proof: dict[str, object] = {"date": date, "method": method, "residual": residual}
    wanted = {**values, **{f"calibration.{what}": proof for what in records}}
    target = Path(os.path.realpath(path))
    text = read_text(path) if os.path.lexists(target) else ""
    parse_car(text, str(path))
    new = _edited(text, {name: {k: _plain(v) for k, v in keys.items()} for name, keys in wanted.items()}, str(path))
    try:
        parse_car(new, str(path))
    except ConfigError as error:
        raise ConfigError(f"{error} (with the new values; {path} is as it was)") from None
    try:
        return _replace(target, new)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}; it is as it was") from None


def check_car_file(path: Path) -> None:
    """Raise ConfigError where `update_car_file` would: a file that is wrong or read-only, a folder that is not there.

    For before the work; a file that is not there yet is none the worse for it.
    """
    target = Path(os.path.realpath(path))
    if target.exists():
        parse_car(read_text(path), str(path))
    elif not target.parent.is_dir():
        raise ConfigError(f"{path}: there is no folder {target.parent}")
    if (target.exists() and _read_only(target)) or not os.access(target.parent, os.W_OK):
        raise ConfigError(f"{path}: cannot be written; look at the permissions of the file and its folder")


def _read_only(target: Path) -> bool:
    return not target.stat().st_mode & 0o222 or not os.access(target, os.W_OK)  # root may write read-only files too


def _plain(value: object) -> object:
    """Numbers and lists of Python's own: numpy's and tuples are written otherwise by tomlkit."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value


def _edited(text: str, values: Values, file: str) -> str:
    """The text with the values in place, proved by reading it again."""
    wanted = parse_toml(text, file)
    for section, keys in values.items():
        table = wanted
        for part in section.split("."):
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise ConfigError(f"{file}: {part} where a table [{section}] is wanted")
        table.update(keys)
    for edit in (_by_lines, _by_document):
        with contextlib.suppress(ConfigError, TOMLKitError):
            new = edit(text, values)
            if parse_toml(new, file) == wanted:
                return new
    raise ConfigError(f"{file}: cannot be edited; write its sections as [section] with one key a line")


def _by_document(text: str, values: Values) -> str:
    """New keys wherever tomlkit puts them."""
    document = tomlkit.parse(text)
    for section, keys in values.items():
        table: Any = document
        for part in section.split("."):
            if part not in table:
                table[part] = tomlkit.table()
            table = table[part]
        for key, value in keys.items():
            table[key] = value
    return tomlkit.dumps(document)


def _by_lines(text: str, values: Values) -> str:
    """New keys behind the last key of their section, before the comments there that may speak of the next section."""
    document = tomlkit.parse(text)
    missing: list[tuple[str, dict[str, object]]] = []
    for section, keys in values.items():
        table: Any = document
        for part in section.split("."):
            table = table.get(part, {})
        for key in [key for key in keys if key in table]:
            table[key] = keys[key]
        missing.append((section, {key: value for key, value in keys.items() if key not in table}))
    lines = tomlkit.dumps(document).rstrip("\n").split("\n") if text.strip() else []
    for section, new in missing:
        if new:
            _insert(lines, section, [f"{key} = {tomlkit.item(value).as_string()}" for key, value in new.items()])
    return "\n".join(lines) + "\n"


def _insert(lines: list[str], section: str, new: list[str]) -> None:
    """Put lines at the end of a section, which is made behind its nearest relatives where it is missing."""
    places: list[tuple[str, int]] = [("", -1)]  # of each section's last line that is no comment
    for number, line in enumerate(lines):
        header = _HEADER.match(line)
        if header:
            places.append((re.sub(r"[\s\"']", "", header.group(1)), number))
        elif line.strip() and not line.lstrip().startswith("#"):
            places[-1] = (places[-1][0], number)
    own = [number for name, number in places if name == section]
    if own:
        lines[own[0] + 1 : own[0] + 1] = new
        return
    family = section.split(".")[0]
    relatives = [number for name, number in places if name.split(".")[0] == family]
    place = (relatives[-1] if relatives else len(lines) - 1) + 1
    before = [""] if place and lines[place - 1].strip() else []
    after = [""] if place < len(lines) and lines[place].strip() else []
    lines[place:place] = [*before, f"[{section}]", *new, *after]


def _replace(target: Path, text: str) -> Path | None:
    """Put the text in the file's place in one step, the old one beside it; on any error nothing is left changed."""
    old = target.read_bytes() if target.exists() else None
    mode = stat.S_IMODE(target.stat().st_mode) if old is not None else 0o644
    if old is not None and _read_only(target):
        raise PermissionError(errno.EACCES, "the file is read-only")
    part = backup = None
    try:
        part = _new_file(target, ".new", text.encode())
        part.chmod(mode)
        backup = None if old is None else _new_file(target, ".bak", old)
        os.replace(part, target)
    except BaseException:
        if part is not None and part.exists():  # else the new file is in place, and the backup is wanted
            part.unlink()
            if backup is not None:
                backup.unlink()
        raise
    with contextlib.suppress(OSError):  # some file systems cannot sync a folder; the file is in its place all the same
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    return backup


def _new_file(beside: Path, suffix: str, data: bytes) -> Path:
    """A file of the first free name (`NAME.bak`, `NAME.bak.2`, ...), on the disk when this returns."""
    for number in range(1, 100_000):
        name = beside.with_name(f"{beside.name}{suffix}{f'.{number}' if number > 1 else ''}")
        try:
            descriptor = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        except FileExistsError:
            continue
        try:
            with open(descriptor, "wb") as stream:
                stream.write(data)
                stream.flush()
                os.fsync(descriptor)
        except BaseException:
            name.unlink()
            raise
        return name
    raise FileExistsError(errno.EEXIST, f"there are too many files {beside.name}{suffix}.*")
