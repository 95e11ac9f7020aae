"""The emulated vehicle on any bus of python-can, in real time: the other end of the wire, in a process of its own."""

from __future__ import annotations

import contextlib
import random
import threading
import time

from firmware_link.can_port import CanPort
from firmware_link.emulator.can_vehicle import EmulatedCanVehicle
from firmware_link.errors import LinkError

STEP_S = 0.001
_REST_S = 0.2  # between two tries to join a bus that was lost


def own_group() -> str:
    """A multicast address for one vehicle: two that run on a machine at a time do not hear each other."""
    draw = random.SystemRandom()
    return f"239.74.{draw.randrange(1, 255)}.{draw.randrange(1, 255)}"  # 239/8 is for use within an organisation


class ServedCanVehicle:
    """Serves a vehicle on a bus in a thread, with the monotonic clock; `path` is the channel.

    `start` joins the bus and raises LinkError where that fails.
    """

    def __init__(self, vehicle: EmulatedCanVehicle, port: CanPort, channel: str) -> None:
        self.vehicle, self.path = vehicle, channel
        self._port = port
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="can-vehicle", daemon=True)

    def start(self) -> None:
        """Join the bus, and serve it."""
        self._port.open()
        self._thread.start()

    def step(self, now_ns: int) -> None:
        """Take what has come, act up to now, and send what is due."""
        for frame in self._port.receive(now_ns).frames:
            self.vehicle.take(frame)
        self.vehicle.advance(now_ns)
        for frame in self.vehicle.collect():
            self._port.send(frame.frame_id, frame.data, frame.extended)

    def close(self) -> None:
        """Leave the bus; may be called twice."""
        self._done.set()
        if self._thread.is_alive():
            self._thread.join()
        self._port.close()

    def _serve(self) -> None:
        while not self._done.wait(STEP_S):
            try:
                self.step(time.monotonic_ns())
            except LinkError:
                self._port.close()
                self._done.wait(_REST_S)
                with contextlib.suppress(LinkError):
                    self._port.open()
