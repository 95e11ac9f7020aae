"""Output files that appear whole or not at all: written under a temporary name beside the target, then renamed."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from automodel.config import ConfigError


@contextlib.contextmanager
def output_path(target: str | Path) -> Iterator[Path]:
    """The path to write a file to; it becomes `target` when the block ends, and is removed when the block raises.

    An older file at `target` stays until then. The temporary name keeps the suffix. What is not a regular file (a pipe,
    /dev/stdout) is written directly. A block that writes no file leaves `target` as it is. Raises ConfigError where the
    file cannot be written.
    """
    path = Path(target).resolve()
    direct = path.exists() and not path.is_file()
    part = path if direct else path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        yield part
        if not direct and part.exists():
            part.replace(path)
    except BaseException as error:
        if not direct:
            with contextlib.suppress(OSError):
                part.unlink()
        if not isinstance(error, OSError) or isinstance(error, BrokenPipeError) or error.errno is None:
            raise
        if error.filename not in (None, str(part)):  # the block uses other files too
            raise
        raise ConfigError(f"{target}: cannot be written: {error.strerror}") from None


@contextlib.contextmanager
def output_text(target: str | Path) -> Iterator[TextIO]:
    """A text file (UTF-8, line ends as written) open for writing; it becomes `target` as in `output_path`.

    Raises ConfigError where it cannot be written.
    """
    with output_path(target) as path, open(path, "w", encoding="utf-8", newline="") as file:
        yield file
