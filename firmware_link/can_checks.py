"""Checksums and counters of CAN messages, by the names that car.toml uses.

A checksum is a function of the frame's identifier, the profile's data id and the payload with the checksum's own bits
set to 0; it gives the value that these bits must have. A counter is a function of the value before and the signal's
length in bits; it gives the next value. An installed package adds its own by the entry points
`automodel.can_checksums` and `automodel.can_counters`, a file beside car.toml as "module:function".
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

ChecksumFunction = Callable[[int, int, bytes], int]
CounterFunction = Callable[[int, int], int]


@lru_cache(maxsize=8)
def _crc8_table(polynomial: int) -> bytes:
    from crccheck.crc import Crc

    crc = Crc(8, polynomial)
    return bytes(crc.reset().process(bytes([value])).final() for value in range(256))


def _crc8(data: bytes, polynomial: int, start: int, xor: int) -> int:
    table = _crc8_table(polynomial)
    value = start
    for byte in data:
        value = table[value ^ byte]
    return value ^ xor


def autosar_e2e_1(frame_id: int, data_id: int, data: bytes) -> int:
    """AUTOSAR E2E profile 1, both bytes of the data id included; the CRC is byte 0, the counter counts 0 .. 14.

    CRC-8 SAE J1850 with start and final XOR 0: what remains of the specification's calls of `Crc_CalculateCRC8`.
    """
    return _crc8(bytes((data_id & 0xFF, data_id >> 8)) + data[1:], 0x1D, 0x00, 0x00)


def autosar_e2e_2(frame_id: int, data_id: int, data: bytes) -> int:
    """AUTOSAR E2E profile 2 with one data id for all counter values; the CRC is byte 0, as in cantools."""
    from cantools.autosar.end_to_end import compute_profile2_crc  # loads all of cantools

    return compute_profile2_crc(data, data_id & 0xFF) or 0


def toyota(frame_id: int, data_id: int, data: bytes) -> int:
    """Toyota: length, identifier and payload summed; the last byte."""
    return (len(data) + (frame_id & 0xFF) + (frame_id >> 8) + sum(data)) & 0xFF


def honda(frame_id: int, data_id: int, data: bytes) -> int:
    """Honda: 8 minus all hexadecimal digits of identifier and payload; the last byte's lower half."""
    digits = sum(int(digit, 16) for digit in f"{frame_id:x}{data.hex()}")
    extended = 3 if frame_id > 0x7FF else 0
    return (8 - digits + extended) & 0xF


def hyundai(frame_id: int, data_id: int, data: bytes) -> int:
    """Hyundai and Kia, LKAS11 of about 2018: the sum of all bytes but byte 6, which holds it (commaai/opendbc)."""
    return sum(data) & 0xFF


def hyundai_crc8(frame_id: int, data_id: int, data: bytes) -> int:
    """Hyundai and Kia, LKAS11 since about 2019: CRC-8, polynomial 0x1D, over all bytes but byte 6, which holds it.

    commaai/opendbc gives it in the notation of crcmod, initial value 0xFD and final XOR 0xDF: there the register starts
    with the exclusive or of both.
    """
    return _crc8(data[:6] + data[7:], 0x1D, 0xFD ^ 0xDF, 0xDF)


def chrysler(frame_id: int, data_id: int, data: bytes) -> int:
    """Chrysler, Jeep, Ram: CRC-8 SAE J1850 over all bytes but the last."""
    return _crc8(data[:-1], 0x1D, 0xFF, 0xFF)


def sum8(frame_id: int, data_id: int, data: bytes) -> int:
    """The sum of all other bytes."""
    return sum(data) & 0xFF


def xor8(frame_id: int, data_id: int, data: bytes) -> int:
    """The exclusive or of all other bytes."""
    value = 0
    for byte in data:
        value ^= byte
    return value


# where a checksum is that the DBC file does not show; all others: the last byte
FIRST_BYTE = frozenset({"autosar_e2e_1", "autosar_e2e_2"})
LAST_NIBBLE = frozenset({"honda"})
BYTE_6 = frozenset({"hyundai", "hyundai_crc8"})


def usual_mask(checksum: str, length: int) -> tuple[int, int]:
    """Mask of the checksum in a payload of `length` bytes as a big-endian number, and how far it is shifted [bits].

    The place that is usual for the checksum of that name: the last byte where nothing else is known.
    """
    if checksum in LAST_NIBBLE:
        return 0xF, 0
    index = 0 if checksum in FIRST_BYTE else min(6, length - 1) if checksum in BYTE_6 else length - 1
    shift = 8 * (length - 1 - index)
    return 0xFF << shift, shift


def rolling(before: int, bits: int) -> int:
    """Counts through all values of the signal."""
    return (before + 1) % (1 << bits)


def rolling_to_14(before: int, bits: int) -> int:
    """AUTOSAR E2E profile 1: 0 .. 14; 15 is invalid."""
    return (before + 1) % 15
