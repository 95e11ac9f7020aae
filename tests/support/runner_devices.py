"""Scripted stand-ins for the devices of a run, living on a virtual clock."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from automodel.runtime.clocks import VirtualClock
from automodel.signals import Command, DriverInput, Event, Frame, LaneEstimate, Motion, StereoFrame, VehicleState
from automodel.sources.errors import EndOfSource, SourceError
from tests.support.runner_fakes import MS


class ScriptedSource:
    """Gives each item at its time of arrival, and time passes meanwhile; then comes silence, then EndOfSource."""

    def __init__(
        self, clock: VirtualClock, items: list[tuple[int, Frame | Exception]], silent_for_ms: float = 0.0
    ) -> None:
        self._clock = clock
        self._items = list(items)
        self._end_ns = (items[-1][0] if items else 0) + round(silent_for_ms * MS)
        self.waits_s: list[float] = []
        self.closed = 0

    def read(self, timeout_s: float) -> Frame | None:
        self.waits_s.append(timeout_s)
        until_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        if not self._items and self._clock.now_ns() >= self._end_ns:
            raise EndOfSource
        if self._items and self._items[0][0] <= until_ns:
            t_ns, item = self._items.pop(0)
            self._clock.advance_to(max(t_ns, self._clock.now_ns()))
            if isinstance(item, Exception):
                raise item
            return item
        self._clock.advance_to(until_ns)
        return None

    def close(self) -> None:
        self.closed += 1


class BrokenSource(ScriptedSource):
    """A source whose device is gone."""

    def __init__(self) -> None:
        super().__init__(VirtualClock(), [])

    def read(self, timeout_s: float) -> Frame | None:
        raise SourceError("camera: /dev/video0 is gone; plug it in")


@dataclass
class Sent:
    what: str
    t_ns: int
    command: Command | None = None


class FakeLink:
    """A board: says hello `hello_ms` after opening, obeys arm and disarm, reports at every poll.

    `down_ms` is the span (from, to) in which every call fails, `restart_ms` when the board restarts by itself,
    `disarm_ms` when it disarms itself, `silent_ms` from when on it reports nothing new. It asks for a
    poll at `wake_ns`.
    """

    def __init__(self, clock: VirtualClock, hello_ms: float = 0.0) -> None:
        self._clock = clock
        self._hello_ns = round(hello_ms * MS)
        self.log: list[Sent] = []
        self.down_ms: tuple[float, float] | None = None
        self.restart_ms = self.disarm_ms = self.silent_ms = math.inf
        self.obeys_arm = True
        self.state_at: Callable[[VehicleState], VehicleState] = lambda state: state
        self.armed = False
        self.wake_ns: int | None = None
        self.boot_id = 7
        self._opened_ns = 0
        self._newest: VehicleState | None = None

    def _check(self) -> None:
        now_ms = self._clock.now_ns() / MS
        if self.down_ms is not None and self.down_ms[0] <= now_ms < self.down_ms[1]:
            raise OSError("port: /dev/ttyUSB0 is gone; plug it in")

    def open(self) -> None:
        self.log.append(Sent("open?", self._clock.now_ns()))
        self._check()
        self.log.append(Sent("open", self._clock.now_ns()))
        self._opened_ns = self._clock.now_ns()
        self.boot_id += 1
        self.armed = False
        self._newest = None

    def poll(self, now_ns: int) -> VehicleState | None:
        self._check()
        if now_ns - self._opened_ns < self._hello_ns:
            return None
        if now_ns >= self.restart_ms * MS:
            self.restart_ms, self.armed = math.inf, False
            self.boot_id += 1
        if now_ns >= self.disarm_ms * MS:
            self.disarm_ms, self.armed = math.inf, False
        if now_ns < self.silent_ms * MS:
            self._newest = VehicleState(t_ns=now_ns, speed_mps=0.5, armed=self.armed, boot_id=self.boot_id)
        return self.state_at(self._newest) if self._newest is not None else None

    def send(self, command: Command, now_ns: int) -> None:
        self._check()
        self.log.append(Sent("send", now_ns, command))

    def arm(self, now_ns: int) -> None:
        self._check()
        self.log.append(Sent("arm", now_ns))
        self.armed = self.obeys_arm

    def disarm(self, now_ns: int) -> None:
        self._check()
        self.log.append(Sent("disarm", now_ns))
        self.armed = False

    def close(self) -> None:
        self.log.append(Sent("close", self._clock.now_ns()))
        self._check()

    @property
    def commands(self) -> list[Command]:
        return [sent.command for sent in self.log if sent.command is not None]

    def driven(self) -> list[Command]:
        return [command for command in self.commands if command.speed_mps != 0.0]


class FakeRecorder:
    """Keeps everything in order; raises `error` at every call from the `fails_after`-th on."""

    def __init__(self, fails_after: int | None = None) -> None:
        self.entries: list[tuple[str, object]] = []
        self.closed = 0
        self._fails_after = fails_after

    def _put(self, kind: str, value: object) -> None:
        if self._fails_after is not None and len(self.entries) >= self._fails_after:
            raise OSError("run.mcap: no space left on the device")
        self.entries.append((kind, value))

    def frame(self, frame: Frame | StereoFrame) -> None:
        self._put("frame", frame)

    def motion(self, motion: Motion) -> None:
        self._put("motion", motion)

    def state(self, state: VehicleState) -> None:
        self._put("state", state)

    def estimate(self, estimate: LaneEstimate) -> None:
        self._put("estimate", estimate)

    def command(self, command: Command) -> None:
        self._put("command", command)

    def driver(self, wanted: DriverInput) -> None:
        self._put("driver", wanted)

    def event(self, event: Event) -> None:
        self._put("event", event)

    def close(self) -> None:
        self.closed += 1

    def of(self, kind: str) -> list[Any]:
        return [value for k, value in self.entries if k == kind]
