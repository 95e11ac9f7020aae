"""Kinds of values on the command line, and the checks that come before any work."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path

import click

from automodel.config import ConfigError
from automodel.config.parts import PIPELINES, PartKind

FILE = click.Path(path_type=Path)
ABOVE_ZERO = click.FloatRange(0, min_open=True)  # together with `finite`: NaN and infinity pass every range


class PartName(click.ParamType):  # type: ignore[type-arg]
    """The name of a part: one of ours, of an installed package, or package.module:Class."""

    name = "part"

    def __init__(self, kind: PartKind) -> None:
        self._kind = kind

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        """Our own names, for --help."""
        return f"[{'|'.join(self._kind.names)}|module:Class]"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The name itself, or a usage error that lists what there is."""
        try:
            self._kind.check(self._kind.kind, value)
        except ValueError as error:
            self.fail(str(error).partition(": ")[2], param, ctx)
        return value


PIPELINE = PartName(PIPELINES)


def finite(ctx: click.Context, param: click.Parameter, value: float | None) -> float | None:
    """A callback that refuses NaN and infinity, which float() takes for numbers."""
    if value is not None and not math.isfinite(value):
        raise click.BadParameter(f"expected a finite number, got {value}", ctx, param)
    return value


RATE = click.option(
    "--rate",
    "rate_hz",
    type=click.FloatRange(0, 1000, min_open=True),
    callback=finite,
    help="Frames a second, for sources that do not say.",
)
FROM = click.option(
    "--from",
    "from_s",
    type=click.FloatRange(0),
    callback=finite,
    default=0.0,
    help="Begin so many seconds after the start.",
)
TO = click.option("--to", "to_s", type=click.FloatRange(0, min_open=True), callback=finite, help="End there.")


def check_outputs(outputs: Mapping[str, Path | None], inputs: Mapping[str, Path | None]) -> None:
    """Refuse what could not be written, or would overwrite an input, before any work is done; raises ConfigError.

    Both map what the user calls it ("--csv") to the path.
    """
    taken = {_identity(path): name for name, path in inputs.items() if path is not None}
    for name, path in outputs.items():
        if path is None:
            continue
        other = taken.setdefault(_identity(path), name)
        if other != name:
            raise ConfigError(f"{name} {path}: is the same file as {other}; choose another name")
        if path.is_dir():
            raise ConfigError(f"{name} {path}: is a folder; give the name of a file")
        folder = path.parent
        if not folder.is_dir():
            raise ConfigError(f"{name} {path}: there is no folder {folder}")
        there, device = path.exists(), path.exists() and not path.is_file()
        if (there and not os.access(path, os.W_OK)) or (not device and not os.access(folder, os.W_OK)):
            raise ConfigError(f"{name} {path}: cannot be written; look at the permissions")


def _identity(path: Path) -> object:
    """The same for all names of one file, linked ones too."""
    try:
        status = path.stat()
    except OSError:  # it is not there yet
        return os.path.realpath(path)
    return status.st_dev, status.st_ino
