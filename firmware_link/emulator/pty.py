"""A board on a pseudo terminal: what opens a serial port opens this.

A board on the bench: nothing moves, the pulses are noted, the sensors read what they are told to.
"""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import tempfile
import threading
import time
import tty
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from automodel.signals import BoardSensors
from firmware_link.transport import Board

STEP_S = 0.001
_READ_BYTES = 4096
_UNREAD_BYTES = 4096  # kept for a host that does not read, beside what the kernel keeps


class ServedBoard(Board, Protocol):
    """A board that can say how much its line takes."""

    def room(self, now_ns: int) -> int:
        """How many bytes `receive` takes at `now_ns`."""
        ...


class PtyBoard:
    """Serves a board at `path`, a symbolic link that stays the same over `unplug` and `replug`.

    `step` does everything once and never blocks; call it about each millisecond, or `start` a thread that does so
    against the monotonic clock. A call of `step` holds a lock, as `unplug`, `replug` and `call` do, so that the
    board and its peripherals are only touched by one thread at a time.

    Opening resets the board as a real one's DTR line does: the kernel reports POLLHUP on the master while nobody has
    the slave open, and the step that sees it gone resets. (A close and an open between two steps go unseen; then the
    board runs on, like one without the reset line.) While nobody has it open, the board's bytes are lost.

    Host -> board: bytes stay in the kernel's buffer until the board's line has room, so a host that writes too much
    is held up. Board -> host: the kernel's buffer and 4096 bytes more, then the newest are lost.
    """

    def __init__(
        self, board: ServedBoard, *, path: str | Path | None = None, clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.board = board
        self._clock = clock
        self._directory = Path(tempfile.mkdtemp(prefix="board-")) if path is None else None
        self.path = str(self._directory / "tty" if self._directory else path)
        self._lock = threading.RLock()
        self._master: int | None = None
        self._poll = select.poll()
        self._host_there = False
        self._unread = b""
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        try:
            self.replug()
        except OSError:
            self.close()
            raise

    def __enter__(self) -> PtyBoard:
        """Start the thread."""
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def step(self, now_ns: int) -> None:
        """Run the board up to `now_ns`, and move bytes both ways."""
        with self._lock:
            if self._master is None:
                self.board.advance(now_ns)
                self.board.transmit(now_ns)
                return
            there = not any(event & select.POLLHUP for _, event in self._poll.poll(0))
            if there and not self._host_there:
                self._unread = b""
                self.board.reset(now_ns)
                self.board.transmit(now_ns)  # what it said before is not for this host, as a tty's buffer is flushed
            self._host_there = there
            self._take_in(self._master, now_ns)  # also the last words of a host that has just closed
            self.board.advance(now_ns)
            self._give_out(self._master, self.board.transmit(now_ns))

    def call(self, function: Callable[[], None]) -> None:
        """Call `function` between two steps, as to inject a fault into the board."""
        with self._lock:
            function()

    def start(self) -> None:
        """Step each millisecond in a thread of its own until `close`."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._serve, name="board", daemon=True)
            self._thread.start()

    def unplug(self) -> None:
        """Take the cable out: the path vanishes, and what the host has open hangs up. The board runs on."""
        with self._lock:
            if self._master is None:
                return
            Path(self.path).unlink(missing_ok=True)
            os.close(self._master)
            self._master = None
            self._host_there = False
            self._unread = b""

    def replug(self) -> None:
        """Put the cable in: the path is there again, on another pseudo terminal."""
        with self._lock:
            if self._master is not None:
                return
            master, slave = os.openpty()
            try:
                tty.setraw(slave)  # else what the board says before the host sets its port up comes back as an echo
                os.symlink(os.ttyname(slave), self.path)
            except OSError:
                os.close(master)
                raise
            finally:
                os.close(slave)  # from here on POLLHUP is there until a host opens it
            os.set_blocking(master, False)
            self._poll = select.poll()
            self._poll.register(master, 0)
            self._master = master

    def close(self) -> None:
        """Stop the thread and remove everything; may be called twice."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self.unplug()
        if self._directory is not None:
            shutil.rmtree(self._directory, ignore_errors=True)

    def _serve(self) -> None:
        try:
            while not self._stop.wait(STEP_S):
                self.step(self._clock())
        finally:
            self.unplug()  # a board that is dead must look so

    def _take_in(self, master: int, now_ns: int) -> None:
        room = min(self.board.room(now_ns), _READ_BYTES)
        if room:
            with contextlib.suppress(OSError):  # nothing there, or nobody
                self.board.receive(os.read(master, room), now_ns)

    def _give_out(self, master: int, data: bytes) -> None:
        if not self._host_there:
            return
        self._unread = (self._unread + data)[:_UNREAD_BYTES]
        if self._unread:
            with contextlib.suppress(OSError):
                self._unread = self._unread[os.write(master, self._unread) :]


class BenchPeripherals:
    """Peripherals of a board on the bench.

    `pulses` has the (t_ns, servo_us, motor_us) of the newest 10,000 servo frames. `sensors` is what is read; assign to
    it.
    """

    def __init__(self) -> None:
        self.pulses: deque[tuple[int, float, float]] = deque(maxlen=10_000)
        self.sensors = BoardSensors(ranges_m=(None, None, None), wheel_ticks=0, battery_v=7.4, yaw_rate_radps=None)

    @property
    def at_pins(self) -> tuple[float, float]:
        """The pulses (servo_us, motor_us) at the pins now."""
        _, servo_us, motor_us = self.pulses[-1]
        return servo_us, motor_us

    def set_pulses(self, t_ns: int, servo_us: float, motor_us: float) -> None:
        """Note the pulses."""
        self.pulses.append((t_ns, servo_us, motor_us))

    def read_sensors(self, t_ns: int) -> BoardSensors:
        """`sensors`."""
        return self.sensors
