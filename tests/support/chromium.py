"""A real Chromium without a window, spoken to by its DevTools protocol."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import itertools
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import AsyncIterator
from pathlib import Path
from types import TracebackType
from typing import Any

import aiohttp

WAIT_S = 60.0  # far beyond what any step takes
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def chromium() -> str | None:
    """The program, None where there is none; $AUTOMODEL_CHROMIUM goes before."""
    return os.environ.get("AUTOMODEL_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)


class Chromium:
    """A browser with a profile of its own; the name `foreign` leads to this machine, as an attacker's DNS may say."""

    def __init__(self, foreign: str = "evil.example") -> None:
        self._profile = Path(tempfile.mkdtemp(prefix="chromium-"))
        program = chromium()
        assert program is not None
        self._process = subprocess.Popen(
            [
                program, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
                "--disable-background-networking", f"--user-data-dir={self._profile}", "--remote-debugging-port=0",
                f"--host-resolver-rules=MAP {foreign} 127.0.0.1", "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip

    def __enter__(self) -> Chromium:
        file, until = self._profile / "DevToolsActivePort", time.monotonic() + WAIT_S
        while not (file.exists() and file.read_text().count("\n")):
            assert self._process.poll() is None, "the browser does not start"
            assert time.monotonic() < until, "the browser does not open its port"
            time.sleep(0.02)
        self._port = int(file.read_text().splitlines()[0])
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(10)
        self._process.kill()
        self._process.wait()
        shutil.rmtree(self._profile, ignore_errors=True)

    @contextlib.asynccontextmanager
    async def tab(self, url: str = "about:blank") -> AsyncIterator[Tab]:
        """A new tab at an address."""
        async with aiohttp.ClientSession() as http:
            async with http.put(f"http://127.0.0.1:{self._port}/json/new?about:blank") as answer:
                address = (await answer.json(content_type=None))["webSocketDebuggerUrl"]
            async with http.ws_connect(address, max_msg_size=0) as socket:
                tab = Tab(socket)
                for domain in ("Page", "Runtime", "Log"):
                    await tab.call(f"{domain}.enable")
                if url != "about:blank":
                    await tab.go(url)
                try:
                    yield tab
                finally:
                    with contextlib.suppress(Exception):
                        await tab.call("Page.close")
                    tab.end()


class Tab:
    """A page; `complaints` are what it has written to the console as errors, exceptions among them."""

    def __init__(self, socket: Any) -> None:
        self.complaints: list[str] = []
        self._socket, self._numbers = socket, itertools.count(1)
        self._answers: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._listening = asyncio.create_task(self._listen())

    def end(self) -> None:
        self._listening.cancel()

    async def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """One command of the protocol, and what it gives."""
        number = next(self._numbers)
        self._answers[number] = asyncio.get_running_loop().create_future()
        await self._socket.send_json({"id": number, "method": method, "params": parameters})
        answer = await asyncio.wait_for(self._answers[number], WAIT_S)
        assert "error" not in answer, (method, answer)
        result: dict[str, Any] = answer["result"]
        return result

    async def go(self, url: str) -> None:
        """Open an address and wait until it is read."""
        await self.call("Page.navigate", url=url)
        await self.until("document.readyState === 'complete' && location.href !== 'about:blank'")

    async def js(self, expression: str) -> Any:
        """The value of an expression; a promise is awaited."""
        done = await self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in done, done
        return done["result"].get("value")

    async def text(self, name: str) -> str:
        """The text of the element with this id."""
        return str(await self.js(f"document.getElementById({name!r}).textContent"))

    async def until(self, expression: str) -> None:
        """Wait until an expression is true."""
        until = time.monotonic() + WAIT_S
        while not await self.js(f"Boolean({expression})"):
            assert time.monotonic() < until, expression
            await asyncio.sleep(0.02)

    async def mouse(self, kind: str, name: str, dx: float = 0.0, dy: float = 0.0) -> None:
        """mousePressed, mouseMoved or mouseReleased, beside the middle of the element with this id."""
        place = "(b => [b.x + b.width / 2, b.y + b.height / 2])(document.getElementById(NAME).getBoundingClientRect())"
        box = await self.js(place.replace("NAME", repr(name)))
        button = {"button": "left", "buttons": 0 if kind == "mouseReleased" else 1, "clickCount": 1}
        await self.call("Input.dispatchMouseEvent", type=kind, x=box[0] + dx, y=box[1] + dy, **button)

    async def key(self, kind: str, code: str, key: str, number: int) -> None:
        """keyDown or keyUp."""
        await self.call("Input.dispatchKeyEvent", type=kind, code=code, key=key, windowsVirtualKeyCode=number)

    async def look(self, width_px: int, height_px: int, dark: bool, phone: bool) -> None:
        """The size of the screen, and whether it is dark."""
        scale = 2 if phone else 1
        await self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width_px,
            height=height_px,
            deviceScaleFactor=scale,
            mobile=phone,
        )
        features = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        await self.call("Emulation.setEmulatedMedia", features=features)

    async def screenshot(self, whole: bool = False) -> bytes:
        """PNG of what is seen, or of the whole page."""
        shot = await self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        return base64.b64decode(shot["data"])

    async def _listen(self) -> None:
        async for message in self._socket:
            said = message.json()
            if "id" in said:
                self._answers.pop(said["id"]).set_result(said)
            elif said["method"] == "Runtime.exceptionThrown":
                self.complaints.append(str(said["params"]["exceptionDetails"]))
            elif said["method"] == "Log.entryAdded" and said["params"]["entry"]["level"] == "error":
                self.complaints.append(said["params"]["entry"]["text"])
            elif said["method"] == "Runtime.consoleAPICalled" and said["params"]["type"] == "error":
                self.complaints.append(str(said["params"]["args"]))
