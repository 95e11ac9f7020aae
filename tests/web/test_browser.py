"""The page in a real Chromium: what is on it, what its buttons say, what a browser refuses."""

from __future__ import annotations

import asyncio
import io
import subprocess
import sys
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import aiohttp.test_utils
import cv2
import numpy as np
import pytest
from aiohttp import web

from automodel.config import CarConfig
from automodel.geometry import SE2
from automodel.recording.reader import Recording
from automodel.signals import Command, Event, LaneEstimate, LaneStatus, Motion, VehicleState
from automodel.web.access import Access
from automodel.web.guard import CLIENTS_MAX, MESSAGE_BYTES
from automodel.web.server import Page
from automodel.web.snapshot import Snapshot
from automodel.web.words import Word, from_bytes
from tests.support.chromium import Chromium, Tab, chromium

pytestmark = pytest.mark.skipif(chromium() is None, reason="needs Chromium: apt-get install chromium")

WAIT_S = 120.0  # far beyond what any step takes
DRAWN = (
    "[...document.querySelectorAll('canvas')].map((c) => c.getContext('2d').getImageData(0, 0, c.width, c.height).data)"
    ".filter((data) => new Set(data).size > 2).length"
)
CUT = (
    "[...document.querySelectorAll('button, dd, dt')]"
    ".filter((e) => e.clientWidth && e.scrollWidth > e.clientWidth + 1).length"
)
SCRIPT = (
    "const s = document.createElement('script'); s.textContent = 'window.evil = 1'; document.body.append(s); "
    "window.evil === undefined"
)
SCREENS = {"desktop": (1400, 900, False), "phone": (390, 844, True)}


class Browsed:
    """A page that is served, a run that goes on behind it, and the words that came through."""

    def __init__(self, by_hand: bool) -> None:
        self.access = Access()
        self.words: list[object] = []
        self.page = Page(CarConfig(), self.access, lambda data: self.words.append(from_bytes(data)), by_hand=by_hand)
        self.server = aiohttp.test_utils.TestServer(self.page.app())
        self.mode, self.driver = "DRIVING", None
        self.events = (Event(t_ns=0, kind="stop", text="<img src=x onerror=alert(1)>"),)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server.port}/#{self.access.token}"

    async def run(self) -> None:
        """What the run shows, ten times a second."""
        for number in range(1_000_000):
            await self.page.show(self._snapshot(number))
            await asyncio.sleep(0.1)

    async def heard(self, *words: object) -> None:
        """Wait until these have come, in this order, whatever came between them."""
        while True:
            came = iter(self.words)
            if all(any(word == one for one in came) for word in words):
                return
            await asyncio.sleep(0.01)

    def _snapshot(self, number: int) -> Snapshot:
        t_ns = number * 100_000_000
        return Snapshot(
            t_ns=t_ns,
            image=np.full((360, 640), 80, np.uint8),
            estimate=LaneEstimate(t_ns=t_ns, status=LaneStatus.LOST),
            command=Command(t_ns=t_ns, steering_rad=0.1 * np.sin(0.3 * number), speed_mps=0.5, valid_until_ns=t_ns),
            state=VehicleState(t_ns=t_ns, battery_v=6.0, armed=True),
            motion=Motion(t_ns=t_ns, speed_mps=0.5, yaw_rate_radps=0.0),
            mode=self.mode,
            reason=None,
            latency_ns=12_000_000,
            place=SE2(0.05 * number, 0.0, 0.0),
            rate_hz=59.9,
            skipped=3,
            unpaired=4,
            events=self.events,
        )


@pytest.fixture(scope="module")
def browser() -> Iterator[Chromium]:
    with Chromium() as started:
        yield started


def browsed(browser: Chromium, test: Callable[[Browsed, Chromium], Awaitable[None]], by_hand: bool = True) -> None:
    async def run() -> None:
        made = Browsed(by_hand)
        await made.server.start_server()
        going = asyncio.create_task(made.run())
        try:
            await asyncio.wait_for(test(made, browser), WAIT_S)
        finally:
            going.cancel()
            await made.server.close()

    asyncio.run(run())


async def shown(tab: Tab) -> None:
    await tab.until("document.getElementById('lane').textContent !== '-'")


def pixels(png: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(io.BytesIO(png).read(), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image


def test_what_is_on_the_page(browser: Chromium) -> None:
    async def test(made: Browsed, browser: Chromium) -> None:
        async with browser.tab(made.url) as tab:
            await shown(tab)
            names = ("mode", "lane", "driver", "armed", "battery", "camera")
            assert [await tab.text(name) for name in names] == [
                "DRIVING", "LOST", "pipeline", "armed", "6.00 V, low", "59.9 Hz, 3 skipped, 4 unpaired",
            ]  # fmt: skip
            await tab.until("document.getElementById('picture').naturalWidth === 640")
            await tab.until(f"{DRAWN} === 4")  # steering, speed, latency and the map: no lane is seen
            assert await tab.js("document.querySelectorAll('canvas').length") == 6
            events = await tab.text("events")
            assert "<img src=x onerror=alert(1)>" in events  # as text
            assert await tab.js("document.querySelectorAll('#events img').length") == 0
            assert tab.complaints == []

    browsed(browser, test)


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("screen", SCREENS)
def test_stop_is_in_sight_and_nothing_is_cut_off(screen: str, dark: bool, browser: Chromium) -> None:
    async def test(made: Browsed, browser: Chromium) -> None:
        width_px, height_px, phone = SCREENS[screen]
        async with browser.tab(made.url) as tab:
            await tab.look(width_px, height_px, dark, phone)
            await shown(tab)
            box = await tab.js("document.getElementById('stop').getBoundingClientRect().toJSON()")
            assert box["bottom"] <= height_px
            assert box["right"] <= width_px
            assert min(box["width"], box["height"]) >= 44  # a finger
            assert await tab.js("document.documentElement.scrollWidth") <= width_px
            assert await tab.js(CUT) == 0
            image = pixels(await tab.screenshot())
            scale = image.shape[1] / width_px
            corner = image[int((box["top"] + 12) * scale), int((box["left"] + 12) * scale)].astype(int)
            assert corner[2] > 150  # red
            assert corner[2] > 2 * corner[1]
            assert bool(image[4, 4].mean() < 60) is dark

    browsed(browser, test)


@pytest.mark.parametrize("how", ["mouse", "space", "escape"])
def test_stop_is_said(how: str, browser: Chromium) -> None:
    async def test(made: Browsed, browser: Chromium) -> None:
        async with browser.tab(made.url) as tab:
            await shown(tab)
            if how == "mouse":
                await tab.mouse("mousePressed", "stop")
            elif how == "space":
                await tab.key("keyDown", "Space", " ", 32)
            else:
                await tab.key("keyDown", "Escape", "Escape", 27)
            await made.heard(Word.STOP)

    browsed(browser, test)


@pytest.mark.parametrize("end", ["let go", "leaves", "loses the focus"])
def test_the_button_arms_is_held_and_let_go_of(end: str, browser: Chromium) -> None:
    async def test(made: Browsed, browser: Chromium) -> None:
        async with browser.tab(made.url) as tab:
            await shown(tab)
            await tab.mouse("mousePressed", "hold")
            await made.heard(Word.ARM, Word.HOLD, Word.HOLD, Word.HOLD)
            if end == "let go":
                await tab.mouse("mouseReleased", "hold")
            elif end == "leaves":
                await tab.call("Page.navigate", url="about:blank")
            else:
                await tab.js("window.dispatchEvent(new Event('blur'))")
            await made.heard(Word.HOLD, Word.RELEASE)
            count = len(made.words)
            await asyncio.sleep(0.5)
            assert len(made.words) == count

    browsed(browser, test)


def test_a_car_that_was_stopped_needs_a_new_press(browser: Chromium) -> None:
    async def test(made: Browsed, browser: Chromium) -> None:
        async with browser.tab(made.url) as tab:
            await shown(tab)
            await tab.mouse("mousePressed", "hold")
            await tab.until("drove")
            made.mode = "STOPPED"
            await made.heard(Word.ARM, Word.RELEASE)
            assert await tab.js("document.getElementById('hold').className") == ""
            assert await tab.text("reason") == "<img src=x onerror=alert(1)>"  # why, of the last stop
            assert await tab.text("driver") == "nobody"

    browsed(browser, test)


def near(steering: float, speed: float) -> object:
    """Equal to a hand's word near these shares."""

    class Near:
        def __eq__(self, other: object) -> bool:
            return isinstance(other, tuple) and other == pytest.approx((steering, speed), abs=0.03)

        __hash__ = None  # type: ignore[assignment]

    return Near()


def test_a_finger_drives_by_hand(browser: Chromium) -> None:
    async def test(made: Browsed, browser: Chromium) -> None:
        async with browser.tab(made.url) as tab:
            await shown(tab)
            await tab.mouse("mousePressed", "take")
            await made.heard(Word.TAKE, near(0, 0))
            await tab.mouse("mouseMoved", "take", dx=-55.0, dy=-110.0)
            await made.heard(near(0.5, 1.0))
            await tab.mouse("mouseMoved", "take", dx=300.0, dy=22.0)
            await made.heard(near(-1.0, -0.2))
            await tab.mouse("mouseReleased", "take", dx=300.0, dy=22.0)
            await made.heard(Word.TAKE, Word.RELEASE)

    browsed(browser, test)


def test_the_keyboard_drives_by_hand(browser: Chromium) -> None:
    async def test(made: Browsed, browser: Chromium) -> None:
        async with browser.tab(made.url) as tab:
            await shown(tab)
            await tab.key("keyDown", "ShiftLeft", "Shift", 16)
            await tab.key("keyDown", "ArrowUp", "ArrowUp", 38)
            await tab.key("keyDown", "KeyD", "D", 68)
            await made.heard(Word.TAKE, near(-1.0, 1.0))
            await tab.key("keyUp", "KeyD", "D", 68)
            await tab.key("keyUp", "ArrowUp", "ArrowUp", 38)
            await made.heard(near(-1.0, 1.0), near(0.0, 0.0))
            await tab.key("keyUp", "ShiftLeft", "Shift", 16)
            await made.heard(Word.TAKE, Word.RELEASE)

    browsed(browser, test)


PAD = (
    "window.pad = {connected: true, mapping: 'standard', axes: [0, 0, 0, 0], "
    "buttons: Array.from({length: 17}, () => ({pressed: false, value: 0}))}; "
    "navigator.getGamepads = () => [null, window.pad];"
)


@pytest.mark.parametrize("end", ["let go", "stop", "gone"])
def test_a_gamepad_drives_by_hand(end: str, browser: Chromium) -> None:
    """The browser's own gamepads need hardware: what it would give the page is put in their place."""

    async def test(made: Browsed, browser: Chromium) -> None:
        async with browser.tab(made.url) as tab:
            await shown(tab)
            await tab.js(PAD)
            await tab.js("pad.axes[0] = -1; pad.buttons[7].value = 0.5; pad.buttons[5].pressed = true; 0")
            await made.heard(Word.TAKE, near(1.0, 0.5))
            if end == "let go":
                await tab.js("pad.buttons[5].pressed = false")
            elif end == "stop":
                await tab.js("pad.buttons[1].pressed = true")
            else:
                await tab.js("pad.connected = false")
            await made.heard(Word.TAKE, Word.RELEASE if end == "let go" else Word.STOP)

    browsed(browser, test)


def test_without_manual_there_is_no_such_button(browser: Chromium) -> None:
    async def test(made: Browsed, browser: Chromium) -> None:
        async with browser.tab(made.url) as tab:
            await shown(tab)
            assert await tab.js("document.getElementById('take').offsetParent") is None
            await tab.key("keyDown", "ShiftLeft", "Shift", 16)
            await tab.mouse("mousePressed", "hold")
            await made.heard(Word.ARM)
            assert Word.TAKE not in made.words

    browsed(browser, test, by_hand=False)


# --- attacks, as a browser makes them ---------------------------------------------------------------------------------

OPEN = """new Promise((told) => {
  const socket = new WebSocket(ADDRESS);
  socket.onopen = () => { socket.send(FIRST); THEN };
  socket.onclose = (event) => told("closed " + event.code);
  socket.onmessage = () => told("let in");
})"""


def attempt(address: str, first: str = "'x'", then: str = "") -> str:
    return OPEN.replace("ADDRESS", repr(address)).replace("FIRST", first).replace("THEN", then)


def test_a_page_of_another_site_gets_no_socket_and_no_frame(browser: Chromium) -> None:
    async def page(request: web.Request) -> web.Response:
        return web.Response(text="<title>evil</title><iframe id=f></iframe>", content_type="text/html")

    async def test(made: Browsed, browser: Chromium) -> None:
        app = web.Application()
        app.router.add_get("/", page)
        async with aiohttp.test_utils.TestServer(app) as evil, browser.tab(f"http://evil.example:{evil.port}/") as tab:
            socket = f"ws://127.0.0.1:{made.server.port}/socket"
            assert (
                await tab.js(attempt(socket, repr(made.access.token))) == "closed 1006"
            )  # although it knows the token
            await tab.js(f"document.getElementById('f').src = 'http://127.0.0.1:{made.server.port}/'; 0")
            while not any("frame" in complaint.lower() or "X-Frame" in complaint for complaint in tab.complaints):
                await asyncio.sleep(0.02)
            read = f"fetch('http://127.0.0.1:{made.server.port}/page.js').then(() => 'read', () => 'refused')"
            assert await tab.js(read) == "refused"
        assert made.words == []

    browsed(browser, test)


def test_a_foreign_name_that_points_here_gets_nothing(browser: Chromium) -> None:
    async def test(made: Browsed, browser: Chromium) -> None:
        async with browser.tab(f"http://evil.example:{made.server.port}/#{made.access.token}") as tab:
            assert "not the host that you asked for" in await tab.js("document.body.textContent")
            socket = f"ws://evil.example:{made.server.port}/socket"
            assert await tab.js(attempt(socket, repr(made.access.token))) in ("closed 1006", None)
        assert made.words == []

    browsed(browser, test)


def test_a_wrong_token_is_told_and_no_script_of_others_runs(browser: Chromium) -> None:
    async def test(made: Browsed, browser: Chromium) -> None:
        async with browser.tab(made.url[:-3]) as tab:
            await tab.until("document.getElementById('reason').textContent.startsWith('the token is wrong')")
        async with browser.tab(f"http://127.0.0.1:{made.server.port}/") as tab:
            await tab.until("document.getElementById('reason').textContent.startsWith('open the address')")
            assert await tab.js(SCRIPT)
            assert await tab.js("fetch('http://evil.example/').then(() => 'read', () => 'refused')") == "refused"
            assert any("Content Security Policy" in complaint for complaint in tab.complaints)
        assert made.words == []

    browsed(browser, test)


def test_long_words_unknown_words_floods_and_crowds_are_cut_off(browser: Chromium) -> None:
    async def test(made: Browsed, browser: Chromium) -> None:
        socket = f"ws://127.0.0.1:{made.server.port}/socket"
        token = repr(made.access.token)
        async with browser.tab(f"http://127.0.0.1:{made.server.port}/") as tab:

            async def code(first: str, then: str = "") -> str:
                only_close = attempt(socket, first, then).replace("socket.onmessage = () => told('let in');", "")
                return str(await tab.js(only_close.replace('socket.onmessage = () => told("let in");', "")))

            assert await code("'wrong'") == "closed 4401"
            assert await code(token, "socket.send('reboot')") == "closed 4400"
            assert await code(token, f"socket.send('x'.repeat({MESSAGE_BYTES + 1}))") == "closed 1009"
            assert await code(token, "for (let i = 0; i < 60; i++) socket.send('hold')") == "closed 4400"
            opened = f"{{ const s = new WebSocket('{socket}'); s.onopen = () => s.send({token}); return s; }}"
            await tab.js(f"window.all = Array.from({{length: {CLIENTS_MAX}}}, () => {opened}); 0")
            await tab.until("all.every((s) => s.readyState === 1)")
            assert await code(token) == "closed 1006"  # one too many
        assert [word for word in made.words if word is not Word.HOLD] == []

    browsed(browser, test)


@pytest.mark.slow
def test_stop_reaches_the_wire_of_a_run(browser: Chromium, tmp_path: Path) -> None:
    """The simulated car drives by itself; after the page's STOP no command has any speed."""
    recording = tmp_path / "run.mcap"
    command = [
        sys.executable,
        "-m",
        "automodel",
        "run",
        "--web",
        "127.0.0.1:0",
        "--pipeline",
        "contour",
        "--laps",
        "500",
    ]

    async def press(url: str) -> None:
        async with browser.tab(url) as tab:
            await tab.until("document.getElementById('mode').textContent === 'DRIVING'")
            await tab.mouse("mousePressed", "stop")
            await tab.until("document.getElementById('mode').textContent !== 'DRIVING'")

    with subprocess.Popen([*command, "--record", recording], stderr=subprocess.PIPE, text=True) as run:
        assert run.stderr is not None
        url = next(line.split()[-1] for line in run.stderr if line.startswith("web page:"))
        asyncio.run(asyncio.wait_for(press(url), WAIT_S))
        said = run.stderr.read()  # it ends, because the car stands
    assert run.returncode == 1
    assert "stop: STOP on the web page" in said
    values = [message.value for message in Recording(recording)]
    (stop,) = [value for value in values if isinstance(value, Event) and value.kind == "stop"]
    commands = [value for value in values if isinstance(value, Command)]
    assert any(command.speed_mps > 0 for command in commands if command.t_ns < stop.t_ns)
    after = [command for command in commands if command.t_ns >= stop.t_ns]
    assert after
    assert not any(command.speed_mps for command in after)
    assert after[0].t_ns - stop.t_ns < 20_000_000  # the very cycle, on the run's own clock
