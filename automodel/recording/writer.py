"""The recorder of a run: a queue and a writer thread."""

from __future__ import annotations

import threading
import time
from collections import deque
from pathlib import Path

from automodel.config import RecordingConfig
from automodel.recording.codec import Value
from automodel.recording.run_file import RunFile
from automodel.signals import Frame, StereoFrame

_SYNC_NS = 750_000_000  # a power cut loses less than a second, including the disk's delay; each keeps 0.6 kB of index
_POLL_S = 0.02  # the thread wakes up for batches: each wake-up takes the interpreter's lock
_MAX_WAITING_BYTES = 48 * 1024 * 1024  # of images
_MAX_WAITING = 20_000  # messages of any kind


class McapRecorder:
    """Implements `Recorder` on an MCAP file (see `RunFile`).

    Calls append to a queue and return. If the disk is too slow, new frames are dropped and counted; other values are
    dropped much later. A write error (the disk is full) ends the recording, not the run: `error` has its text. A value
    that cannot be written is left out: `refused` counts them, `refusal` is the reason of the first. `file` writes to
    the disk. Raises ConfigError if the file cannot be created.
    """

    def __init__(self, path: str | Path, car_text: str, config: RecordingConfig, file: type[RunFile] = RunFile) -> None:
        self.error: str | None = None
        self.refusal: str | None = None
        self.written = self.frames = self.dropped_frames = self.dropped_values = self.refused = 0
        self._file = file(path, car_text, config)
        self.path = self._file.path
        self._waiting: deque[tuple[int, Frame | StereoFrame | Value]] = deque()
        self._bytes_in = self._bytes_out = 0  # each is written by one thread only
        self._frame_index = 0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def frame(self, frame: Frame | StereoFrame) -> None:
        """Record a frame as the pipeline got it."""
        self._frame_index = frame.index
        if self._closed or self._bytes_in - self._bytes_out > _MAX_WAITING_BYTES:
            self.dropped_frames += 1
            return
        self._bytes_in += _bytes_of(frame)
        self._waiting.append((frame.index, frame))

    def _value(self, value: Value) -> None:
        """Record any other value as belonging to the last frame."""
        if self._closed or len(self._waiting) >= _MAX_WAITING:
            self.dropped_values += 1
        else:
            self._waiting.append((self._frame_index, value))

    motion = state = estimate = command = driver = event = _value  # the methods of `Recorder`

    def close(self) -> None:
        """Write the remaining values and the index, and close the file; may be called twice."""
        self._stopping.set()
        self._thread.join()

    def summary(self) -> str:
        """One line for the end of a run: the numbers of recorded and lost values."""
        parts = [f"{self.path}: {self.frames} frames, {self.written} messages"]
        if self.dropped_frames or self.dropped_values:
            why = "the disk is too slow" if self.error is None else "after the error"
            parts.append(f"{self.dropped_frames} frames and {self.dropped_values} values dropped ({why})")
        if self.refused:
            parts.append(f"{self.refused} values left out ({self.refusal})")
        if self.error is not None:
            parts.append(f"stopped early: {self.error}; recover it with: automodel recover {self.path}")
        return "; ".join(parts)

    @property
    def _closed(self) -> bool:
        return self.error is not None or self._stopping.is_set()

    def _run(self) -> None:
        self._synced_ns = time.monotonic_ns()
        error: str | None = "the recorder's thread died"
        try:
            stopping = False
            while not stopping:
                stopping = self._stopping.wait(_POLL_S)
                self._write_waiting()
            self._file.finish(self._counts())
            error = None
        except OSError as failure:
            error = failure.strerror or str(failure)
        finally:
            self.error = error
            if error is not None:
                self._file.abandon()
                self._waiting.clear()

    def _write_waiting(self) -> None:
        """Write all queued values, and sync when it is due."""
        while True:
            if self._waiting:
                self._write(*self._waiting.popleft())
            if time.monotonic_ns() - self._synced_ns >= _SYNC_NS:
                self._file.sync()
                self._synced_ns = time.monotonic_ns()
            if not self._waiting:
                return

    def _write(self, frame_index: int, value: Frame | StereoFrame | Value) -> None:
        try:
            if isinstance(value, Frame | StereoFrame):
                self._bytes_out += _bytes_of(value)
                self._file.frame(value)
                self.frames += 1
            else:
                self._file.value(value, frame_index)
            self.written += 1
        except ValueError as error:
            self.refused += 1
            self.refusal = self.refusal or str(error)

    def _counts(self) -> dict[str, int]:
        return {
            "frames": self.frames,
            "messages": self.written,
            "dropped_frames": self.dropped_frames,
            "dropped_values": self.dropped_values,
            "refused_values": self.refused,
        }


def _bytes_of(frame: Frame | StereoFrame) -> int:
    if isinstance(frame, StereoFrame):
        return frame.left.nbytes + frame.right.nbytes
    return frame.image.nbytes
