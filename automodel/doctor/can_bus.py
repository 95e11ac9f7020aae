"""Checks a vehicle's CAN bus by listening for two seconds: what comes, how often, how sound, what [link.can] misses.

Nothing is sent: a bus on which we only listen moves nothing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from automodel.assembly.can_parts import can_functions
from automodel.config import CanConfig, CanMessage, CarConfig
from automodel.doctor.findings import Finding, bounded, fail, okay, warn
from automodel.runtime.clocks import SleepingClock
from firmware_link.can_port import BusTrouble, CanPort
from firmware_link.can_receiver import CanReceiver, MessageCount, Verdict, load_dbc

LISTENING_S = 2.0
POLL_S = 0.005
_OPENING_S = 5.0
_RATE_OFF = 0.2  # share by which a message's rate may differ from that of its period
_BAD_SHARE, _BAD_FEW = 0.02, 2  # of a message's frames: as many as a disturbed wire may damage
_NAMES_MAX = 8  # of one line
_WATCHED = {  # what a driver's override is seen by
    "driver_torque_nm": "the driver's hand on the wheel",
    "brake": "the brake",
    "accelerator": "the accelerator",
    "gear": "the gear",
}

Key = tuple[int, bool]  # identifier, extended


@dataclass(slots=True)
class Heard:
    """What came on the bus in `span_s`."""

    span_s: float
    frames: Counter[Key] = field(default_factory=Counter)
    troubles: Counter[BusTrouble] = field(default_factory=Counter)
    counts: dict[str, MessageCount] = field(default_factory=dict)  # of each supervised message


def can_bus_findings(car: CarConfig, port: CanPort, clock: SleepingClock) -> Iterator[Finding]:
    """Findings on the bus, on each supervised message, and on the mapping."""
    config = car.link.can
    do = "see [link] port and [link.can] interface; SocketCAN must be up: ip link set can0 up type can bitrate 500000"
    database = load_dbc(config.dbc)
    receiver = CanReceiver(database, config, can_functions(config))
    heard = bounded("CAN bus", lambda: listen(port, receiver, clock), LISTENING_S + _OPENING_S, do)
    if isinstance(heard, Finding):
        yield heard
        return
    yield judge_bus(heard, port.place)
    if heard.frames:
        yield from (judge_message(message, heard.counts[message.name]) for message in config.receive)
        yield judge_senders(config, database, heard)
        yield judge_others(config, database, heard)
    yield judge_watched(config)


def listen(port: CanPort, receiver: CanReceiver, clock: SleepingClock) -> Heard:
    """Join the bus, listen for `LISTENING_S` and leave it; raises LinkError."""
    heard = Heard(span_s=LISTENING_S)
    port.open()
    try:
        start_ns = clock.now_ns()
        while (now_ns := clock.now_ns()) - start_ns < LISTENING_S * 1e9:
            received = port.receive(now_ns)
            heard.troubles.update(received.troubles)
            for frame in received.frames:
                heard.frames[frame.frame_id, frame.extended] += 1
                receiver.take(frame)
            clock.sleep(POLL_S)
    finally:
        port.close()
    heard.counts = {watch.name: watch.count for watch in receiver.watches.values()}
    return heard


def judge_bus(heard: Heard, place: str) -> Finding:
    """Whether anything comes, and whether the bus is sound."""
    name, total = "CAN bus", heard.frames.total()
    what = f"{place}: {total / heard.span_s:.0f} frames/s of {len(heard.frames)} messages"
    if heard.troubles:
        told = ", ".join(f"{count} times {trouble.value}" for trouble, count in heard.troubles.items())
        return fail(
            name,
            f"{what}; {told}",
            "compare [link.can] bitrate with the vehicle's; look at the wires and both terminators",
        )
    if total == 0:
        return fail(
            name,
            f"{place}: nothing came in {heard.span_s:g} s",
            "is the vehicle on? See the wires, [link] port and the bit rate",
        )
    return okay(name, what)


def judge_message(message: CanMessage, count: MessageCount) -> Finding:
    """Whether a supervised message comes, in its period, and sound."""
    name = message.name
    if count.frames == 0:
        return fail(name, "did not come", "is it on this bus? See [[link.can.receive]] name and dbc")
    bad = {verdict: number for verdict, number in count.verdicts.items() if verdict is not Verdict.GOOD}
    told = ", ".join(f"{number} {verdict.value}" for verdict, number in bad.items())
    rate_hz = _rate_hz(count)
    what = f"{rate_hz:.1f} Hz, {count.frames} frames" + (f", wrong: {told}" if told else "")
    if sum(bad.values()) > _BAD_SHARE * count.frames + _BAD_FEW:
        return fail(name, what, _REMEDIES.get(max(bad, key=lambda verdict: bad[verdict]), "see [[link.can.receive]]"))
    if abs(rate_hz * message.period_s - 1.0) > _RATE_OFF:
        do = f"set period_s to {1.0 / rate_hz:.3g}, if that is what the vehicle does" if rate_hz else "listen again"
        return warn(name, f"{what}; expected {1.0 / message.period_s:.1f} Hz", do)
    return okay(name, what)


_REMEDIES = {
    Verdict.LENGTH: "the DBC file is of another car or year",
    Verdict.CHECKSUM: "see checksum, checksum_signal and data_id in [[link.can.receive]]",
    Verdict.COUNTER: "see counter and counter_signal in [[link.can.receive]]",
    Verdict.RANGE: "see factor, offset, minimum and maximum in [[link.can.state]]",
    Verdict.JUMP: "see factor and rate_max in [[link.can.state]]",
    Verdict.QUALITY: "the vehicle doubts its values: wait, drive a few metres, or see quality_signal",
}


def judge_senders(config: CanConfig, database: Any, heard: Heard) -> Finding:
    """Whether somebody else sends what we would send."""
    name = "CAN senders"
    known = _names(database)
    own = {message.name for message in config.send}
    others = [known[key] for key in heard.frames if known.get(key) in own]
    if others:
        do = "silence that sender, or disconnect it: two senders of one message end the arming"
        return fail(name, f"somebody sends {', '.join(sorted(others))}, which is ours", do)
    return okay(name, f"nobody else sends {', '.join(sorted(own))}")


def judge_others(config: CanConfig, database: Any, heard: Heard) -> Finding:
    """What comes and is not mapped: of the DBC files, and of none."""
    known = _names(database)
    mapped = {message.name for message in (*config.receive, *config.send)}
    unmapped = sorted({known[key] for key in heard.frames if key in known} - mapped)
    foreign = sorted(key for key in heard.frames if key not in known)
    told = [f"not mapped: {_few(unmapped)}"] if unmapped else []
    told += [f"not in the DBC files: {_few([f'{frame_id:#x}' for frame_id, _ in foreign])}"] if foreign else []
    return okay("CAN mapping", "; ".join(told) or "every message that came is mapped")


def judge_watched(config: CanConfig) -> Finding:
    """Whether the driver's override can be seen."""
    name = "CAN override"
    missing = [text for value, text in _WATCHED.items() if value not in {part.value for part in config.state}]
    if missing:
        return warn(
            name,
            f"nothing tells {', '.join(missing)}",
            "map them in [[link.can.state]]: only they end the arming by the driver",
        )
    return okay(name, f"{', '.join(_WATCHED.values())} are watched")


def _rate_hz(count: MessageCount) -> float:
    span_ns = (count.last_ns or 0) - (count.first_ns or 0)
    return (count.frames - 1) * 1e9 / span_ns if span_ns else 0.0


def _names(database: Any) -> Mapping[Key, str]:
    return {(message.frame_id, message.is_extended_frame): message.name for message in database.messages}


def _few(names: list[str]) -> str:
    more = len(names) - _NAMES_MAX
    return ", ".join(names[:_NAMES_MAX]) + (f" and {more} more" if more > 0 else "")
