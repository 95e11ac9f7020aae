"""What stands in for the devices of a real car: a camera over a straight road, and an Arduino on a pseudo terminal."""

from __future__ import annotations

import time
from pathlib import Path

from automodel.assembly.simulated_car import Simulation, build_world
from automodel.config import CarConfig
from automodel.signals import Frame
from automodel.sources.errors import SourceError
from automodel.types import Image

PERIOD_NS = 16_666_667
CAR_TOML = """
[camera]
source = "usb"
[link]
port = "{port}"
[safety]  # a loaded machine is slow; what is tested is the order of things
frame_timeout_s = 2.0
hold_s = 2.0
[recording]
directory = "{recordings}"
"""


def road() -> Image:
    """What the simulated car sees from the middle of its lane."""
    image, _ = build_world(CarConfig(), Simulation(track="oval", style="clean")).capture(0, 0)
    return image


class StillCamera:
    """Implements `Source`: the same view at 60 Hz, with a bit of noise; from `dies_at` on, the device is gone."""

    def __init__(self, image: Image, dies_at: int | None = None) -> None:
        self._image, self._dies_at = image, dies_at
        self._next_ns = time.monotonic_ns()
        self._index = 0

    def read(self, timeout_s: float) -> Frame:
        self._next_ns = max(self._next_ns + PERIOD_NS, time.monotonic_ns())
        time.sleep(max(self._next_ns - time.monotonic_ns(), 0) * 1e-9)
        self._index += 1
        if self._dies_at is not None and self._index >= self._dies_at:
            raise SourceError("/dev/video0: no more frames; is the camera still plugged in?")
        image = self._image.copy()
        image.flat[0] = self._index % 256  # not two pictures in turn: a loop that drops every other frame sees only one
        return Frame(t_ns=time.monotonic_ns(), index=self._index, image=image)

    def close(self) -> None:
        pass


class TriggeredCamera:
    """Implements `Source`: one camera of several that are triggered together, `late_ns` after each trigger.

    Triggers come at `rate_hz` of the machine's clock, whoever reads when. The same view with a bit of noise.
    """

    own_time = True

    def __init__(self, image: Image, rate_hz: float, late_ns: int = 0) -> None:
        self._image, self._late_ns = image, late_ns
        self._period_ns, self._t_ns, self._index = round(1e9 / rate_hz), time.monotonic_ns(), 0

    def read(self, timeout_s: float) -> Frame:
        newest_ns = max(self._t_ns, time.monotonic_ns())
        self._t_ns = (newest_ns // self._period_ns + 1) * self._period_ns + self._late_ns
        time.sleep(max(self._t_ns - time.monotonic_ns(), 0) * 1e-9)
        self._index += 1
        image = self._image.copy()
        image.flat[0] = self._index % 256
        return Frame(t_ns=self._t_ns, index=self._index, image=image)

    def close(self) -> None:
        pass


def car_toml(folder: Path, port: str) -> Path:
    """A car.toml for the camera and a board at `port`."""
    path = folder / "car.toml"
    path.write_text(CAR_TOML.format(port=port, recordings=folder / "recordings"))
    return path
