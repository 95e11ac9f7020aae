"""The vehicle behind a serial port, in the language that car.toml's [link] kind names; and the boards of each.

Loaded by name only (`automodel.config.parts.LINKS`): a replay never imports a link.
"""

from __future__ import annotations

from automodel.assembly.can_parts import can_functions
from automodel.config import CarConfig
from firmware_link.arduino import ArduinoLink
from firmware_link.autonomos import AutonomosLink
from firmware_link.can_link import CanLink
from firmware_link.can_port import CanPort, PythonCanPort
from firmware_link.can_receiver import load_dbc
from firmware_link.transport import SerialTransport, Transport


def arduino_link(car: CarConfig, transport: Transport | None = None) -> ArduinoLink:
    """The board with our firmware, on `transport` (default: the port of car.toml)."""
    return ArduinoLink(transport or SerialTransport(car.link.port, car.link.baud), car.link, car.vehicle)


def autonomos_link(car: CarConfig, transport: Transport | None = None) -> AutonomosLink:
    """The boards of an AutoNOMOS car, on `transport` (default: the ports of car.toml, one or two)."""
    if transport is not None:
        return AutonomosLink([transport], car.link, car.vehicle)
    names = [name for name in (car.link.port, car.link.autonomos.motor_port) if name]
    return AutonomosLink([SerialTransport(name, car.link.baud) for name in names], car.link, car.vehicle)


def can_link(car: CarConfig, port: CanPort | None = None) -> CanLink:
    """The vehicle behind the CAN bus of car.toml, or behind `port`."""
    config = car.link.can
    bus = port or PythonCanPort(config.interface, car.link.port, config.bitrate)
    return CanLink(bus, load_dbc(config.dbc), config, car.vehicle, can_functions(config))
