"""The vehicle behind a real port. Apart from `parts`, because a replay must not so much as import a link."""

from __future__ import annotations

from automodel.config import CarConfig
from automodel.interfaces import VehicleLink
from firmware_link.arduino import ArduinoLink
from firmware_link.autonomos import AutonomosLink
from firmware_link.transport import SerialTransport


def make_link(car: CarConfig) -> VehicleLink:
    """The vehicle behind the serial ports that car.toml names, in the language that its [link] kind says."""
    names = [car.link.port]
    if car.link.kind == "autonomos" and car.link.autonomos.motor_port:
        names.append(car.link.autonomos.motor_port)
    ports = [SerialTransport(name, car.link.baud) for name in names]
    if car.link.kind == "autonomos":
        return AutonomosLink(ports, car.link, car.vehicle)
    return ArduinoLink(ports[0], car.link, car.vehicle)
