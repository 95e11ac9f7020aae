"""TOML text -> frozen dataclasses, with errors that say file, line, key and what to do.

A key that is one of some words.
"""

from __future__ import annotations

import dataclasses
import datetime
import difflib
import math
import re
import stat
import sys
import types
import typing
from pathlib import Path
from typing import Any, TypeVar

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

from automodel.config.ranges import out_of_range

T = TypeVar("T")

MOST_TEXT_BYTES = 2**26  # [byte] 64 MiB: a race track's centreline has 1 MiB, the labels of TuSimple 20
_SHOWN = 40  # characters of a wrong value that an error quotes


class ConfigError(ValueError):
    """A file that a user wrote is wrong; the text is one line: where, what, what to do."""


def positive(section: object, *names: str) -> None:
    """Raise ValueError, the key first, unless these fields of a section are above 0."""
    for name in names:
        value = getattr(section, name)
        if not value > 0:
            raise ValueError(f"{name}: expected a positive number, got {value}")


def not_negative(section: object, *names: str) -> None:
    """Raise ValueError, the key first, unless these fields of a section are 0 or above."""
    for name in names:
        value = getattr(section, name)
        if not value >= 0:
            raise ValueError(f"{name}: expected a number >= 0, got {value}")


def check_file(path: str | Path, most_bytes: int | None = None) -> None:
    """Raise ConfigError for a device or a pipe, whose reading may never end, and for a larger file than `most_bytes`.

    What is missing, a folder or not readable is left to whoever opens it.
    """
    try:
        status = Path(path).stat()
    except (OSError, ValueError):
        return
    if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
        raise ConfigError(f"{path}: is a device or a pipe; give the name of a file")
    if most_bytes is not None and stat.S_ISREG(status.st_mode) and status.st_size > most_bytes:
        raise ConfigError(f"{path}: has {status.st_size / 2**20:.0f} MiB; at most {most_bytes / 2**20:.0f} are read")


def read_text(path: str | Path, most_bytes: int = MOST_TEXT_BYTES) -> str:
    """The file's text; raises ConfigError when it cannot be read or is larger than `most_bytes`."""
    check_file(path, most_bytes)
    try:
        return Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: cannot be read: not a text file in UTF-8") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None


def parse_toml(text: str, file: str) -> dict[str, Any]:
    """TOML -> dict; raises ConfigError with file and line."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        line = re.search(r"\(at line (\d+)", str(error))
        number = line.group(1) if line else len(text.splitlines())  # without a line it says "at end of document"
        raise ConfigError(f"{file}:{number}: not TOML: {re.sub(r' [(]at .*', '', str(error))}") from None
    except RecursionError:
        raise ConfigError(f"{file}: nested too deep; is this the right file?") from None
    except ValueError as error:  # of Python's int(): thousands of digits
        raise ConfigError(f"{file}: not TOML: {str(error).partition(';')[0]}") from None


def read_section(cls: type[T], table: dict[str, Any], text: str, file: str, path: tuple[str, ...] = ()) -> T:
    """Build the dataclass `cls` from a TOML table, checking names, types and finiteness.

    `path` is the table's place in the file (for errors); raises ConfigError.
    """
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    hints = typing.get_type_hints(cls)
    values: dict[str, Any] = {}
    for key, raw in table.items():
        if key not in fields:
            close = difflib.get_close_matches(key, fields, 1)
            hint = f"did you mean {close[0]}?" if close else f"known here: {', '.join(fields)}"
            raise ConfigError(f"{where(text, file, path, key)}: unknown key; {hint}")
        values[key] = _value(hints[key], raw, text, file, (*path, key))
    missing = [
        f.name
        for f in fields.values()
        if f.name not in values and f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
    ]
    if missing:
        raise ConfigError(f"{where(text, file, path, None)}: {missing[0]} is missing")
    try:
        return cls(**values)
    except ConfigError:
        raise
    except ValueError as error:
        key = str(error).split(":", 1)[0]
        raise ConfigError(f"{where(text, file, path, key if key in fields else None, error)}") from None


def _value(hint: Any, raw: Any, text: str, file: str, path: tuple[str, ...]) -> Any:
    def wrong(expected: str) -> ConfigError:
        return ConfigError(f"{where(text, file, path[:-1], path[-1])}: expected {expected}, got {_shown(raw)}")

    origin = typing.get_origin(hint)
    if origin is types.UnionType or origin is typing.Union:
        hint = next(a for a in typing.get_args(hint) if a is not type(None))
        origin = typing.get_origin(hint)
    if dataclasses.is_dataclass(hint):
        if not isinstance(raw, dict):
            raise wrong("a table")
        return read_section(typing.cast(type, hint), raw, text, file, path)
    if origin is tuple:
        inner = typing.get_args(hint)[0]
        if not isinstance(raw, list):
            raise wrong("a list")
        return tuple(_value(inner, item, text, file, path) for item in raw)
    if hint is bool:
        if not isinstance(raw, bool):
            raise wrong("true or false")
    elif hint is int:
        if not isinstance(raw, int) or isinstance(raw, bool):
            raise wrong("a whole number")
    elif hint is float and (not isinstance(raw, int | float) or isinstance(raw, bool) or not _finite(raw)):
        raise wrong("a finite number")
    elif hint is datetime.date:
        if not isinstance(raw, datetime.date) or isinstance(raw, datetime.datetime):
            raise wrong("a date (2026-01-31, without quotes)")
    elif hint is str and not isinstance(raw, str):
        raise wrong("a string")
    if hint in (int, float):
        if expected := out_of_range(path, raw):
            raise wrong(expected)
        return hint(raw)
    return raw


def _finite(number: float) -> bool:
    """Whether it is a number; a whole one of any size is."""
    return isinstance(number, int) or math.isfinite(number)


def _shown(raw: object) -> str:
    text = repr(raw)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def where(text: str, file: str, path: tuple[str, ...], key: str | None, error: object = None) -> str:
    """`file:line: [section] key` of a key in TOML text, for error messages; the line is left out where not found."""
    section = ".".join(path)
    line = _line_of(text, path, key)
    place = f"{file}:{line}" if line else file
    inside = f" [{section}]" if section else ""
    if error is not None:
        return f"{place}:{inside} {error}"
    return f"{place}:{inside} {key}" if key else f"{place}:{inside}".rstrip(":")


def _line_of(text: str, path: tuple[str, ...], key: str | None) -> int | None:
    current: tuple[str, ...] = ()
    header_line = None
    for number, line in enumerate(text.splitlines(), 1):
        header = re.match(r"\s*\[\[?\s*([^\]]+?)\s*\]\]?", line)
        if header:
            current = tuple(part.strip().strip("\"'") for part in header.group(1).split("."))
            if current == path and header_line is None:
                header_line = number
            if key is not None and current == (*path, key):
                return number
            continue
        assigned = re.match(r"\s*([\w.\"'-]+)\s*=", line)
        if assigned and key is not None:
            dotted = tuple(part.strip("\"'") for part in assigned.group(1).split("."))
            if (*current, *dotted)[: len(path) + 1] == (*path, key):
                return number
            if current + dotted == path:  # an inline table
                return number
    return header_line


def one_of(name: str, value: str, choices: tuple[str, ...]) -> None:
    """Raises ValueError, with the nearest word, for a value that is none of the choices."""
    if value not in choices:
        close = difflib.get_close_matches(value, choices, 1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {value!r}{hint}")
