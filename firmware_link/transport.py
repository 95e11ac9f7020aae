"""The byte pipe to a board, non-blocking: a serial port, a board in the same process, and a logger of board times."""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from automodel.types import IntArray
from firmware_link import messages
from firmware_link.errors import PortLost, PortNotFound, PortRefused

if TYPE_CHECKING:
    import serial

STATUS_LATE_NS = 1_000_000  # delay of a status after the start of the servo frame that it reports
_READ_BYTES = 4096
_BACKLOG_BYTES = 256  # 18 commands; more than the line transmits while a command is valid
_WRAP_US = 1 << 32
_BUCKET_NS = 1_000_000_000


class Clock(Protocol):
    """A monotonic clock in integer nanoseconds, such as the runner's."""

    def now_ns(self) -> int:
        """The time now [ns]."""
        ...


class Transport(Protocol):
    """A pipe of bytes; no call blocks. Every call but `close` may raise a LinkError."""

    def open(self) -> None:
        """Open the pipe; this may reset the board."""
        ...

    def write(self, data: bytes) -> None:
        """Send `data`."""
        ...

    def read(self) -> bytes:
        """The bytes that have arrived since the last call."""
        ...

    def close(self) -> None:
        """Close the pipe; may be called twice. It can be opened again."""
        ...


class SerialTransport:
    """A serial port (or pty) through pyserial.

    At most 256 bytes that the port does not accept at once are queued; then the port is lost. Unread input is limited
    by the system's buffer; a read gives at most 4096 bytes.
    """

    def __init__(self, port: str, baud: int) -> None:
        self._port = port
        self._baud = baud
        self._serial: serial.Serial | None = None
        self._backlog = b""

    def open(self) -> None:
        """Open the port; raises PortNotFound or PortRefused."""
        import serial

        self.close()
        try:
            self._serial = serial.Serial(self._port, self._baud, timeout=0, write_timeout=0, exclusive=True)
        except (OSError, ValueError) as error:  # SerialException is an OSError
            raise self._not_opened(error) from None

    def _not_opened(self, error: Exception) -> PortNotFound | PortRefused:
        number = getattr(error, "errno", None)
        if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EIO):
            return PortNotFound(f"{self._port}: no such port; {likely_ports()}")
        if number in (errno.EACCES, errno.EPERM):
            return PortRefused(f"{self._port}: permission denied; add the user to the group that owns it (dialout)")
        if number in (errno.EBUSY, errno.EAGAIN):
            return PortRefused(f"{self._port}: another program uses the port; close it")
        return PortRefused(f"{self._port}: cannot be opened as a serial port at {self._baud} baud: {error}")

    def write(self, data: bytes) -> None:
        """Send `data`, or queue what the port does not accept at once; raises PortLost."""
        if self._serial is None:
            raise PortLost(f"{self._port}: not open")
        self._backlog += data
        try:
            sent = os.write(self._serial.fileno(), self._backlog)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            raise self._lost(error) from None
        self._backlog = self._backlog[sent:]
        if len(self._backlog) > _BACKLOG_BYTES:
            raise PortLost(f"{self._port}: accepts no more bytes; check the cable, then it is opened again")

    def read(self) -> bytes:
        """The bytes that have arrived, at most 4096; raises PortLost."""
        if self._serial is None:
            raise PortLost(f"{self._port}: not open")
        try:
            # To read or poll an empty tty waits for the kernel's worker that fills it, whatever the timeout: on a busy
            # machine for half a second. To ask how much there is does not.
            waiting = self._serial.in_waiting
            return os.read(self._serial.fileno(), min(waiting, _READ_BYTES)) if waiting else b""
        except OSError as error:
            raise self._lost(error) from None

    def _lost(self, error: Exception) -> PortLost:
        return PortLost(f"{self._port}: disappeared ({error}); check the cable, then it is opened again")

    def close(self) -> None:
        """Close the port."""
        if self._serial is not None:
            self._serial.close()
        self._serial = None
        self._backlog = b""


def likely_ports() -> str:
    """A phrase for error messages: the likely ports of a board, and where to configure the port."""
    from serial.tools import list_ports

    found = [f"{p.device} ({p.description})" for p in list_ports.comports() if p.vid is not None]
    if not found:
        return "no USB serial port was found: plug the board in, or set [link] port in car.toml"
    return f"likely: {', '.join(sorted(found))}; set [link] port in car.toml"


class Board(Protocol):
    """A board in this process, such as `emulator.board.EmulatedArduino`; time is an argument."""

    def reset(self, now_ns: int) -> None:
        """Restart, as on opening the port."""
        ...

    def receive(self, data: bytes, now_ns: int) -> int:
        """Put bytes on the line to the board; gives the number of accepted bytes."""
        ...

    def transmit(self, now_ns: int) -> bytes:
        """The bytes from the board since the last call."""
        ...

    def advance(self, now_ns: int) -> None:
        """Run the board's program up to `now_ns`."""
        ...


class MemoryTransport:
    """A board in this process behind the same bytes as a serial line, on any clock."""

    def __init__(self, board: Board, clock: Clock) -> None:
        self._board = board
        self._clock = clock
        self._open = False
        self._plugged = True

    def open(self) -> None:
        """Open, which resets the board; raises PortNotFound while unplugged."""
        if not self._plugged:
            raise PortNotFound("memory: no such port; the cable is unplugged")
        self._open = True
        self._board.reset(self._clock.now_ns())

    def write(self, data: bytes) -> None:
        """Put `data` on the line; raises PortLost."""
        self._check()
        if self._board.receive(data, self._clock.now_ns()) < len(data):
            raise PortLost("memory: accepts no more bytes; the board's line is full")

    def read(self) -> bytes:
        """Run the board up to now; gives the bytes that it has sent. Raises PortLost."""
        self._check()
        now_ns = self._clock.now_ns()
        self._board.advance(now_ns)
        return self._board.transmit(now_ns)

    def close(self) -> None:
        """Close; the board keeps running."""
        self._open = False

    def unplug(self) -> None:
        """Unplug the cable."""
        self._plugged = False

    def replug(self) -> None:
        """Plug the cable in again; the port must be opened again."""
        self._open = False
        self._plugged = True

    def _check(self) -> None:
        if not (self._open and self._plugged):
            raise PortLost("memory: disappeared; the cable is unplugged or the port is not open")


class Pins(NamedTuple):
    """The pulses at the pins from the board's time `board_ns` on."""

    board_ns: int
    servo_us: float
    motor_us: float


class Rolled(NamedTuple):
    """Wheel ticks and yaw rate [rad/s] (None without a gyro) at the board's time `board_ns`."""

    board_ns: int
    ticks: int
    yaw_rate_radps: float | None


class LoggedTransport:
    """A transport that forwards everything and logs the board's reports in `pins` and `rolled`.

    The logs are cleared when the pipe is opened and when the board restarts.
    """

    def __init__(self, transport: Transport, clock: Clock) -> None:
        self._transport, self._clock = transport, clock
        self._decoder = messages.decoder(on_board=False)
        self._forget()

    def _forget(self) -> None:
        self.pins: list[Pins] = []
        self.rolled: list[Rolled] = []
        self._heard: list[tuple[int, int]] = []  # the board's time, and the host's time of arrival
        self._last_us: int | None = None

    def open(self) -> None:
        """As the transport's."""
        self._transport.open()
        self._decoder.reset()
        self._forget()

    def write(self, data: bytes) -> None:
        """As the transport's."""
        self._transport.write(data)

    def read(self) -> bytes:
        """As the transport's."""
        data = self._transport.read()
        for frame in self._decoder.feed(data):
            message = messages.decode(frame)
            if isinstance(message, messages.Status):
                board_ns = self._board_ns(message.time_us)
                self.pins.append(Pins(board_ns - STATUS_LATE_NS, message.servo_us, message.motor_us))
            elif isinstance(message, messages.Odometry):
                board_ns = self._board_ns(message.time_us)
                self.rolled.append(Rolled(board_ns, message.wheel_ticks, message.yaw_rate_radps))
        return data

    def close(self) -> None:
        """As the transport's; the logs are kept."""
        self._transport.close()

    def host_ns(self, board_ns: Sequence[int]) -> IntArray:
        """The host times [ns] of board times.

        From a line through the smallest delay of each second: a board's resonator may be off by half a percent, and
        delayed messages do not count. The shortest transmission delay, a millisecond or two, is not corrected.
        """
        heard = np.array(self._heard, dtype=np.int64).reshape(-1, 2)
        start_ns, offsets = int(heard[0, 0]), heard[:, 1] - heard[:, 0]
        buckets = (heard[:, 0] - start_ns) // _BUCKET_NS
        least = [int(np.argmin(np.where(buckets == b, offsets, np.iinfo(np.int64).max))) for b in np.unique(buckets)]
        base = int(offsets[least[0]])
        seconds = (heard[least, 0] - start_ns) * 1e-9
        drift, late = np.polyfit(seconds, offsets[least] - base, 1) if len(least) > 2 else (0.0, 0.0)
        board = np.asarray(board_ns, dtype=np.int64)
        return board + base + np.round(late + drift * (board - start_ns) * 1e-9).astype(np.int64)

    def _board_ns(self, time_us: int) -> int:
        if self._last_us is not None:
            step_us = (time_us - self._last_us) % _WRAP_US
            if step_us < _WRAP_US // 2:
                time_us = self._last_us + step_us
            else:
                self._forget()
        self._last_us = time_us
        self._heard.append((time_us * 1000, self._clock.now_ns()))
        return time_us * 1000
