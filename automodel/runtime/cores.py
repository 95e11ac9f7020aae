"""Which threads run on which cores, and before which others: what a run in real time asks of Linux.

The loop has a core that nothing else of the program uses, and the camera's thread another one where there are three.
Where the system allows it loop, camera and recorder get nearly all of a core against other processes (niceness), and
are never swapped out (mlockall). All threads share one heap, in which some memory is kept in hand: a page that is asked
for anew costs the loop time, and locked memory cannot be given back in pieces.

Not SCHED_FIFO: with all cores busy with other work, loops at SCHED_FIFO stood still for 70 to 360 ms in reads of the
serial port, which waited for a worker of the kernel that has no such priority. The port is no longer read so
(`firmware_link.transport`), but that worker still hands its bytes on, and must find a core. For the same reason the
loop may use all cores: its own is where nothing else is put.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import sys
import threading
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from types import TracebackType

# The weight of 29 ordinary processes. The recorder's thread has it too: it must not be kept from giving Python's lock
# back, for which the loop waits.
NICE = -15
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4  # <sys/mman.h>; on fault: what is never used takes no memory
_M_ARENA_MAX = -8  # <malloc.h>
# Byte: in an hour with page and recording, where frames wait for the disk and chunks are put together, the process had
# up to 13 MB more than after its first minute.
_IN_HAND = 16 * 1024 * 1024
_PIECE = 64 * 1024  # byte, of which it is taken: larger blocks are mappings of their own, which a free gives back
_LINUX = sys.platform == "linux"


@dataclass(frozen=True, slots=True, kw_only=True)
class CorePlan:
    """The cores of the loop, of the camera's thread, and of everything else; None where there is only one core."""

    loop: frozenset[int]
    capture: frozenset[int]
    others: frozenset[int]


def plan_cores(usable: Collection[int]) -> CorePlan | None:
    """The plan for these cores: the last ones for loop and camera, because the first does most of the kernel's work."""
    cores = sorted(usable)
    if len(cores) < 2:
        return None
    loop, rest = frozenset(cores[-1:]), cores[:-1]
    if len(rest) < 2:
        return CorePlan(loop=loop, capture=frozenset(rest), others=frozenset(rest))
    return CorePlan(loop=loop, capture=frozenset(rest[-1:]), others=frozenset(rest[:-1]))


def usable_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if _LINUX else (os.cpu_count() or 1)


def denied() -> tuple[str, ...]:
    """What the system does not let this process do, in words; nothing where all is allowed. Changes nothing."""
    if not _LINUX:
        return ("real-time priority and cores of one's own are for Linux only",)
    found = []
    if not _may_be_favoured():
        found.append(f"the loop waits for other processes (no niceness of {NICE})")
    if not _may_lock_memory():
        found.append("memory may be swapped out (no mlockall)")
    return tuple(found)


class LoopCores:
    """While inside, what is started stays off the loop's core; after `claim` the calling thread is the loop.

    Everything is as it was at the end, but that threads share one heap. What the system does not allow is left out: see
    `denied`.
    """

    def __init__(self) -> None:
        self._usable: set[int] | None = None
        self._plan: CorePlan | None = None
        self._nice: int | None = None  # before it was claimed
        self._locked = False
        self._last: int | None = None  # above the memory in hand

    def __enter__(self) -> LoopCores:
        if _LINUX:
            _share_heap()
            self._usable = os.sched_getaffinity(0)
            self._plan = plan_cores(self._usable)
            if self._plan is not None:
                _run_on(0, self._plan.others)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._nice is not None:
            _favour(threading.get_native_id(), self._nice)
        if self._plan is not None and self._usable is not None:
            _run_on(0, self._usable)
        if self._locked:
            _libc().munlockall()
            _libc().free(self._last)

    def claim(self) -> None:
        """The calling thread is the loop from now on; the threads of camera and recorder get their places."""
        if self._plan is None or self._usable is None:
            return
        if self._nice is None:
            self._nice = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
        self._place()
        if _may_lock_memory() and not self._locked:
            self._locked = _libc().mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) == 0
            if self._locked:
                self._last = _in_hand()

    @contextlib.contextmanager
    def elsewhere(self) -> Iterator[None]:
        """While inside, the loop's thread is off its core: what it starts (a camera's process) inherits that."""
        if self._plan is None or self._usable is None:
            yield
            return
        _run_on(0, self._plan.others)
        if self._nice is not None:
            _favour(threading.get_native_id(), self._nice)
        try:
            yield
        finally:
            self._place()

    def _place(self) -> None:
        """Loop, camera and recorder where they belong."""
        assert self._plan is not None
        assert self._usable is not None
        _run_on(0, self._usable)
        _favour(threading.get_native_id(), NICE)
        for thread in threading.enumerate():
            if thread.name in ("capture", "recorder") and thread.native_id is not None:
                _run_on(thread.native_id, self._plan.capture if thread.name == "capture" else self._plan.others)
                _favour(thread.native_id, NICE)


def _run_on(thread: int, cores: Collection[int]) -> None:
    with contextlib.suppress(OSError):  # the thread has ended, or the system forbids it
        os.sched_setaffinity(thread, cores)


def _favour(thread: int, nice: int) -> bool:
    """Whether the thread has this niceness now."""
    try:
        os.setpriority(os.PRIO_PROCESS, thread, nice)  # of a thread, in Linux
    except OSError:
        return False
    return True


def _may_be_favoured() -> bool:
    """Whether a thread may have that niceness; tried on one that ends at once."""
    allowed: list[bool] = []
    thread = threading.Thread(target=lambda: allowed.append(_favour(threading.get_native_id(), NICE)))
    thread.start()
    thread.join()
    return allowed == [True]


def _may_lock_memory() -> bool:
    """Only without a limit: memory beyond one could not be had at all."""
    return os.geteuid() == 0 or resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY


def _share_heap() -> None:
    """All threads take their memory from one heap; nothing where the C library is not glibc."""
    if hasattr(_libc(), "mallopt"):
        _libc().mallopt(_M_ARENA_MAX, 1)


def _in_hand() -> int | None:
    """Take memory for what is needed for a moment, once memory is locked; the address of what keeps it.

    It is freed again, but lies below a block that stays: the heap's end is given back whenever somebody asks for that
    (protobuf does, every few thousand messages), but what is locked below it is not.
    """
    libc = _libc()
    blocks = [libc.malloc(_PIECE) for _ in range(_IN_HAND // _PIECE + 1)]
    *free, last = [block for block in blocks if block is not None]
    for block in free:
        ctypes.memset(block, 0, _PIECE)  # touched: the system hands a page out when it is written to
        libc.free(block)
    return last


def _libc() -> ctypes.CDLL:
    libc = ctypes.CDLL(None, use_errno=True)
    libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, (ctypes.c_size_t,)
    libc.free.restype, libc.free.argtypes = None, (ctypes.c_void_p,)
    return libc
