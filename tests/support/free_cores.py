"""How much of the machine the tests have to themselves, for what can only be judged on an idle one."""

from __future__ import annotations

import subprocess
import sys

WALL_S = 0.5
IDLE_CORES = 1.9  # of 2: a run in real time takes one for itself and one for the simulated world
BUSY = f"import time\nend = time.monotonic() + {WALL_S}\nwhile time.monotonic() < end: pass\nprint(time.process_time())"


def free_cores() -> float:
    """How many cores two processes get that do nothing but compute."""
    children = [subprocess.Popen([sys.executable, "-c", BUSY], stdout=subprocess.PIPE) for _ in range(2)]
    return sum(float(child.communicate()[0]) for child in children) / WALL_S


class Retries:
    """Allows a test in real time to fail on a busy machine as often as it likes, and on an idle one once."""

    def __init__(self) -> None:
        self._failures_when_idle = 0

    def failed(self, output: str) -> None:
        """A try has failed: AssertionError with `output` if it is the second one on an idle machine."""
        self._failures_when_idle += free_cores() > IDLE_CORES
        assert self._failures_when_idle < 2, output
