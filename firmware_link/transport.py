"""The pipe to a board: bytes out, bytes in, never blocking."""

from __future__ import annotations

import errno
import os
from typing import TYPE_CHECKING, Protocol

from firmware_link.errors import PortLost, PortNotFound, PortRefused

if TYPE_CHECKING:
    import serial

_READ_BYTES = 4096
_BACKLOG_BYTES = 256  # 18 commands; more than the line carries while a command is valid


class Clock(Protocol):
    """Integer nanoseconds that never go back; the runner's clocks are such."""

    def now_ns(self) -> int:
        """The time now [ns]."""
        ...


class Transport(Protocol):
    """A pipe of bytes; no call blocks. Every call but `close` may raise a LinkError."""

    def open(self) -> None:
        """Open the pipe; this may reset the board."""
        ...

    def write(self, data: bytes) -> None:
        """Hand `data` over for sending."""
        ...

    def read(self) -> bytes:
        """What has arrived since the last call, empty when nothing has."""
        ...

    def close(self) -> None:
        """Close the pipe; may be called twice, and opened again afterwards."""
        ...


class SerialTransport:
    """A serial port (or pty) through pyserial.

    What the port does not take at once is kept, 256 bytes at most: a port that takes nothing for longer is lost.
    Unread input is bounded by the system's own buffer; a read takes 4096 bytes at most.
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
        except (OSError, ValueError) as error:  # SerialException is an OSError; termios.error is none, see below
            raise self._not_opened(error) from None

    def _not_opened(self, error: Exception) -> PortNotFound | PortRefused:
        number = getattr(error, "errno", None)
        if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EIO):
            return PortNotFound(f"{self._port}: no such port; {likely_ports()}")
        if number in (errno.EACCES, errno.EPERM):
            return PortRefused(f"{self._port}: permission denied; add the user to the group that owns it (dialout)")
        if number in (errno.EBUSY, errno.EAGAIN):
            return PortRefused(f"{self._port}: another program holds the port; close it")
        return PortRefused(f"{self._port}: cannot be opened as a serial port at {self._baud} baud: {error}")

    def write(self, data: bytes) -> None:
        """Send `data`, or keep what does not go out at once; raises PortLost."""
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
            raise PortLost(f"{self._port}: takes no more bytes; check the cable, then it is opened again")

    def read(self) -> bytes:
        """What has arrived, 4096 bytes at most; raises PortLost."""
        if self._serial is None:
            raise PortLost(f"{self._port}: not open")
        try:
            return self._serial.read(_READ_BYTES)
        except OSError as error:
            raise self._lost(error) from None

    def _lost(self, error: Exception) -> PortLost:
        return PortLost(f"{self._port}: vanished ({error}); check the cable, then it is opened again")

    def close(self) -> None:
        """Close the port."""
        if self._serial is not None:
            self._serial.close()
        self._serial = None
        self._backlog = b""


def likely_ports() -> str:
    """One phrase for error messages: the ports that a board is likely to be at, and where to write it."""
    from serial.tools import list_ports

    found = [f"{p.device} ({p.description})" for p in list_ports.comports() if p.vid is not None]
    if not found:
        return "no USB serial port was found: plug the board in, or set [link] port in car.toml"
    return f"likely: {', '.join(sorted(found))}; set [link] port in car.toml"


class Board(Protocol):
    """A board in this process, on time that is passed in; `emulator.board.EmulatedArduino` is one."""

    def reset(self, now_ns: int) -> None:
        """Restart, as when its port is opened."""
        ...

    def receive(self, data: bytes, now_ns: int) -> int:
        """Put bytes on the line to the board; how many there was room for."""
        ...

    def transmit(self, now_ns: int) -> bytes:
        """The bytes that have come from the board since the last call."""
        ...

    def advance(self, now_ns: int) -> None:
        """Run the board's program up to `now_ns`."""
        ...


class MemoryTransport:
    """A board in this process behind the same bytes as a serial line, on any clock.

    `unplug` and `replug` do what they say to the cable.
    """

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
            raise PortLost("memory: takes no more bytes; the board's line is full")

    def read(self) -> bytes:
        """Run the board up to now; what it has sent. Raises PortLost."""
        self._check()
        now_ns = self._clock.now_ns()
        self._board.advance(now_ns)
        return self._board.transmit(now_ns)

    def close(self) -> None:
        """Close; the board goes on."""
        self._open = False

    def unplug(self) -> None:
        """Take the cable out."""
        self._plugged = False

    def replug(self) -> None:
        """Put the cable in again; the port must be opened again."""
        self._open = False
        self._plugged = True

    def _check(self) -> None:
        if not (self._open and self._plugged):
            raise PortLost("memory: vanished; the cable is unplugged or the port is not open")
