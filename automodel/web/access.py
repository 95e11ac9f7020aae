"""Where the page is served, and who may look and command: the token, the host names, the page behind a socket."""

from __future__ import annotations

import hmac
import ipaddress
import secrets
import socket
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

TOKEN_BYTES = 32  # 256 bits
CSP = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": CSP,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class PageOptions:
    """Where the page is served; `tls` names the files of a certificate and its key.

    `by_hand`: a person may drive from it, too.
    """

    host: str = "127.0.0.1"
    port: int = 8765
    tls: tuple[Path, Path] | None = None
    by_hand: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Access:
    """The rules of one server; `token` is never shown by `repr`."""

    tls: bool = False
    token: str = field(default_factory=lambda: secrets.token_urlsafe(TOKEN_BYTES), repr=False)

    def token_fits(self, given: str) -> bool:
        """Whether `given` is the token, in a time that does not tell how much of it is right."""
        return hmac.compare_digest(given.encode("utf-8", "replace"), self.token.encode())

    def host_fits(self, host: str | None) -> bool:
        """Whether a Host header names this machine.

        An address, localhost, or the machine's own name: a name that someone else's DNS points here is none of them
        (DNS rebinding).
        """
        name = _name_of(host)
        if name is None:
            return False
        try:
            ipaddress.ip_address(name)
        except ValueError:
            own = socket.gethostname().lower()
            return name in ("localhost", own, f"{own}.local")
        return True

    def origin_fits(self, origin: str | None, host: str | None) -> bool:
        """Whether a websocket was opened by our own page: its Origin is the scheme and host that it was sent to."""
        return bool(host) and origin == f"{'https' if self.tls else 'http'}://{host}"


def _name_of(host: str | None) -> str | None:
    try:
        name = urlsplit(f"//{host}").hostname if host else None
    except ValueError:
        return None
    return name.lower().rstrip(".") if name else None
