"""The time of a board in another process, see `realtime_rig`."""

from __future__ import annotations

import mmap
import struct
import time
from pathlib import Path

_NAP_S = 0.0005


class BoardTime:
    """Implements `SleepingClock`."""

    def __init__(self, path: str | Path) -> None:
        with open(path, "rb") as file:
            self._shared = mmap.mmap(file.fileno(), 8, access=mmap.ACCESS_READ)

    def now_ns(self) -> int:
        return int(struct.unpack_from("=q", self._shared)[0])

    def sleep_until(self, t_ns: int) -> None:
        while self.now_ns() < t_ns:
            time.sleep(_NAP_S)

    def sleep(self, seconds: float) -> None:
        self.sleep_until(self.now_ns() + round(seconds * 1e9))
