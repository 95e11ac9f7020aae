"""What systemd is told of a run: ready, alive, how it is; by the datagrams of sd_notify(3)."""

from __future__ import annotations

import contextlib
import os
import socket
import time
import types
from collections.abc import MutableMapping
from pathlib import Path

from automodel.runtime.run_types import TickRecord
from automodel.signals import Event

_STATUS_NS = 1_000_000_000  # between two texts of how the run is
_DEFAULT_ALIVE_NS = 1_000_000_000  # between two signs of life where nobody asks for them


class Notifier:
    """Sends to the socket that systemd names in `environment`; does nothing where it names none. Never waits.

    The variables are taken away, so that no process started from here speaks in this one's name.
    """

    def __init__(self, environment: MutableMapping[str, str] | None = None) -> None:
        variables = os.environ if environment is None else environment
        path, usec = variables.pop("NOTIFY_SOCKET", ""), variables.pop("WATCHDOG_USEC", "")
        for_us = variables.pop("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self.watchdog_ns = int(usec) * 1000 if usec.isdecimal() and for_us else None
        self._socket: socket.socket | None = None
        if path[:1] in ("/", "@"):
            self._address = "\0" + path[1:] if path.startswith("@") else path
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)

    @property
    def heard(self) -> bool:
        """Whether there is somebody to tell."""
        return self._socket is not None

    def send(self, **values: str) -> None:
        """Send variables such as READY="1"; a full or missing socket loses them."""
        if self._socket is None:
            return
        lines = [f"{name}={' '.join(value.split())}" for name, value in values.items()]
        with contextlib.suppress(OSError):
            self._socket.sendto("\n".join(lines).encode(), self._address)

    def close(self) -> None:
        """Close the socket; may be called twice."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class ServiceViewer:
    """Implements `assembly.drive.Viewer`: READY with the first cycle that has a frame and the vehicle's word.

    The signs of life come from the run's own cycles, at a quarter of what systemd waits for: a loop that hangs is
    killed and started anew. As a context it says STOPPING at the end.
    """

    def __init__(self, notifier: Notifier) -> None:
        self._notifier = notifier
        self._ready = False
        self._alive_due_ns = self._status_due_ns = 0
        self._alive_ns = (notifier.watchdog_ns or 4 * _DEFAULT_ALIVE_NS) // 4
        self._status = ""

    def __enter__(self) -> ServiceViewer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: types.TracebackType | None
    ) -> None:
        """Say that the run ends."""
        self._notifier.send(STOPPING="1")
        self._notifier.close()

    def on_tick(self, record: TickRecord) -> None:
        """A cycle of the run."""
        now_ns = time.monotonic_ns()
        if not self._ready and record.frame is not None and record.state is not None:
            self._ready = True
            age_s = process_age_s()
            after = "" if age_s is None else f"ready {age_s:.2f} s after the process began"
            self._notifier.send(READY="1", STATUS=after)
            self._status_due_ns = now_ns + _STATUS_NS
        if now_ns >= self._alive_due_ns:
            self._alive_due_ns = now_ns + self._alive_ns
            self._notifier.send(WATCHDOG="1")
        if self._ready and now_ns >= self._status_due_ns:
            reason = record.decision.reason
            status = record.decision.mode.value + (f": {reason}" if reason else "")
            if status != self._status:
                self._status, self._status_due_ns = status, now_ns + _STATUS_NS
                self._notifier.send(STATUS=status)

    def on_event(self, event: Event) -> None:
        """The journal has them from stderr."""


def process_age_s() -> float | None:
    """Seconds since the kernel started this process, to a hundredth; None where /proc does not say."""
    try:
        fields = Path("/proc/self/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        start_s = int(fields[19]) / os.sysconf("SC_CLK_TCK")  # field 22 of proc(5)
        return time.clock_gettime(time.CLOCK_BOOTTIME) - start_s
    except (OSError, ValueError, IndexError, AttributeError):
        return None
