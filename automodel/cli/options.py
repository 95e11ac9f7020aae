"""Kinds of values on the command line, and the checks that come before any work."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import click

from automodel.config import ConfigError
from automodel.config.parts import PIPELINES, PartKind

FILE = click.Path(path_type=Path, readable=False)  # what reads it says more than that it cannot
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


Number = TypeVar("Number", float, None, "tuple[float, ...]")


def finite(ctx: click.Context, param: click.Parameter, value: Number) -> Number:
    """A callback that refuses NaN and infinity, which float() takes for numbers, in one value or in several."""
    for one in value if isinstance(value, tuple) else (value,):
        if one is not None and not math.isfinite(one):
            raise click.BadParameter(f"expected a finite number, got {one}", ctx, param)
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


class _Shard(click.ParamType):  # type: ignore[type-arg]
    """ "i/n" as (i, n)."""

    name = "i/n"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        first, _, count = value.partition("/")
        if not (first.isdigit() and count.isdigit() and 1 <= int(first) <= int(count)):
            self.fail(f"expected i/n with i from 1 to n, such as 1/4; got {value!r}", param, ctx)
        return int(first), int(count)


def SWEEP(function: Callable[..., int]) -> Callable[..., int]:
    """The options of a sweep, given to the command as `sweep`; it ends with 1 where cases were lost."""

    @functools.wraps(function)
    def command(
        jobs: int | None, keep: Path | None, shard: tuple[int, int] | None, scheduler: str | None, **rest: Any
    ) -> int:
        from automodel.console.workers import Sweep  # takes a while to load

        if shard is not None and keep is None:
            raise click.UsageError("--shard needs --keep DIR, for its results")
        if scheduler is not None and jobs is not None:
            raise click.UsageError("--jobs and --scheduler: the cluster has its own workers; give one")
        sweep = Sweep(jobs=jobs, keep=keep, shard=shard, scheduler=scheduler)
        code = function(sweep=sweep, **rest)
        return code or (1 if sweep.lost else 0)

    for option in (
        click.option("--scheduler", metavar="ADDRESS", help="Run on a Dask cluster, such as tcp://10.0.0.1:8786."),
        click.option("--shard", type=_Shard(), help="--keep: of n equal parts, run only the i-th."),
        click.option("--keep", type=FILE, metavar="DIR", help="Keep the results of finished cases; go on from there."),
        click.option("--jobs", type=click.IntRange(1), help="Processes (default: one a core)."),
    ):
        command = option(command)
    return command
