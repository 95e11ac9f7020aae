"""The page of a run that is over: its time line, and each frame with what a pipeline said, drawn when asked for."""

from __future__ import annotations

import asyncio
import json
import math
import re
import signal
from typing import Any

import cv2
import numpy as np
from aiohttp import WSMsgType, web

from automodel.config import CarConfig, ConfigError
from automodel.config.changes import with_value
from automodel.console.messages import say
from automodel.web.access import Access
from automodel.web.film import ViewedRun
from automodel.web.guard import REFUSED, GuardedServer
from automodel.web.trial import Trial, changeable

HOST = "127.0.0.1"
MOST_TRIALS = 12  # of one run: each keeps what was seen in all frames
TRY = re.compile(r"try (\S+) (\S+) (.+)")
_JPEG_QUALITY = 85  # [%]
_FILES = {"/": ("view.html", "text/html"), "/view.js": ("view.js", "text/javascript"),
          "/draw.js": ("draw.js", "text/javascript"), "/page.css": ("page.css", "text/css")}  # fmt: skip


class ViewPage(GuardedServer):
    """A page asks "NUMBER EYE" and is told that number and, in a second message, the picture as JPEG.

    "try KEY VALUE EYE" runs the eye's pipeline again with this value in its car.toml: the page is told how far that is,
    what is wrong, or the eye that saw with it. Anything else closes the socket.
    """

    def __init__(self, run: ViewedRun, access: Access) -> None:
        super().__init__(access, _FILES)
        self._run = run
        self._drawing = asyncio.Lock()
        self._trial: Trial | None = None  # the newest; an older one is ended

    async def talk(self, socket: web.WebSocketResponse) -> None:
        """Send the summary, then each frame that is asked for and what comes of each change."""
        await socket.send_str(json.dumps(summary(self._run), allow_nan=False))
        trying: set[asyncio.Task[None]] = set()
        try:
            async for message in socket:
                text = message.data if message.type is WSMsgType.TEXT else ""
                try:
                    if asked := TRY.fullmatch(text):
                        trying.add(asyncio.create_task(self._try(socket, *self._changed(*asked.groups()))))
                    else:
                        await self._show(socket, text)
                except ConfigError as error:
                    await socket.send_str(json.dumps({"trial": {"wrong": str(error)}}))
                except (ValueError, KeyError, IndexError):
                    await socket.close(code=REFUSED, message=b"expected: NUMBER EYE, or try KEY VALUE EYE")
                    return
        finally:
            if trying:
                self.end_trial()
                await asyncio.gather(*trying, return_exceptions=True)

    def end_trial(self) -> None:
        """End what runs, if anything does."""
        if self._trial is not None:
            self._trial.close()

    async def _show(self, socket: web.WebSocketResponse, text: str) -> None:
        number, eye = text.split(" ", 1)
        async with self._drawing:
            picture = await asyncio.to_thread(self._picture, int(number), eye)
        await socket.send_str(json.dumps({"number": int(number), "eye": eye}))
        await socket.send_bytes(picture)

    def _picture(self, number: int, eye: str) -> bytes:
        drawn = self._run.picture(number, eye)
        return cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()

    def _changed(self, key: str, value: str, base: str) -> tuple[str, str, CarConfig]:
        """The eye to compare with, the change in words and the car; raises ConfigError and KeyError."""
        eye = self._run.eye(base)
        if key not in changeable(eye):
            raise KeyError(key)
        if len(self._run.trials) >= MOST_TRIALS:
            raise ConfigError(f"{MOST_TRIALS} changes are kept; start automodel view again for more")
        return base, f"{key} = {value}", with_value(eye.car, key, value)

    async def _try(self, socket: web.WebSocketResponse, base: str, change: str, car: CarConfig) -> None:
        """Run the trial and say what comes of it; a newer one, of this page or another, ends it."""
        self.end_trial()
        trial = self._trial = Trial(self._run.footage, car)
        frames = len(self._run.frames)
        try:
            while isinstance(word := await asyncio.to_thread(trial.next_word), int):
                await socket.send_str(json.dumps({"trial": {"done": word, "of": frames}}))
            if self._trial is not trial:
                word = "ended: another change was asked for"
            elif not isinstance(word, str) and len(word) != frames:
                word = "the source has changed; start automodel view again"
            told: dict[str, Any] = {"wrong": word}
            if not isinstance(word, str):
                name = self._run.add_trial(base, change, car, word)
                told = {"eye": name, "track": _track(self._run, name)}
            if not socket.closed:
                await socket.send_str(json.dumps({"trial": told}, allow_nan=False))
        finally:
            trial.close()


def summary(run: ViewedRun) -> dict[str, Any]:
    """What the page draws its time line from; None for what is not known, lengths in metres, angles in radians."""
    path = None if run.path is None else np.round(run.path.xy_m, 3).tolist()
    return {
        "name": run.name,
        "t": [round(t, 4) for t in run.t_s],
        "frames": run.frames,
        "path": path,
        "speed": [_number(motion.speed_mps) if motion.known else None for motion in run.motions],
        "events": [[round(t, 3), event.kind, event.text] for t, event in run.events],
        "eyes": {eye.name: _track(run, eye.name) for eye in run.eyes},
    }


def _track(run: ViewedRun, eye: str) -> dict[str, Any]:
    """An eye's columns over the frames, and its marks."""
    columns: dict[str, list[Any]] = {name: [] for name in ("status", "offset", "bound", "heading", "steering", "ms")}
    for word in run.seen[eye]:
        pose = None if word.estimate is None else word.estimate.pose
        columns["status"].append("LOST" if word.estimate is None else word.estimate.status.value)
        columns["offset"].append(None if pose is None else _number(pose.offset_m))
        columns["bound"].append(None if pose is None else _number(pose.offset_bound_m))
        columns["heading"].append(None if pose is None else _number(pose.heading_rad))
        columns["steering"].append(None if word.command is None else _number(word.command.steering_rad))
        columns["ms"].append(None if word.time_ms is None else _number(word.time_ms))
    base, words = run.trials.get(eye, (None, eye))
    marks = [[round(t, 3), text] for t, text in run.marks(eye)]
    return {**columns, "marks": marks, "base": base, "words": words, "settings": changeable(run.eye(eye))}


def _number(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None


def serve(run: ViewedRun, port: int) -> None:
    """Serve the page on this machine alone until Ctrl-C; prints its address. Raises ConfigError for a port in use."""
    asyncio.run(_serve(run, port))


async def _serve(run: ViewedRun, port: int) -> None:
    access = Access()
    page = ViewPage(run, access)
    runner = page.runner()
    await runner.setup()
    try:
        await web.TCPSite(runner, HOST, port).start()
    except OSError as error:
        await runner.cleanup()
        raise ConfigError(f"--port {port}: cannot be served: {error.strerror}; choose another port") from None
    over = asyncio.Event()
    for name in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(name, over.set)
    say(f"open http://{HOST}:{runner.addresses[0][1]}/#{access.token} ; Ctrl-C ends it")
    try:
        await over.wait()
    finally:
        page.end_trial()
        await runner.cleanup()
