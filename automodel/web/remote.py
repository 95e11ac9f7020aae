"""The run's side of the page: puts what happens into the mailbox, hears the operator, and never waits for either."""

from __future__ import annotations

import contextlib
import importlib.util
import multiprocessing
import pickle
import time
import types
from collections import deque

from automodel.config import CarConfig, ConfigError
from automodel.runtime.os_signals import signals_held_back
from automodel.runtime.run_types import TickRecord
from automodel.signals import Event
from automodel.web.access import Access, PageOptions
from automodel.web.dead_man import DeadMan, Word
from automodel.web.mailbox import Mailbox
from automodel.web.snapshot import Trip

RATE_HZ = 20.0  # of the page: a person sees a car's way in it, and two of three cycles cost nothing
_EVENTS = 30  # the newest, which every message carries: one that is lost loses none of them
_EXTRA_BYTES = 1 << 18  # room beside the picture; an estimate is some 20 kB
_WORDS = 32  # heard in one cycle; more wait for the next
_START_S = 30.0  # a new process and aiohttp, on a slow board
_END_S = 2.0


class WebRemote:
    """Serves the page from another process while the context is open; raises ConfigError where it cannot be.

    Implements `RunObserver` and the requests of `assembly.drive.Operator`.
    """

    def __init__(self, car: CarConfig, options: PageOptions) -> None:
        if importlib.util.find_spec("aiohttp") is None:
            raise ConfigError("--web: needs aiohttp; pip install 'automodel[web]'")
        self._access = Access(tls=options.tls is not None)
        context = multiprocessing.get_context("spawn")
        pixels = car.camera.width_px * car.camera.height_px * 3
        self._mailbox = Mailbox(context, pixels + _EXTRA_BYTES)
        self._pipe, theirs = context.Pipe()
        from automodel.web.server import serve  # needs aiohttp

        self._process = context.Process(
            target=serve, args=(car, options, self._access, self._mailbox, theirs), daemon=True, name="automodel web"
        )
        self._theirs = theirs
        self._options = options
        self._trip, self._dead_man = Trip(), DeadMan()
        self._events: deque[Event] = deque(maxlen=_EVENTS)
        self._due_ns = 0
        self._lost = False

    def __enter__(self) -> WebRemote:
        with signals_held_back():
            self._process.start()
        self._theirs.close()
        try:
            answer = self._pipe.recv() if self._pipe.poll(_START_S) else "--web: the page's process does not start"
        except EOFError:
            answer = "--web: the page's process died as it started"
        if not isinstance(answer, int):
            self._close()
            raise ConfigError(answer)
        self._port = answer
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: types.TracebackType | None
    ) -> None:
        """End the page."""
        self._close()

    @property
    def url(self) -> str:
        """The page's address, with the token in its fragment, which a browser sends to nobody."""
        host = f"[{self._options.host}]" if ":" in self._options.host else self._options.host
        return f"{'https' if self._access.tls else 'http'}://{host}:{self._port}/#{self._access.token}"

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

    def stop_requested(self) -> str | None:
        """Why the car has to stop by the operator's will or silence, None where it has not; never waits."""
        now_ns = time.monotonic_ns()
        reason = None
        try:
            for _ in range(_WORDS):
                if self._lost or not self._pipe.poll():
                    break
                reason = self._dead_man.hear(Word(self._pipe.recv_bytes(1)), now_ns) or reason
        except (EOFError, OSError, ValueError):
            self._lost = True  # the page's process is gone: the held button will be overdue
        return reason or self._dead_man.overdue(now_ns)

    def arm_requested(self) -> bool:
        """Whether the operator has asked to arm since the last call."""
        return self._dead_man.take_arm()

    def _close(self) -> None:
        with contextlib.suppress(OSError):
            self._pipe.close()  # which ends the server
        self._process.join(_END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
