from __future__ import annotations

import functools
import itertools
import operator
import random
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_link import framing, messages
from firmware_link.framing import (
    CRC16_CHECK,
    Decoder,
    FrameFormat,
    RawFrame,
    cobs_decode,
    cobs_encode,
    crc16_dnp,
    crc32_check,
    encode,
)

CHECK = crc32_check(0x1234)
FORMATS = {0x01: FrameFormat(7, CHECK), 0x05: FrameFormat(0, CHECK), 0x83: FrameFormat(14, CRC16_CHECK)}


def bitwise_crc(data: bytes, seed: int) -> int:
    """Straight from the definition: polynomial 0x3D65 fed with each byte's bits, the lowest first; result reflected."""
    register = int(f"{seed:016b}"[::-1], 2)
    for byte in data:
        for bit in range(8):
            out = (register >> 15) ^ (byte >> bit & 1)
            register = (register << 1 & 0xFFFF) ^ (0x3D65 if out else 0)
    return int(f"{register:016b}"[::-1], 2) ^ 0xFFFF


def test_crc_has_the_published_check_value() -> None:
    assert crc16_dnp(b"123456789") == 0xEA82


@given(st.binary(max_size=20), st.integers(0, 0xFFFF))
def test_crc_is_that_of_the_definition(data: bytes, seed: int) -> None:
    assert crc16_dnp(data, seed) == bitwise_crc(data, seed)


@pytest.mark.parametrize(
    ("plain", "stuffed"),
    [  # the examples of Cheshire and Baker 1999
        ("00", "01 01"),
        ("00 00", "01 01 01"),
        ("11 22 00 33", "03 11 22 02 33"),
        ("11 22 33 44", "05 11 22 33 44"),
        ("11 00 00 00", "02 11 01 01 01"),
    ],
)
def test_cobs_examples(plain: str, stuffed: str) -> None:
    assert cobs_encode(bytes.fromhex(plain)) == bytes.fromhex(stuffed)
    assert cobs_decode(bytes.fromhex(stuffed)) == bytes.fromhex(plain)


@given(st.lists(st.sampled_from([0, 0, 1, 2, 255]), max_size=18).map(bytes))
def test_cobs_round_trip_without_zeros(data: bytes) -> None:
    stuffed = cobs_encode(data)
    assert 0 not in stuffed
    assert len(stuffed) == len(data) + 1
    assert cobs_decode(stuffed) == data


@given(st.sampled_from(sorted(FORMATS)), st.integers(0, 255), st.data())
def test_frame_round_trip_in_any_pieces(frame_type: int, counter: int, data: st.DataObject) -> None:
    length = FORMATS[frame_type].payload_bytes
    payload = data.draw(st.binary(min_size=length, max_size=length))
    wire = encode(frame_type, counter, payload, FORMATS[frame_type].check)
    cut = data.draw(st.integers(0, len(wire)))
    decoder = Decoder(FORMATS)
    assert decoder.feed(wire[:cut]) + decoder.feed(wire[cut:]) == [RawFrame(frame_type, counter, payload)]
    assert decoder.errors.total == 0


def test_body_of_more_than_16_bytes_is_refused() -> None:
    encode(1, 0, bytes(14), CHECK)
    with pytest.raises(ValueError, match="expected at most 16"):
        encode(1, 0, bytes(15), CHECK)


COMMANDS = [
    messages.Command(servo_us=1500.0, motor_us=1500.0, deadline_ms=0, flags=0),
    messages.Command(servo_us=1050.5, motor_us=1625.0, deadline_ms=0xBEEF, flags=1),
    messages.Command(servo_us=1024.0, motor_us=2048.0, deadline_ms=0x0100, flags=1),  # zeros in between
]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_error_of_one_to_three_bits_of_a_command_on_the_wire_is_rejected(command: messages.Command) -> None:
    chunk = messages.encode(command, 0)[1:-1]
    decoder = messages.decoder(on_board=True)
    assert len(decoder.feed(b"\0" + chunk + b"\0")) == 1
    wire = int.from_bytes(chunk, "little")
    bits = 8 * len(chunk)
    flips = [1 << bit for bit in range(bits)]
    wrong = [a | b for a, b in itertools.combinations(flips, 2)] + flips
    triples = [a | b | c for a, b, c in itertools.combinations(flips, 3)]
    stream = b"\0".join((wire ^ flip).to_bytes(len(chunk), "little") for flip in wrong + triples)
    assert decoder.feed(stream + b"\0") == []
    assert decoder.errors.total >= len(wrong) + len(triples) - 8 * len(chunk)


def syndromes(stuffed: bytes) -> list[int]:
    """What each single wrong bit does to the CRC: of the stuffed bytes, then of the CRC's own 32 bits."""
    right = zlib.crc32(stuffed)
    number = int.from_bytes(stuffed, "little")
    flipped = [(number ^ 1 << bit).to_bytes(len(stuffed), "little") for bit in range(8 * len(stuffed))]
    return [zlib.crc32(wrong) ^ right for wrong in flipped] + [1 << bit for bit in range(32)]


def test_every_error_of_one_to_six_bits_on_the_wire_changes_the_check() -> None:
    """Hamming distance 7: by the CRC's linearity it is enough that no sum of 1 .. 6 single-bit syndromes is zero.

    Where all sums of three are different, none of two halves of six, five or four is zero; shorter frames are the end
    of the longest one.
    """
    singles = syndromes(bytes(range(1, framing.MAX_BODY_BYTES + 2)))
    sums = [0, *singles]
    for count in (2, 3):
        sums += [functools.reduce(operator.xor, some) for some in itertools.combinations(singles, count)]
    assert len(set(sums)) == len(sums)


def test_the_check_is_five_bytes_of_seven_bits_of_the_crc_that_starts_from_the_seed() -> None:
    body = bytes.fromhex("01 07 11 22")
    wire = encode(body[0], body[1], body[2:], crc32_check(0xBEEF))
    assert wire[:7] == b"\0" + cobs_encode(body) + wire[6:7]
    number = sum((byte & 0x7F) << 7 * place for place, byte in enumerate(wire[6:11]))
    assert number == zlib.crc32(cobs_encode(body), 0xBEEF)
    assert all(byte & 0x80 for byte in wire[6:11])


def test_frame_right_after_garbage_is_accepted() -> None:
    frame = messages.encode(COMMANDS[1], 5)
    rng = random.Random(1)
    for length in range(1, 80):
        decoder = messages.decoder(on_board=True)
        garbage = bytes(rng.randrange(256) for _ in range(length))
        assert [f.counter for f in decoder.feed(garbage + frame)] == [5]


def test_frame_cut_at_any_point_costs_only_itself() -> None:
    frame = messages.encode(COMMANDS[1], 5)
    for cut in range(len(frame) - 1):
        decoder = messages.decoder(on_board=True)
        assert [f.counter for f in decoder.feed(frame[:cut] + messages.encode(COMMANDS[0], 6))] == [6], cut
        assert decoder.errors.total == (1 if cut > 1 else 0)


def test_errors_are_counted_by_kind() -> None:
    decoder = Decoder(FORMATS)
    good = encode(0x05, 1, b"", CHECK)
    assert decoder.feed(encode(0x05, 1, b"", crc32_check(0x1235))) == []
    assert (decoder.errors.crc, decoder.errors.total) == (1, 1)
    assert decoder.feed(encode(0x07, 1, b"", CHECK)) == []
    assert (decoder.errors.unknown_type, decoder.errors.total) == (1, 2)
    assert decoder.feed(encode(0x01, 1, b"123456", CHECK)) == []
    assert (decoder.errors.length, decoder.errors.total) == (1, 3)
    assert decoder.feed(b"\x02\x05" + b"\x80" * 5 + b"\0") == []  # decodes to one byte
    assert (decoder.errors.length, decoder.errors.total) == (2, 4)
    assert decoder.feed(b"\x09\x01" + b"\x80" * 5 + b"\0") == []  # the code points beyond the end
    assert (decoder.errors.cobs, decoder.errors.total) == (1, 5)
    assert decoder.feed(b"x" * 1000 + b"\0") == []
    assert (decoder.errors.length, decoder.errors.total) == (3, 6)
    assert len(decoder.feed(good)) == 1


def test_memory_is_bounded_and_the_frame_after_an_endless_one_is_taken() -> None:
    decoder = Decoder(FORMATS)
    for _ in range(1000):
        assert decoder.feed(b"x" * 50) == []
        assert len(decoder._tail) <= framing.MAX_BODY_BYTES + 7
    assert len(decoder.feed(encode(0x05, 1, b"", CHECK))) == 1
    assert decoder.errors.length == 1


def test_random_bytes_are_no_frames() -> None:
    decoder = messages.decoder(on_board=True)
    rng = random.Random(2)
    accepted = sum(len(decoder.feed(rng.randbytes(4096))) for _ in range(250))
    assert accepted == 0
    assert decoder.errors.total > 3000
