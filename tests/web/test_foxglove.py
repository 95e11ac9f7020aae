"""A run as Foxglove's own protocol gives it to a client, from the real process."""

from __future__ import annotations

import asyncio
import json
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Any

import aiohttp
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Log_pb2 import Log

from automodel.config import CarConfig, ConfigError
from automodel.geometry import SE2
from automodel.recording import foxglove as recorded
from automodel.recording.codec import CAMERA, LEFT, TOPICS, decode, decode_image
from automodel.runtime.loop import Tick
from automodel.runtime.run_types import TickRecord
from automodel.runtime.safety import Action, SafetyDecision, SafetyMode
from automodel.signals import Command, DriverInput, Event, Frame, LaneEstimate, LaneStatus, Motion, VehicleState
from automodel.web.foxglove import FoxgloveLive, Scene
from automodel.web.snapshot import Snapshot
from tests.support.stereo_drives import stereo_car

pytest.importorskip("foxglove")
WAIT_S = 60.0  # far beyond what any step takes


def record(index: int) -> TickRecord:
    t_ns = index * 100_000_000
    decision = SafetyDecision(
        mode=SafetyMode.DISARMED, action=Action.NEUTRAL, arm=False, disarm=False, reason=None, events=()
    )
    frame = Frame(t_ns=t_ns, index=index, image=np.full((360, 640), 80, np.uint8))
    command = Command(t_ns=t_ns, steering_rad=0.1, speed_mps=0.0, valid_until_ns=t_ns + 1)
    tick = Tick(
        motion=Motion(t_ns=t_ns, speed_mps=1.0, yaw_rate_radps=0.0),
        estimate=LaneEstimate(t_ns=t_ns, status=LaneStatus.LOST),
        wanted=command,
        command=command,
        driver=DriverInput(t_ns=t_ns, steering=0.5, speed=-1.0),
    )
    return TickRecord(
        t_ns=t_ns, frame=frame, state=VehicleState(t_ns=t_ns), tick=tick, decision=decision, sent=command, latency_ns=1
    )


class Client:
    """Speaks Foxglove's websocket protocol: what it is told, and every message of the topics it subscribes to."""

    def __init__(self, url: str, enough: Callable[[Client], bool]) -> None:
        self.server: dict[str, Any] = {}
        self.channels: dict[str, dict[str, Any]] = {}
        self.messages: dict[str, list[tuple[int, bytes]]] = {}
        self.said: list[dict[str, Any]] = []
        self.done = threading.Event()
        self._url, self._enough = url, enough

    def __enter__(self) -> Client:
        self._thread = threading.Thread(target=asyncio.run, args=(self._look(),))
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._thread.join()

    async def _look(self) -> None:
        ids: dict[int, str] = {}
        try:
            async with (
                aiohttp.ClientSession() as session,
                session.ws_connect(self._url, protocols=("foxglove.sdk.v1",)) as connection,
            ):
                await connection.send_json({"op": "advertise", "channels": [_PUBLISHED]})  # which nobody may
                await connection.send_json({"op": "setParameters", "parameters": [{"name": "speed", "value": 9}]})
                while not self._enough(self):
                    message = await connection.receive(WAIT_S)
                    if message.type is aiohttp.WSMsgType.BINARY:
                        _, number, t_ns = struct.unpack_from("<BIQ", message.data)
                        self.messages.setdefault(ids[number], []).append((t_ns, message.data[13:]))
                        continue
                    assert message.type is aiohttp.WSMsgType.TEXT
                    told = json.loads(message.data)
                    if told["op"] == "serverInfo":
                        self.server = told
                    elif told["op"] == "advertise":
                        for channel in told["channels"]:
                            self.channels[channel["topic"]] = channel
                            ids[channel["id"]] = channel["topic"]
                        wanted = [{"id": c["id"], "channelId": c["id"]} for c in told["channels"]]
                        await connection.send_json({"op": "subscribe", "subscriptions": wanted})
                    else:
                        self.said.append(told)
        finally:
            self.done.set()


_PUBLISHED = {"id": 1, "topic": "/command", "encoding": "json", "schemaName": ""}


def everything(client: Client) -> bool:
    always = {CAMERA, recorded.WORLD_BODY, recorded.LOG, recorded.CALIBRATIONS[CAMERA], recorded.CAR, *TOPICS.values()}
    return always <= client.messages.keys() and len(client.messages[CAMERA]) > 3 and len(client.said) > 1


def test_a_client_sees_the_run_and_can_only_look() -> None:
    with FoxgloveLive(CarConfig(), 0) as live, Client(live.url, everything) as client:
        index, until = 0, time.monotonic() + WAIT_S
        while not client.done.wait(0.01) and time.monotonic() < until:
            index += 1
            if client.channels and index % 50 == 0:
                live.on_event(Event(t_ns=index * 100_000_000, kind="hold", text="why"))
            live.on_tick(record(index))
    assert client.server["capabilities"] == []
    assert all(said["op"] == "status" and said["level"] > 0 for said in client.said)  # warnings and errors: refused
    schemas = {topic: channel["schemaName"] for topic, channel in client.channels.items()}
    assert schemas[CAMERA] == "foxglove.CompressedImage"
    assert {topic: schemas[topic] for topic in recorded.TOPICS} == {
        topic: kind.DESCRIPTOR.full_name for topic, kind in recorded.TOPICS.items()
    }
    t_ns, data = client.messages[CAMERA][0]
    assert CompressedImage.FromString(data).timestamp.ToNanoseconds() == t_ns
    assert np.abs(decode_image(data).astype(int) - 80).max() < 5
    t_ns, data = client.messages[recorded.WORLD_BODY][-1]
    start_m = t_ns * 1e-9 - FrameTransform.FromString(data).translation.x  # at 1 m/s
    assert start_m == pytest.approx(0.1, abs=1e-6)
    for topic in TOPICS.values():
        assert decode(topic, client.messages[topic][0][1])
    logs = [Log.FromString(data) for _, data in client.messages[recorded.LOG]]
    assert [(log.name, log.message) for log in logs[:1]] == [("hold", "why")]
    assert len({log.timestamp.ToNanoseconds() for log in logs}) == len(logs)  # each event once


def test_a_port_in_use_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(ConfigError, match=rf"--foxglove: 127\.0\.0\.1:{port}: cannot be served: Failed .*in use"):
            FoxgloveLive(CarConfig(), port).__enter__()


def test_a_server_that_dies_costs_the_run_nothing() -> None:
    with FoxgloveLive(CarConfig(), 0) as live:
        live._process.kill()
        live._process.join()
        for index in range(1, 100):
            live.on_tick(record(index))


def test_no_other_machine_reaches_it() -> None:
    with FoxgloveLive(CarConfig(), 0) as live, pytest.raises(OSError):  # which listens at 127.0.0.1 and nowhere else
        socket.create_connection(("127.0.0.2", live.port), 5.0).close()


def snapshot(t_ns: int, *events: Event) -> Snapshot:
    return Snapshot(
        t_ns=t_ns, image=np.zeros((360, 640), np.uint8), estimate=None, command=None, state=None, motion=None,
        mode="DISARMED", reason=None, latency_ns=None, place=SE2(), rate_hz=None, skipped=0, events=events,
    )  # fmt: skip


def test_what_holds_for_the_run_is_sent_once_a_second_and_after_a_jump_back() -> None:
    scene = Scene(CarConfig())
    sent = []
    for t_ns in (0, 500_000_000, 1_100_000_000, 1_200_000_000, 100_000_000):
        sent.append(recorded.CAR in [topic for topic, *_ in scene.show(snapshot(t_ns))])
    assert sent == [True, False, True, False, True]


def test_of_two_cameras_the_left_one_is_shown() -> None:
    topics = [topic for topic, *_ in Scene(stereo_car()).show(snapshot(0))]
    assert LEFT in topics
    assert CAMERA not in topics
