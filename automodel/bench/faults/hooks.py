"""The places at which a fault takes hold of a run."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from automodel.signals import BoardSensors, Frame, LaneEstimate

CameraHook = Callable[[Frame], "tuple[int, Frame] | None"]  # when the frame is delivered, None: never; may raise
LaneHook = Callable[[LaneEstimate], LaneEstimate]  # may raise
WireHook = Callable[[bytes, int], Iterable[tuple[int, bytes]]]  # bytes at a time -> when which bytes arrive
PulseHook = Callable[[float, float], tuple[float, float]]  # servo and motor pulse [us], as commanded
SensorHook = Callable[[BoardSensors], BoardSensors]


class Moment(enum.Enum):
    """What happens at one time."""

    UNPLUG = "the cable is taken out"
    REPLUG = "the cable is put in again"
    OTHER_FIRMWARE = "the board starts again with another program"
    BROWN_OUT = "the board's supply dips"
    HANG = "the board's program hangs"
    RESTART = "the board is reset"
    STOP_REQUEST = "the program is asked to stop, as by SIGINT or SIGTERM"
    WALL_CLOCK_BACK = "the wall clock is set back by an hour"


class At(enum.Enum):
    """Who takes his time."""

    CAMERA = "camera"
    PIPELINE = "pipeline"
    AFTER = "after the command, where the collector runs"


class Disk(enum.Enum):
    """What is wrong with the recording."""

    FULL = "no space left"
    SLOW = "writes nothing before the run is over"
    RAISES = "the recorder raises an error"


@dataclass(frozen=True, slots=True, kw_only=True)
class Stall:
    """Somebody takes `seconds` longer: once, or `again` at each turn."""

    at: At
    seconds: float
    again: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Hooks:
    """A fault as it is built into one run; None and empty where a part works.

    Hooks are called from the fault's begin to its end only; `to_board` and `from_board` get what the host writes in one
    go (a frame), and what the board has sent since it was read last. `moments` are seconds after the begin.
    `servo_stuck` keeps the servo where it is.
    """

    camera: CameraHook | None = None
    lane: LaneHook | None = None
    stall: Stall | None = None
    to_board: WireHook | None = None
    from_board: WireHook | None = None
    pulses: PulseHook | None = None
    sensors: SensorHook | None = None
    servo_stuck: bool = False
    disk: Disk | None = None
    moments: tuple[tuple[float, Moment], ...] = ()
