from __future__ import annotations

from tests.support.command_line import cli, driven

__all__ = ["cli", "driven"]
