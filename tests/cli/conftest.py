from __future__ import annotations

from tests.support.calibrated_cars import at_rest, car, pins
from tests.support.command_line import cli, driven

__all__ = ["at_rest", "car", "cli", "driven", "pins"]
