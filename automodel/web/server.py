"""The page's server: its own process, told by the mailbox, heard through the pipe.

Every request is checked by `Access`; a websocket has to send the token as its first message. What is drawn and encoded
here costs the loop nothing.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import pickle
import ssl
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2
from aiohttp import WSMsgType, web

from automodel.config import CarConfig, ConfigError
from automodel.geometry import GroundCamera, wrap_angle
from automodel.manual.dead_man import HOLD_TIMEOUT_S
from automodel.viewer.overlay import draw
from automodel.web.access import Access, PageOptions
from automodel.web.guard import REFUSED, GuardedServer
from automodel.web.live_process import LOOK_S, stand_back
from automodel.web.mailbox import Mailbox
from automodel.web.snapshot import Snapshot
from automodel.web.words import Wanted, Word, from_page, to_bytes

WORDS_PER_S = 50  # of one page, which says 10, and 20 by hand: more would pile up in front of another's STOP
HISTORY = 2400  # rows kept for a page that is opened late: two minutes at the page's rate
_JPEG_QUALITY = 80  # [%]
_FILES = {"/": ("index.html", "text/html"), "/page.js": ("page.js", "text/javascript"),
          "/draw.js": ("draw.js", "text/javascript"), "/page.css": ("page.css", "text/css")}  # fmt: skip


def serve(car: CarConfig, options: PageOptions, access: Access, mailbox: Mailbox, pipe: Connection) -> None:
    """Serve until the other end of `pipe` is closed; the port, or a text of what is wrong, is sent through it first."""
    stand_back()
    asyncio.run(_serve(car, options, access, mailbox, pipe))


async def _serve(car: CarConfig, options: PageOptions, access: Access, mailbox: Mailbox, pipe: Connection) -> None:
    # Pictures are drawn by one thread: each has a heap of its own, some 10 MB, and more of them start in the end.
    asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(1))
    page = Page(car, access, pipe.send_bytes, by_hand=options.by_hand)
    runner = page.runner()
    await runner.setup()
    try:
        site = web.TCPSite(runner, options.host, options.port, ssl_context=_tls(options.tls))
        await site.start()
    except ConfigError as error:
        pipe.send(str(error))
    except OSError as error:
        known = error.errno is not None and error.errno > 0  # a name that cannot be resolved has a number below 0
        why = os.strerror(error.errno) if known and error.errno else error.strerror
        pipe.send(f"--web: {options.host}:{options.port}: cannot be served: {why}; choose another HOST:PORT")
    else:
        pipe.send(runner.addresses[0][1])
        await _until_closed(page, mailbox, pipe)
    await runner.cleanup()


async def _until_closed(page: Page, mailbox: Mailbox, pipe: Connection) -> None:
    over = asyncio.Event()
    asyncio.get_running_loop().add_reader(pipe.fileno(), over.set)  # nothing is ever sent here: it ends
    while not over.is_set():
        message = mailbox.take()
        if message is not None:
            await page.show(pickle.loads(message))  # from our own process, through memory that is ours alone
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(over.wait(), LOOK_S)


def _tls(files: tuple[Path, Path] | None) -> ssl.SSLContext | None:
    if files is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(*files, password="")  # a key with a passphrase is refused, not asked for
    except OSError as error:
        names = " ".join(map(str, files))
        raise ConfigError(f"--web-tls: {names}: {error.strerror or error}; expected PEM files of both") from None
    return context


class Page(GuardedServer):
    """The page's requests and its open sockets; `say` sends a word's bytes to the run.

    `by_hand`: a person may drive from the page, too.
    """

    def __init__(self, car: CarConfig, access: Access, say: Callable[[bytes], None], *, by_hand: bool = False) -> None:
        super().__init__(access, _FILES)
        self._by_hand = by_hand
        self._vehicle = car.vehicle
        self._camera = GroundCamera.from_config(car.camera)
        self._say = say
        self._clients: set[_Client] = set()
        self._holder: _Client | None = None  # whose button is held, or was last, and when it was heard of [s]
        self._holder_s = 0.0
        self._start_ns: int | None = None  # of the page's time: the first cycle shown
        self._history: deque[list[float | None]] = deque(maxlen=HISTORY)

    async def show(self, snapshot: Snapshot) -> None:
        """Tell every open page of a cycle; a page that has not yet received the one before gets only the newest."""
        if self._start_ns is None:
            self._start_ns = snapshot.t_ns
        row = row_of(snapshot, self._start_ns)
        self._history.append(row)
        if self._clients:
            text = json.dumps(
                {"row": row, **status_of(snapshot, self._start_ns, self._vehicle.battery_low_v)}, allow_nan=False
            )
            picture = await asyncio.to_thread(self._picture, snapshot)
            for client in self._clients:
                client.offer(text, picture)

    def _picture(self, snapshot: Snapshot) -> bytes:
        drawn = draw(
            snapshot.image,
            snapshot.estimate,
            self._camera,
            snapshot.command,
            self._vehicle.reference_x_m,
            wheelbase_m=self._vehicle.wheelbase_m,
        )
        return cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()

    async def talk(self, socket: web.WebSocketResponse) -> None:
        """Send what happens, and hear the operator."""
        client = _Client(socket)
        await client.socket.send_str(
            json.dumps({"history": list(self._history), "by_hand": self._by_hand}, allow_nan=False)
        )
        self._clients.add(client)
        sending = asyncio.create_task(client.send())
        try:
            async for message in client.socket:
                said = from_page(message.data) if message.type is WSMsgType.TEXT else None
                if said is None or not self._may(said) or client.floods(asyncio.get_running_loop().time()):
                    await client.socket.close(code=REFUSED, message=b"unknown word, or too many")
                    break
                self._hear(client, said)
        finally:
            self._clients.discard(client)
            sending.cancel()
            if client is self._holder:
                self._hear(client, Word.RELEASE)

    def _may(self, said: Word | Wanted) -> bool:
        """Whether a page may say so here: by hand only where the run was started for it."""
        return self._by_hand or (isinstance(said, Word) and said is not Word.TAKE)

    def _hear(self, client: _Client, said: Word | Wanted) -> None:
        """Pass on what a page says: STOP from anyone, the buttons' words from one page at a time."""
        now_s = asyncio.get_running_loop().time()
        if said is not Word.STOP:
            if self._holder not in (None, client) and now_s - self._holder_s < HOLD_TIMEOUT_S:
                return
            if said not in (Word.ARM, Word.TAKE) and client is not self._holder:
                return
            self._holder, self._holder_s = (None if said is Word.RELEASE else client), now_s
        with contextlib.suppress(OSError):  # the run is over
            self._say(to_bytes(said))


class _Client:
    """An open page and the newest message for it."""

    def __init__(self, socket: web.WebSocketResponse) -> None:
        self.socket = socket
        self._newest: tuple[str, bytes] | None = None
        self._there = asyncio.Event()
        self._said_s: deque[float] = deque(maxlen=WORDS_PER_S + 1)

    def floods(self, now_s: float) -> bool:
        """Whether this page has said more than `WORDS_PER_S` words within a second, the one now included."""
        self._said_s.append(now_s)
        return len(self._said_s) > WORDS_PER_S and now_s - self._said_s[0] < 1.0

    def offer(self, text: str, picture: bytes) -> None:
        self._newest = (text, picture)
        self._there.set()

    async def send(self) -> None:
        with contextlib.suppress(ConnectionError):
            while True:
                await self._there.wait()
                self._there.clear()
                if self._newest is not None:
                    text, picture = self._newest
                    await self.socket.send_str(text)
                    await self.socket.send_bytes(picture)


def row_of(snapshot: Snapshot, start_ns: int) -> list[float | None]:
    """A row of the plots, None for what is not known.

    The columns: t [s], offset, its bound [m], heading, steering [rad], speed [m/s], latency [ms], x, y [m].
    """
    pose, motion = snapshot.estimate.pose if snapshot.estimate is not None else None, snapshot.motion
    values = (
        (snapshot.t_ns - start_ns) * 1e-9,
        pose.offset_m if pose is not None else None,
        pose.offset_bound_m if pose is not None else None,
        pose.heading_rad if pose is not None else None,
        snapshot.command.steering_rad if snapshot.command is not None else None,
        motion.speed_mps if motion is not None and motion.known else None,
        snapshot.latency_ns * 1e-6 if snapshot.latency_ns is not None else None,
        snapshot.place.x_m,
        snapshot.place.y_m,
    )
    return [round(value, 4) if value is not None and math.isfinite(value) else None for value in values]


def status_of(snapshot: Snapshot, start_ns: int, battery_low_v: float) -> dict[str, Any]:
    """What the page says in words; None for what is not known."""
    state, estimate = snapshot.state, snapshot.estimate
    battery_v = state.battery_v if state is not None else None
    return {
        "mode": snapshot.mode,
        "reason": snapshot.reason,
        "lane": estimate.status.value if estimate is not None else None,
        "by_hand": snapshot.driver is not None,
        "armed": state.armed if state is not None else None,
        "vehicle_faults": list(state.faults) if state is not None else [],
        "battery_v": round(battery_v, 2) if battery_v is not None and math.isfinite(battery_v) else None,
        "battery_low": battery_v is not None and battery_v < battery_low_v,
        "rate_hz": round(snapshot.rate_hz, 1) if snapshot.rate_hz is not None else None,
        "skipped": snapshot.skipped,
        "unpaired": snapshot.unpaired,
        "yaw_rad": round(wrap_angle(snapshot.place.yaw_rad), 4),
        "events": [[round((event.t_ns - start_ns) * 1e-9, 2), event.kind, event.text] for event in snapshot.events],
    }
