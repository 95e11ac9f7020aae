from __future__ import annotations

from support.command_line import cli, driven

__all__ = ["cli", "driven"]
