"""Scripted stand-ins for the stages of a run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from automodel.curves.base import Curve
from automodel.runtime.run_types import TickRecord
from automodel.signals import (
    Command,
    Frame,
    LaneEstimate,
    LanePose,
    LaneStatus,
    Motion,
    MotionSource,
    VehicleState,
)

MS = 1_000_000
PICTURE = np.zeros((2, 2), dtype=np.uint8)


class Straight(Curve):
    """Straight ahead at the given y."""

    length_m = 2.0

    def __init__(self, y_m: float = 0.0) -> None:
        self._y_m = y_m

    def position(self, s_m):
        s = np.asarray(s_m, dtype=np.float64)
        return np.stack((s, np.full_like(s, self._y_m)), axis=-1)

    def heading(self, s_m):
        return np.zeros_like(np.asarray(s_m, dtype=np.float64))

    curvature = heading


def frame(t_ms: float, index: int = 0) -> Frame:
    return Frame(t_ns=round(t_ms * MS), index=index, image=PICTURE)


def estimate(t_ns: int, status: LaneStatus = LaneStatus.TRACKING, offset_m: float = 0.0) -> LaneEstimate:
    if status is LaneStatus.LOST:
        return LaneEstimate(t_ns=t_ns, status=status)
    pose = LanePose(offset_m=offset_m, heading_rad=0.0, width_m=0.4, curvature_per_m=0.0, covariance=np.eye(3))
    return LaneEstimate(t_ns=t_ns, status=status, centerline=Straight(), pose=pose)


def frames(count: int, period_ms: float = 16.0, start_ms: float = 0.0) -> list[tuple[int, Frame | Exception]]:
    """`count` frames, each captured 2 ms before it arrives."""
    times = [start_ms + (i + 1) * period_ms for i in range(count)]
    return [(round(t * MS), frame(t - 2.0, i)) for i, t in enumerate(times)]


class FakePipeline:
    """TRACKING always, but for what `at` says of a frame's index: a status, an offset, or an exception to raise."""

    name = "fake"

    def __init__(self, at: dict[int, object] | None = None) -> None:
        self._at = {} if at is None else at
        self.seen: list[Frame] = []
        self.motions: list[Motion] = []
        self.resets = 0

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        self.seen.append(frame)
        self.motions.append(motion)
        what = self._at.get(frame.index)
        if callable(what):
            what()
        elif isinstance(what, Exception):
            raise what
        elif isinstance(what, LaneStatus):
            return estimate(frame.t_ns, what)
        elif isinstance(what, float):
            return estimate(frame.t_ns, offset_m=what)
        return estimate(frame.t_ns)

    def reset(self) -> None:
        self.resets += 1


class FakeController:
    """Steers 0.2 rad and ramps the speed up by 0.1 m/s a frame, to 1 m/s; LOST gives 0 m/s. Valid for a second."""

    def __init__(self) -> None:
        self._speed_mps = 0.0
        self.override: Command | None = None
        self.resets = 0

    def step(self, estimate: LaneEstimate, motion: Motion, state: VehicleState | None, t_ns: int) -> Command:
        if self.override is not None:
            return self.override
        self._speed_mps = min(self._speed_mps + 0.1, 1.0) if estimate.valid else 0.0
        return Command(t_ns=t_ns, steering_rad=0.2, speed_mps=self._speed_mps, valid_until_ns=t_ns + 1000 * MS)

    def reset(self) -> None:
        self._speed_mps = 0.0
        self.resets += 1


@dataclass
class FakeLimited:
    command: Command
    reasons: tuple[str, ...] = ()


class FakeLimits:
    """Lets everything through but what is faster than 2 m/s, and remembers the commands it was reset to."""

    def __init__(self) -> None:
        self.reset_to: list[Command | None] = []
        self.override: Command | None = None

    def step(self, command: Command, motion: Motion, t_ns: int) -> FakeLimited:
        if self.override is not None:
            return FakeLimited(self.override, ("override",))
        if command.speed_mps <= 2.0:
            return FakeLimited(command)
        slow = Command(
            t_ns=t_ns, steering_rad=command.steering_rad, speed_mps=2.0, valid_until_ns=command.valid_until_ns
        )
        return FakeLimited(slow, ("speed",))

    def reset(self, sent: Command | None = None) -> None:
        self.reset_to.append(sent)


class FakeMotion:
    """Passes the vehicle's speed on; `speed_mps` instead where given."""

    def __init__(self) -> None:
        self.speed_mps: float | None = None
        self.given: list[tuple[VehicleState | None, Command]] = []

    def step(self, state: VehicleState | None, last_command: Command, t_ns: int) -> Motion:
        self.given.append((state, last_command))
        speed = self.speed_mps if self.speed_mps is not None else (state.speed_mps if state else None)
        if speed is None:
            return Motion(t_ns=t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
        return Motion(t_ns=t_ns, speed_mps=speed, yaw_rate_radps=0.0)


class Watcher:
    """Keeps the records of all turns."""

    def __init__(self) -> None:
        self.records: list[TickRecord] = []

    def on_tick(self, record: TickRecord) -> None:
        self.records.append(record)
