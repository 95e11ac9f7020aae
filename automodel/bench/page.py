"""`bench page`: what the page of a run costs the loop, how soon its STOP is on the wire, and whether memory grows.

Drives of the simulated car in real time, each in a process of its own, in turn without the page and with page,
recording and open pages. The pages are sockets that take all that comes, off the loop's core: they stand for machines
of their own. In a last drive a page says STOP again and again, and drives on by its button.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import multiprocessing
import os
import random
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import aiohttp

from automodel.assembly.drive import RunOptions, drive_simulated
from automodel.bench.accuracy import Row
from automodel.config import CarConfig, ConfigError
from automodel.console.progress import progress
from automodel.runtime.cores import LoopCores
from automodel.runtime.latencies import Latencies
from automodel.runtime.run_types import TickRecord
from automodel.runtime.safety import SafetyMode
from automodel.signals import Event
from automodel.web.access import PageOptions
from automodel.web.remote import WebRemote

COLUMNS = (
    "stage", "pages", "samples", "p50_ms", "p99_ms", "max_ms",
    "loop_mb", "loop_grown_mb", "page_mb", "page_grown_mb", "ended",
)  # fmt: skip
SETTLED_S = 60.0  # a process has what it needs
_START_S = 240.0  # a process, its libraries, loops compiled for the first time, the world
_PATIENCE_S = 20.0
_HOLD_S = 0.1  # as the page says it
_AT_REST = (SafetyMode.STOPPED.value, SafetyMode.DISARMED.value)
_WELL_S = 1.0  # after a stop all must be well for half a second before the car may be armed
_NEWS_S = 5.0  # a busy machine's page tells so late that the car was armed
_PAUSES_S = (0.3, 1.0)  # between driving and STOP
_STATM_PAGES = 1  # the resident ones in /proc/PID/statm


def measure(car: CarConfig, duration_s: float, rounds: int, pages: int, stops: int) -> list[Row]:
    """A row a drive of `duration_s`, in turn without the page and with `pages` open, and one of `stops` STOPs.

    With 0 `rounds` one drive, with the page. Raises ConfigError where a drive does not begin or a STOP is not obeyed.
    """
    drives = [0, pages] * rounds or [pages]
    with (
        progress("bench page", len(drives) + (stops > 0), threaded=False) as tick,
        tempfile.TemporaryDirectory(prefix="page-") as folder,
    ):
        rows = []
        for opened in drives:
            recording = Path(folder) / "drive.mcap"
            rows.append(_timed(car, duration_s, opened, recording))
            recording.unlink(missing_ok=True)
            tick()
        if stops:
            rows.append(_stopped(car, pages, stops, Path(folder) / "stops.mcap"))
            tick()
    return rows


def _timed(car: CarConfig, duration_s: float, pages: int, record: Path) -> Row:
    """A drive with so many pages, without page and recording where none."""
    options = RunOptions(duration_s=duration_s, realtime=True, record=record if pages else None)
    with _driving(car, options, with_page=pages > 0) as drive, LoopCores():  # a page is on another machine
        asyncio.run(_look(drive, [_Page() for _ in range(pages)]))
    return _row(drive, "frame -> write", pages, drive.outcome["loop"])


def _stopped(car: CarConfig, pages: int, stops: int, record: Path) -> Row:
    """A drive in which one of the pages says STOP so often."""
    options = RunOptions(realtime=True, duration_s=stops * 2 * _PATIENCE_S, record=record)
    operator = _Page()
    with _driving(car, options, with_page=True) as drive, LoopCores():
        asyncio.run(_look(drive, [operator, *(_Page() for _ in range(pages - 1))], stops))
    waits = Latencies()
    for said, until in zip(operator.said_ns, [*operator.said_ns[1:], math.inf], strict=True):
        waits_ns = [obeyed - said for obeyed in drive.outcome["obeyed_ns"] if said < obeyed < until]
        for wait_ns in waits_ns[:1]:  # none of a car that stood already: the page tells late that it stopped
            waits.add(wait_ns)
    return _row(drive, "STOP -> write", pages, waits)


def _row(drive: Drive, stage: str, pages: int, times: Latencies) -> Row:
    if not len(times):
        raise ConfigError(f"bench page: nothing was measured: {drive.outcome['ended']}")
    median, p99, most = (times.percentile_ms(share) for share in (50, 99, 100))
    (loop, loop_grown), (page, page_grown) = (drive.memory(index) for index in range(2))
    return {
        "stage": stage, "pages": pages, "samples": len(times), "p50_ms": median, "p99_ms": p99, "max_ms": most,
        "loop_mb": loop, "loop_grown_mb": loop_grown, "page_mb": page, "page_grown_mb": page_grown,
        "ended": drive.outcome["ended"],
    }  # fmt: skip


@dataclass(slots=True, kw_only=True)
class Drive:
    """A run in a process of its own: its processes, the loop's first, its page's address, what came of it."""

    pids: list[int]
    url: str
    pipe: Connection
    memory_mb: list[tuple[float, list[float]]] = field(default_factory=list)  # time [s], of each process
    outcome: dict[str, Any] = field(default_factory=dict)

    def over(self) -> bool:
        """Whether it has ended; its outcome is there then. Raises ConfigError where it could not go on."""
        if not self.outcome and self.pipe.poll():
            self.outcome = _told(self.pipe.recv())
        return bool(self.outcome)

    def sample(self) -> None:
        """Note how much memory its processes have."""
        with contextlib.suppress(OSError, IndexError):  # not Linux; it has just ended
            mb = [_resident_mb(pid) for pid in self.pids]
            self.memory_mb.append((time.monotonic(), mb))

    def memory(self, process: int) -> tuple[float | None, float | None]:
        """What a process had once it had settled [MB], and by how much it had more or less later; None if unknown."""
        if not self.memory_mb or process >= len(self.pids):
            return None, None
        start_s, end_s = self.memory_mb[0][0], self.memory_mb[-1][0]
        settled_s = start_s + min(SETTLED_S, 0.5 * (end_s - start_s))
        later = [mb[process] for t_s, mb in self.memory_mb if t_s >= settled_s]
        return later[0], max((mb - later[0] for mb in later), key=abs)


def _told(message: Any) -> Any:
    """What a drive says; raises ConfigError where it is what is wrong."""
    if isinstance(message, str):
        raise ConfigError(message)
    return message


def _resident_mb(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[_STATM_PAGES])
    return pages * os.sysconf("SC_PAGE_SIZE") * 1e-6


@contextlib.contextmanager
def _driving(car: CarConfig, options: RunOptions, *, with_page: bool) -> Iterator[Drive]:
    """A run in another process, which has ended when the block has; it is told to end then."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_drive, args=(car, options, with_page, theirs))
    process.start()
    theirs.close()
    try:
        if not ours.poll(_START_S):
            raise ConfigError("bench page: the run does not start")
        url, pids = _told(ours.recv())
        drive = Drive(pids=pids, url=url, pipe=ours)
        yield drive
        with contextlib.suppress(OSError):  # it has ended already
            ours.send("end")
        if not drive.over() and ours.poll(_PATIENCE_S):
            drive.over()
    except EOFError:
        raise ConfigError("bench page: the run has died") from None
    finally:
        process.join(_PATIENCE_S)
        if process.is_alive():
            process.kill()
            process.join()
        ours.close()
    if not drive.outcome:
        raise ConfigError("bench page: the run does not end")


def _drive(car: CarConfig, options: RunOptions, with_page: bool, pipe: Connection) -> None:
    """The run, in its process: its page's address and processes are sent first, what came of it last.

    Instead of either, what is wrong.
    """
    sys.stderr = None  # what it says would stand in the middle of the bench's own progress
    with contextlib.ExitStack() as shown:
        pids, url, operators = [os.getpid()], "", []
        try:
            if with_page:
                page = shown.enter_context(WebRemote(car, PageOptions(port=0)))
                pids.append(page.pid)
                operators, url = [page], page.url
            pipe.send((url, pids))
            noted = _Noted()
            report = drive_simulated(car, "", options, operators, [noted], pipe.poll)
        except (ConfigError, OSError) as error:
            pipe.send(str(error))
        else:
            pipe.send({"ended": report.ended, "loop": report.loop, "obeyed_ns": noted.obeyed_ns})


class _Noted:
    """Notes when a person's STOP was on the wire; a `Viewer` of the run, the last that is told."""

    def __init__(self) -> None:
        self.obeyed_ns: list[int] = []
        self._said = False

    def on_tick(self, record: TickRecord) -> None:
        """A cycle, after all was sent."""
        self._said |= any(event.kind == "stop" and event.text.startswith("STOP ") for event in record.decision.events)
        if self._said and record.sent is not None and record.sent.speed_mps == 0:
            self.obeyed_ns.append(time.monotonic_ns())
            self._said = False

    def on_event(self, event: Event) -> None:
        """Nothing is noted of it."""


async def _look(drive: Drive, pages: Sequence[_Page], stops: int | None = None) -> None:
    """Sample the memory and keep the pages open until the drive is over, or the first has said so many STOPs.

    Without `stops` the first page drives on after a stop, as a person would.
    """
    async with aiohttp.ClientSession() as session:
        looking = [asyncio.create_task(page.look(session, drive.url)) for page in pages]
        operating = asyncio.create_task(pages[0].operate(stops)) if pages else None
        try:
            while not drive.over() and (operating is None or not operating.done()):
                drive.sample()
                await asyncio.sleep(1.0)
            if operating is not None and operating.done():
                operating.result()
            elif stops is not None:
                raise ConfigError(f"bench page: the drive ended too soon: {drive.outcome['ended']}")
        finally:
            tasks = [*looking, *([operating] if operating is not None else [])]
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


class _Page:
    """An open page of a run."""

    def __init__(self) -> None:
        self.said_ns: list[int] = []  # when it said STOP
        self._socket: Any = None
        self._mode = ""
        self._held = False  # the button

    async def look(self, session: aiohttp.ClientSession, url: str) -> None:
        """Take all that is shown, and say that the button is held while it is."""
        address, token = url.split("/#")
        async with session.ws_connect(f"{address}/socket", headers={"Origin": address}, max_msg_size=0) as socket:
            await socket.send_str(token)
            self._socket = socket
            holding = asyncio.create_task(self._hold())
            try:
                async for message in socket:
                    if message.type is aiohttp.WSMsgType.TEXT:
                        self._mode = json.loads(message.data).get("mode", self._mode)
            finally:
                holding.cancel()

    async def operate(self, stops: int | None) -> None:
        """Say STOP so often at random times of a drive, and drive on; None: only drive on. Raises ConfigError."""
        rng = random.Random(0)
        while stops is None or len(self.said_ns) < stops:
            await self._until(SafetyMode.DRIVING)
            if stops is None:
                await asyncio.sleep(1.0)
                continue
            await asyncio.sleep(rng.uniform(*_PAUSES_S))
            if self._mode != SafetyMode.DRIVING.value:
                continue
            self._held = False
            self.said_ns.append(time.monotonic_ns())
            await self._socket.send_str("stop")
            await self._until(SafetyMode.STOPPED)

    async def _until(self, mode: SafetyMode) -> None:
        """Wait for a mode of the run; for driving, press the button where the car is at rest."""
        until_s = time.monotonic() + (_PATIENCE_S if self._mode else _START_S)
        while self._mode != mode.value:
            if time.monotonic() > until_s:
                raise ConfigError(f"bench page: expected mode {mode.value}, the run is {self._mode or 'not heard of'}")
            if mode is SafetyMode.DRIVING and self._mode in _AT_REST:
                self._held = False
                await self._socket.send_str("release")
                await asyncio.sleep(_WELL_S)
                await self._socket.send_str("arm")
                self._held = True
                news_s = time.monotonic() + _NEWS_S
                while self._mode in _AT_REST and time.monotonic() < news_s:
                    await asyncio.sleep(0.01)
            await asyncio.sleep(0.01)

    async def _hold(self) -> None:
        while True:
            if self._held:
                await self._socket.send_str("hold")
            await asyncio.sleep(_HOLD_S)
