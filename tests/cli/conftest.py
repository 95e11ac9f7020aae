from __future__ import annotations

from calibrated_cars import at_rest, car, pins
from command_line import cli, driven

__all__ = ["at_rest", "car", "cli", "driven", "pins"]
