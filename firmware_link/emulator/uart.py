"""One direction of a serial line with transmission times of 10 bits per byte."""

from __future__ import annotations

from collections import deque

WIRE_BYTES = 4096  # queued on the host's side, as in a tty's buffer
_BITS_NS = 10 * 1_000_000_000  # start, 8 data, stop


class UartLine:
    """Bytes are sent one after the other at the baud rate, and arrive when their last bit is sent.

    At most `capacity` bytes are queued or in transmission.
    """

    def __init__(self, baud: int, capacity: int) -> None:
        if not baud > 0:
            raise ValueError(f"baud: expected a positive number, got {baud}")
        self._baud = baud
        self._capacity = capacity
        self._free_ns = 0  # when all queued bytes have been sent
        self._bursts: deque[tuple[int, bytes]] = deque()  # start of the first byte, contiguous bytes
        self._gone = 0  # bytes of the first burst that were taken

    def put(self, data: bytes, now_ns: int) -> int:
        """Queue `data`; gives the time at which its first bit is sent."""
        start_ns = max(now_ns, self._free_ns)
        self._free_ns = start_ns + len(data) * _BITS_NS // self._baud
        self._bursts.append((start_ns, data))
        return start_ns

    def room(self, now_ns: int) -> int:
        """The number of bytes that can be queued at `now_ns`."""
        waiting = -(-max(self._free_ns - now_ns, 0) * self._baud // _BITS_NS)
        return max(self._capacity - waiting, 0)

    def next_ns(self) -> int | None:
        """The time at which the next byte arrives."""
        if not self._bursts:
            return None
        return self._bursts[0][0] + (self._gone + 1) * _BITS_NS // self._baud

    def take(self, now_ns: int) -> bytes:
        """The bytes that have arrived by `now_ns`."""
        bursts = self._bursts
        out = b""
        while bursts:
            start_ns, data = bursts[0]
            count = min(((now_ns - start_ns + 1) * self._baud - 1) // _BITS_NS, len(data))  # those at now_ns too
            if count > self._gone:
                out += data[self._gone : count]
                self._gone = count
            if self._gone < len(data):
                break
            bursts.popleft()
            self._gone = 0
        return out

    def clear(self) -> None:
        """Drop all bytes that have not arrived."""
        self._bursts.clear()
        self._gone = 0
        self._free_ns = 0


class UartBoard:
    """The serial line of a board, in both directions; `tx_capacity` bytes are queued for sending."""

    def __init__(self, baud: int, tx_capacity: int) -> None:
        self._rx = UartLine(baud, WIRE_BYTES)
        self._tx = UartLine(baud, tx_capacity)
        self._sent = b""  # on the host's side

    def room(self, now_ns: int) -> int:
        """The number of bytes that `receive` accepts at `now_ns`."""
        return self._rx.room(now_ns)

    def receive(self, data: bytes, now_ns: int) -> int:
        """Put the host's bytes on the line; gives the number of accepted ones, the others are lost."""
        taken = data[: self._rx.room(now_ns)]
        if taken:
            self._rx.put(taken, now_ns)
        return len(taken)

    def transmit(self, now_ns: int) -> bytes:
        """The bytes sent by `now_ns` since the last call; at most 4096, the newest are lost."""
        self._collect(now_ns)
        sent, self._sent = self._sent, b""
        return sent

    def _collect(self, now_ns: int) -> None:
        arrived = self._tx.take(now_ns)
        if arrived:
            self._sent = (self._sent + arrived)[:WIRE_BYTES]  # a full tty drops the newest
