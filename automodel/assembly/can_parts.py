"""The functions that a CAN mapping names: ours, those of installed packages, and a team's own."""

from __future__ import annotations

from automodel.assembly.registry import find_part
from automodel.config import CanConfig
from automodel.config.parts import CAN_CHECKSUMS, CAN_COUNTERS
from firmware_link.can_receiver import Functions


def can_functions(config: CanConfig) -> Functions:
    """The checksum and counter functions of all messages; raises ConfigError where one cannot be imported."""
    messages = (*config.receive, *config.send)
    checksums = {message.checksum for message in messages if message.checksum}
    counters = {message.counter for message in messages if message.counter}
    return Functions(
        checksums={name: find_part(CAN_CHECKSUMS, name) for name in checksums},
        counters={name: find_part(CAN_COUNTERS, name) for name in counters},
    )
