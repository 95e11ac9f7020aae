"""A run in real time with a board that only keeps a log, for the tests to send signals to.

Arguments: the log's path, what happens ("frames" come at 60 Hz, or "silence"). Prints "driving" or "waiting" when it is
ready for a signal.
"""

from __future__ import annotations

import signal
import sys
import threading
import time

import numpy as np

from automodel.config import SafetyConfig
from automodel.runtime.clocks import MonotonicClock
from automodel.runtime.loop import Loop
from automodel.runtime.runner import RunConfig, Runner, RunParts
from automodel.runtime.safety import Safety, SafetyMode
from automodel.signals import Frame, VehicleState
from automodel.sources.cameras import CaptureThread
from tests.support.runner_fakes import FakeController, FakeLimits, FakeMotion, FakePipeline

PERIOD_S = 1.0 / 60.0


def say(line):
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


class Camera:
    def __init__(self, silent):
        self._silent = silent
        self._next_s = time.monotonic()
        self._index = 0

    def read(self, timeout_s):
        if self._silent:
            time.sleep(timeout_s)
            return None
        self._next_s = max(self._next_s + PERIOD_S, time.monotonic())
        time.sleep(max(self._next_s - time.monotonic(), 0.0))
        self._index += 1
        return Frame(t_ns=time.monotonic_ns(), index=self._index, image=np.zeros((2, 2), dtype=np.uint8))

    def close(self):
        pass


class Log:
    """Link and recorder in one, each call a line: time [ns], what, speed."""

    def __init__(self, path):
        self._file = open(path, "w")  # noqa: SIM115
        self._armed = False

    def _line(self, what, speed_mps=""):
        self._file.write(f"{time.monotonic_ns()} {what} {speed_mps}\n")
        self._file.flush()

    def open(self):
        self._line("open")

    def poll(self, now_ns):
        return VehicleState(t_ns=now_ns, armed=self._armed, boot_id=1)

    def send(self, command, now_ns):
        self._line("send", command.speed_mps)

    def arm(self, now_ns):
        self._armed = True
        self._line("arm")

    def disarm(self, now_ns):
        self._armed = False
        self._line("disarm")

    def close(self):
        self._line("close")


class Recorder:
    """Its file takes a while to close, so that a second signal falls into the clean-up."""

    def __init__(self, log):
        self._log = log

    def frame(self, value):
        pass

    motion = state = estimate = command = driver = event = frame

    def close(self):
        self._log._line("closing the recording")
        say("closing")
        time.sleep(0.3)
        self._log._line("recording closed")


class Announcer:
    def __init__(self, silent):
        self._silent = silent
        self._turns = 0
        self._told = False

    def on_tick(self, record):
        self._turns += 1
        if not self._told and (record.decision.mode is SafetyMode.DRIVING or (self._silent and self._turns > 10)):
            self._told = True
            say("waiting" if self._silent else "driving")


def main():
    log = Log(sys.argv[1])
    silent = sys.argv[2] == "silence"
    # Times a loaded machine keeps; what is tested is the order of things.
    config = SafetyConfig(frame_timeout_s=20.0, command_validity_s=20.0, rearm_s=0.05)
    parts = RunParts(
        source=CaptureThread(Camera(silent)),
        link=log,
        recorder=Recorder(log),
        motion=FakeMotion(),
        loop=Loop(FakePipeline(), FakeController(), FakeLimits(), validity_s=20.0),
        safety=Safety(config, auto_arm=True),
        clock=MonotonicClock(),
    )
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    result = Runner(parts, RunConfig(), observer=Announcer(silent)).run()
    after = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    left = [thread.name for thread in threading.enumerate() if thread is not threading.main_thread()]
    say(f"{result.end.name} {result.events[-1].text} {before == after} {left}")


if __name__ == "__main__":
    main()
