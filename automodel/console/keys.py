"""The Enter key, by which a person arms the car."""

from __future__ import annotations

import select
import sys
import types

from automodel.console.messages import say


def has_terminal() -> bool:
    """Whether stdin is a terminal."""
    return sys.stdin is not None and not sys.stdin.closed and sys.stdin.isatty()


class ArmKey:
    """Whether Enter was pressed; as a context it prints first what the key does. Never pressed without a terminal."""

    def __init__(self, prompt: str = "press Enter to arm, Ctrl-C to stop") -> None:
        self._prompt = prompt
        self._terminal = sys.stdin if has_terminal() else None

    def __enter__(self) -> ArmKey:
        say(self._prompt if self._terminal else "no terminal to arm from; Ctrl-C stops")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: types.TracebackType | None
    ) -> None:
        """Leave the terminal as it is."""

    def pressed(self) -> bool:
        """Whether Enter was pressed since the last call; never waits."""
        if self._terminal is None:
            return False
        try:
            return bool(select.select([self._terminal], [], [], 0)[0]) and self._terminal.readline() != ""
        except OSError:  # the terminal was closed
            self._terminal = None
            return False
