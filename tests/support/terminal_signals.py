"""The signals that a child of a test starts with."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def signals_of_a_terminal() -> Iterator[None]:
    """Start a process inside: SIGINT ends it, as it does not in background jobs; SIGUSR it ignores until it listens.

    Not by Popen's preexec_fn, which runs Python between fork and exec: beside a thread that holds a lock just then (a
    board's, a network's), the child may never get that far, and Popen waits for it.
    """
    wanted: dict[signal.Signals, Any] = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGUSR1: signal.SIG_IGN,
        signal.SIGUSR2: signal.SIG_IGN,
    }
    former = {number: signal.signal(number, handler) for number, handler in wanted.items()}
    try:
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
