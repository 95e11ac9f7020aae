"""The run's side with the real process of the page."""

from __future__ import annotations

import asyncio
import os
import socket
import threading
import time
from pathlib import Path

import aiohttp
import numpy as np
import pytest

from automodel.config import CarConfig, ConfigError
from automodel.runtime.cores import plan_cores, usable_cores
from automodel.runtime.run_types import TickRecord
from automodel.runtime.safety import Action, SafetyDecision, SafetyMode
from automodel.signals import Event, Frame
from automodel.web.access import PageOptions
from automodel.web.remote import WebRemote

WAIT_S = 60.0  # far beyond what any step takes


def record(index: int) -> TickRecord:
    decision = SafetyDecision(
        mode=SafetyMode.DISARMED, action=Action.NEUTRAL, arm=False, disarm=False, reason=None, events=()
    )
    frame = Frame(t_ns=index * 16_000_000, index=index, image=np.zeros((360, 640), np.uint8))
    return TickRecord(
        t_ns=index * 16_000_000, frame=frame, state=None, tick=None, decision=decision, sent=None, latency_ns=None
    )


def test_the_run_is_seen_and_stop_is_heard() -> None:
    with WebRemote(CarConfig(), PageOptions(port=0)) as remote:
        address, token = remote.url.split("/#")
        remote.on_event(Event(t_ns=0, kind="hold", text="why"))
        told: list[dict[str, object]] = []

        async def look_and_stop() -> None:
            async with (
                aiohttp.ClientSession() as session,
                session.ws_connect(f"{address}/socket", headers={"Origin": address}) as page,
            ):
                await page.send_str(token)
                while not (told and "row" in told[-1]):
                    message = await page.receive(WAIT_S)
                    if message.type is aiohttp.WSMsgType.TEXT:
                        told.append(message.json())
                await page.send_str("arm")
                await page.send_str("stop")
                await page.close()

        operator = threading.Thread(target=asyncio.run, args=(look_and_stop(),))
        operator.start()
        reason, index, until = None, 0, time.monotonic() + WAIT_S
        while reason is None and time.monotonic() < until:
            index += 1
            remote.on_tick(record(index))
            reason = remote.stop_requested()
            time.sleep(0.002)
        operator.join()
        assert reason == "STOP on the web page"
        assert told[-1]["mode"] == "DISARMED"
        assert told[-1]["events"][0][1:] == ["hold", "why"]  # type: ignore[index]
        assert not remote.arm_requested()


@pytest.mark.skipif(plan_cores(range(usable_cores())) is None, reason="one core: the loop has none of its own")
def test_the_page_stays_off_the_loops_core() -> None:
    before = os.sched_getaffinity(0)
    plan = plan_cores(before)
    assert plan is not None
    with WebRemote(CarConfig(), PageOptions(port=0)) as remote:
        assert os.sched_getaffinity(remote.pid) == plan.others
    assert os.sched_getaffinity(0) == before


def test_a_page_drives_by_hand_until_it_goes_away() -> None:
    with WebRemote(CarConfig(), PageOptions(port=0, by_hand=True)) as remote:
        address, token = remote.url.split("/#")

        async def drive() -> None:
            async with (
                aiohttp.ClientSession() as session,
                session.ws_connect(f"{address}/socket", headers={"Origin": address}) as page,
            ):
                for word in (token, "take", "drive 0.25 0.5"):
                    await page.send_str(word)
                for _ in range(int(WAIT_S / 0.05)):
                    if seen:
                        break
                    await page.send_str("drive 0.25 0.5")
                    await asyncio.sleep(0.05)

        seen: list[tuple[float, float]] = []
        operator = threading.Thread(target=asyncio.run, args=(drive(),))
        operator.start()
        reason, armed, until = None, False, time.monotonic() + WAIT_S
        while reason is None and time.monotonic() < until:
            wanted = remote.wanted_by_hand()
            if wanted is not None and wanted.steering:
                seen.append((wanted.steering, wanted.speed))
            reason = remote.stop_requested()
            armed = remote.arm_requested() or armed
            time.sleep(0.002)
        operator.join()
        assert (reason, armed) == ("the web page's button was released", True)
        assert set(seen) == {(0.25, 0.5)}
        assert remote.wanted_by_hand() is None


def test_a_page_that_dies_stops_what_it_held_and_nothing_else() -> None:
    with WebRemote(CarConfig(), PageOptions(port=0)) as remote:
        remote._process.kill()
        remote._process.join()
        for index in range(1, 100):
            remote.on_tick(record(index))  # nobody takes it
            assert remote.stop_requested() is None
        remote._dead_man.press(time.monotonic_ns())  # as if it had been held when it died
        reason, until = None, time.monotonic() + WAIT_S
        while reason is None and time.monotonic() < until:
            reason = remote.stop_requested()
            time.sleep(0.002)
        assert reason == "the web page's button has not been heard of for 0.5 s"


def test_a_port_in_use_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(ConfigError, match=rf"--web: 127\.0\.0\.1:{port}: cannot be served: .*in use"):
            WebRemote(CarConfig(), PageOptions(port=port)).__enter__()


@pytest.mark.parametrize("content", [None, "no certificate"])
def test_a_certificate_that_is_none_is_named(tmp_path: Path, content: str | None) -> None:
    file = tmp_path / "cert.pem"
    if content is not None:
        file.write_text(content)
    with pytest.raises(ConfigError, match=r"--web-tls: .*cert\.pem"):
        WebRemote(CarConfig(), PageOptions(port=0, tls=(file, file))).__enter__()
