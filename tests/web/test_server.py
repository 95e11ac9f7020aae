"""The page over real sockets: what a page gets, and each attack with what refuses it."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

import aiohttp
import numpy as np
import pytest
from aiohttp import WSMsgType, WSServerHandshakeError, web
from aiohttp.test_utils import TestClient, TestServer

from automodel.config import CarConfig
from automodel.geometry import SE2
from automodel.signals import Event, LaneEstimate, LaneStatus, Motion, VehicleState
from automodel.web.access import CSP, Access
from automodel.web.guard import CLIENTS_MAX, MESSAGE_BYTES
from automodel.web.server import WORDS_PER_S, Page
from automodel.web.snapshot import Snapshot
from automodel.web.words import to_bytes

WAIT_S = 20.0  # far beyond what any step takes


class Served:
    """A page that is served, its client, and the words that came through."""

    def __init__(self, by_hand: bool) -> None:
        self.access = Access()
        self.words: list[bytes] = []
        self.page = Page(CarConfig(), self.access, self.words.append, by_hand=by_hand)
        self.server = TestServer(self.page.app())
        self.client = TestClient(self.server)

    @property
    def origin(self) -> str:
        return f"http://127.0.0.1:{self.server.port}"

    async def socket(
        self, token: str | None = None, headers: dict[str, str] | None = None
    ) -> aiohttp.ClientWebSocketResponse:
        """An open socket, its token sent."""
        socket = await self.client.ws_connect(
            "/socket", headers={"Origin": self.origin} if headers is None else headers
        )
        await socket.send_str(self.access.token if token is None else token)
        return socket

    async def ready(self) -> aiohttp.ClientWebSocketResponse:
        """A socket that was let in."""
        socket = await self.socket()
        assert "history" in await socket.receive_json(timeout=WAIT_S)
        return socket

    async def heard(self, count: int) -> list[bytes]:
        while len(self.words) < count:
            await asyncio.sleep(0.001)
        return self.words


def served(test: Callable[[Served], Awaitable[None]], by_hand: bool = False) -> None:
    @asynccontextmanager
    async def started() -> AsyncIterator[Served]:
        made = Served(by_hand)
        await made.client.start_server()
        try:
            yield made
        finally:
            await made.client.close()

    async def run() -> None:
        async with started() as made:
            await asyncio.wait_for(test(made), WAIT_S)

    asyncio.run(run())


def snapshot(t_ns: int = 5_000_000_000) -> Snapshot:
    return Snapshot(
        t_ns=t_ns,
        image=np.zeros((360, 640), np.uint8),
        estimate=LaneEstimate(t_ns=t_ns, status=LaneStatus.LOST),
        command=None,
        state=VehicleState(t_ns=t_ns, battery_v=6.0),
        motion=Motion(t_ns=t_ns, speed_mps=0.5, yaw_rate_radps=0.0),
        mode="DRIVING",
        reason=None,
        latency_ns=12_000_000,
        place=SE2(1.0, 2.0, 0.5),
        rate_hz=59.9,
        skipped=3,
        unpaired=4,
        events=(Event(t_ns=t_ns, kind="hold", text="<b>the lane is lost</b>"),),
    )


@pytest.mark.parametrize("path", ["/", "/page.js", "/draw.js", "/page.css"])
def test_the_files_carry_the_policy_and_no_token(path: str) -> None:
    async def test(made: Served) -> None:
        answer = await made.client.get(path)
        assert answer.status == 200
        assert answer.headers["Content-Security-Policy"] == CSP
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
        assert made.access.token not in await answer.text()

    served(test)


def test_a_page_is_told_of_a_cycle_in_words_and_a_picture() -> None:
    async def test(made: Served) -> None:
        socket = await made.ready()
        await made.page.show(snapshot())
        news = await socket.receive_json(timeout=WAIT_S)
        assert news["row"] == [0.0, None, None, None, None, 0.5, 12.0, 1.0, 2.0]
        assert (news["mode"], news["lane"], news["battery_v"], news["skipped"]) == ("DRIVING", "LOST", 6.0, 3)
        assert news["unpaired"] == 4
        assert news["events"] == [[0.0, "hold", "<b>the lane is lost</b>"]]
        assert (await socket.receive_bytes(timeout=WAIT_S)).startswith(b"\xff\xd8")
        late = await made.socket()
        assert (await late.receive_json(timeout=WAIT_S))["history"] == [news["row"]]

    served(test)


def test_a_page_that_reads_nothing_gets_only_the_newest_and_delays_nobody() -> None:
    async def test(made: Served) -> None:
        lazy, eager = await made.ready(), await made.ready()
        for number in range(30):
            await made.page.show(snapshot(5_000_000_000 + number * 1_000_000_000))
            seen = None
            while seen is None:
                message = await eager.receive(WAIT_S)
                seen = json.loads(message.data)["row"][0] if message.type is WSMsgType.TEXT else None
            assert seen == number
        await lazy.close()

    served(test)


def test_words_reach_the_run() -> None:
    async def test(made: Served) -> None:
        socket = await made.ready()
        for word in ("arm", "hold", "release", "stop"):
            await socket.send_str(word)
        assert await made.heard(4) == [b"A", b"H", b"R", b"S"]

    served(test)


def test_a_hand_s_words_reach_the_run_where_it_was_started_for_it() -> None:
    async def test(made: Served) -> None:
        socket = await made.ready()
        for word in ("take", "drive 0.5 -1", "release"):
            await socket.send_str(word)
        assert await made.heard(3) == [b"T", to_bytes((0.5, -1.0)), b"R"]

    served(test, by_hand=True)


@pytest.mark.parametrize("word", ["take", "drive 0 0"])
def test_nobody_drives_by_hand_where_the_run_was_not_started_for_it(word: str) -> None:
    async def test(made: Served) -> None:
        socket = await made.ready()
        await socket.send_str(word)
        assert (await socket.receive(WAIT_S)).type is WSMsgType.CLOSE
        assert made.words == []

    served(test)


def test_a_hand_that_did_not_take_the_car_is_not_heard() -> None:
    async def test(made: Served) -> None:
        first, second = await made.ready(), await made.ready()
        await first.send_str("take")
        await made.heard(1)
        for word in ("take", "drive 1 1", "release", "stop"):
            await second.send_str(word)
        assert await made.heard(2) == [b"T", b"S"]

    served(test, by_hand=True)


def test_a_page_that_goes_away_has_let_go_of_the_button() -> None:
    async def test(made: Served) -> None:
        socket = await made.ready()
        await socket.send_str("arm")
        await made.heard(1)
        await socket.close()
        assert await made.heard(2) == [b"A", b"R"]

    served(test)


def test_one_page_at_a_time_holds_the_button_and_every_page_stops() -> None:
    async def test(made: Served) -> None:
        first, second = await made.ready(), await made.ready()
        await first.send_str("arm")
        await made.heard(1)
        for word in ("arm", "hold", "release", "stop"):
            await second.send_str(word)
        assert await made.heard(2) == [b"A", b"S"]

    served(test)


# --- attacks ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("attack", "headers", "status"),
    [
        ("a page of another site opens the socket", {"Origin": "http://evil.example"}, 403),
        ("a program that sends no Origin", {}, 403),
        ("a file opened in the browser", {"Origin": "null"}, 403),
        ("a foreign name that points here", {"Origin": "http://evil.example", "Host": "evil.example"}, 421),
    ],
)
def test_a_socket_is_refused_to(attack: str, headers: dict[str, str], status: int) -> None:
    async def test(made: Served) -> None:
        with pytest.raises(WSServerHandshakeError) as refused:
            await made.socket(headers=headers)
        assert refused.value.status == status, attack

    served(test)


@pytest.mark.parametrize("token", ["", "wrong", "stop", "x" * (MESSAGE_BYTES - 1)])
def test_without_the_token_nothing_is_told_and_nothing_heard(token: str) -> None:
    async def test(made: Served) -> None:
        socket = await made.socket(token)
        await socket.send_str("stop")
        message = await socket.receive(WAIT_S)
        assert message.type is WSMsgType.CLOSE
        assert message.data == 4401
        assert made.words == []

    served(test)


def test_a_foreign_host_gets_no_page() -> None:
    async def test(made: Served) -> None:
        answer = await made.client.get("/", headers={"Host": "evil.example"})
        assert answer.status == 421

    served(test)


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/../server.py", 404),
        ("GET", "/%2e%2e/access.py", 404),
        ("GET", "/page/index.html", 404),
        ("POST", "/", 405),
        ("PUT", "/page.js", 405),
    ],
)
def test_only_the_pages_own_files_are_read(method: str, path: str, status: int) -> None:
    async def test(made: Served) -> None:
        answer = await made.client.request(method, path)
        assert answer.status == status
        assert answer.headers["Content-Security-Policy"] == CSP

    served(test)


@pytest.mark.parametrize("message", ["reboot", "STOP ", "x" * (MESSAGE_BYTES + 1), b"stop"])
def test_what_is_no_word_closes_the_socket(message: str | bytes) -> None:
    async def test(made: Served) -> None:
        socket = await made.ready()
        await (socket.send_str(message) if isinstance(message, str) else socket.send_bytes(message))
        assert (await socket.receive(WAIT_S)).type is WSMsgType.CLOSE
        assert made.words == []

    served(test)


def test_a_page_that_floods_is_cut_off() -> None:
    async def test(made: Served) -> None:
        socket = await made.ready()
        for _ in range(WORDS_PER_S + 10):
            await socket.send_str("stop")
        assert (await socket.receive(WAIT_S)).type is WSMsgType.CLOSE
        assert len(made.words) == WORDS_PER_S

    served(test)


def test_a_flood_of_sockets_is_cut_off_and_those_that_close_make_room() -> None:
    async def test(made: Served) -> None:
        sockets = [await made.ready() for _ in range(CLIENTS_MAX)]
        with pytest.raises(WSServerHandshakeError) as refused:
            await made.socket()
        assert refused.value.status == 503
        await sockets[0].close()
        while made.page._open == CLIENTS_MAX:
            await asyncio.sleep(0.001)
        await made.ready()

    served(test)


def test_what_is_no_http_is_refused_without_a_word(caplog: pytest.LogCaptureFixture) -> None:
    """Whoever reaches the port may send anything: it must not fill the terminal from which a car is driven."""
    said = asyncio.run(_sent_raw(b"\x16\x03\x01\x02\x00\x01\x00\r\n\r\n", lambda app: None))
    assert b"400" in said
    assert caplog.text == ""


def test_a_mistake_of_ours_in_a_request_is_one_line(caplog: pytest.LogCaptureFixture) -> None:
    def broken(page: Page) -> None:
        page._files = {}  # every known address is one that it does not know

    said = asyncio.run(_sent_raw(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", broken))
    assert b"500" in said
    (record,) = caplog.records
    assert record.getMessage() == "Error handling request from 127.0.0.1: KeyError: '/'"
    assert record.exc_info is None  # nor its traceback


async def _sent_raw(data: bytes, change: Callable[[Page], None]) -> bytes:
    """What the page's own server answers to these bytes."""
    page = Page(CarConfig(), Access(), lambda word: None)
    runner = page.runner()
    change(page)
    await runner.setup()
    try:
        await web.TCPSite(runner, "127.0.0.1", 0).start()
        reader, writer = await asyncio.open_connection("127.0.0.1", runner.addresses[0][1])
        writer.write(data)
        answer = await asyncio.wait_for(reader.read(4096), WAIT_S)
        writer.close()
        return answer
    finally:
        await runner.cleanup()
