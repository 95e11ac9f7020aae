from __future__ import annotations

import queue
import threading

import numpy as np
import pytest

from automodel.signals import Frame
from automodel.sources.cameras import CaptureThread
from automodel.sources.errors import EndOfSource, SourceError

WAIT_S = 20.0  # far beyond what any step takes; nothing waits for it when all is well


class Scripted:
    """A source that the test feeds; it counts what was taken from it."""

    def __init__(self) -> None:
        self.inbox: queue.Queue[Frame | Exception] = queue.Queue()
        self.closed = threading.Event()
        self.closed_by = ""

    def read(self, timeout_s: float) -> Frame | None:
        try:
            item = self.inbox.get(timeout=timeout_s)
        except queue.Empty:
            return None
        if isinstance(item, Exception):
            raise item
        return item

    def close(self) -> None:
        self.closed_by = threading.current_thread().name
        self.closed.set()


def frame(index: int) -> Frame:
    return Frame(t_ns=index, index=index, image=np.zeros((2, 2), np.uint8))


def wait_until_end(capture: CaptureThread, source: Scripted) -> None:
    assert source.closed.wait(WAIT_S)


def test_the_newest_frame_is_delivered_once_and_older_ones_count_as_drops() -> None:
    source = Scripted()
    for index in range(5):
        source.inbox.put(frame(index))
    source.inbox.put(EndOfSource())  # so that all five have gone through the thread
    capture = CaptureThread(source)
    wait_until_end(capture, source)
    newest = capture.read(WAIT_S)
    assert newest is not None
    assert newest.index == 4
    assert capture.drops == 4
    with pytest.raises(EndOfSource):
        capture.read(WAIT_S)


def test_every_frame_arrives_when_the_reader_is_fast() -> None:
    source = Scripted()
    capture = CaptureThread(source)
    for index in range(20):
        source.inbox.put(frame(index))
        got = capture.read(WAIT_S)
        assert got is not None
        assert got.index == index
    assert capture.drops == 0
    capture.close()


def test_no_frame_is_delivered_twice() -> None:
    source = Scripted()
    capture = CaptureThread(source)
    source.inbox.put(frame(0))
    assert capture.read(WAIT_S) is not None
    assert capture.read(0.0) is None
    assert capture.read(0.01) is None
    capture.close()


def test_an_error_is_passed_on_after_the_last_frame_and_stays() -> None:
    source = Scripted()
    source.inbox.put(frame(0))
    source.inbox.put(SourceError("/dev/video0: unplugged"))
    capture = CaptureThread(source)
    wait_until_end(capture, source)
    assert capture.read(WAIT_S) is not None
    for _ in range(2):
        with pytest.raises(SourceError, match="unplugged"):
            capture.read(WAIT_S)


def test_a_waiting_reader_is_woken_by_an_error() -> None:
    source = Scripted()
    capture = CaptureThread(source)
    threading.Timer(0.05, source.inbox.put, (OSError("gone"),)).start()
    with pytest.raises(OSError, match="gone"):
        capture.read(WAIT_S)


def test_closing_closes_the_source_in_its_own_thread_and_may_be_repeated() -> None:
    source = Scripted()
    capture = CaptureThread(source)
    capture.close()
    capture.close()
    assert source.closed.is_set()
    assert source.closed_by == "capture"
    with pytest.raises(EndOfSource):
        capture.read(0.0)


def test_a_bug_in_a_source_is_not_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "excepthook", lambda args: None)
    source = Scripted()
    source.inbox.put(KeyError("bug"))
    capture = CaptureThread(source)
    with pytest.raises(SourceError, match="died"):
        capture.read(WAIT_S)
    capture.close()
