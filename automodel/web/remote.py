"""The run's side of the page: what it is shown, and the operator, who is heard without waiting."""

from __future__ import annotations

import importlib.util
import time

from automodel.config import CarConfig, ConfigError
from automodel.web.access import Access, PageOptions
from automodel.web.dead_man import DeadMan, Word
from automodel.web.live_process import LiveProcess

_WORDS = 32  # heard in one cycle; more wait for the next


class WebRemote(LiveProcess):
    """Serves the page from another process while the context is open; raises ConfigError where it cannot be.

    Implements `RunObserver` and the requests of `assembly.drive.Operator`.
    """

    def __init__(self, car: CarConfig, options: PageOptions) -> None:
        if importlib.util.find_spec("aiohttp") is None:
            raise ConfigError("--web: needs aiohttp; pip install 'automodel[web]'")
        from automodel.web.server import serve  # needs aiohttp

        self._access = Access(tls=options.tls is not None)
        super().__init__("--web", car, serve, options, self._access)
        self._options = options
        self._dead_man = DeadMan()
        self._lost = False

    @property
    def url(self) -> str:
        """The page's address, with the token in its fragment, which a browser sends to nobody."""
        host = f"[{self._options.host}]" if ":" in self._options.host else self._options.host
        return f"{'https' if self._access.tls else 'http'}://{host}:{self.port}/#{self._access.token}"

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
