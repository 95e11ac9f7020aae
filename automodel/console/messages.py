"""Messages for a person, on stderr."""

from __future__ import annotations

import contextlib
import sys

from automodel.interfaces import Clock
from automodel.signals import Event


def say(line: str) -> None:
    """Print a line on stderr; a closed terminal is no error: it must not stop a car."""
    if sys.stderr is not None:  # None: closed by the parent process; print would take stdout
        with contextlib.suppress(OSError, ValueError):  # ValueError: it is closed
            print(line, file=sys.stderr)


class EventPrinter:
    """Prints a line for each event, with the seconds since this was constructed; kinds in `quiet` are left out."""

    def __init__(self, clock: Clock, quiet: frozenset[str]) -> None:
        self._start_ns, self._quiet = clock.now_ns(), quiet

    def __call__(self, event: Event) -> None:
        """Print one event."""
        if event.kind not in self._quiet:
            say(f"{(event.t_ns - self._start_ns) * 1e-9:.2f} s: {event.kind}: {event.text}")
