"""Work for other processes, which import this module by its name."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

Tick = Callable[[float], None]


def root(number: float, tick: Tick) -> float:
    """The square root."""
    return math.sqrt(number)


def die_if_negative(number: float, tick: Tick) -> float:
    """The square root; a negative number ends the process."""
    if number < 0:
        os._exit(3)
    return math.sqrt(number)


def die_once(folder: Path, number: float, tick: Tick) -> float:
    """The square root; the first process that is asked for it is killed."""
    mark = folder / str(number)
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return math.sqrt(number)


def noted_root(log: Path, number: float, tick: Tick) -> float:
    """The square root; every call is noted in a file."""
    with open(log, "a") as file:
        print(number, file=file)
    return math.sqrt(number)


def whereabouts(folder: Path, number: float, tick: Tick) -> float:
    """The square root, after 50 ms; the process leaves a file with its number as name."""
    (folder / str(os.getpid())).touch()
    time.sleep(0.05)
    return math.sqrt(number)


def slowly(steps: int, tick: Tick) -> int:
    """Progress in steps of 50 ms."""
    for _ in range(steps):
        time.sleep(0.05)
        tick(1.0 / steps)
    return steps
