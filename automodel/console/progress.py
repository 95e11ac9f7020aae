"""Progress of long work, on stderr and only where that is a terminal."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def progress(what: str, total: float | None) -> Iterator[Callable[..., None]]:
    """A function to call after each step (`advance`, default 1), with a bar where a person watches."""
    if sys.stderr is None or not sys.stderr.isatty():  # None: closed by whoever started us
        yield lambda advance=1.0: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda advance=1.0: bar.advance(task, advance)
