"""A fault: what goes wrong, for how long, and what the car must make of it."""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass
from random import Random

from automodel.bench.faults.hooks import Hooks

BOUND_S = 0.150  # from a fault's begin to neutral throttle at the motor's pin (DESIGN, section 7)


class Kind(enum.Enum):
    """How a part fails; every part may fail in each of these ways."""

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

    STOP = "stop"  # neutral within the bound, then straight, and so until a person arms it again
    HOLD = "hold"  # neutral within the bound where the fault lasts longer than that; on by itself when it is over
    NOTHING = "nothing"  # drive on, as if nothing had been


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One row of the catalogue.

    `lasting_s` is the range that the fault's length is drawn from; (0, 0) for what happens at one moment. `ends` is
    False where nothing but other hardware helps. After the end the input takes up to `recovery_s` to be well again: a
    pipeline finds its lane, a board restarts, a port is opened. `heard` is False where the host's own input stays well:
    a board that is not reached says so only by disarming itself, and whoever asks to arm is not refused.

    `told` is the kind of an event that a person must see. `the_same`: the pulses at the pins must be those of a run
    without the fault, to the last one. `when_shown`: the bound counts from when the car's motion shows the fault; while
    it does not, anything goes.

    `hooks` makes the faulty parts for a fault that ends at `end_ns`; whatever is random in them comes from the
    generator.
    """

    name: str
    kind: Kind
    must: Must
    text: str
    hooks: Callable[[Random, int], Hooks]
    lasting_s: tuple[float, float] = (0.0, 0.0)
    within_s: float = BOUND_S
    ends: bool = True
    recovery_s: float = 0.4
    heard: bool = True
    told: str | None = None
    the_same: bool = False
    when_shown: bool = False
