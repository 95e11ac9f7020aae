"""The errors of a link, all derived from OSError; each text is one line with the place, the cause and the remedy."""

from __future__ import annotations


class LinkError(OSError):
    """The vehicle cannot be reached, or is not the expected one."""


class PortNotFound(LinkError):
    """The port does not exist; the text names likely ports."""


class PortRefused(LinkError):
    """The port exists but cannot be opened: permissions, or another program uses it."""


class PortLost(LinkError):
    """The port disappeared or stopped accepting bytes after it was opened; close and open it again."""


class HandshakeError(LinkError):
    """The board sends no Hello, or has another message table; opening it again does not help."""
