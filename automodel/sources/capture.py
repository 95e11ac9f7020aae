"""A thread that always has the newest frame."""

from __future__ import annotations

import threading

from automodel.interfaces import Source
from automodel.signals import Frame, StereoFrame
from automodel.sources.errors import EndOfSource, SourceError

_POLL_S = 0.1  # how long the thread stays in the wrapped source before it looks whether to stop
_JOIN_S = 2.0


class CaptureThread:
    """Wraps a source: reads it in a daemon thread and hands out the newest frame only.

    A frame that is replaced before it was read counts in `drops`. An error or the end of the wrapped source is passed
    on by `read`, after the frame that came before it. The thread closes the wrapped source itself, so that a driver
    is never closed while it is being read.
    """

    def __init__(self, source: Source) -> None:
        self.drops = 0
        self._source = source
        self._changed = threading.Condition()
        self._newest: Frame | StereoFrame | None = None
        self._end: OSError | EndOfSource | None = None
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)
        self._thread.start()

    def read(self, timeout_s: float) -> Frame | StereoFrame | None:
        """The newest frame that was not delivered yet, or None when none came within `timeout_s`."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or self._end is not None, timeout_s)
            frame, self._newest = self._newest, None
            if frame is None and self._end is not None:
                raise self._end
            return frame

    def close(self) -> None:
        """Stop the thread and give the device back; may be called twice."""
        with self._changed:
            self._stopping = True
        self._thread.join(_JOIN_S)

    def _run(self) -> None:
        end: OSError | EndOfSource = SourceError("the capture thread died")
        try:
            while not self._stopping:
                frame = self._source.read(_POLL_S)
                if frame is not None:
                    self._put(frame)
            end = EndOfSource("closed")
        except (OSError, EndOfSource) as error:
            end = error
        finally:
            with self._changed:
                self._end = end
                self._changed.notify_all()
            self._source.close()

    def _put(self, frame: Frame | StereoFrame) -> None:
        with self._changed:
            if self._newest is not None:
                self.drops += 1
            self._newest = frame
            self._changed.notify_all()
