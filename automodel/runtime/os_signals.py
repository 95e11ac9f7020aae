"""What may break into a run from outside the loop: signals, and Python's garbage collector."""

from __future__ import annotations

import contextlib
import gc
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

# SIGHUP too: it comes when the network under a remote terminal breaks, and its default ends the process at once.
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")


_come: list[str] = []  # before a run


class Interrupted(KeyboardInterrupt):
    """A signal that ends the command.

    A class of its own, because Python may end a process by the signal even where KeyboardInterrupt itself was caught
    (it was in flight through an `exec` of text, as imports do); then the exit code would be none of ours.
    """


def interrupt(number: int, _frame: FrameType | None) -> None:
    """Handles a signal that comes outside a run: notes it, and raises Interrupted.

    It is noted because some imports swallow whatever is raised in them (numpy's among others): the command would go on
    as if nobody had pressed Ctrl-C.
    """
    _come.append(signal.Signals(number).name)
    raise Interrupted


def raise_if_interrupted() -> None:
    """Raise Interrupted where it has been raised before and swallowed."""
    if _come:
        raise Interrupted


@contextlib.contextmanager
def stop_on_signals() -> Iterator[Callable[[], str | None]]:
    """While inside, SIGINT, SIGTERM and SIGHUP only set a flag; the callable gives the signal's name, None before one.

    A second signal changes nothing, so that it cannot break the clean-up that the first one began. Outside the main
    thread, where Python takes no handlers, nothing is installed and the flag stays unset.
    """
    caught = _come[:1]  # one that was swallowed counts

    def note(number: int, _frame: FrameType | None) -> None:
        caught.append(signal.Signals(number).name)

    former = {}
    if threading.current_thread() is threading.main_thread():
        for name in _NAMES:
            if hasattr(signal, name):
                number = getattr(signal, name)
                former[number] = signal.signal(number, note)
    try:
        yield lambda: caught[0] if caught else None
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def signals_held_back() -> Iterator[None]:
    """While inside, SIGINT, SIGTERM and SIGHUP wait; a process started meanwhile never gets them.

    Ctrl-C goes to every process of the terminal: a child that must end in order is ended by its parent instead, and
    until it could say so itself it would die with a traceback.
    """
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # multiprocessing would start it itself, and let the signals through after that
    numbers = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Keep the collector out of the loop: a full collection takes tens of milliseconds, whenever it likes.

    What lives at the start is collected once and then set aside, so that the collections of `collect_young` and
    `collect_all` only look at what the run itself made.
    """
    enabled = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.unfreeze()
        if enabled:
            gc.enable()


def collect_young() -> None:
    """Collect what one cycle of the loop left in reference cycles.

    Its time is bounded: it looks only at the objects made since the last call, which is one cycle's worth when it is
    called every cycle (some ten microseconds), never at the heap.
    """
    gc.collect(0)


def collect_all() -> None:
    """Collect everything the run has made; only while the car stands still."""
    gc.collect()
