"""The interfaces between the runner and the parts of a run; `automodel.assembly` chooses the classes."""

from __future__ import annotations

from typing import Protocol

from automodel.signals import Command, DriverInput, Event, Frame, LaneEstimate, Motion, StereoFrame, VehicleState


class Clock(Protocol):
    """Monotonic time in integer nanoseconds, of the system or of a simulation."""

    def now_ns(self) -> int:
        """The time now [ns]."""


class Source(Protocol):
    """A source of frames. `read` raises `SourceError` (an OSError) when the source is broken."""

    def read(self, timeout_s: float) -> Frame | StereoFrame | None:
        """The next frame, or None if none came within `timeout_s`; raises EndOfSource after the last one."""

    def close(self) -> None:
        """Release the device; may be called twice."""


class Pipeline(Protocol):
    """Estimates the lane from images. Never raises because of an image's content, never returns NaN."""

    name: str

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        """The lane in this frame; `motion` is the car's since the frame before."""

    def reset(self) -> None:
        """Forget everything but the configuration."""


def cameras_of(pipeline: object) -> int:
    """How many cameras a pipeline looks through: what its `cameras` says, one where it has none.

    `Pipeline.step` of one that looks through two takes a `StereoFrame`, or a `Frame` of the eye that is left.
    """
    return int(getattr(pipeline, "cameras", 1))


class Controller(Protocol):
    """Computes the requested command from a lane estimate and the vehicle's state; limits follow."""

    def step(self, estimate: LaneEstimate, motion: Motion, state: VehicleState | None, t_ns: int) -> Command:
        """The requested command at `t_ns`."""

    def reset(self) -> None:
        """Forget everything but the configuration."""


class Driver(Protocol):
    """Computes the requested command of a person who drives; limits follow."""

    def step(self, wanted: DriverInput, t_ns: int) -> Command:
        """The requested command at `t_ns`."""

    def reset(self) -> None:
        """Forget everything but the configuration."""


class VehicleLink(Protocol):
    """A connection to a vehicle. Every call may raise a `LinkError` (an OSError) when it is lost; none blocks."""

    def open(self) -> None:
        """Open the connection; the vehicle may take seconds to answer the first `poll`."""

    def poll(self, now_ns: int) -> VehicleState | None:
        """Process what has arrived; the newest state, or None until the vehicle has sent its hello."""

    def send(self, command: Command, now_ns: int) -> None:
        """Send a command; one that is no longer valid at `now_ns` is sent as neutral."""

    def arm(self, now_ns: int) -> None:
        """Ask the vehicle to accept commands; `VehicleState.armed` is True once it does."""

    def disarm(self, now_ns: int) -> None:
        """Send straight and neutral at once; the vehicle accepts no commands until it is armed again."""

    def close(self) -> None:
        """Disarm if the connection allows it, and close; may be called twice."""


def wake_of(link: object) -> int | None:
    """When a link wants its next `poll`, on that clock: what its `wake_ns` says, None where it has none or no wish."""
    wake_ns: int | None = getattr(link, "wake_ns", None)
    return wake_ns


class Recorder(Protocol):
    """Records a run. Calls return at once; another thread writes."""

    def frame(self, frame: Frame | StereoFrame) -> None:
        """Record a frame that was given to the pipeline."""

    def motion(self, motion: Motion) -> None:
        """Record the motion that was given to the pipeline with the previous frame."""

    def state(self, state: VehicleState) -> None:
        """Record a state of the vehicle."""

    def estimate(self, estimate: LaneEstimate) -> None:
        """Record an estimate of the pipeline."""

    def command(self, command: Command) -> None:
        """Record a command as it was sent, after the limits."""

    def driver(self, wanted: DriverInput) -> None:
        """Record what the person wanted who drove by the last frame."""

    def event(self, event: Event) -> None:
        """Record a safety event."""

    def close(self) -> None:
        """Write what is pending and close the file."""
