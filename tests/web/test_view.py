"""The page of a run that is over, over real sockets."""

from __future__ import annotations

import asyncio
import json
import math
import os
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from aiohttp import ClientWebSocketResponse, WSMsgType, WSServerHandshakeError
from aiohttp.test_utils import TestClient, TestServer

from automodel.assembly.report import Seen
from automodel.config import ConfigError
from automodel.recording.reader import Recording
from automodel.signals import Event
from automodel.web.access import CSP, Access
from automodel.web.film import Film, ViewedRun, look_through
from automodel.web.guard import MESSAGE_BYTES
from automodel.web.view import ViewPage, summary

WAIT_S = 20.0


@pytest.fixture(scope="module")
def run(driven: Path) -> Iterator[ViewedRun]:
    viewed = look_through(driven / "run.mcap", ["contour"], to_s=0.5)
    yield viewed
    viewed.film.close()


def opened(
    run: ViewedRun, test: Callable[[ClientWebSocketResponse], Awaitable[None]], token: str | None = None
) -> None:
    """Run the test with a socket of the page whose token was sent."""

    async def whole() -> None:
        access = Access()
        server = TestServer(ViewPage(run, access).app())
        async with TestClient(server) as client:
            headers = {"Origin": f"http://127.0.0.1:{server.port}"}
            socket = await client.ws_connect("/socket", headers=headers)
            await socket.send_str(access.token if token is None else token)
            await test(socket)

    asyncio.run(asyncio.wait_for(whole(), 2 * WAIT_S))


def test_the_summary_is_what_was_recorded_and_what_the_pipeline_says(run: ViewedRun, driven: Path) -> None:
    told = json.loads(json.dumps(summary(run), allow_nan=False))
    steps = list(Recording(driven / "run.mcap").steps())[: len(run.frames)]
    assert told["frames"] == [step.frame.index for step in steps]
    assert list(told["eyes"]) == ["recorded", "contour"]
    for column in told["eyes"]["contour"].values():
        assert isinstance(column, list)
    track = told["eyes"]["recorded"]
    for number, step in enumerate(steps):
        assert step.estimate is not None
        assert track["status"][number] == step.estimate.status.value
        pose = step.estimate.pose
        assert track["offset"][number] == (None if pose is None else pytest.approx(pose.offset_m, abs=1e-4))
    assert len(told["path"]) == len(told["t"]) == len(told["speed"]) == len(run.frames)
    assert [event[1] for event in told["events"]] == [event.kind for step in steps for event in step.events]


def test_marks_are_events_and_where_the_lane_is_lost_and_found(run: ViewedRun) -> None:
    blind = list(run.seen["contour"])
    for number in (5, 6, 7):
        blind[number] = Seen(estimate=None, command=None, time_ms=None)
    event = Event(t_ns=0, kind="hold", text="no frame")
    cut = replace(run, seen={**run.seen, "contour": blind}, events=[(run.t_s[6], event)])
    assert cut.marks("contour")[-3:] == [
        (run.t_s[5], f"{status_of(run, 4)} to LOST"),
        (run.t_s[6], "hold: no frame"),
        (run.t_s[8], f"LOST to {status_of(run, 8)}"),
    ]
    assert (run.t_s[6], "hold: no frame") in cut.marks("recorded")


def status_of(run: ViewedRun, number: int) -> str:
    estimate = run.seen["contour"][number].estimate
    assert estimate is not None
    return estimate.status.value


def test_a_frame_that_is_asked_for_comes_as_it_is_drawn(run: ViewedRun) -> None:
    async def test(socket: ClientWebSocketResponse) -> None:
        assert (await socket.receive_json(timeout=WAIT_S))["name"] == "run.mcap"
        for number, eye in ((7, "recorded"), (len(run.frames) - 1, "contour"), (0, "contour")):
            await socket.send_str(f"{number} {eye}")
            assert await socket.receive_json(timeout=WAIT_S) == {"number": number, "eye": eye}
            data = await socket.receive_bytes(timeout=WAIT_S)
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
            assert image is not None
            expected = run.picture(number, eye)
            assert image.shape == expected.shape
            assert np.abs(image.astype(float) - expected).mean() < 3.0  # grey levels: JPEG

    opened(run, test)


@pytest.mark.parametrize(
    "message",
    ["", "7", "-1 recorded", "99999 recorded", "7 nobody", "x recorded", "1" * (MESSAGE_BYTES + 1), b"7 x"],
)
def test_what_is_no_frame_closes_the_socket(run: ViewedRun, message: str | bytes) -> None:
    async def test(socket: ClientWebSocketResponse) -> None:
        await socket.receive_json(timeout=WAIT_S)
        await (socket.send_str(message) if isinstance(message, str) else socket.send_bytes(message))
        assert (await socket.receive(WAIT_S)).type is WSMsgType.CLOSE

    opened(run, test)


def test_without_the_token_nothing_is_told(run: ViewedRun) -> None:
    async def test(socket: ClientWebSocketResponse) -> None:
        message = await socket.receive(WAIT_S)
        assert (message.type, message.data) == (WSMsgType.CLOSE, 4401)

    opened(run, test, token="wrong")


def test_a_foreign_page_opens_no_socket(run: ViewedRun) -> None:
    async def whole() -> None:
        async with TestClient(TestServer(ViewPage(run, Access()).app())) as client:
            with pytest.raises(WSServerHandshakeError, match="403"):
                await client.ws_connect("/socket", headers={"Origin": "http://evil.example"})
            for path in ("/", "/view.js", "/draw.js", "/page.css"):
                answer = await client.get(path)
                assert (answer.status, answer.headers["Content-Security-Policy"]) == (200, CSP)
            assert (await client.get("/", headers={"Host": "evil.example"})).status == 421

    asyncio.run(whole())


def test_the_script_and_the_page_name_the_same_elements() -> None:
    folder = Path(look_through.__code__.co_filename).parent / "page"
    for page, script in (("index.html", "page.js"), ("view.html", "view.js")):
        ids = set(re.findall(r'id="([\w-]+)"', (folder / page).read_text()))
        asked = set(re.findall(r'at\("([\w-]+)"\)', (folder / script).read_text()))
        assert asked
        assert asked <= ids


def test_a_film_gives_its_images_back_in_any_order() -> None:
    film = Film()
    images = [np.full((8, 12), 20 * number, np.uint8) for number in range(5)]
    for image in images:
        film.add(image)
    film.add(np.full((8, 12, 3), 77, np.uint8))
    for number in (3, 0, 4):
        assert np.abs(film.image(number).astype(int) - images[number]).max() <= 2
    assert film.image(5).shape == (8, 12, 3)
    assert len(film) == 6
    film.close()


def test_no_frames_is_one_line(driven: Path) -> None:
    with pytest.raises(ConfigError, match=r"no frames between --from 99 and --to inf s"):
        look_through(driven / "run.mcap", from_s=99.0, to_s=math.inf)


def test_the_command_serves_on_this_machine_alone_until_ctrl_c(driven: Path) -> None:
    command = [sys.executable, "-m", "automodel", "view", str(driven / "run.mcap"), "--to", "0.2"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env={**os.environ, "COLUMNS": "200"}) as process:
        assert process.stderr is not None
        line = process.stderr.readline()
        url = re.search(r"http://127\.0\.0\.1:(\d+)/#[\w-]{43}", line)
        assert url, line
        with urllib.request.urlopen(url.group(0), timeout=WAIT_S) as answer:
            assert b"view.js" in answer.read()
        process.send_signal(signal.SIGINT)
        assert process.wait(WAIT_S) == 0


def test_a_port_in_use_is_one_line(driven: Path, cli) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        said = cli("view", driven / "run.mcap", "--to", "0.1", "--port", port)
    assert said.code == 2
    assert f"--port {port}: cannot be served" in said.line()
