"""Damaged requests at the pages' servers: the bytes that a browser sends; a good request comes after them."""

from __future__ import annotations

import asyncio
import contextlib
import struct
import sys
from collections.abc import Callable
from pathlib import Path

from aiohttp import web

from automodel.config import CarConfig
from automodel.web.access import Access
from automodel.web.film import Footage, ViewedRun, look_through
from automodel.web.guard import GuardedServer
from automodel.web.server import Page
from automodel.web.view import ViewPage

TOKEN = "0123456789abcdefghijklmnopqrstuvwxyzABCDEFG"
HOST = "127.0.0.1:8765"  # what the files say: any address is this machine's
ANSWER_S, SOCKET_S = 10.0, 0.05
_CONTROL, _TEXT, _FINAL, _MASKED = 0x8, 0x1, 0x80, 0x80


def get(path: str, *headers: str) -> bytes:
    """A request."""
    return "\r\n".join([f"GET {path} HTTP/1.1", f"Host: {HOST}", *headers, "", ""]).encode()


def words(*texts: str) -> bytes:
    """A websocket that is opened, its token and what is said on it; the mask is nothing, so that damage is seen."""
    opened = get(
        "/socket",
        "Connection: Upgrade",
        "Upgrade: websocket",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
        f"Origin: http://{HOST}",
    )
    return opened + b"".join(_frame(_TEXT, text.encode()) for text in (TOKEN, *texts)) + _frame(_CONTROL, b"")


def _frame(code: int, data: bytes) -> bytes:
    return struct.pack("!BB", _FINAL | code, _MASKED | len(data)) + bytes(4) + data


def send_to_page(arguments: list[str]) -> int:
    """The bytes of the file at the run's page; gives an exit code: 1 where it answers no more."""
    return _sent(Page(CarConfig(), Access(token=TOKEN), lambda word: None), Path(arguments[0]))


def send_to_view(arguments: list[str]) -> int:
    """The same at the page of a run that is over, whose recording is the second file."""
    run = _viewed(arguments[1])
    return _sent(ViewPage(run, Access(token=TOKEN)), Path(arguments[0]))


_runs: dict[int, ViewedRun] = {}  # read once a process: what is damaged is the request


def _viewed(path: str) -> ViewedRun:
    size = Path(path).stat().st_size
    if size not in _runs:
        _runs[size] = look_through(Footage(path=Path(path)))
    return _runs[size]


def _sent(page: GuardedServer, file: Path) -> int:
    async def served() -> bytes:
        runner = page.runner()
        await runner.setup()
        try:
            await web.TCPSite(runner, "127.0.0.1", 0).start()
            port = int(runner.addresses[0][1])
            await _said(port, file.read_bytes(), SOCKET_S)
            return await _said(port, get("/", "Connection: close"), ANSWER_S)
        finally:
            await runner.cleanup()

    answer = asyncio.run(served())
    if not answer.startswith(b"HTTP/1.1 200 "):
        sys.stderr.write(f"Traceback of none: the page answers no more: {answer[:100]!r}\n")
        return 1
    return 0


async def _said(port: int, data: bytes, wait_s: float) -> bytes:
    """What comes back on a connection of its own until it is closed, or for so long."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    answer = b""
    try:
        with contextlib.suppress(ConnectionError):
            writer.write(data)
            await writer.drain()
        with contextlib.suppress(ConnectionError, asyncio.TimeoutError):
            answer = await asyncio.wait_for(reader.read(65536), wait_s)
        with contextlib.suppress(ConnectionError, asyncio.TimeoutError):
            await asyncio.wait_for(reader.read(65536), SOCKET_S)
    finally:
        writer.close()
    return answer


Sender = Callable[[list[str]], int]
