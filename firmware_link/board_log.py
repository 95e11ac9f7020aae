"""What a board says, written down as it goes by: for measurements that need the board's own times."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_link import messages
from firmware_link.transport import Clock, Transport

_WRAP_US = 1 << 32
_BUCKET_NS = 1_000_000_000
STATUS_LATE_NS = 1_000_000  # a status is said so long after the servo frame that it tells of has begun


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
    """A transport that passes everything on and keeps `pins` and `rolled`, the board's own words.

    They begin anew when the pipe is opened and when the board restarts.
    """

    def __init__(self, transport: Transport, clock: Clock) -> None:
        self._transport, self._clock = transport, clock
        self._decoder = messages.decoder(on_board=False)
        self._forget()

    def _forget(self) -> None:
        self.pins: list[Pins] = []
        self.rolled: list[Rolled] = []
        self._heard: list[tuple[int, int]] = []  # the board's time, and the host's when it came
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
        """As the transport's; what was written down stays."""
        self._transport.close()

    def host_ns(self, board_ns: Sequence[int]) -> NDArray[np.int64]:
        """The host's times [ns] of the board's.

        A line through the least delays of each second: a board's resonator may be half a percent off, and nothing that
        is held up on the way counts. The shortest way over the wire, a millisecond or two, stays in.
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
