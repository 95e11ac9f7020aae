"""The faults of the serial line, and of what is at its other end."""

from __future__ import annotations

from random import Random

from automodel.bench.faults import wire
from automodel.bench.faults.fault import Fault, Kind, Must
from automodel.bench.faults.hooks import Hooks, Moment, WireHook

LONG = (0.2, 0.6)
BOOT_S = 0.7  # a port that is opened again, and a board that starts: until it has taken the limits over
HEARD_S = 0.3  # a link that was silent, until the board's time is known again


def _either_way(random: Random, hook: WireHook) -> Hooks:
    return Hooks(to_board=hook) if random.random() < 0.5 else Hooks(from_board=hook)


def _replugged(random: Random, end_ns: int) -> Hooks:
    out_s = random.uniform(0.02, 0.5)
    return Hooks(moments=((0.0, Moment.UNPLUG), (out_s, Moment.REPLUG)))


def _other_firmware(random: Random, end_ns: int) -> Hooks:
    out_s = random.uniform(0.05, 0.4)
    return Hooks(moments=((0.0, Moment.UNPLUG), (out_s, Moment.OTHER_FIRMWARE), (out_s, Moment.REPLUG)))


def _falling_behind(random: Random, end_ns: int) -> Hooks:
    return Hooks(to_board=wire.falling_behind(end_ns - 500_000_000, random.uniform(1.0, 2.0)))


SERIAL = (
    Fault(
        name="serial-unplugged", kind=Kind.OFF, must=Must.STOP, ends=False, told="link-lost",
        text="the cable is taken out",
        hooks=lambda random, end_ns: Hooks(moments=((0.0, Moment.UNPLUG),)),
    ),
    Fault(
        name="serial-replugged", kind=Kind.INTERMITTENT, must=Must.STOP, lasting_s=(0.5, 0.5), recovery_s=BOOT_S,
        told="link-lost",
        text="the cable is taken out and put in again",
        hooks=_replugged,
    ),
    Fault(
        name="serial-other-firmware", kind=Kind.WRONG, must=Must.STOP, ends=False, told="link-lost",
        text="the board that is put in again speaks another message table",
        hooks=_other_firmware,
    ),
    Fault(
        name="serial-deaf", kind=Kind.OFF, must=Must.STOP, lasting_s=LONG, recovery_s=HEARD_S,
        heard=False,
        text="nothing arrives at the board",
        hooks=lambda random, end_ns: Hooks(to_board=wire.silent),
    ),
    Fault(
        name="serial-mute", kind=Kind.OFF, must=Must.STOP, lasting_s=LONG, recovery_s=HEARD_S,
        text="nothing comes from the board",
        hooks=lambda random, end_ns: Hooks(from_board=wire.silent),
    ),
    Fault(
        name="serial-backlog", kind=Kind.STUCK, must=Must.STOP, lasting_s=LONG, recovery_s=HEARD_S,
        heard=False,
        text="nothing is read at one end; then everything that has waited comes at once",
        hooks=lambda random, end_ns: _either_way(random, wire.held_back(end_ns)),
    ),
    Fault(
        name="serial-noise", kind=Kind.GARBAGE, must=Must.NOTHING, lasting_s=(0.3, 1.0),
        text="up to 60 random bytes ahead of each frame to the board",
        hooks=lambda random, end_ns: Hooks(to_board=wire.noise_before(random, 60)),
    ),
    Fault(
        name="serial-random", kind=Kind.GARBAGE, must=Must.STOP, lasting_s=LONG, recovery_s=HEARD_S,
        heard=False,
        text="nothing but random bytes",
        hooks=lambda random, end_ns: _either_way(random, wire.random_bytes(random)),
    ),
    Fault(
        name="serial-cut", kind=Kind.GARBAGE, must=Must.STOP, lasting_s=LONG, recovery_s=HEARD_S,
        heard=False,
        text="every frame to the board is cut",
        hooks=lambda random, end_ns: Hooks(to_board=wire.cut(random)),
    ),
    Fault(
        name="serial-doubled", kind=Kind.WRONG, must=Must.NOTHING, lasting_s=(0.3, 1.0),
        text="every frame to the board comes twice",
        hooks=lambda random, end_ns: Hooks(to_board=wire.doubled),
    ),
    Fault(
        name="serial-swapped", kind=Kind.WRONG, must=Must.NOTHING, lasting_s=(0.3, 1.0),
        text="frames to the board come in another order",
        hooks=lambda random, end_ns: Hooks(to_board=wire.Swapped()),
    ),
    Fault(
        name="serial-delayed", kind=Kind.DELAYED, must=Must.STOP, lasting_s=(0.3, 0.6), recovery_s=1.2,
        heard=False,
        text="everything comes 0.12 to 0.5 s later, one way",
        hooks=lambda random, end_ns: _either_way(random, wire.delayed(round(random.uniform(0.12e9, 0.5e9)))),
    ),
    Fault(
        name="serial-falls-behind", kind=Kind.DELAYED, must=Must.STOP, lasting_s=(0.5, 0.5), within_s=0.35,
        heard=False, recovery_s=1.3,
        text="frames to the board come later and later, by 1 to 2 s a second: a stop within 0.35 s",
        hooks=_falling_behind,
    ),
    Fault(
        name="serial-late", kind=Kind.DELAYED, must=Must.NOTHING, lasting_s=(0.3, 1.0),
        text="everything comes 20 to 50 ms later, one way",
        hooks=lambda random, end_ns: _either_way(random, wire.delayed(round(random.uniform(20e6, 50e6)))),
    ),
    Fault(
        name="serial-crc", kind=Kind.GARBAGE, must=Must.STOP, lasting_s=(0.1, 0.1), recovery_s=HEARD_S,
        heard=False,
        text="wrong bits in every frame to the board for 100 ms",
        hooks=lambda random, end_ns: Hooks(to_board=wire.corrupt(random)),
    ),
    Fault(
        name="serial-byte", kind=Kind.INTERMITTENT, must=Must.NOTHING, lasting_s=(0.1, 0.1),
        text="one wrong byte, or one frame cut",
        hooks=lambda random, end_ns: _either_way(
            random, random.choice((wire.one_byte(random), wire.once(wire.cut(random))))
        ),
    ),
)  # fmt: skip
