"""A board on a pseudo terminal, which can be opened like a serial port, and peripherals for a board on the bench."""

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
_UNREAD_BYTES = 4096  # queued for a host that does not read, in addition to the kernel's buffer


class ServedBoard(Board, Protocol):
    """A board that reports the free space of its line."""

    def room(self, now_ns: int) -> int:
        """The number of bytes that `receive` accepts at `now_ns`."""
        ...


class PtyBoard:
    """Serves a board at `path`, a symbolic link that stays the same over `unplug` and `replug`.

    `step` runs one step without blocking; call it about each millisecond, or `start` a thread that does so with the
    monotonic clock. `step`, `unplug`, `replug` and `call` hold a lock, so that only one thread uses the board and its
    peripherals at a time.

    Opening the port resets the board, as the DTR line of a real one: the kernel reports POLLHUP on the master while the
    slave is closed, and the step in which it is gone resets the board. (A close and an open between two steps are not
    detected; the board keeps running, as without a reset line.) While the port is closed, the board's bytes are lost.

    Host to board: bytes stay in the kernel's buffer until the board's line has room, which blocks a host that writes
    too much. Board to host: the kernel's buffer and 4096 more bytes, then the newest are lost.
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
        """Run the board up to `now_ns`, and transfer bytes in both directions."""
        with self._lock:
            if self._master is None:
                self.board.advance(now_ns)
                self.board.transmit(now_ns)
                return
            there = not any(event & select.POLLHUP for _, event in self._poll.poll(0))
            if there and not self._host_there:
                self._unread = b""
                self.board.reset(now_ns)
                self.board.transmit(now_ns)  # earlier bytes are not for this host, as a tty's buffer is flushed
            self._host_there = there
            self._take_in(self._master, now_ns)  # also the last bytes of a host that has just closed the port
            self.board.advance(now_ns)
            self._give_out(self._master, self.board.transmit(now_ns))

    def call(self, function: Callable[[], None]) -> None:
        """Call `function` between two steps, for example to inject a fault into the board."""
        with self._lock:
            function()

    def start(self) -> None:
        """Call `step` each millisecond in a thread until `close`."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._serve, name="board", daemon=True)
            self._thread.start()

    def unplug(self) -> None:
        """Unplug the cable: the path disappears, and the host's open port hangs up. The board keeps running."""
        with self._lock:
            if self._master is None:
                return
            Path(self.path).unlink(missing_ok=True)
            os.close(self._master)
            self._master = None
            self._host_there = False
            self._unread = b""

    def replug(self) -> None:
        """Plug the cable in: the path is restored, on another pseudo terminal."""
        with self._lock:
            if self._master is not None:
                return
            master, slave = os.openpty()
            try:
                tty.setraw(slave)  # else bytes that the board sends before the host configures its port are echoed
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
            self.unplug()  # a dead board must not look alive

    def _take_in(self, master: int, now_ns: int) -> None:
        room = min(self.board.room(now_ns), _READ_BYTES)
        if room:
            with contextlib.suppress(OSError):  # no data, or no host
                self.board.receive(os.read(master, room), now_ns)

    def _give_out(self, master: int, data: bytes) -> None:
        if not self._host_there:
            return
        self._unread = (self._unread + data)[:_UNREAD_BYTES]
        if self._unread:
            with contextlib.suppress(OSError):
                self._unread = self._unread[os.write(master, self._unread) :]


class BenchPeripherals:
    """Peripherals of a board on the bench, where nothing moves.

    `pulses` has the (t_ns, servo_us, motor_us) of the newest 10,000 servo frames; assign the readings to `sensors`.
    """

    def __init__(self) -> None:
        self.pulses: deque[tuple[int, float, float]] = deque(maxlen=10_000)
        self.sensors = BoardSensors(ranges_m=(None, None, None), wheel_ticks=0, battery_v=7.4, yaw_rate_radps=None)

    @property
    def at_pins(self) -> tuple[float, float]:
        """The pulses (servo_us, motor_us) at the pins now; 0 where there are none."""
        _, servo_us, motor_us = self.pulses[-1] if self.pulses else (0, 0.0, 0.0)
        return servo_us, motor_us

    def set_pulses(self, t_ns: int, servo_us: float, motor_us: float) -> None:
        """Record the pulses."""
        self.pulses.append((t_ns, servo_us, motor_us))

    def read_sensors(self, t_ns: int) -> BoardSensors:
        """`sensors`."""
        return self.sensors
