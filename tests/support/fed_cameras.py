"""A camera that a test feeds with frames and errors."""

from __future__ import annotations

import queue
import threading

from automodel.signals import Frame


class FedCamera:
    """Implements `Source`: gives, or raises, what the test puts into its `inbox`; `closed_by`: the thread that did."""

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
