"""The emulated vehicle on real buses of python-can."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from automodel.assembly.can_parts import can_functions
from automodel.config import CanConfig
from firmware_link.can_port import PythonCanPort
from firmware_link.can_receiver import load_dbc
from firmware_link.emulator.can_bus import ServedCanVehicle, own_group
from firmware_link.emulator.can_vehicle import EmulatedCanVehicle
from firmware_link.errors import LinkError

BUSES = ("virtual", "udp_multicast")
_CHANNELS = itertools.count()


@dataclass
class Standing:
    """A body that stands, whatever it is asked for."""

    speed_mps: float = 0.0
    yaw_rate_radps: float = 0.0
    steering_rad: float = 0.0
    asked_mps2: float = math.nan

    def drive(self, t_ns: int, steering_rad: float | None, accel_mps2: float) -> None:
        self.asked_mps2 = accel_mps2

    def measure(self, t_ns: int) -> Standing:
        return self


def channel_of(interface: str) -> str:
    """A channel of its own."""
    return own_group() if interface == "udp_multicast" else f"bus-{next(_CHANNELS)}"


@contextlib.contextmanager
def served_vehicle(interface: str, config: CanConfig) -> Iterator[ServedCanVehicle]:
    """A vehicle that stands, on a bus of its own; skips where this machine has no such bus."""
    channel = channel_of(interface)
    vehicle = EmulatedCanVehicle(Standing(), load_dbc(config.dbc), config, can_functions(config))
    served = ServedCanVehicle(vehicle, PythonCanPort(interface, channel, config.bitrate), channel)
    try:
        served.start()
    except LinkError as error:
        pytest.skip(f"no {interface} here: {error}")
    try:
        yield served
    finally:
        served.close()
        served.close()
