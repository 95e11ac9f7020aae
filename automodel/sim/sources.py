"""Sources of simulated frames: in lock-step on virtual time, or from a separate process in real time."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, Protocol

import cv2
import numpy as np

from automodel.runtime.clocks import VirtualClock
from automodel.runtime.os_signals import signals_held_back
from automodel.signals import Frame, StereoFrame
from automodel.sim.world import Scene, Surroundings
from automodel.sources.errors import SourceError
from automodel.types import Image


def frame_of(scene: Scene, image: Image, pair: bool) -> Frame | StereoFrame:
    """What the camera of a scene gives; of a `pair` the image is (2, h, w), left first."""
    if pair:
        return StereoFrame(t_ns=scene.t_ns, index=scene.index, left=image[0], right=image[1])
    return Frame(t_ns=scene.t_ns, index=scene.index, image=image)


class LockStepSource:
    """Implements `Source`: each `read` advances the virtual clock to the next capture plus `latency_ns`.

    The clock's `on_advance` moves the board and the world. `latency_ns` is the simulated time from taking up a frame to
    its command on the wire. A reader that took longer than a frame's period gets the newest frame, as from
    `CaptureThread`. `on_scene` gets the ground truth of each frame. Deterministic, and as fast as the machine.
    """

    def __init__(
        self,
        world: Surroundings[Any],
        clock: VirtualClock,
        rate_hz: float,
        latency_ns: int,
        on_scene: Callable[[Scene], None],
    ) -> None:
        self.world, self.clock = world, clock
        self._latency_ns = latency_ns
        self._on_scene = on_scene
        self._start_ns, self._rate_hz, self._index = clock.now_ns(), rate_hz, 0

    def read(self, timeout_s: float) -> Frame | StereoFrame | None:
        """The next frame; None, with `timeout_s` elapsed, if none is due within it."""
        now_ns = self.clock.now_ns()
        taken = int((now_ns - self._start_ns) * 1e-9 * self._rate_hz)
        self._index = max(self._index, taken - 1)  # the reader was late: older frames are lost as with a camera
        t_ns = self._time_of(self._index + 1)
        deadline_ns = now_ns + round(timeout_s * 1e9)
        if t_ns > deadline_ns:
            self.clock.advance_to(deadline_ns)
            return None
        self._index += 1
        self.clock.advance_to(max(t_ns, now_ns))
        image, scene = self.world.capture(t_ns, self._index)
        self._on_scene(scene)
        self.clock.advance_to(max(t_ns, now_ns) + self._latency_ns)
        return frame_of(scene, image, self.world.pair)

    def _time_of(self, index: int) -> int:
        return self._start_ns + round(index * 1e9 / self._rate_hz)

    def close(self) -> None:
        """Nothing to release."""


SLOTS = 8
LEAD_NS = 14_000_000  # a frame is rendered this much before its capture time
NICE = -15  # of the world's process: nearly all of its core against ordinary processes, which still get some
SETTLED_NS = 3_000_000  # the board's thread is at most this much behind


class Port(Protocol):
    """The board's serial port, served in real time."""

    path: str

    def start(self) -> None:
        """Serve the port in a thread."""
        ...

    def close(self) -> None:
        """Stop and remove the port."""
        ...


WorldFactory = Callable[..., tuple[Surroundings[Any], Port]]


class RealTimeWorld:
    """Implements `Source`: the simulated world in a separate process, in real time.

    `factory(*arguments)` builds the world in the child process; `port` is the serial port of its board. Frames come
    through shared memory (a ring of `SLOTS`), announced over a pipe. They are rendered ahead (see `World`) and arrive
    at their capture time. `shape` is that of an image; with `pair` of two, (2, h, w).
    """

    START_TIMEOUT_S = 20.0
    STOP_TIMEOUT_S = 5.0

    def __init__(
        self,
        factory: WorldFactory,
        arguments: tuple[Any, ...],
        shape: tuple[int, ...],
        rate_hz: float,
        on_scene: Callable[[Scene], None],
        *,
        pair: bool = False,
    ) -> None:
        context = multiprocessing.get_context("spawn")
        size = int(np.prod(shape))
        memory = context.RawArray("B", size * SLOTS)
        self._slots = np.frombuffer(memory, dtype=np.uint8).reshape((SLOTS, *shape))
        self._pipe, theirs = context.Pipe()
        self._on_scene, self._pair = on_scene, pair
        self._process = context.Process(
            target=_serve, args=(factory, arguments, memory, shape, rate_hz, theirs), daemon=True
        )
        with signals_held_back():
            self._process.start()
        theirs.close()
        try:
            self.port = self._await_port()
        except BaseException:  # also an interrupt: the child must not outlive this process
            self.close()
            raise

    def read(self, timeout_s: float) -> Frame | StereoFrame | None:
        """The newest frame, None if none came in time; raises SourceError when the world's process has died.

        Older frames are dropped: the ring may have been overwritten.
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
        return frame_of(scene, self._slots[slot].copy(), self._pair)

    def close(self) -> None:
        """End the world's process."""
        with contextlib.suppress(OSError):
            self._pipe.send("stop")
        self._process.join(self.STOP_TIMEOUT_S)
        if self._process.is_alive():
            self._process.kill()
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
    cv2.setNumThreads(1)  # the driving process needs the other core
    with contextlib.suppress(OSError):  # a real camera and board do not wait for a busy machine; not everyone may ask
        os.nice(NICE)
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
            if now > t_ns:  # the machine was busy: the frame is lost as with a camera
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
