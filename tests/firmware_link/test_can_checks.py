"""Checksums of CAN messages against frames of real cars and published values, and against their definitions."""

from __future__ import annotations

import functools
import itertools
import operator

import pytest
from crccheck.crc import Crc8Autosar, Crc8SaeJ1850

from automodel.config.parts import CAN_CHECKSUMS
from firmware_link import can_checks


def test_autosar_profile_1_gives_the_specification_s_example() -> None:
    """AUTOSAR PRS_E2EProtocol, profile 1, data id 0x123 (both bytes), a payload of zeros: CRC 0xCC."""
    assert can_checks.autosar_e2e_1(0, 0x123, bytes(8)) == 0xCC


def test_autosar_profile_2_is_the_crc_of_payload_and_data_id() -> None:
    data = bytes((0, 3, 1, 2, 3, 4, 5, 6))
    assert can_checks.autosar_e2e_2(0, 0x42, data) == Crc8Autosar.calc(data[1:] + b"\x42")


def test_chrysler_is_crc_8_j1850() -> None:
    assert can_checks.chrysler(0, 0, b"123456789\x00") == Crc8SaeJ1850.calc(b"123456789") == 0x4B


@pytest.mark.parametrize(  # frames of comma2k19's Toyota RAV4
    ("frame_id", "data"),
    [(0x0B4, "000000001D0B7A5E"), (0x260, "08FFFB0000001884"), (0x2C1, "0014DF14BBCA3A91")],
)
def test_toyota_fits_frames_of_a_real_car(frame_id: int, data: str) -> None:
    payload = bytes.fromhex(data)
    assert can_checks.toyota(frame_id, 0, payload[:-1] + b"\x00") == payload[-1]


def test_honda_adds_digits() -> None:
    """Of identifier 0xE4 and payload 10 20 00 00 3x: 8 - (14 + 4 + 1 + 2 + 3) = -16, modulo 16; 3 more if extended."""
    data = bytes.fromhex("1020000030")
    assert can_checks.honda(0xE4, 0, data) == (8 - 24) % 16
    assert can_checks.honda(0x10000E4, 0, data) == (8 - 25 + 3) % 16


@pytest.mark.parametrize(("frame_id", "checksums"), [(829, (11, 10, 9, 8)), (13274, (4, 3, 2, 1))])
def test_honda_gives_the_checksums_that_opendbc_tests(frame_id: int, checksums: tuple[int, ...]) -> None:
    """commaai/opendbc, test_checksums.py: LKAS_HUD and LKAS_HUD_A (extended), counters 0 .. 3 in byte 4."""
    for counter, checksum in enumerate(checksums):
        assert can_checks.honda(frame_id, 0, bytes((0x41, 0x05, 0, 0, counter << 4))) == checksum


@pytest.mark.parametrize(
    "data", ["6B00BD0000000000", "EE010A0000000000", "D802A90000000000", "0303BEA212000000", "600F62C000000000"]
)
def test_autosar_profile_2_fits_frames_of_a_real_car(data: str) -> None:
    """Volkswagen's LWI_01, whose data id is 0x86 for every counter; the frames are in opendbc's test_checksums.py."""
    payload = bytes.fromhex(data)
    assert can_checks.autosar_e2e_2(0x86, 0x86, b"\x00" + payload[1:]) == payload[0]


@pytest.mark.parametrize(
    ("data", "crc"), [("0000000400000000", 0x44), ("2A00640440010009", 0x71), ("FFFFFFFFFFFF00FF", 0x34)]
)
def test_hyundai_crc_is_crcmod_s(data: str, crc: int) -> None:
    """As by crcmod 1.7 with opendbc's parameters: mkCrcFun(0x11D, initCrc=0xFD, rev=False, xorOut=0xDF)."""
    assert can_checks.hyundai_crc8(0x340, 0, bytes.fromhex(data)) == crc


def test_hyundai_sum_is_in_byte_6() -> None:
    assert can_checks.hyundai(0x340, 0, bytes((1, 2, 3, 4, 5, 6, 0, 250))) == 271 % 256
    assert can_checks.usual_mask("hyundai", 8) == (0xFF00, 8)


def test_sums_and_xor() -> None:
    data = bytes((200, 100, 0, 3))
    assert can_checks.sum8(0, 0, data) == 303 % 256
    assert can_checks.xor8(0, 0, data) == 200 ^ 100 ^ 3


def test_hyundai_crc_leaves_its_own_byte_out() -> None:
    data = bytearray(range(8))
    before = can_checks.hyundai_crc8(0x340, 0, bytes(data))
    data[6] = 77
    assert can_checks.hyundai_crc8(0x340, 0, bytes(data)) == before
    data[7] ^= 1
    assert can_checks.hyundai_crc8(0x340, 0, bytes(data)) != before


@pytest.mark.parametrize("name", [*CAN_CHECKSUMS.names, "my_own:function"])
def test_the_usual_place_lies_in_the_payload(name: str) -> None:
    for length in (2, 5, 8):
        mask, shift = can_checks.usual_mask(name, length)
        assert 0 < mask < 1 << 8 * length
        assert mask >> shift in (0xF, 0xFF)


@pytest.mark.parametrize("name", CAN_CHECKSUMS.names)
def test_every_wrong_bit_is_found(name: str) -> None:
    """One flipped bit anywhere outside of the checksum changes it."""
    function = getattr(can_checks, name)
    mask, _ = can_checks.usual_mask(name, 8)
    right = int.from_bytes(bytes(range(3, 11)), "big") & ~mask
    expected = function(0x123, 0x123, right.to_bytes(8, "big"))
    for bit in (bit for bit in range(64) if not mask >> bit & 1):
        assert function(0x123, 0x123, (right ^ 1 << bit).to_bytes(8, "big")) != expected, bit


def test_profile_2_finds_every_error_of_three_bits() -> None:
    """By the CRC's linearity: no error of up to three bits has the checksum of none. Hamming distance 4."""
    zero = can_checks.autosar_e2e_2(0, 0x110, bytes(8))
    syndromes = []
    for bit in range(64):
        data = (1 << bit).to_bytes(8, "big")
        syndromes.append(can_checks.autosar_e2e_2(0, 0x110, b"\x00" + data[1:]) ^ zero ^ data[0])
    for count in (1, 2, 3):
        assert all(functools.reduce(operator.xor, bits) for bits in itertools.combinations(syndromes, count))


def test_counters() -> None:
    assert [can_checks.rolling(value, 2) for value in range(4)] == [1, 2, 3, 0]
    assert [can_checks.rolling_to_14(value, 4) for value in (0, 13, 14)] == [1, 14, 0]
