"""What a calibration writes into car.toml: all of it or nothing, comments kept, a backup beside it."""

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
from automodel.console.messages import say

Values = Mapping[str, Mapping[str, object]]

RECORD_OF_SECTION = {  # section of car.toml -> its record [calibration.<what>]
    "camera.intrinsics": "camera",
    "camera.extrinsics": "ground",
    "camera.right.intrinsics": "stereo",
    "camera.right.extrinsics": "stereo",
    "link.servo": "servo",
    "link.motor": "odometry",
    "vehicle": "odometry",
}
_HEADER = re.compile(r"\s*\[\[?\s*([\w.\"' -]+?)\s*\]\]?\s*(#.*)?$")


def write_values(car_file: Path, values: Values, *, residual: str, method: str, dry_run: bool) -> None:
    """Write the values into car.toml, dated today, and report it; with `dry_run` report that nothing was written."""
    if dry_run:
        say(f"{car_file}: unchanged (--dry-run)")
        return
    backup = update_car_file(car_file, values, residual=residual, date=datetime.date.today(), method=method)
    sections = ", ".join(f"[{name}]" for name in values)
    say(f"{car_file}: {sections} written" + ("" if backup is None else f"; the old file is {backup}"))


def update_car_file(path: Path, values: Values, *, residual: str, date: datetime.date, method: str) -> Path | None:
    """Set keys of car.toml: `values` maps a section ("camera.intrinsics") to its keys. Returns the backup's path.

    Also writes the record `[calibration.<what>]` (date, method, residual; a lens's also its camera's mode) of every
    section in `RECORD_OF_SECTION`.
    Comments and order are kept; missing sections and a missing file are created. The new text must load as a car; it
    then replaces the file in one step, and the old file is kept beside it (`car.toml.bak`, then `car.toml.bak.2`, ...).

    Raises ConfigError, with nothing changed, where the file is invalid, would become invalid or cannot be written;
    ValueError where no section belongs to a calibration.
    """
    records = dict.fromkeys(RECORD_OF_SECTION[name] for name in values if name in RECORD_OF_SECTION)
    if not records:
        raise ValueError(f"values: expected a section that a calibration writes, got {', '.join(values)}")
    proof: dict[str, object] = {"date": date, "method": method, "residual": residual}
    wanted = {**values, **{f"calibration.{what}": proof for what in records}}
    target = Path(os.path.realpath(path))
    text = read_text(path) if os.path.lexists(target) else ""
    parse_car(text, str(path))
    new = _edited(text, {name: {k: _plain(v) for k, v in keys.items()} for name, keys in wanted.items()}, str(path))
    try:
        car = parse_car(new, str(path))
        eyes = {"camera": car.camera, "stereo": car.camera.eyes[-1]}
        modes = {f"calibration.{what}": {"mode": eye.mode} for what, eye in eyes.items() if what in records}
        if modes:  # a lens's figures hold for its camera's mode alone
            new = _edited(new, modes, str(path))
    except ConfigError as error:
        raise ConfigError(f"{error} (with the new values; {path} is unchanged)") from None
    try:
        return replace_file(target, new)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}; it is unchanged") from None


def check_car_file(path: Path) -> None:
    """Raise ConfigError where `update_car_file` would fail: an invalid or read-only file, a folder that does not exist.

    Called before the work. A file that does not exist yet is fine.
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
    """The value as Python's own numbers and lists: tomlkit writes numpy's and tuples differently."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value


def _edited(text: str, values: Values, file: str) -> str:
    """The text with the values in place, checked by parsing it."""
    wanted = parse_toml(text, file)
    for section, keys in values.items():
        table = wanted
        for part in section.split("."):
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise ConfigError(f"{file}: expected a table [{section}], got the value {part}")
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
    """New keys after the last key of their section, before comments there that may belong to the next section."""
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
    """Put lines at the end of a section; a missing section is created after those of the same first name."""
    places: list[tuple[str, int]] = [("", -1)]  # each section and its last line that is not a comment
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
    first = section.split(".")[0]
    related = [number for name, number in places if name.split(".")[0] == first]
    place = (related[-1] if related else len(lines) - 1) + 1
    before = [""] if place and lines[place - 1].strip() else []
    after = [""] if place < len(lines) and lines[place].strip() else []
    lines[place:place] = [*before, f"[{section}]", *new, *after]


def replace_file(target: Path, text: str) -> Path | None:
    """Replace a file in one step and return its backup's path, None for a new file; on OSError nothing is changed."""
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
        if part is not None and part.exists():  # otherwise the new file is in place, and the backup is kept
            part.unlink()
            if backup is not None:
                backup.unlink()
        raise
    with contextlib.suppress(OSError):  # some file systems cannot sync a folder
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    return backup


def _new_file(beside: Path, suffix: str, data: bytes) -> Path:
    """A new file with the first free name (`NAME.bak`, `NAME.bak.2`, ...), synced to the disk."""
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
    raise FileExistsError(errno.EEXIST, f"too many files {beside.name}{suffix}.*")
