"""Progress of long work, on stderr and only where that is a terminal."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator

REDRAW_S = 0.1


@contextlib.contextmanager
def progress(title: str, total: float | None, threaded: bool = True) -> Iterator[Callable[..., None]]:
    """A bar on a terminal; the function it gives advances it (by 1 without an argument).

    Without `threaded` only these calls redraw the bar: no thread runs beside what is being measured.
    """
    if sys.stderr is None or not sys.stderr.isatty():  # None: closed by the parent process
        yield lambda advance=1.0: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True, auto_refresh=threaded) as bar:
        task = bar.add_task(title, total=total)
        due_s = 0.0

        def advance(by: float = 1.0) -> None:
            nonlocal due_s
            bar.advance(task, by)
            if not threaded and time.monotonic() >= due_s:
                bar.refresh()
                due_s = time.monotonic() + REDRAW_S

        yield advance
