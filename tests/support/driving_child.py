"""`automodel run` with a real car's devices, for the tests to disturb: the camera looks at a road that never ends.

Arguments: the picture (.npy), the board's clock, what SIGUSR2 does in the loop ("stall" or "collect"), then those of
`automodel`. SIGUSR1 is a person who presses Enter.
"""

from __future__ import annotations

import gc
import signal
import sys
from unittest import mock

import numpy as np

from automodel.assembly import drive
from automodel.assembly.parts import make_loop, make_pipeline
from automodel.cli import main
from automodel.signals import Frame
from tests.support.board_time import BoardTime

PERIOD_NS = 16_666_667
STALL_NS = 100_000_000
OBJECTS = 1_000_000
COLLECTING_NS = 350_000_000  # a fast machine collects them in less than what stops even a slow car, so again


class Flag:
    """Set by a signal, asked for once."""

    def __init__(self, number):
        self._set = False
        signal.signal(number, self._note)

    def _note(self, number, frame):
        self._set = True

    def taken(self):
        was, self._set = self._set, False
        return was


class Key(Flag):
    """Implements what the run wants of `ArmKey`."""

    def __init__(self):
        super().__init__(signal.SIGUSR1)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    def pressed(self):
        return self.taken()


class StillCamera:
    """Implements `Source`: the same view at 60 Hz, with a bit of noise, which never comes twice from a camera."""

    def __init__(self, clock, picture):
        self._clock, self._picture = clock, picture
        self._next_ns, self._index = clock.now_ns(), 0

    def read(self, timeout_s):
        self._next_ns = max(self._next_ns + PERIOD_NS, self._clock.now_ns())
        self._clock.sleep_until(self._next_ns)
        self._index += 1
        picture = self._picture.copy()
        picture.flat[0] = self._index % 256  # not one bit to and fro: a loop that drops every other frame sees each
        return Frame(t_ns=self._clock.now_ns(), index=self._index, image=picture)

    def close(self):
        pass


class DisturbedPipeline:
    """A pipeline that keeps the loop waiting when a signal has come."""

    def __init__(self, pipeline, clock, how):
        self._pipeline, self._clock, self._how = pipeline, clock, how
        self._flag = Flag(signal.SIGUSR2)
        self._heap = None
        self.name, self.stages = pipeline.name, pipeline.stages
        self.reset = pipeline.reset

    def step(self, frame, motion):
        if self._how == "collect" and self._heap is None:
            self._heap = [[number] for number in range(OBJECTS)]  # the car stands still now
        if self._flag.taken():
            begin_ns = self._clock.now_ns()
            if self._how == "stall":
                self._clock.sleep_until(begin_ns + STALL_NS)
            while self._how == "collect" and self._clock.now_ns() < begin_ns + COLLECTING_NS:
                gc.collect()
        return self._pipeline.step(frame, motion)


def disturb(picture, clock, how):
    mock.patch.multiple(
        drive,
        make_camera=lambda car: StillCamera(clock, picture),
        MonotonicClock=lambda: clock,
        ArmKey=Key,
        make_loop=lambda car, **more: make_loop(
            car, pipeline=DisturbedPipeline(make_pipeline(car.pipeline.name, car), clock, how), **more
        ),
    ).start()


if __name__ == "__main__":
    disturb(np.load(sys.argv[1]), BoardTime(sys.argv[2]), sys.argv[3])
    sys.argv[1:] = sys.argv[4:]
    main.main()
