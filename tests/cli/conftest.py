from __future__ import annotations

from support.calibrated_cars import at_rest, car, pins
from support.command_line import cli, driven

__all__ = ["at_rest", "car", "cli", "driven", "pins"]
