"""What every page's server checks: the host asked for, the socket's origin and its token, and how many are open."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path

from aiohttp import WSMsgType, web
from aiohttp.http_exceptions import HttpProcessingError

from automodel.web.access import HEADERS, Access

CLIENTS_MAX = 8  # sockets at a time, those included that have not yet sent their token
MESSAGE_BYTES = 256  # the longest message of a page, its token
TOKEN_S = 3.0  # for the token to come
NO_TOKEN = 4401  # websocket close codes, with the HTTP status that they stand for
REFUSED = 4400
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


def _logger() -> logging.Logger:
    """aiohttp's own would print a traceback for whatever somebody sends."""
    logger = logging.getLogger("automodel.web.requests")
    logger.filters[:] = [_in_one_line]
    return logger


def _in_one_line(record: logging.LogRecord) -> bool:
    error = record.exc_info[1] if isinstance(record.exc_info, tuple) else None
    if isinstance(error, HttpProcessingError):
        return False
    if error is not None:
        record.msg, record.args = f"{record.getMessage()}: {type(error).__name__}: {error}", ()
        record.exc_info = record.exc_text = None
    return True


class GuardedServer(ABC):
    """A few files, by their address ("/page.js": name and content type), and a socket that is let in by `access`."""

    def __init__(self, access: Access, files: Mapping[str, tuple[str, str]]) -> None:
        self._access, self._files = access, files
        self._open = 0

    def app(self) -> web.Application:
        """The application."""
        app = web.Application(middlewares=[self._guard], client_max_size=1)
        app.router.add_get("/socket", self._socket)
        for path in self._files:
            app.router.add_get(path, self._file)
        return app

    def runner(self) -> web.AppRunner:
        """What serves the application; requests that are no HTTP are refused and forgotten, our mistakes are a line."""
        return web.AppRunner(self.app(), access_log=None, shutdown_timeout=0.5, logger=_logger())

    @abstractmethod
    async def talk(self, socket: web.WebSocketResponse) -> None:
        """Serve a socket whose token was right, until it is closed."""

    async def _file(self, request: web.Request) -> web.Response:
        name, kind = self._files[request.path]
        text = (Path(__file__).parent / "page" / name).read_text(encoding="utf-8")
        return web.Response(text=text, content_type=kind)

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        if not self._access.host_fits(request.headers.get("Host")):
            return web.Response(status=421, text="this is not the host that you asked for\n", headers=HEADERS)
        try:
            response = await handler(request)
        except web.HTTPException as error:
            error.headers.update(HEADERS)
            raise
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        if not self._access.origin_fits(request.headers.get("Origin"), request.headers.get("Host")):
            raise web.HTTPForbidden(text="only this server's own page may open its socket\n")
        if self._open >= CLIENTS_MAX:
            raise web.HTTPServiceUnavailable(text="too many pages are open\n")
        self._open += 1
        try:
            socket = web.WebSocketResponse(max_msg_size=MESSAGE_BYTES, heartbeat=5.0, compress=False)
            await socket.prepare(request)
            if await self._has_token(socket):
                await self.talk(socket)
            else:
                await socket.close(code=NO_TOKEN, message=b"token")
            return socket
        finally:
            self._open -= 1

    async def _has_token(self, socket: web.WebSocketResponse) -> bool:
        with contextlib.suppress(asyncio.TimeoutError):
            first = await asyncio.wait_for(socket.receive(), TOKEN_S)
            return first.type is WSMsgType.TEXT and self._access.token_fits(first.data)
        return False
