"""Figures for people (a table) and for programs (`--json`: one object on stdout)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from automodel import __version__

Row = Mapping[str, Any]


def show(command: str, rows: Sequence[Row], as_json: bool, columns: Sequence[str] | None = None) -> None:
    """Print `rows`, all with the same keys; `columns` picks and orders those of the table."""
    if as_json:
        print(json.dumps({"version": __version__, "command": command, "rows": [dict(row) for row in rows]}))
        return
    if not rows:
        return
    from rich.console import Console
    from rich.table import Table

    names = list(columns or rows[0])
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in names:
        table.add_column(name, justify="left" if isinstance(rows[0][name], str) else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(_text(row[name]) for name in names))
    console = Console()
    if not console.is_terminal:
        console = Console(width=40 + 20 * len(names))  # piped output is plain, and never cut to a terminal's width
    console.print(table)


def _text(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1000 else f"{value:.0f}"
    return str(value)
