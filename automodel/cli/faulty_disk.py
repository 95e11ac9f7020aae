"""Recorders on disks that are full or too slow."""

from __future__ import annotations

import contextlib
import errno
import os
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

from automodel.clocks import VirtualClock
from automodel.config import RecordingConfig
from automodel.faults.hooks import Disk
from automodel.faults.plan import Plan
from automodel.faults.wrappers import RaisingRecorder
from automodel.interfaces import Recorder
from automodel.recording.run_file import RunFile
from automodel.recording.writer import McapRecorder
from automodel.signals import Frame, StereoFrame


class FullDisk(RunFile):
    """Takes no frame at all."""

    def frame(self, frame: Frame | StereoFrame) -> None:
        """The error of a full disk."""
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class SlowDisk(RunFile):
    """Takes the first frame only when `released` is set."""

    released: threading.Event

    def frame(self, frame: Frame | StereoFrame) -> None:
        """Write a frame, much later."""
        self.released.wait()
        super().frame(frame)


class SlowRecorder(McapRecorder):
    """A recorder whose disk writes nothing until it is closed."""

    def __init__(self, path: Path, config: RecordingConfig) -> None:
        released = threading.Event()
        self._released = released
        super().__init__(path, "", config, type("ThisDisk", (SlowDisk,), {"released": released}))

    def close(self) -> None:
        """Let the disk write, and close."""
        self._released.set()
        super().close()


@contextlib.contextmanager
def faulty_recorder(disk: Disk | None, plan: Plan, clock: VirtualClock) -> Iterator[Recorder | None]:
    """A recorder with this fault; None where there is none."""
    if disk is None or disk is Disk.RAISES:
        yield None if disk is None else RaisingRecorder(plan, clock)
        return
    config = RecordingConfig(image="jpeg")
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        path = Path(folder) / "run.mcap"
        slow = disk is Disk.SLOW
        recorder = SlowRecorder(path, config) if slow else McapRecorder(path, "", config, FullDisk)
        try:
            yield recorder
        finally:
            recorder.close()
