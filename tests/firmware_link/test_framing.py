from __future__ import annotations

import itertools
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_link import framing, messages
from firmware_link.framing import Decoder, FrameFormat, RawFrame, cobs_decode, cobs_encode, crc16_dnp, encode

SEED = 0x1234
FORMATS = {0x01: FrameFormat(7, SEED), 0x05: FrameFormat(0, SEED), 0x83: FrameFormat(14, 0)}


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
    wire = encode(frame_type, counter, payload, FORMATS[frame_type].seed)
    cut = data.draw(st.integers(0, len(wire)))
    decoder = Decoder(FORMATS)
    assert decoder.feed(wire[:cut]) + decoder.feed(wire[cut:]) == [RawFrame(frame_type, counter, payload)]
    assert decoder.errors.total == 0


def test_body_of_more_than_16_bytes_is_refused() -> None:
    encode(1, 0, bytes(14), 0)
    with pytest.raises(ValueError, match="expected at most 16"):
        encode(1, 0, bytes(15), 0)


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
    """What each single wrong bit does to the check: of the stuffed bytes, then of the check's own 16 bits."""
    right = checked(stuffed)
    number = int.from_bytes(stuffed, "little")
    flipped = [(number ^ 1 << bit).to_bytes(len(stuffed), "little") for bit in range(8 * len(stuffed))]
    return [checked(wrong) ^ right for wrong in flipped] + [1 << bit for bit in range(16)]


def checked(stuffed: bytes) -> int:
    return crc16_dnp(stuffed[1:] + stuffed[:1], messages.TABLE_HASH)


@pytest.mark.parametrize("length", range(3, 17))
def test_every_error_of_one_to_five_bits_on_the_wire_changes_the_check(length: int) -> None:
    """Hamming distance 6: by the CRC's linearity it is enough that no sum of 1 .. 5 single-bit syndromes is zero."""
    singles = syndromes(bytes(range(1, length + 1)))
    assert no_sum_of_one_to_five_is_zero(singles)


def test_the_same_for_the_longest_frames_but_for_errors_that_make_another_type() -> None:
    singles = syndromes(bytes(range(1, framing.MAX_BODY_BYTES + 2)))
    assert not no_sum_of_one_to_five_is_zero(singles)  # 136 bits are one too many
    lowest_of_type = 8  # the first bit that the check takes in
    assert no_sum_of_one_to_five_is_zero(singles[:lowest_of_type] + singles[lowest_of_type + 1 :])
    lengths = {entry.type_id: entry.codec.payload_bytes for entry in messages.TABLE}
    longest = [type_id for type_id, length in lengths.items() if length == framing.MAX_BODY_BYTES - 2]
    assert longest
    assert all(lengths.get(type_id ^ 1) != framing.MAX_BODY_BYTES - 2 for type_id in longest)


def no_sum_of_one_to_five_is_zero(singles: list[int]) -> bool:
    if len(set(singles)) < len(singles) or 0 in singles:
        return False
    pairs = {a ^ b for a, b in itertools.combinations(singles, 2)}
    if pairs & set(singles) or len(pairs) < len(singles) * (len(singles) - 1) // 2:  # three; four
        return False
    return not {a ^ b ^ c for a, b, c in itertools.combinations(singles, 3)} & pairs  # five


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
    good = encode(0x05, 1, b"", SEED)
    assert decoder.feed(encode(0x05, 1, b"", SEED + 1)) == []
    assert (decoder.errors.crc, decoder.errors.total) == (1, 1)
    assert decoder.feed(encode(0x07, 1, b"", SEED)) == []
    assert (decoder.errors.unknown_type, decoder.errors.total) == (1, 2)
    assert decoder.feed(encode(0x01, 1, b"123456", SEED)) == []
    assert (decoder.errors.length, decoder.errors.total) == (1, 3)
    assert decoder.feed(b"\x01\x40\x40\x40\0") == []  # decodes to one byte
    assert (decoder.errors.length, decoder.errors.total) == (2, 4)
    assert decoder.feed(b"\x09\x01\x40\x40\x40\0") == []  # the code points beyond the end
    assert (decoder.errors.cobs, decoder.errors.total) == (1, 5)
    assert decoder.feed(b"x" * 1000 + b"\0") == []
    assert (decoder.errors.length, decoder.errors.total) == (3, 6)
    assert len(decoder.feed(good)) == 1


def test_memory_is_bounded_and_the_frame_after_an_endless_one_is_taken() -> None:
    decoder = Decoder(FORMATS)
    for _ in range(1000):
        assert decoder.feed(b"x" * 50) == []
        assert len(decoder._tail) <= framing.MAX_BODY_BYTES + 5
    assert len(decoder.feed(encode(0x05, 1, b"", SEED))) == 1
    assert decoder.errors.length == 1


def test_random_bytes_are_no_frames() -> None:
    decoder = messages.decoder(on_board=True)
    rng = random.Random(2)
    accepted = sum(len(decoder.feed(rng.randbytes(4096))) for _ in range(250))
    assert accepted == 0
    assert decoder.errors.total > 3000
