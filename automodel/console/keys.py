"""The person's part in arming: a line on the terminal."""

from __future__ import annotations

import select
import sys
import types

from automodel.console.messages import say


def has_terminal() -> bool:
    """Whether a person may type."""
    return sys.stdin is not None and not sys.stdin.closed and sys.stdin.isatty()


class ArmKey:
    """`pressed` tells, once, that Enter was pressed; as a context it says first what that does. No terminal: never."""

    def __init__(self, says: str = "press Enter to arm, Ctrl-C to stop") -> None:
        self._says = says
        self._terminal = sys.stdin if has_terminal() else None

    def __enter__(self) -> ArmKey:
        say(self._says if self._terminal else "no terminal to arm from; Ctrl-C stops")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: types.TracebackType | None
    ) -> None:
        """Nothing to undo."""

    def pressed(self) -> bool:
        """Whether Enter was pressed since the last call; never waits."""
        if self._terminal is None:
            return False
        try:
            return bool(select.select([self._terminal], [], [], 0)[0]) and self._terminal.readline() != ""
        except OSError:  # the terminal is gone
            self._terminal = None
            return False
