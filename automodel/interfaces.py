"""What the runner knows of the things it drives; concrete classes are chosen in `automodel.cli`."""

from __future__ import annotations

from typing import Protocol

from automodel.signals import Command, Event, Frame, LaneEstimate, Motion, StereoFrame, VehicleState


class Clock(Protocol):
    """Integer nanoseconds that never go back: the monotonic clock, or a simulation's virtual one."""

    def now_ns(self) -> int:
        """The time now [ns]."""
        ...


class Source(Protocol):
    """Where frames come from. `read` raises `SourceError` (an OSError) when the source is broken."""

    def read(self, timeout_s: float) -> Frame | StereoFrame | None:
        """The next frame, or None when none came within `timeout_s`; raises EndOfSource after the last one."""
        ...

    def close(self) -> None:
        """Give the device back; may be called twice."""
        ...


class Pipeline(Protocol):
    """An image in, the lane out. Never raises on what an image shows, never gives NaN."""

    name: str

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        """The lane in this frame; `motion` is the car's since the frame before."""
        ...

    def reset(self) -> None:
        """Forget everything but the configuration."""
        ...


class Controller(Protocol):
    """A lane estimate and the vehicle's state in, the wanted command out (limits come after it)."""

    def step(self, estimate: LaneEstimate, motion: Motion, state: VehicleState | None, t_ns: int) -> Command:
        """The command wanted at `t_ns`."""
        ...

    def reset(self) -> None:
        """Forget everything but the configuration."""
        ...


class VehicleLink(Protocol):
    """A vehicle behind a pipe. Every call may raise a `LinkError` (an OSError) when the pipe is gone; none blocks."""

    def open(self) -> None:
        """Open the pipe; the vehicle may take seconds to answer its first `poll`."""
        ...

    def poll(self, now_ns: int) -> VehicleState | None:
        """Take in what has arrived; the newest state, or None until the vehicle has said hello."""
        ...

    def send(self, command: Command, now_ns: int) -> None:
        """Put a command on the wire; one that is no longer valid at `now_ns` goes out as neutral."""
        ...

    def arm(self, now_ns: int) -> None:
        """Ask the vehicle to accept commands; `VehicleState.armed` tells when it does."""
        ...

    def disarm(self, now_ns: int) -> None:
        """Neutral and straight, at once, and no more commands accepted until armed again."""
        ...

    def close(self) -> None:
        """Disarm as far as the pipe allows, and close; may be called twice."""
        ...


class Recorder(Protocol):
    """Where a run is written down. Calls return at once; the writing happens elsewhere."""

    def frame(self, frame: Frame | StereoFrame) -> None:
        """A frame that the pipeline was given."""
        ...

    def motion(self, motion: Motion) -> None:
        """The motion that the pipeline was given with the frame before."""
        ...

    def state(self, state: VehicleState) -> None:
        """A state that the vehicle sent."""
        ...

    def estimate(self, estimate: LaneEstimate) -> None:
        """A pipeline's estimate."""
        ...

    def command(self, command: Command) -> None:
        """A command as it was sent, after the limits."""
        ...

    def event(self, event: Event) -> None:
        """A safety event."""
        ...

    def close(self) -> None:
        """Write what is left and close the file."""
        ...
