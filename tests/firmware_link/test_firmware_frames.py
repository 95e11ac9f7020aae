"""The board's C++ frames: what is made, taken and thrown away; against the Python ones and on their own."""

from __future__ import annotations

import ctypes
import random
from typing import Any

import numpy as np
import pytest

from firmware_link import framing, messages
from firmware_link.framing import RawFrame

COMMANDS = [
    messages.Command(servo_us=1500.0, motor_us=1500.0, deadline_ms=0, flags=0),
    messages.Command(servo_us=1050.5, motor_us=1625.0, deadline_ms=0xBEEF, flags=1),
    messages.Command(servo_us=1024.0, motor_us=2048.0, deadline_ms=0x0100, flags=1),  # zeros in between
]
LENGTHS = {entry.type_id: entry.codec.payload_bytes for entry in messages.TABLE if entry.to_board}


def taken(library: Any, stream: bytes) -> tuple[list[RawFrame], int]:
    """The frames in a stream, and how many were thrown away."""
    out = (ctypes.c_uint8 * (len(stream) + 64))()
    errors = ctypes.c_uint32()
    count = library.decode_stream(stream, len(stream), out, ctypes.byref(errors))
    raw, place, frames = bytes(out), 0, []
    for _ in range(count):
        length = LENGTHS[raw[place]]
        frames.append(RawFrame(raw[place], raw[place + 1], raw[place + 2 : place + 2 + length]))
        place += 2 + length
    return frames, errors.value


def same(library: Any, stream: bytes) -> int:
    """How many frames both decoders take; they must agree on each, and on how many were thrown away."""
    decoder = messages.decoder(on_board=True)
    frames = decoder.feed(stream)
    assert taken(library, stream) == (frames, decoder.errors.total)
    return len(frames)


def stream_of(rng: random.Random, count: int) -> bytes:
    """Frames of every kind, good, damaged and made up."""
    parts = []
    for _ in range(count):
        kind = rng.random()
        frame_type = rng.choice([*LENGTHS, 0x81, 0x00, rng.randrange(256)])
        length = LENGTHS.get(frame_type, 0) if rng.random() < 0.8 else rng.randrange(15)
        seed = messages.TABLE_HASH if rng.random() < 0.9 else rng.randrange(65536)
        payload = bytes(rng.choices([0, rng.randrange(256)], k=length))
        frame = bytearray(framing.encode(frame_type, rng.randrange(256), payload, messages.check_of(frame_type, seed)))
        if kind < 0.3:
            frame[rng.randrange(len(frame))] ^= 1 << rng.randrange(8)
        elif kind < 0.4:
            frame = bytearray(rng.randbytes(rng.randrange(30)))
        elif kind < 0.5:
            del frame[rng.randrange(len(frame)) :]
        parts.append(bytes(frame))
    return b"".join(parts)


def test_frames_made_are_the_same(library: Any) -> None:
    rng = random.Random(1)
    out = (ctypes.c_uint8 * 32)()
    for _ in range(5000):
        payload = bytes(rng.choices([0, 1, rng.randrange(256)], k=rng.randrange(15)))
        frame_type, counter = rng.choice([0x81, rng.randrange(256)]), rng.randrange(256)
        length = library.encode_frame(frame_type, counter, payload, len(payload), out)
        assert bytes(out[:length]) == framing.encode(frame_type, counter, payload, messages.check_of(frame_type))


def test_crc_of_the_standard(library: Any) -> None:
    """The check value of CRC-16/DNP in the catalogue of G. Cook."""
    assert library.crc(b"123456789", 9, 0) == 0xEA82


def test_random_frames_are_taken_and_thrown_away_as_by_the_emulated_board(library: Any) -> None:
    assert same(library, stream_of(random.Random(2), 20_000)) > 2000


@pytest.mark.slow
def test_a_million_random_frames(library: Any) -> None:
    rng = random.Random(3)
    assert sum(same(library, stream_of(rng, 50_000)) for _ in range(20)) > 100_000


def test_random_bytes_are_no_frames(library: Any) -> None:
    stream = np.random.default_rng(4).integers(0, 256, 2_000_000, dtype=np.uint8).tobytes()
    frames, errors = taken(library, stream)
    assert frames == []
    assert errors > 5000


def flipped(library: Any, command: messages.Command, bits: int) -> tuple[int, int]:
    wire = messages.encode(command, 0)[1:]  # the first zero only closes what came before
    tried, accepted = ctypes.c_uint32(), ctypes.c_uint32()
    library.flip_bits(wire, len(wire), bits, ctypes.byref(tried), ctypes.byref(accepted))
    return tried.value, accepted.value


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(("bits", "count"), [(1, 128), (2, 8_128), (3, 341_376), (4, 10_668_000)])
def test_every_error_of_one_to_four_bits_is_thrown_away(
    library: Any, command: messages.Command, bits: int, count: int
) -> None:
    """Of all 16 bytes with the delimiter behind; the counts are 128 over `bits`."""
    assert flipped(library, command, bits) == (count, 0)


def test_an_undamaged_frame_is_taken(library: Any) -> None:
    assert [flipped(library, command, 0) for command in COMMANDS] == [(1, 1)] * 3


def test_a_frame_cut_anywhere_costs_only_itself(library: Any) -> None:
    whole, following = messages.encode(COMMANDS[1], 5), messages.encode(COMMANDS[0], 6)
    for cut in range(len(whole) - 1):
        frames, errors = taken(library, whole[:cut] + following)
        assert [frame.counter for frame in frames] == [6]
        assert errors == (1 if cut > 1 else 0)
    for cut in range(1, len(whole)):  # the beginning is missing
        frames, _ = taken(library, whole[cut:] + following)
        assert [frame.counter for frame in frames] == ([5, 6] if cut == 1 else [6])


def test_a_frame_right_after_garbage_is_taken(library: Any) -> None:
    rng = random.Random(5)
    for length in range(1, 80):
        frames, _ = taken(library, rng.randbytes(length) + messages.encode(COMMANDS[1], 5))
        assert [frame.counter for frame in frames] == [5]


def test_frames_of_another_table_are_thrown_away(library: Any) -> None:
    stream = b"".join(messages.encode(command, 1, messages.TABLE_HASH ^ 1) for command in COMMANDS)
    assert taken(library, stream) == ([], 3)
