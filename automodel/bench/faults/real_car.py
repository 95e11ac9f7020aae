"""The car of `bench faults --real-time`: `automodel run` on a terminal of its own, with a camera that needs no device.

`python -m automodel.bench.faults.real_car TERMINAL run ...`
"""

from __future__ import annotations

import os
import signal
import sys
import time
from types import FrameType

from automodel.assembly.simulated_car import Simulation, build_world
from automodel.bench.faults.faulty_parts import set_wall_clock_back
from automodel.bench.faults.real_catalogue import STEP_CLOCK
from automodel.config import CameraConfig, CarConfig
from automodel.signals import Frame

SOURCE = "automodel.bench.faults.real_car:StillCamera"


class StillCamera:
    """Implements `Source`: what a car sees from the middle of a straight lane, taken anew at the camera's rate.

    The wall clock, as Python sees it, is set back by an hour when `STEP_CLOCK` comes.
    """

    def __init__(self, config: CameraConfig) -> None:
        signal.signal(STEP_CLOCK, _step_clock)
        world = build_world(CarConfig(camera=config), Simulation(track="oval", style="clean"))
        self._image, _ = world.capture(0, 0)
        self._period_ns = round(1e9 / config.rate_hz)
        self._next_ns = time.monotonic_ns()
        self._index = 0

    def read(self, timeout_s: float) -> Frame:
        """The next frame, when it is due."""
        self._next_ns = max(self._next_ns + self._period_ns, time.monotonic_ns())
        time.sleep(max(self._next_ns - time.monotonic_ns(), 0) * 1e-9)
        self._index += 1
        image = self._image.copy()
        image.flat[0] = self._index % 256  # the sensor's noise: no image is the one before
        return Frame(t_ns=time.monotonic_ns(), index=self._index, image=image)

    def close(self) -> None:
        """Nothing is open."""


def _step_clock(_number: int, _frame: FrameType | None) -> None:
    set_wall_clock_back()


def _take_terminal(path: str) -> None:
    """Standard input, output and errors are that terminal: that of this session, which has none yet."""
    terminal = os.open(path, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(terminal, stream)
    os.close(terminal)


if __name__ == "__main__":
    _take_terminal(sys.argv[1])
    os.execv(sys.executable, [sys.executable, "-m", "automodel", *sys.argv[2:]])
