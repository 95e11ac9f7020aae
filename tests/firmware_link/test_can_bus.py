"""The emulated vehicle on real buses of python-can, against the link, in real time."""

from __future__ import annotations

import time

import pytest

from automodel.assembly.can_parts import can_functions
from automodel.config import CanConfig, VehicleConfig
from automodel.signals import Command
from firmware_link.can_link import CanLink
from firmware_link.can_port import PythonCanPort
from firmware_link.can_receiver import load_dbc
from firmware_link.emulator.can_bus import own_group
from tests.support.can_buses import BUSES, served_vehicle

CONFIG = CanConfig()
VEHICLE = VehicleConfig(wheelbase_m=2.7, reference_x_m=1.3, width_m=1.8)
CYCLES = 1000


@pytest.mark.parametrize("interface", BUSES)
def test_a_vehicle_on_a_bus_is_armed_and_let_go(interface: str) -> None:
    with served_vehicle(interface, CONFIG) as served:
        port = PythonCanPort(interface, served.path, CONFIG.bitrate)
        link = CanLink(port, load_dbc(()), CONFIG, VEHICLE, can_functions(CONFIG))
        link.open()
        for _ in range(CYCLES):
            now_ns = time.monotonic_ns()
            state = link.poll(now_ns)
            link.send(Command(t_ns=now_ns, steering_rad=0.0, speed_mps=1.0, valid_until_ns=now_ns + 10**8), now_ns)
            if state is not None and not state.armed:
                link.arm(now_ns)  # again and again: a busy machine loses it, rightly
            if state is not None and state.armed:
                break
            time.sleep(0.005)
        assert state is not None
        assert state.armed
        assert served.vehicle.unknown == 0
        link.close()
        for _ in range(CYCLES):
            if not served.vehicle.engaged:
                break
            time.sleep(0.005)
        assert not served.vehicle.engaged


def test_two_vehicles_have_groups_of_their_own() -> None:
    groups = {own_group() for _ in range(50)}
    assert len(groups) > 40
    assert all(group.startswith("239.74.") for group in groups)
