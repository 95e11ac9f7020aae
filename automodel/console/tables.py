"""Rows of results: for people as lines or a table that fits the terminal, for programs as JSON (`--json`)."""

from __future__ import annotations

import csv
import json
import shutil
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from automodel import __version__
from automodel.output_files import output_text

Row = Mapping[str, Any]

# the last parts of a field's name, and the unit that they stand for; the longest that fits counts
UNITS = {
    "per_m": "1/m", "m": "m", "mm": "mm", "rad": "rad", "deg": "deg", "s": "s", "ms": "ms", "us": "us", "pct": "%",
    "mps": "m/s", "radps": "rad/s", "px": "px", "hz": "Hz", "v": "V", "mb": "MB",
}  # fmt: skip
SHORT = {"availability": "avail."}  # in the headers of tables
GAP = "  "
TEXT_WIDTH = 30  # the least width of a column of sentences, which are wrapped


def show(
    command: str, rows: Sequence[Row], as_json: bool, columns: Sequence[str] | None = None, machine: Row | None = None
) -> None:
    """Print `rows`, all with the same keys: as one JSON object, as lines (one row) or as a table (several).

    `columns` are the chief ones, the most important first; the others follow in their own order. A table has as many
    as fit the terminal, 80 characters where there is none; its last line names those that are only in the JSON. Where
    there are chief columns, others without any value are left out. `machine` is what they were measured on, for the
    JSON.
    """
    if as_json:
        on = {} if machine is None else {"machine": dict(machine)}
        click.echo(json.dumps({"version": __version__, "command": command, "rows": [dict(row) for row in rows], **on}))
        return
    if not rows:
        return
    columns = columns or ()
    names = list(dict.fromkeys((*columns, *rows[0])))
    if columns:
        names = [name for name in names if name in columns or any(row[name] is not None for row in rows)]
    width = terminal_width()
    lines = _fields(rows[0], names, width) if len(rows) == 1 else _table(rows, names, width)
    for line in lines:
        click.echo(line.rstrip())


def show_tables(
    command: str, tables: Mapping[str, Sequence[Row]], as_json: bool, columns: Mapping[str, Sequence[str]]
) -> None:
    """Print several tables; as JSON they are one list of rows, all with the same keys and the name of their table."""
    if as_json:
        keys = dict.fromkeys(key for rows in tables.values() for row in rows for key in row)
        show(command, [{"table": name, **keys, **row} for name, rows in tables.items() for row in rows], True)
        return
    for number, (name, rows) in enumerate(tables.items()):
        if number and rows:
            click.echo()
        show(command, rows, False, columns.get(name, ()))


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Rows as CSV with the keys of all of them as columns; None is empty. Raises ConfigError."""
    names = list(dict.fromkeys(key for row in rows for key in row))
    with output_text(path) as file:
        table = csv.DictWriter(file, names, lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def terminal_width() -> int:
    """Of the terminal, or as $COLUMNS says; 80 characters where there is neither."""
    return shutil.get_terminal_size((80, 24)).columns


def wrapped(text: str, width: int, indent: int) -> str:
    """`text` in lines of at most `width`, all but the first indented; words are never cut."""
    return textwrap.fill(text, max(width, indent + 20), subsequent_indent=" " * indent, break_long_words=False,
                         break_on_hyphens=False)  # fmt: skip


def _fields(row: Row, names: Sequence[str], width: int) -> list[str]:
    """A line a field: name, value, unit."""
    labels = {name: label_of(name) for name in names}
    indent = max(len(words) for words, _ in labels.values()) + len(GAP)
    return [
        wrapped(f"{words:<{indent}}{text_of(row[name])} {unit if row[name] is not None else ''}", width, indent)
        for name, (words, unit) in labels.items()
    ]


class _Column:
    """Header and cells of one column: its natural width, and the least that it can be printed in."""

    def __init__(self, name: str, rows: Sequence[Row]) -> None:
        words, unit = label_of(name)
        self.name, self.cells = name, [text_of(row[name]) for row in rows]
        self.left = any(isinstance(row[name], str) for row in rows)
        header = [*(SHORT.get(word, word) for word in words.split()), *([f"[{unit}]"] if unit else [])]
        longest = max(map(len, self.cells))
        self.is_text = longest > TEXT_WIDTH and any(" " in cell for cell in self.cells)
        self.width = max(TEXT_WIDTH if self.is_text else longest, *map(len, header), 1)
        self.header = textwrap.wrap(" ".join(header), self.width, break_long_words=False, break_on_hyphens=False)

    def lines(self, text: str) -> list[str]:
        """A cell's lines in the column's width."""
        return textwrap.wrap(text, self.width, break_long_words=False, break_on_hyphens=False) or [""]

    def padded(self, text: str) -> str:
        return text.ljust(self.width) if self.left else text.rjust(self.width)


def _table(rows: Sequence[Row], names: Sequence[str], width: int) -> list[str]:
    chosen: list[_Column] = []
    left = width + len(GAP)
    for column in (_Column(name, rows) for name in names):
        if column.width + len(GAP) <= left or not chosen:
            left -= column.width + len(GAP)
            chosen.append(column)
    chosen.sort(key=lambda column: column.is_text)  # sentences come last
    texts = [column for column in chosen if column.is_text]
    if texts:
        texts[-1].width += min(max(left, 0), max(map(len, texts[-1].cells)) - texts[-1].width)
    height = max(len(column.header) for column in chosen)
    headers = [[""] * (height - len(column.header)) + column.header for column in chosen]
    lines = [click.style(line.rstrip(), bold=True) for line in _joined(chosen, headers)]
    for index in range(len(rows)):
        lines += _joined(chosen, [column.lines(column.cells[index]) for column in chosen])
    cut = [name for name in names if name not in {column.name for column in chosen}]
    return [*lines, *([wrapped(f"only in --json: {', '.join(cut)}", width, 2)] if cut else [])]


def _joined(columns: Sequence[_Column], cells: Sequence[Sequence[str]]) -> list[str]:
    """The lines of one row of cells, each of which may have several."""
    return [
        GAP.join(column.padded(cell[at] if at < len(cell) else "") for column, cell in zip(columns, cells, strict=True))
        for at in range(max(map(len, cells)))
    ]


def label_of(name: str) -> tuple[str, str]:
    """What a person reads for a field's name, and its unit ("" without one)."""
    for suffix, unit in UNITS.items():
        if name.endswith(f"_{suffix}"):
            return name.removesuffix(f"_{suffix}").replace("_", " "), unit
    return name.replace("_", " "), ""


def text_of(value: object) -> str:
    """A value as people read it."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1000 else f"{value:.0f}"
    return str(value)
