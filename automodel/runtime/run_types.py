"""What a run is put together from, and what it gives."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Protocol

from automodel.interfaces import Recorder, Source, VehicleLink
from automodel.runtime.clocks import SleepingClock
from automodel.runtime.latencies import Latencies
from automodel.runtime.loop import Loop, Tick
from automodel.runtime.safety import Safety, SafetyDecision
from automodel.signals import Command, Event, Frame, Motion, StereoFrame, VehicleState


class MotionStage(Protocol):
    """From the vehicle's state and the last command to its motion."""

    def step(self, state: VehicleState | None, last_command: Command, t_ns: int) -> Motion:
        """The motion at `t_ns`, the capture of a frame; `last_command` is the one on the wire."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunParts:
    """The things that a run drives; `recorder` is None where nothing is written down."""

    source: Source
    link: VehicleLink
    recorder: Recorder | None
    motion: MotionStage
    loop: Loop
    safety: Safety
    clock: SleepingClock


@dataclass(frozen=True, slots=True, kw_only=True)
class RunConfig:
    """Times of a run.

    `command_validity_s` is the life of the hold and neutral commands that the runner makes itself, `period_s` the
    time between two frames, beyond which a cycle's work counts as an overrun. `collector_off` keeps the garbage
    collector out of the loop; in lock-step, where nothing is late, that is time spent for nothing.
    """

    command_validity_s: float = 0.1
    period_s: float = 1.0 / 60.0
    collector_off: bool = True

    def __post_init__(self) -> None:
        for name in ("command_validity_s", "period_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a positive number, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TickRecord:
    """One cycle of the run at `t_ns`, reported after everything was sent.

    `frame` is None in a cycle without one; `tick` also where the frame's time was wrong, so that it was not looked at.
    `sent` is the command that went out, None where none did. `latency_ns` is the time from the frame's capture until
    its own command had been handed to the link; None for any other command. `unpaired` counts the frames of two cameras
    that had no partner, since the run began; None where the source is no pair.
    """

    t_ns: int
    frame: Frame | StereoFrame | None
    state: VehicleState | None
    tick: Tick | None
    decision: SafetyDecision
    sent: Command | None
    latency_ns: int | None
    unpaired: int | None = None


class RunObserver(Protocol):
    """Who wants to watch: progress, laps, a simulator's truth."""

    def on_tick(self, record: TickRecord) -> None:
        """One cycle; it is called in the loop, so it has to be quick."""
        ...


class RunEnd(enum.Enum):
    """Why a run ended."""

    STOP = "asked to stop"
    FRAMES = "the number of frames is reached"
    SOURCE = "the source has no more frames"
    SIGNAL = "a signal"
    SOURCE_FAILED = "the source failed"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunResult:
    """What came of a run.

    `frames` were taken up, `skipped` were not (gaps in the frames' index). `overruns` counts cycles that worked longer
    than the frames' period, `stops` the latched stops. `latencies` are those of `TickRecord`, `unpaired` is as
    there. `traceback` is that of the first exception of the chain. `interrupted`: a signal came, if only while
    everything was closed: the caller must not go on as if there was none.
    """

    end: RunEnd
    frames: int
    skipped: int
    overruns: int
    stops: int
    latencies: Latencies
    events: tuple[Event, ...]
    traceback: str | None
    interrupted: bool = False
    unpaired: int | None = None

    def latency_ms(self, percentile: float) -> float | None:
        """A percentile (0 .. 100) of the latency [ms], None where nothing was driven."""
        return self.latencies.percentile_ms(percentile)
