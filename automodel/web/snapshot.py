"""What the page is told of a cycle of the run."""

from __future__ import annotations

from dataclasses import dataclass

from automodel.geometry import SE2
from automodel.runtime.run_types import TickRecord
from automodel.signals import Command, DriverInput, Event, LaneEstimate, Motion, StereoFrame, VehicleState
from automodel.types import Image


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Snapshot:
    """A frame's cycle: `image` is the left one of a stereo frame; `place` is that of the car by dead reckoning.

    `rate_hz` is the rate of the frames as measured, None before the second; `skipped` frames came and were not taken
    up, and `unpaired` ones, of two cameras, had no partner (None of a single one). `driver` is what the person wanted
    who drove, None where the pipeline did. `events` are the newest ones, the oldest first.
    """

    t_ns: int
    image: Image
    estimate: LaneEstimate | None
    command: Command | None
    state: VehicleState | None
    motion: Motion | None
    mode: str
    reason: str | None
    latency_ns: int | None
    place: SE2
    rate_hz: float | None
    skipped: int
    events: tuple[Event, ...]
    driver: DriverInput | None = None
    unpaired: int | None = None


_RATE_SHARE = 0.05  # of the newest period in the mean: settled after about 20 frames


class Trip:
    """Follows a run from frame to frame: the way driven, the rate of the frames and those that were skipped."""

    def __init__(self) -> None:
        self._place = SE2()
        self._last: tuple[int, int] | None = None  # time [ns] and index of the frame before
        self._period_ns: float | None = None
        self._skipped = 0

    def step(self, record: TickRecord) -> None:
        """A cycle with a frame."""
        frame, tick = record.frame, record.tick
        if frame is None:
            return
        if self._last is not None and frame.t_ns > self._last[0]:
            period_ns = frame.t_ns - self._last[0]
            gap = max(frame.index - self._last[1], 1)
            self._skipped += gap - 1
            mean_ns = period_ns / gap if self._period_ns is None else self._period_ns
            self._period_ns = mean_ns + _RATE_SHARE * (period_ns / gap - mean_ns)
            if tick is not None and tick.motion.known:
                dt_s = period_ns * 1e-9
                self._place @= SE2.arc(tick.motion.speed_mps * dt_s, tick.motion.yaw_rate_radps * dt_s)
        self._last = (frame.t_ns, frame.index)

    def snapshot(self, record: TickRecord, events: tuple[Event, ...]) -> Snapshot | None:
        """What there is to show of a cycle, None of one without a frame."""
        frame, tick = record.frame, record.tick
        if frame is None:
            return None
        return Snapshot(
            t_ns=record.t_ns,
            image=frame.left if isinstance(frame, StereoFrame) else frame.image,
            estimate=tick.estimate if tick is not None else None,
            command=record.sent,
            state=record.state,
            motion=tick.motion if tick is not None else None,
            mode=record.decision.mode.value,
            reason=record.decision.reason,
            latency_ns=record.latency_ns,
            place=self._place,
            rate_hz=1e9 / self._period_ns if self._period_ns else None,
            skipped=self._skipped,
            events=events,
            driver=tick.driver if tick is not None else None,
            unpaired=record.unpaired,
        )
