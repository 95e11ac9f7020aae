"""Kinds of values on the command line, and the checks that come before any work."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from automodel.config import ConfigError


class PositiveNumber(click.ParamType):
    """A finite number above 0, `largest` at most; NaN and infinity are numbers to Python's float."""

    name = "number"

    def __init__(self, largest: float = math.inf) -> None:
        self._largest = largest

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The number in `value`."""
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        if not (0 < number < math.inf and number <= self._largest):
            limit = f" up to {self._largest:g}" if self._largest < math.inf else ""
            self.fail(f"{str(value)!r} where a number above 0{limit} is wanted", param, ctx)
        return number


FILE = click.Path(path_type=Path)
POSITIVE = PositiveNumber()


def check_outputs(outputs: Mapping[str, Path | None], inputs: Mapping[str, Path | None]) -> None:
    """Refuse what could not be written, or would overwrite an input, before any work is done; raises ConfigError.

    Both map what the user calls it ("--csv") to the path.
    """
    taken = {os.path.realpath(path): name for name, path in inputs.items() if path is not None}
    for name, path in outputs.items():
        if path is None:
            continue
        other = taken.setdefault(os.path.realpath(path), name)
        if other != name:
            raise ConfigError(f"{name} {path}: is the same file as {other}; choose another name")
        if path.is_dir():
            raise ConfigError(f"{name} {path}: is a folder; give the name of a file")
        folder = path.parent
        if not folder.is_dir():
            raise ConfigError(f"{name} {path}: there is no folder {folder}")
        if not os.access(path if path.exists() else folder, os.W_OK):
            raise ConfigError(f"{name} {path}: cannot be written; look at the permissions")
