from __future__ import annotations

from command_line import cli, driven

__all__ = ["cli", "driven"]
