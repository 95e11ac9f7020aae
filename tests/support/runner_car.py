"""A whole run on virtual time, and what must hold at its end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from automodel.config import SafetyConfig
from automodel.runtime.clocks import VirtualClock
from automodel.runtime.loop import Loop
from automodel.runtime.run_types import TickRecord
from automodel.runtime.runner import RunConfig, Runner, RunParts, RunResult
from automodel.runtime.safety import Safety, SafetyMode
from tests.support.runner_devices import FakeLink, FakeRecorder, ScriptedSource
from tests.support.runner_fakes import FakeController, FakeLimits, FakeMotion, FakePipeline, Watcher, frames

CONFIG = SafetyConfig(frame_timeout_s=0.06, command_validity_s=0.1, hold_s=0.3, rearm_s=0.5)
DISARMED, ARMING, DRIVING = SafetyMode.DISARMED, SafetyMode.ARMING, SafetyMode.DRIVING
HOLD, STOPPED = SafetyMode.HOLD, SafetyMode.STOPPED


@dataclass
class Car:
    """A whole run on virtual time; change a part before `run`."""

    at: dict[int, object] = field(default_factory=dict)
    hello_ms: float = 0.0
    auto_arm: bool = True
    items: list = field(default_factory=lambda: frames(120))
    silent_for_ms: float = 0.0
    reopen: Callable | None = None
    recorded: bool = True
    arm_requested: Callable[[], bool] | None = None
    stop_requested: Callable[[], str | None] | None = None

    def __post_init__(self) -> None:
        self.clock = VirtualClock()
        self.source = ScriptedSource(self.clock, self.items, self.silent_for_ms)
        self.link = FakeLink(self.clock, self.hello_ms)
        self.recorder = FakeRecorder()
        self.pipeline = FakePipeline(self.at)
        self.controller = FakeController()
        self.limits = FakeLimits()
        self.motion = FakeMotion()
        self.safety = Safety(CONFIG, self.auto_arm)
        self.watcher = Watcher()

    def run(self, **how: object) -> RunResult:
        parts = RunParts(
            source=self.source,
            link=self.link,
            recorder=self.recorder if self.recorded else None,
            motion=self.motion,
            loop=Loop(self.pipeline, self.controller, self.limits, validity_s=CONFIG.command_validity_s),
            safety=self.safety,
            clock=self.clock,
        )
        runner = Runner(
            parts,
            RunConfig(command_validity_s=0.1, period_s=0.016, collector_off=False),
            observer=self.watcher,
            reopen=self.reopen,
            arm_requested=self.arm_requested,
            stop_requested=self.stop_requested,
        )
        return runner.run(**how)  # type: ignore[arg-type]

    def modes(self) -> list[SafetyMode]:
        """The modes in the order in which they came."""
        modes = [record.decision.mode for record in self.watcher.records]
        return [mode for i, mode in enumerate(modes) if i == 0 or mode is not modes[i - 1]]

    def kinds(self) -> list[str]:
        return [event.kind for event in self.recorder.of("event")]


def assert_parked(car: Car) -> None:
    """The last words on the wire are neutral with the steering before, disarm, close; everything is closed once."""
    assert [entry.what for entry in car.link.log[-3:]] == ["send", "disarm", "close"]
    *before, last = car.link.commands
    assert (last.steering_rad, last.speed_mps) == (before[-1].steering_rad if before else 0.0, 0.0)
    assert (car.recorder.closed, car.source.closed) == (1, 1)


def frame_index(record: TickRecord) -> int | None:
    """The index of the turn's frame, None without one."""
    return None if record.frame is None else record.frame.index


def sent(record: TickRecord) -> tuple[float, float]:
    """The steering [rad] and speed [m/s] that went out in this turn."""
    assert record.sent is not None
    return record.sent.steering_rad, record.sent.speed_mps


def assert_neutral(command) -> None:
    assert (command.steering_rad, command.speed_mps) == (0.0, 0.0)
