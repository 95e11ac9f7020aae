"""A message for another process, replaced by each newer one; neither side ever waits."""

from __future__ import annotations

import struct
from multiprocessing.context import SpawnContext

_HEAD = struct.Struct("<QQ")  # number of the message, its length in bytes


class Mailbox:
    """One slot of shared memory for up to `capacity` bytes; passed to the other process as an argument of its start.

    The lock is only tried: another side that is copying, has stopped or has died costs a message, no time.
    """

    def __init__(self, context: SpawnContext, capacity: int) -> None:
        self._memory = context.RawArray("B", _HEAD.size + capacity)
        self._lock = context.Lock()
        self._number = 0  # of the last message put or taken, in this process

    def put(self, message: bytes) -> bool:
        """Replace the message; False where it is too long or the reader is copying the one before."""
        view = memoryview(self._memory).cast("B")
        if _HEAD.size + len(message) > len(view) or not self._lock.acquire(block=False):
            return False
        try:
            self._number += 1
            view[_HEAD.size : _HEAD.size + len(message)] = message
            _HEAD.pack_into(view, 0, self._number, len(message))
        finally:
            self._lock.release()
        return True

    def take(self) -> bytes | None:
        """The newest message, None where there is none since the last call, or one is being put; never waits either."""
        view = memoryview(self._memory).cast("B")
        if not self._lock.acquire(block=False):
            return None
        try:
            number, length = _HEAD.unpack_from(view, 0)
            if number == self._number:
                return None
            self._number = number
            return bytes(view[_HEAD.size : _HEAD.size + length])
        finally:
            self._lock.release()
