"""Tells the person at the terminal what happens in a run, as it happens."""

from __future__ import annotations

import contextlib
import sys

from automodel.interfaces import Clock
from automodel.signals import Event


def say(line: str) -> None:
    """A line on stderr; a terminal that is gone is no reason to stop a car."""
    if sys.stderr is not None:  # None: closed by the parent process; print would take stdout
        with contextlib.suppress(OSError, ValueError):  # ValueError: it is closed
            print(line, file=sys.stderr)


class EventTeller:
    """A line an event, with the seconds since it was made; kinds in `quiet` are left out."""

    def __init__(self, clock: Clock, quiet: frozenset[str]) -> None:
        self._start_ns, self._quiet = clock.now_ns(), quiet

    def __call__(self, event: Event) -> None:
        """Tell of one event."""
        if event.kind not in self._quiet:
            say(f"{(event.t_ns - self._start_ns) * 1e-9:.2f} s: {event.kind}: {event.text}")
