"""A source that may fail and be replaced: its errors become values, and no error makes the loop spin."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

from automodel.interfaces import Source
from automodel.runtime.clocks import NS_PER_S, SleepingClock
from automodel.runtime.run_log import RunLog
from automodel.signals import Event, Frame, StereoFrame
from automodel.sources.errors import SourceStalled

REOPEN_S = 0.2  # between two tries to open a source that failed
START_S = 5.0  # for the first frame of a camera opened again: the sensor and its exposure take 1 to 3 s


class SupervisedSource:
    """Wraps a `Source`; `reopen` gives a new one in its place or raises OSError, None where there is no other.

    A ValueError counts as a failure too: the device gave an image of a kind that no camera should give. Only
    EndOfSource is passed on.
    """

    def __init__(
        self, source: Source, clock: SleepingClock, run_log: RunLog, reopen: Callable[[], Source] | None
    ) -> None:
        self._source = source
        self._clock = clock
        self._run_log = run_log
        self._reopen = reopen
        self._failed = False
        self._stalled = False  # it gives nothing for now, and may go on by itself
        self._awaited = False  # opened again, and no frame has come yet
        self._tried_ns: int | None = None  # when it was opened again last
        self._unpaired = 0  # of the sources that were replaced
        self._trouble = ""  # of one camera of a pair, as was last reported

    @property
    def dead(self) -> bool:
        """Whether no frame will ever come again."""
        return self._failed and self._reopen is None

    @property
    def unpaired(self) -> int | None:
        """Frames of a pair's cameras so far without a partner, of all sources; None where there is no pair."""
        count = getattr(self._source, "unpaired", None)
        return None if count is None else self._unpaired + int(count)

    def read(self, timeout_s: float, at_rest: bool) -> Frame | StereoFrame | None:
        """A frame, or None after `timeout_s` on the clock, also where the source has failed.

        A failed source, or one whose stall lasts, is only replaced `at_rest`, because opening a camera takes seconds.
        """
        if at_rest and (self._failed or self._late()):
            self._replace()
        try:
            frame = self._source.read(timeout_s)
        except (OSError, ValueError) as error:
            self._stalled = True
            self._failed = self._failed or not isinstance(error, SourceStalled) or error.lasting
            cause = "failed" if self._failed else "stalled"  # a stall does not keep quiet what the camera died of
            self._run_log.report("source-failed", str(error), self._clock.now_ns(), cause)
            self._clock.sleep(timeout_s)  # a broken source fails at once
            return None
        if frame is not None and (self._failed or self._stalled or self._awaited):
            self._failed = self._stalled = self._awaited = False
            text = "frames come again; arm to drive on" if at_rest else "frames come again"
            event = Event(t_ns=self._clock.now_ns(), kind="source-back", text=text)
            self._run_log.note(event)
        return frame

    def report_eyes(self, frame: Frame | StereoFrame, unseen: str) -> None:
        """Say that one camera of a pair is missing while the other one goes on, and that pairs are seen again.

        `unseen` is why a pair was looked at through one eye alone, "" where it was not.
        """
        trouble = unseen if isinstance(frame, StereoFrame) else str(getattr(self._source, "trouble", ""))
        if trouble == self._trouble:
            return
        kind, text = "camera-missing", f"{trouble}; the other one goes on alone"
        if not trouble:
            kind, text = "camera-back", "pairs of frames come again"
        if (trouble or isinstance(frame, StereoFrame)) and self._run_log.report(kind, text, self._clock.now_ns()):
            self._trouble = trouble

    def close(self) -> None:
        """Close what there is; never raises an OSError."""
        with contextlib.suppress(OSError):
            self._source.close()

    def _late(self) -> bool:
        """Whether a source that was opened again has given no frame for too long."""
        return self._awaited and self._clock.now_ns() - (self._tried_ns or 0) >= START_S * NS_PER_S

    def _replace(self) -> None:
        now_ns = self._clock.now_ns()
        if self._reopen is None or (self._tried_ns is not None and now_ns - self._tried_ns < REOPEN_S * NS_PER_S):
            return
        self._tried_ns = now_ns
        self.close()
        with contextlib.suppress(OSError):  # the fault has been reported already
            anew = self._reopen()
            self._source, self._unpaired = anew, self.unpaired or 0
            self._failed, self._stalled, self._awaited = False, False, True
