"""The run's side of the page: what it is shown, and the operator, who is heard without waiting."""

from __future__ import annotations

import time

from automodel.config import CarConfig
from automodel.config.extras import need_extra
from automodel.manual.dead_man import DeadMan
from automodel.signals import DriverInput
from automodel.web.access import Access, PageOptions
from automodel.web.live_process import LiveProcess
from automodel.web.words import LONGEST, Wanted, Word, from_bytes

_WORDS = 32  # heard in one cycle; more wait for the next


class WebRemote(LiveProcess):
    """Serves the page from another process while the context is open; raises ConfigError where it cannot be.

    Implements `RunObserver` and the requests of `assembly.drive.Operator`.
    """

    def __init__(self, car: CarConfig, options: PageOptions) -> None:
        need_extra("--web", "aiohttp")
        from automodel.web.server import serve  # needs aiohttp

        self._access = Access(tls=options.tls is not None)
        super().__init__("--web", car, serve, options, self._access)
        self._options = options
        self._dead_man = DeadMan("the web page")
        self._wanted: DriverInput | None = None  # by hand, while the button for that is held
        self._reason: str | None = None
        self._lost = False

    @property
    def url(self) -> str:
        """The page's address, with the token in its fragment, which a browser sends to nobody."""
        host = f"[{self._options.host}]" if ":" in self._options.host else self._options.host
        return f"{'https' if self._access.tls else 'http'}://{host}:{self.port}/#{self._access.token}"

    def stop_requested(self) -> str | None:
        """Why the car has to stop by the operator's will or silence, None where it has not; never waits."""
        self._listen()
        reason, self._reason = self._reason, None
        return reason

    def arm_requested(self) -> bool:
        """Whether the operator has asked to arm since the last call."""
        return self._dead_man.take_arm()

    def wanted_by_hand(self) -> DriverInput | None:
        """What the person wants who drives by hand, None while nobody does; never waits."""
        self._listen()
        return self._wanted if self._dead_man.held else None

    def _listen(self) -> None:
        now_ns = time.monotonic_ns()
        try:
            for _ in range(_WORDS):
                if self._lost or not self._pipe.poll():
                    break
                self._hear(from_bytes(self._pipe.recv_bytes(LONGEST)), now_ns)
        except (EOFError, OSError, ValueError):
            self._lost = True  # the page's process is gone: the held button will be overdue
        self._reason = self._dead_man.overdue(now_ns) or self._reason

    def _hear(self, said: Word | Wanted, now_ns: int) -> None:
        if isinstance(said, Word):
            self._hear_word(said, now_ns)
        elif self._wanted is not None and self._dead_man.held:
            self._dead_man.hold(now_ns)
            self._wanted = DriverInput(t_ns=now_ns, steering=said[0], speed=said[1])

    def _hear_word(self, word: Word, now_ns: int) -> None:
        if word is Word.STOP:
            self._reason = self._dead_man.stop()
        elif word is Word.RELEASE:
            self._reason = self._dead_man.release() or self._reason
        elif word is Word.HOLD:
            self._dead_man.hold(now_ns)
        else:
            self._dead_man.press(now_ns)
            self._wanted = DriverInput(t_ns=now_ns, steering=0.0, speed=0.0) if word is Word.TAKE else None
