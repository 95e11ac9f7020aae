"""A host in its simplest form, to be killed: arms the board at a port, by its clock, and drives."""

from __future__ import annotations

import sys

from automodel.config import LinkConfig, VehicleConfig
from automodel.signals import Command
from firmware_link.arduino import ArduinoLink
from firmware_link.transport import SerialTransport
from tests.support.board_time import BoardTime

PERIOD_NS = 16_666_667
VALID_NS = 100_000_000


def main():
    config, clock = LinkConfig(port=sys.argv[1]), BoardTime(sys.argv[2])
    link = ArduinoLink(SerialTransport(config.port, config.baud), config, VehicleConfig())
    link.open()
    while True:
        now_ns = clock.now_ns()
        state = link.poll(now_ns)
        if state is not None and not state.armed:
            link.arm(now_ns)
        link.send(Command(t_ns=now_ns, steering_rad=0.1, speed_mps=1.0, valid_until_ns=now_ns + VALID_NS), now_ns)
        clock.sleep_until(now_ns + PERIOD_NS)


if __name__ == "__main__":
    main()
