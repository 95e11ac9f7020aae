"""A process that shows a run while it lasts; the loop copies what happens into a mailbox and never waits."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
import time
import types
from collections import deque
from collections.abc import Callable
from typing import TypeVar

import cv2

from automodel.config import CarConfig, ConfigError
from automodel.runtime.cores import LoopCores
from automodel.runtime.os_signals import signals_held_back
from automodel.runtime.run_types import TickRecord
from automodel.signals import Event
from automodel.web.mailbox import Mailbox
from automodel.web.snapshot import Trip

LOOK_S = 0.02  # between two looks into the mailbox
RATE_HZ = 20.0  # of what is shown: a person sees a car's way in it, and two of three cycles cost nothing
_EVENTS = 30  # the newest, which every message carries: one that is lost loses none of them
_EXTRA_BYTES = 1 << 18  # room beside the picture; an estimate is some 20 kB
_START_S = 30.0  # a new process and its libraries, on a slow board
_END_S = 2.0
_NICE = 10  # the loop and the recorder come first
_Self = TypeVar("_Self", bound="LiveProcess")


def stand_back() -> None:
    """What a target does first: leave Ctrl-C to the run, which then closes the pipe, and the processor to the loop."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    cv2.setNumThreads(1)


class LiveProcess:
    """Runs `target(car, *args, mailbox, pipe)` in another process while the context is open.

    The target sends its port, or a text of what is wrong, through the pipe first, takes pickled `Snapshot` from the
    mailbox, and ends when the pipe is closed. Implements `RunObserver`. Entering raises ConfigError, led by `option`
    where the process does not even say why.
    """

    def __init__(self, option: str, car: CarConfig, target: Callable[..., None], *args: object) -> None:
        self._option = option
        context = multiprocessing.get_context("spawn")
        pixels = car.camera.width_px * car.camera.height_px * 3
        self._mailbox = Mailbox(context, pixels + _EXTRA_BYTES)
        self._pipe, self._theirs = context.Pipe()
        self._process = context.Process(
            target=target,
            args=(car, *args, self._mailbox, self._theirs),
            daemon=True,
            name=f"automodel {option}",
        )
        self._trip = Trip()
        self._events: deque[Event] = deque(maxlen=_EVENTS)
        self._due_ns = 0
        self.port = 0  # that is served, once the context is entered

    def __enter__(self: _Self) -> _Self:
        with signals_held_back(), LoopCores():  # the process stays off the loop's core
            self._process.start()
        self._theirs.close()
        try:
            answer = self._pipe.recv() if self._pipe.poll(_START_S) else f"{self._option}: its process does not start"
        except EOFError:
            answer = f"{self._option}: its process died as it started"
        if not isinstance(answer, int):
            self._close()
            raise ConfigError(answer)
        self.port = answer
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: types.TracebackType | None
    ) -> None:
        """End the process."""
        self._close()

    @property
    def pid(self) -> int:
        """The number of its process, while the context is open."""
        assert self._process.pid is not None
        return self._process.pid

    def on_tick(self, record: TickRecord) -> None:
        """A cycle of the run; a picture of it goes out at most `RATE_HZ` times a second."""
        self._trip.step(record)
        now_ns = time.monotonic_ns()
        if record.frame is None or now_ns < self._due_ns:
            return
        snapshot = self._trip.snapshot(record, tuple(self._events))
        if self._mailbox.put(pickle.dumps(snapshot, protocol=5)):
            self._due_ns = now_ns + round(1e9 / RATE_HZ)

    def on_event(self, event: Event) -> None:
        """An event of the run."""
        self._events.append(event)

    def _close(self) -> None:
        with contextlib.suppress(OSError):
            self._pipe.close()  # which ends the process
        self._process.join(_END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
