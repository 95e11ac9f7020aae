"""`python -m tests.fuzz.can_frames [--count N] [--seed N]`: mutated frames at the supervision of our own CAN messages.

Every other frame of each message is mutated; the other ones are good, as they would be. On the wire a frame is its
bits with CAN's own CRC-15 and bit stuffing, and what a controller would not receive never arrives. The other mutations
are of what is above the wire: gateways, drivers, other senders. Exit code 1 where a mutated frame was accepted.

`memory` is apart: four and more wrong bits behind the controller's check are more than a CRC-8 always finds; ranges,
reserved bits and rates bound what they can do.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from random import Random

from automodel.assembly.can_parts import can_functions
from automodel.config import CanConfig
from firmware_link.can_receiver import CanFrame, CanReceiver, MessageWriter, Verdict, load_dbc

CRC_15 = 0x4599
APART = ("memory",)


def crc_15(bits: Sequence[int]) -> list[int]:
    """The CRC field of a CAN frame over its bits from the start of frame to the data's end (ISO 11898-1)."""
    register = 0
    for bit in bits:
        feedback = bit ^ (register >> 14)
        register = (register << 1) & 0x7FFF
        if feedback:
            register ^= CRC_15
    return [register >> place & 1 for place in range(14, -1, -1)]


def on_wire(frame_id: int, data: bytes) -> list[int]:
    """The bits of a standard data frame as far as the CRC's end, stuffed."""
    bits = [0, *_bits(frame_id, 11), 0, 0, 0, *_bits(len(data), 4)]
    for byte in data:
        bits += _bits(byte, 8)
    stuffed: list[int] = []
    run = 0
    for bit in bits + crc_15(bits):
        run = run + 1 if stuffed and stuffed[-1] == bit else 1
        stuffed.append(bit)
        if run == 5:
            stuffed.append(1 - bit)
            run = 1
    return stuffed


def off_wire(stuffed: Sequence[int]) -> tuple[int, bytes] | None:
    """Identifier and payload of bits on the wire; None where a controller signals an error, or sees no data frame."""
    bits: list[int] = []
    run, before, skip = 0, -1, False
    for bit in stuffed:
        if skip:
            if bit == before:
                return None  # six equal bits
            before, run, skip = bit, 1, False
            continue
        run = run + 1 if bit == before else 1
        before = bit
        bits.append(bit)
        skip = run == 5
    if len(bits) < 34 or bits[0] or any(bits[12:15]):  # the start of frame; remote or extended frames are others
        return None
    length = min(_number(bits[15:19]), 8)
    end = 19 + 8 * length
    if len(bits) != end + 15 or crc_15(bits[:end]) != bits[end:]:
        return None
    return _number(bits[1:12]), bytes(_number(bits[at : at + 8]) for at in range(19, end, 8))


def _bits(value: int, count: int) -> list[int]:
    return [value >> place & 1 for place in range(count - 1, -1, -1)]


def _number(bits: Sequence[int]) -> int:
    return int("".join(map(str, bits)), 2)


@dataclass(frozen=True, slots=True)
class Sent:
    """A good frame, those of its message before it (the newest last), and the newest payload of another message."""

    frame_id: int
    data: bytes
    before: Sequence[bytes]
    other: bytes


Mutation = Callable[[Random, Sent], "tuple[int, bytes] | None"]


def _flipped(random: Random, data: bytes, low: int, high: int) -> bytes:
    number = int.from_bytes(data, "big")
    for bit in random.sample(range(8 * len(data)), random.randint(low, high)):
        number ^= 1 << bit
    return number.to_bytes(len(data), "big")


def wire_bits(random: Random, sent: Sent) -> tuple[int, bytes] | None:
    """One to eight wrong bits anywhere on the wire."""
    bits = on_wire(sent.frame_id, sent.data)
    for place in random.sample(range(len(bits)), random.randint(1, 8)):
        bits[place] ^= 1
    return off_wire(bits)


def wire_burst(random: Random, sent: Sent) -> tuple[int, bytes] | None:
    """Random bits for up to half a frame on the wire."""
    bits = on_wire(sent.frame_id, sent.data)
    start = random.randrange(len(bits))
    for place in range(start, min(start + random.randint(2, 60), len(bits))):
        bits[place] = random.getrandbits(1)
    return off_wire(bits)


def payload_bits(random: Random, sent: Sent) -> tuple[int, bytes]:
    """One to three wrong bits in the payload."""
    return sent.frame_id, _flipped(random, sent.data, 1, 3)


def payload_byte(random: Random, sent: Sent) -> tuple[int, bytes]:
    """One wrong byte."""
    place = random.randrange(len(sent.data))
    return sent.frame_id, bytes((*sent.data[:place], random.randrange(256), *sent.data[place + 1 :]))


def payload_random(random: Random, sent: Sent) -> tuple[int, bytes]:
    """Any bytes at all, all zeros and all ones among them."""
    return sent.frame_id, random.choice((random.randbytes(8), random.randbytes(8), bytes(8), b"\xff" * 8))


def length(random: Random, sent: Sent) -> tuple[int, bytes]:
    """A payload that is cut, or goes on."""
    return sent.frame_id, random.choice((sent.data[: random.randrange(8)], sent.data + bytes(random.randint(1, 56))))


def replayed(random: Random, sent: Sent) -> tuple[int, bytes]:
    """One of the last fifteen payloads once more: a counter of four bits tells no older ones apart."""
    return sent.frame_id, random.choice(sent.before[-15:])


def of_another(random: Random, sent: Sent) -> tuple[int, bytes]:
    """The payload of another message, with its own right CRC."""
    return sent.frame_id, sent.other


def memory(random: Random, sent: Sent) -> tuple[int, bytes]:
    """Four to sixteen wrong bits behind the controller's check."""
    return sent.frame_id, _flipped(random, sent.data, 4, 16)


MUTATIONS: tuple[Mutation, ...] = (
    wire_bits, wire_burst, payload_bits, payload_byte, payload_random, length, replayed, of_another, memory
)  # fmt: skip


class Bus:
    """Good frames of all messages that the host receives, and the host's supervision of them."""

    def __init__(self, config: CanConfig) -> None:
        database, functions = load_dbc(config.dbc), can_functions(config)
        self.receiver = CanReceiver(database, config, functions)
        self.t_ns = 0
        self._writers = [
            MessageWriter(database, message, [v for v in config.state if v.message == message.name], functions)
            for message in config.receive
        ]
        self.before: dict[str, list[bytes]] = {writer.name: [] for writer in self._writers}

    def next(self, index: int) -> Sent:
        """The next good frame of one of the messages."""
        writer = self._writers[index % len(self._writers)]
        t_s = self.t_ns * 1e-9
        told = {
            "speed_mps": 15.0 + 3.0 * math.sin(0.3 * t_s),
            "yaw_rate_radps": 0.1 * math.sin(0.5 * t_s),
            "steering_rad": 0.02 * math.sin(0.5 * t_s),
            "engaged": 1.0,
            "gear": 3.0,
            "boot_id": 7.0,
            "driver_torque_nm": 0.5 * math.sin(t_s),
        }
        data = writer.payload(told)
        others = [frames[-1] for name, frames in self.before.items() if name != writer.name and frames]
        sent = Sent(writer.frame_id, data, tuple(self.before[writer.name]), others[0] if others else bytes(8))
        self.before[writer.name] = [*self.before[writer.name][-15:], data]
        return sent

    def take(self, frame_id: int, data: bytes) -> Verdict | None:
        """What the supervision says of a frame."""
        self.t_ns += 3_000_000
        return self.receiver.take(CanFrame(t_ns=self.t_ns, frame_id=frame_id, data=data))


def tried(count: int, seed: int, config: CanConfig | None = None) -> dict[str, Counter[str]]:
    """For each mutation how many frames were `mutated`, did `arrive` (of that: changed) and were `accepted`."""
    bus, random = Bus(config or CanConfig()), Random(seed)
    found = {mutation.__name__: Counter[str]() for mutation in MUTATIONS}
    for index in range(3 * 20):
        sent = bus.next(index)
        assert bus.take(sent.frame_id, sent.data) is Verdict.GOOD
    for index in range(count):
        mutation = MUTATIONS[index // 3 % len(MUTATIONS)]
        sent = bus.next(index)
        counts = found[mutation.__name__]
        counts["mutated"] += 1
        arrived = mutation(random, sent)
        bus.t_ns += 3_000_000
        if arrived is not None and arrived != (sent.frame_id, sent.data):
            counts["arrive"] += 1
            counts["accepted"] += bus.take(*arrived) is Verdict.GOOD
        for _ in range(2):
            sent = bus.next(index)
            bus.take(sent.frame_id, sent.data)
    return found


def main() -> int:
    """Try `--count` mutated frames."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.can_frames", description="Mutated CAN frames.")
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    found = tried(given.count, given.seed)
    for name, counts in found.items():
        sys.stdout.write(
            f"{name:15} {counts['mutated']:8} mutated, {counts['arrive']:8} arrive, {counts['accepted']} accepted\n"
        )
    return 1 if any(counts["accepted"] for name, counts in found.items() if name not in APART) else 0


if __name__ == "__main__":
    sys.exit(main())
