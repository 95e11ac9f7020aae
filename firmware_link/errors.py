"""The errors of a link: one tree under OSError; each text is one line that says what, where and what to do."""

from __future__ import annotations


class LinkError(OSError):
    """The vehicle cannot be reached, or is not the one that was expected."""


class PortNotFound(LinkError):
    """There is no such port; the text names the likely ones."""


class PortRefused(LinkError):
    """The port is there and cannot be opened: permissions, or another program holds it."""


class PortLost(LinkError):
    """The port vanished, or stopped taking bytes, after it was opened; close and open again."""


class HandshakeError(LinkError):
    """The board says no hello, or speaks another message table; opening again does not help."""
