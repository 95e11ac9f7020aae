"""What `automodel bench ... --json` printed, as tables of a report."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from automodel.config import ConfigError
from automodel.console.tables import label_of, text_of
from automodel.viewer.report_page import ResultTable

SUFFIX = ".json"
EXPECTED = "expected what automodel bench ... --json prints"
PAPER = "paper_"  # before the name of a result: the paper's own figure


def bench_tables(path: Path) -> list[ResultTable]:
    """The tables of a file, one or more; raises ConfigError, in one line, for what is no such file."""
    results = _read(path)
    rows: list[dict[str, Any]] = results["rows"]
    origin = f"automodel {results.get('command')}, version {results.get('version')}"
    machine = results.get("machine")
    if isinstance(machine, dict) and machine.get("model"):
        origin += f", on {machine['model']}"
    rows = [{**row, "table": None if row.get("table") is None else str(row["table"])} for row in rows]
    names = list(dict.fromkeys(row["table"] for row in rows))
    return [
        _table(
            path.name if name is None else f"{path.name}: {name}",
            origin,
            [{key: value for key, value in row.items() if key != "table"} for row in rows if row["table"] == name],
        )
        for name in names
    ]


def _read(path: Path) -> dict[str, Any]:
    try:
        results = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError):  # JSONDecodeError and UnicodeDecodeError are ValueErrors
        raise ConfigError(f"{path}: not a JSON file; {EXPECTED}") from None
    rows = results.get("rows") if isinstance(results, dict) else None
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ConfigError(f"{path}: has no list of rows; {EXPECTED}")
    if not rows:
        raise ConfigError(f"{path}: has no results: its list of rows is empty")
    return results


def _table(title: str, origin: str, rows: Sequence[Mapping[str, Any]]) -> ResultTable:
    """Columns that say nothing are left out; a paper's figure stands behind our own."""
    keys = [key for key in dict.fromkeys(key for row in rows for key in row) if _said(rows, key)]
    place = {key: number for number, key in enumerate(keys)}
    columns = sorted(keys, key=lambda key: (place.get(_own(key), place[key]), key != _own(key)))
    largest = {key: _largest(rows, [other for other in columns if _own(other) == _own(key)]) for key in columns}
    return ResultTable(
        title=title,
        origin=origin,
        header=tuple(_heading(key) for key in columns),
        rows=tuple(tuple(_cell(row.get(key), largest[key]) for key in columns) for row in rows),
    )


def _own(key: str) -> str:
    """The name of our own result that a paper's figure stands beside."""
    return key.removeprefix(PAPER)


def _said(rows: Sequence[Mapping[str, Any]], key: str) -> bool:
    return any(row.get(key) is not None for row in rows)


def _heading(key: str) -> str:
    words, unit = label_of(key)
    return f"{words} [{unit}]" if unit else words


def _cell(value: Any, largest: float) -> tuple[str, float]:
    """The text, and the share of the column's largest value that a bar behind it shows."""
    number = _number(value)
    return text_of(value), 0.0 if number is None or not largest else abs(number) / largest


def _largest(rows: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> float:
    """The largest value of a measured column and its paper's; 0 where bars would say nothing, as for a seed."""
    values = [number for key in keys for row in rows if (number := _number(row.get(key))) is not None]
    measured = len(values) > 1 and any(not value.is_integer() for value in values)
    return max(map(abs, values)) if measured else 0.0


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:  # a whole number of hundreds of digits
        return None
    return number if math.isfinite(number) else None
