"""A run in Foxglove while it lasts, served from another process: to look at, never to command.

Foxglove's server asks for no token and takes a socket of any page (no Origin check): it listens on this machine only,
and takes up nothing that a client sends. It needs the extra `foxglove`.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from multiprocessing.connection import Connection

from automodel.config import CarConfig, RecordingConfig
from automodel.config.extras import need_extra
from automodel.recording import foxglove as recorded
from automodel.recording.codec import CAMERA, LEFT, SCHEMA, TOPICS, ImageCodec, descriptor_set, encode
from automodel.signals import Event
from automodel.web.live_process import LOOK_S, LiveProcess, stand_back
from automodel.web.mailbox import Mailbox
from automodel.web.snapshot import Snapshot

HOST = "127.0.0.1"
_AGAIN_NS = 1_000_000_000  # what holds for the whole run is sent again, for a client that comes later
_CODEC = RecordingConfig(image="jpeg", jpeg_quality=80)


class FoxgloveLive(LiveProcess):
    """Serves Foxglove on `port` of this machine (0: a free one) while the context is open; see `LiveProcess`."""

    def __init__(self, car: CarConfig, port: int) -> None:
        need_extra("--foxglove", "foxglove")
        super().__init__("--foxglove", car, serve, port)

    @property
    def url(self) -> str:
        """What Foxglove is told to open."""
        return f"ws://{HOST}:{self.port}"


def serve(car: CarConfig, port: int, mailbox: Mailbox, pipe: Connection) -> None:
    """Serve until the other end of `pipe` is closed; the port, or a text of what is wrong, is sent through it first."""
    import foxglove

    stand_back()
    context = foxglove.Context()
    try:
        server = foxglove.start_server(name="automodel", host=HOST, port=port, context=context)
    except RuntimeError as error:  # whose text is led by a class that Python does not know
        why = str(error).removeprefix("FoxgloveError: ")
        pipe.send(f"--foxglove: {HOST}:{port}: cannot be served: {why}; choose another PORT")
        return
    topics = {topic: foxglove.Channel(topic, message_encoding="json", context=context) for topic in TOPICS.values()}
    scene = Scene(car)
    for topic, (name, descriptors) in scene.schemas().items():
        schema = foxglove.Schema(name=name, encoding="protobuf", data=descriptors)
        topics[topic] = foxglove.Channel(topic, message_encoding="protobuf", schema=schema, context=context)
    pipe.send(server.port)
    while not pipe.poll(LOOK_S):  # nothing is ever sent here: it ends
        message = mailbox.take()
        if message is not None and any(topic.has_sinks() for topic in topics.values()):  # somebody looks
            for topic, data, t_ns in scene.show(pickle.loads(message)):  # from our own process, through its memory
                topics[topic].log(data, log_time=t_ns)
    server.stop()


class Scene:
    """From the cycles of a run to the messages that Foxglove is sent, with the topics and schemas of recordings."""

    def __init__(self, car: CarConfig) -> None:
        self._scene = recorded.FoxgloveScene(car)
        self._images = LEFT if car.camera.right is not None else CAMERA
        self._codec = ImageCodec(_CODEC)
        self._told: tuple[Event, ...] = ()
        self._started_ns: int | None = None

    def schemas(self) -> dict[str, tuple[str, bytes]]:
        """Of each topic with a schema, its name and file descriptor set."""
        images = {self._images: (SCHEMA, descriptor_set())}
        return images | {topic: recorded.schema_of(kind) for topic, kind in recorded.TOPICS.items()}

    def show(self, snapshot: Snapshot) -> Iterator[tuple[str, bytes, int]]:
        """Topic, message and time [ns] of what there is to send of a cycle."""
        t_ns, scene = snapshot.t_ns, self._scene
        if self._started_ns is None or not 0 <= t_ns - self._started_ns < _AGAIN_NS:
            self._started_ns = t_ns
            for topic, message in scene.start(t_ns):
                yield topic, message.SerializeToString(), t_ns
        new = [event for event in snapshot.events if event not in self._told]
        self._told = snapshot.events
        for event in new:
            for topic, message in scene.event(event):
                yield topic, message.SerializeToString(), event.t_ns
        yield self._images, self._codec.encode(t_ns, snapshot.image), t_ns
        messages = [scene.placed(snapshot.place, t_ns)]
        if snapshot.estimate is not None:
            messages += scene.estimate(snapshot.estimate)
        for topic, message in messages:
            yield topic, message.SerializeToString(), t_ns
        values = (snapshot.motion, snapshot.state, snapshot.estimate, snapshot.command, snapshot.driver)
        for value in (*new, *values):
            if value is not None:
                yield TOPICS[type(value)], encode(value), t_ns
