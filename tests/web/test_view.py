"""The page of a run that is over, over real sockets."""

from __future__ import annotations

import asyncio
import json
import multiprocessing
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
from typing import Any

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
from automodel.web.film import Film, Footage, ViewedRun, look_through
from automodel.web.guard import MESSAGE_BYTES
from automodel.web.trial import Trial, changeable
from automodel.web.view import MOST_TRIALS, ViewPage, summary

WAIT_S = 100.0  # for what only ever comes late on a busy machine


@pytest.fixture(scope="module")
def run(driven: Path) -> Iterator[ViewedRun]:
    viewed = look_through(Footage(path=driven / "run.mcap", to_s=0.5), ["contour"])
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
    for name in ("status", "offset", "bound", "heading", "steering", "ms"):
        assert len(told["eyes"]["contour"][name]) == len(run.frames)
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


def own(run: ViewedRun) -> ViewedRun:
    """The same run, to which a test may add changes."""
    return replace(run, eyes=list(run.eyes), seen=dict(run.seen), trials=dict(run.trials))


async def results(socket: ClientWebSocketResponse) -> dict[str, Any]:
    """What comes of a change, after the words about how far it is."""
    while "done" in (word := (await socket.receive_json(timeout=WAIT_S))["trial"]):
        assert 0 < word["done"] <= word["of"]
    return dict(word)


def test_a_changed_key_is_seen_with_by_a_pipeline_that_runs_again(run: ViewedRun) -> None:
    run = own(run)
    height_m = run.eye("contour").car.camera.extrinsics.z_m

    async def test(socket: ClientWebSocketResponse) -> None:
        told = (await socket.receive_json(timeout=WAIT_S))["eyes"]["contour"]
        assert told["settings"]["camera.extrinsics.z_m"] == height_m
        await socket.send_str(f"try camera.extrinsics.z_m {1.1 * height_m} contour")
        first = await results(socket)
        assert (first["eye"], first["track"]["base"]) == ("change 1", "contour")
        assert first["track"]["words"] == f"contour, camera.extrinsics.z_m = {1.1 * height_m}"
        widths = [
            [word.estimate.pose.width_m for word in run.seen[eye] if word.estimate and word.estimate.pose]
            for eye in ("contour", "change 1")
        ]
        assert np.median(widths[1]) / np.median(widths[0]) == pytest.approx(1.1, rel=0.02)
        await socket.send_str("3 change 1")  # its frames are drawn like all others
        assert (await socket.receive_json(timeout=WAIT_S))["eye"] == "change 1"
        await socket.receive_bytes(timeout=WAIT_S)
        await socket.send_str("try pipeline.contour.coast_s 1.5 change 1")  # and it can be changed further
        second = await results(socket)
        assert second["track"]["words"].endswith(f"z_m = {1.1 * height_m}, pipeline.contour.coast_s = 1.5")
        assert second["track"]["settings"]["camera.extrinsics.z_m"] == pytest.approx(1.1 * height_m)

    opened(run, test)
    again = summary(run)["eyes"]  # for a page that is opened later
    assert list(again) == ["recorded", "contour", "change 1", "change 2"]
    assert again["change 2"]["base"] == "change 1"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("lane.width_m x", "lane.width_m: expected a finite number"),
        ("lane.width_m nan", "lane.width_m: expected a finite number"),
        ("lane.width_m 1e300", "lane.width_m: expected at most 20"),
        ("lane.width_m 0", "width_m: expected a positive number, got 0.0"),
        ("lane.markings green", "markings: expected one of light, dark, both, got 'green'"),
        ("pipeline.contour.nodes 3.5", "pipeline.contour.nodes: expected a whole number"),
    ],
)
def test_a_value_that_cannot_be_is_told_and_nothing_runs(run: ViewedRun, change: str, said: str) -> None:
    async def test(socket: ClientWebSocketResponse) -> None:
        await socket.receive_json(timeout=WAIT_S)
        await socket.send_str(f"try {change} contour")
        assert (await results(socket))["wrong"].startswith(said)
        await socket.send_str("0 contour")  # the socket is still open
        assert (await socket.receive_json(timeout=WAIT_S))["number"] == 0

    opened(run, test)


def test_a_page_names_no_files_and_not_more_changes_than_are_kept(run: ViewedRun) -> None:
    full = own(run)
    for _ in range(MOST_TRIALS):
        full.add_trial("contour", "nothing", full.eye("contour").car, full.seen["contour"])
    keys = {key for eye in run.eyes for key in changeable(eye)}
    assert {"lane.width_m", "lane.markings", "pipeline.contour.nodes", "camera.extrinsics.pitch_rad"} <= keys
    assert not [key for key in keys if "model" in key or "provider" in key or "source" in key or "link" in key]

    async def test(socket: ClientWebSocketResponse) -> None:
        await socket.receive_json(timeout=WAIT_S)
        await socket.send_str("try lane.width_m 0.5 contour")
        assert (await results(socket))["wrong"].startswith(f"{MOST_TRIALS} changes are kept")

    opened(full, test)


def test_a_trial_that_is_ended_says_so_and_leaves_no_process(run: ViewedRun) -> None:
    trial = Trial(run.footage, run.eye("contour").car)
    trial.close()
    assert "the process ended" in str(trial.next_word())
    assert not [child for child in multiprocessing.active_children() if child.name == "automodel view"]


def test_what_a_source_has_become_is_told(run: ViewedRun, tmp_path: Path) -> None:
    trial = Trial(replace(run.footage, path=tmp_path / "gone.mcap"), run.eye("contour").car)
    try:
        assert "gone.mcap: no such file" in str(trial.next_word())
    finally:
        trial.close()


@pytest.mark.parametrize(
    "message",
    ["", "7", "-1 recorded", "99999 recorded", "7 nobody", "x recorded", "1" * (MESSAGE_BYTES + 1), b"7 x",
     "try", "try lane.width_m 1", "try lane.width_m 1 nobody", "try link.kind x contour", "try a b contour",
     "try pipeline.contour.__class__ 1 contour", "try lane 1 contour"],
)  # fmt: skip
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
        look_through(Footage(path=driven / "run.mcap", from_s=99.0))


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
