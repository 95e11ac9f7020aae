"""A key that is one of some words."""

from __future__ import annotations

import difflib


def one_of(name: str, value: str, choices: tuple[str, ...]) -> None:
    """Raises ValueError, with the nearest word, for a value that is none of the choices."""
    if value not in choices:
        close = difflib.get_close_matches(value, choices, 1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"{name}: {value!r} is none of {', '.join(choices)}{hint}")
