"""The person's part in arming: a line on the terminal."""

from __future__ import annotations

import select
import sys
import types


class ArmKey:
    """`pressed` tells, once, that Enter was pressed; as a context it says so first. Without a terminal: never."""

    def __enter__(self) -> ArmKey:
        if sys.stdin.isatty():
            print("press Enter to arm, Ctrl-C to stop", file=sys.stderr)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: types.TracebackType | None
    ) -> None:
        """Nothing to undo."""

    def pressed(self) -> bool:
        """Whether Enter was pressed since the last call; never waits."""
        if not sys.stdin.isatty() or not select.select([sys.stdin], [], [], 0)[0]:
            return False
        return sys.stdin.readline() != ""
