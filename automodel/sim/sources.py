"""A source of simulated frames that moves virtual time: deterministic, as fast as the machine can.

The simulated world in a process of its own, against the real clock: as a camera and a serial port, nothing else.

The parent gets frames through shared memory (a ring of `SLOTS`), each announced over a pipe at its very time of
capture, and the name of the board's serial port. Pictures are rendered ahead of their time (see `World`), so that they
arrive when a camera without delay would deliver them.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, Protocol

import cv2
import numpy as np

from automodel.runtime.clocks import VirtualClock
from automodel.runtime.os_signals import signals_held_back
from automodel.signals import Frame
from automodel.sim.world import Scene, World
from automodel.sources.errors import SourceError


class LockStepSource:
    """Implements `Source`: each `read` advances the clock to the next capture, plus the loop's own time.

    The clock's `on_advance` moves board and world, so that they follow whoever moves time.
    `latency_ns` stands for what the loop takes from capture to the byte on the wire: the clock shows it when `read`
    returns, so that commands reach the wire that much after their frame. `on_scene` is told the truth of each frame.
    """

    def __init__(
        self, world: World, clock: VirtualClock, rate_hz: float, latency_ns: int, on_scene: Callable[[Scene], None]
    ) -> None:
        self.world, self.clock = world, clock
        self._latency_ns = latency_ns
        self._on_scene = on_scene
        self._start_ns, self._rate_hz, self._index = clock.now_ns(), rate_hz, 0

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, None when it is not due within `timeout_s` (which then has passed)."""
        now_ns = self.clock.now_ns()
        if self._time_of(self._index + 1) < now_ns:  # somebody waited longer: those frames are lost, as a camera's are
            self._index = int((now_ns - self._start_ns) * 1e-9 * self._rate_hz)
        t_ns = self._time_of(self._index + 1)
        deadline_ns = now_ns + round(timeout_s * 1e9)
        if t_ns > deadline_ns:
            self.clock.advance_to(deadline_ns)
            return None
        self._index += 1
        self.clock.advance_to(max(t_ns, now_ns))
        image, scene = self.world.capture(t_ns, self._index)
        self._on_scene(scene)
        self.clock.advance_to(max(t_ns + self._latency_ns, now_ns))
        return Frame(t_ns=t_ns, index=self._index, image=image)

    def _time_of(self, index: int) -> int:
        return self._start_ns + round(index * 1e9 / self._rate_hz)

    def close(self) -> None:
        """Nothing to give back."""


SLOTS = 8
LEAD_NS = 14_000_000  # time that a picture is rendered ahead
SETTLED_NS = 3_000_000  # the board's thread is no further behind than this


class Port(Protocol):
    """The board's serial port, served against the real clock."""

    path: str

    def start(self) -> None:
        """Serve it in a thread."""
        ...

    def close(self) -> None:
        """Stop and remove it."""
        ...


WorldFactory = Callable[..., tuple[World, Port]]


class RealTimeWorld:
    """Implements `Source`. `port` is the serial port to open; `factory(*arguments)` builds the world in the child."""

    START_TIMEOUT_S = 20.0
    STOP_TIMEOUT_S = 5.0

    def __init__(
        self,
        factory: WorldFactory,
        arguments: tuple[Any, ...],
        shape: tuple[int, ...],
        rate_hz: float,
        on_scene: Callable[[Scene], None],
    ) -> None:
        context = multiprocessing.get_context("spawn")
        size = int(np.prod(shape))
        memory = context.RawArray("B", size * SLOTS)
        self._slots = np.frombuffer(memory, dtype=np.uint8).reshape((SLOTS, *shape))
        self._pipe, theirs = context.Pipe()
        self._on_scene = on_scene
        self._process = context.Process(
            target=_serve, args=(factory, arguments, memory, shape, rate_hz, theirs), daemon=True
        )
        with signals_held_back():
            self._process.start()
        theirs.close()
        try:
            self.port = self._await_port()
        except BaseException:  # an interrupt, too: the process must not outlive this one
            self.close()
            raise

    def read(self, timeout_s: float) -> Frame | None:
        """The newest frame, None when none came in time; raises SourceError when the world's process died.

        Frames that nobody fetched are gone, as a camera's are: the ring would have been written over under them.
        """
        try:
            if not self._pipe.poll(timeout_s):
                return None
            while True:
                slot, scene = self._pipe.recv()
                self._on_scene(scene)
                if not self._pipe.poll(0):
                    break
        except (EOFError, OSError) as error:
            raise SourceError("the simulated world's process has ended") from error
        return Frame(t_ns=scene.t_ns, index=scene.index, image=self._slots[slot].copy())

    def close(self) -> None:
        """End the world's process."""
        with contextlib.suppress(OSError):
            self._pipe.send("stop")
        self._process.join(self.STOP_TIMEOUT_S)
        if self._process.is_alive():
            self._process.kill()  # nothing less gets through
            self._process.join()
        self._pipe.close()

    def _await_port(self) -> str:
        try:
            if self._pipe.poll(self.START_TIMEOUT_S):
                return str(self._pipe.recv())
        except (EOFError, OSError):
            pass
        raise SourceError("the simulated world's process did not start")


def _serve(
    factory: WorldFactory,
    arguments: tuple[Any, ...],
    memory: Any,
    shape: tuple[int, ...],
    rate_hz: float,
    pipe: Connection,
) -> None:
    cv2.setNumThreads(1)  # the other core is the driving process's
    slots = np.frombuffer(memory, dtype=np.uint8).reshape((SLOTS, *shape))
    world, port = factory(*arguments)
    index, start = 0, time.monotonic_ns()
    try:
        port.start()
        pipe.send(port.path)
        while not pipe.poll(0):
            index += 1
            t_ns = start + round(index * 1e9 / rate_hz)
            _sleep_until(t_ns - LEAD_NS)
            now = time.monotonic_ns()
            if now > t_ns:  # the machine was busy: this picture is lost, as a camera would lose it
                continue
            world.settle(now - SETTLED_NS)
            image, scene = world.capture(t_ns, index)
            slots[index % SLOTS] = image
            _sleep_until(t_ns)
            pipe.send((index % SLOTS, scene))
    except (BrokenPipeError, EOFError, OSError):
        pass  # the parent is gone
    finally:
        port.close()


def _sleep_until(t_ns: int) -> None:
    while (left := t_ns - time.monotonic_ns()) > 0:
        time.sleep(left * 1e-9)
