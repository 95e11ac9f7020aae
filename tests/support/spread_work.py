"""Work for other processes, which import this module by its name."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable

Tick = Callable[[float], None]


def root(number: float, tick: Tick) -> float:
    """The square root."""
    return math.sqrt(number)


def die(code: int, tick: Tick) -> None:
    """End the process."""
    os._exit(code)


def slowly(steps: int, tick: Tick) -> int:
    """Progress in steps of 50 ms."""
    for _ in range(steps):
        time.sleep(0.05)
        tick(1.0 / steps)
    return steps
