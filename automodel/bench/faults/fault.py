"""A fault: what goes wrong, where it is built into a run, for how long, and what the car must do."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from random import Random

from automodel.config import CameraConfig
from automodel.signals import BoardSensors, Frame, LaneEstimate, StereoFrame
from firmware_link.emulator.can_vehicle import EmulatedCanVehicle

BOUND_S = 0.150  # from the start of a fault to neutral throttle at the motor's pin

CameraHook = Callable[[Frame], "tuple[int, Frame] | None"]  # when the frame is delivered, None: never; may raise
PairHook = Callable[[StereoFrame], "tuple[int, Frame | StereoFrame] | None"]  # likewise; a `Frame`: one eye alone
RigHook = Callable[[tuple[CameraConfig, ...]], tuple[CameraConfig, ...]]
LaneHook = Callable[[LaneEstimate], LaneEstimate]  # may raise
WireHook = Callable[[bytes, int], Iterable[tuple[int, bytes]]]  # bytes at a time -> when which bytes arrive
PulseHook = Callable[[float, float], tuple[float, float]]  # servo and motor pulse [us], as commanded
SensorHook = Callable[[BoardSensors], BoardSensors]
CanHook = Callable[
    [EmulatedCanVehicle], None
]  # sets what is wrong with the vehicle or its bus, or what its driver does


class Moment(enum.Enum):
    """What happens at one time."""

    UNPLUG = "the cable is unplugged"
    REPLUG = "the cable is plugged in again"
    OTHER_FIRMWARE = "the board restarts with another program"
    BROWN_OUT = "the board's supply dips"
    HANG = "the board's program hangs"
    RESTART = "the board is reset"
    STOP_REQUEST = "the program is asked to stop, as by SIGINT or SIGTERM"
    PERSON_STOPS = "a person asks for a stop"
    WALL_CLOCK_BACK = "the wall clock is set back by an hour"


class At(enum.Enum):
    """Where in a turn of the loop a stall happens."""

    CAMERA = "camera"
    PIPELINE = "pipeline"
    AFTER = "after the command, where the garbage collector runs"


class Disk(enum.Enum):
    """What is wrong with the recording."""

    FULL = "no space left"
    SLOW = "writes nothing before the run is over"
    RAISES = "the recorder raises an error"


@dataclass(frozen=True, slots=True, kw_only=True)
class Stall:
    """A turn takes `seconds` longer: once, or `again` and again."""

    at: At
    seconds: float
    again: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Grip:
    """What a wet floor leaves: the share of the steered turn, and the greatest lateral acceleration."""

    share: float = 1.0
    lateral_max_mps2: float = math.inf


@dataclass(frozen=True, slots=True, kw_only=True)
class Hooks:
    """A fault as it is built into one run; None or empty where a part works.

    Of a pair of cameras `camera` spoils the left one's images, `right_camera` those of the right one.
    Hooks are called from the fault's start to its end only. `to_board` gets what the host writes at once (a frame),
    `from_board` what the board has sent since it was last read. `moments` are in seconds after the start. `rig` takes
    the two cameras of car.toml, left first, and gives those that the car really has, for the whole run.
    """

    camera: CameraHook | None = None
    right_camera: CameraHook | None = None
    pair: PairHook | None = None
    rig: RigHook | None = None
    lane: LaneHook | None = None
    stall: Stall | None = None
    to_board: WireHook | None = None
    from_board: WireHook | None = None
    pulses: PulseHook | None = None
    sensors: SensorHook | None = None
    servo_stuck: bool = False
    slip: Grip | None = None
    disk: Disk | None = None
    can: CanHook | None = None
    moments: tuple[tuple[float, Moment], ...] = ()


class Kind(enum.Enum):
    """How a part fails."""

    OFF = "off"
    STUCK = "stuck"
    GARBAGE = "garbage"
    WRONG = "wrong"
    SLOW = "slow"
    DELAYED = "delayed"
    INTERMITTENT = "intermittent"
    NONE = "none"


class Must(enum.Enum):
    """What the car must do."""

    STOP = "stop"  # neutral within the bound, then straight, until a person arms it again
    HOLD = "hold"  # neutral within the bound if the fault lasts longer; drives on by itself when it is over
    NOTHING = "nothing"  # drive on
    REFUSE = "refuse"  # never be armed, whoever asks: it is wrong from the start
    STAY = "stay"  # drive on, hold or stop: but stay in the lane, up to standstill, or for a second after the fault


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One row of the catalogue.

    `duration_s` is the range that the fault's duration is drawn from; (0, 0) for what happens at one moment. `ends` is
    False where only other hardware helps. After the end the input needs up to `recovery_s` to work again: a pipeline
    finds its lane, a board restarts, a port is opened. `host_notices` is False where the host's own input stays well:
    a board that gets no commands shows it only by disarming itself, and a request to arm is not refused.

    `event` is the kind of an event that the run must report. `same_pulses`: the pulses at the pins must be exactly
    those of a run without the fault. `timed_from_motion`: the bound counts from when the car's motion shows the fault;
    before that the car may do anything. `shown_by` are messages of a CAN bus: the bound counts from the first frame of
    one of them to the host's command that lets the car go. `holds_first`: the car may be held and drive on before it is
    stopped; the bound counts to the stop. `images`: it needs a pipeline that looks at images. `outside_m`: where it
    must stay in its lane, its body may leave it by so much (infinite: by how much is only reported). `anywhere`: on any
    track, with a random look. `pairs`: it needs a pipeline of two cameras. `from_start`: it is there before the car is
    armed, and the pipeline sees the road from the first frame on. `both_eyes`: both cameras of a pair have it alike,
    as one that works would go on alone.

    `hooks` makes the faulty parts for a fault that ends at `end_ns`; the generator gives whatever is random in them.
    """

    name: str
    kind: Kind
    must: Must
    text: str
    hooks: Callable[[Random, int], Hooks]
    duration_s: tuple[float, float] = (0.0, 0.0)
    within_s: float = BOUND_S
    ends: bool = True
    recovery_s: float = 0.4
    host_notices: bool = True
    event: str | None = None
    same_pulses: bool = False
    timed_from_motion: bool = False
    shown_by: tuple[str, ...] = ()
    holds_first: bool = False
    outside_m: float = 0.0
    anywhere: bool = False
    images: bool = False
    pairs: bool = False
    from_start: bool = False
    both_eyes: bool = False

    def built(self, random: Callable[[], Random], end_ns: int) -> Hooks:
        """The faulty parts of a fault that ends at `end_ns`; each generator of `random` gives the same numbers."""
        hooks = self.hooks(random(), end_ns)
        return replace(hooks, right_camera=self.hooks(random(), end_ns).camera) if self.both_eyes else hooks
