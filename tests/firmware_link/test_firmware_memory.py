"""The board's C++ decisions about what it keeps over restarts, and about why it started."""

from __future__ import annotations

import ctypes
import dataclasses
import random
from typing import Any

import pytest

from firmware_link import framing, messages
from firmware_link.emulator.logic import NO_LIMITS
from firmware_link.messages import Limits, ResetCause
from tests.support.wide_limits import WIDE_LIMITS

LIMITS_CODEC = next(entry.codec for entry in messages.TABLE if entry.codec.cls is Limits)


class Eeprom:
    """The slots of boot ids, blank at first."""

    def __init__(self, library: Any) -> None:
        self.library, self.slots = library, bytearray(b"\xff" * 32)

    def start(self, cut: int = 4) -> int:
        """One start; power fails after `cut` bytes of the slot are written."""
        boot_id = int(self.library.kept_next_boot_id(bytes(self.slots)))
        record = (ctypes.c_uint8 * 4)()
        slot = self.library.kept_slot(ctypes.c_uint16(boot_id), record)
        self.slots[4 * slot : 4 * slot + cut] = bytes(record)[:cut]
        return boot_id


def test_boot_ids_count_up_wrap_around_and_wear_all_cells_alike(library: Any) -> None:
    eeprom = Eeprom(library)
    assert [eeprom.start() for _ in range(20)] == list(range(1, 21))
    for number in range(65528, 65536):
        record = (ctypes.c_uint8 * 4)()
        slot = library.kept_slot(ctypes.c_uint16(number), record)
        eeprom.slots[4 * slot : 4 * slot + 4] = bytes(record)
    assert [eeprom.start() for _ in range(10)] == list(range(10))


@pytest.mark.parametrize("starts", [0, 1, 5, 30])
@pytest.mark.parametrize("cut", [0, 1, 2, 3])
def test_after_a_start_that_power_cut_short_no_boot_id_comes_twice(library: Any, starts: int, cut: int) -> None:
    eeprom = Eeprom(library)
    told = [eeprom.start() for _ in range(starts)]
    eeprom.start(cut)
    whole = cut == 3  # the fourth byte is as it was: the slot is complete, and its boot id is left out
    assert eeprom.start() == starts + 1 + whole
    assert eeprom.start() == starts + 2 + whole
    assert told == list(range(1, starts + 1))


def test_boot_ids_survive_any_damage(library: Any) -> None:
    rng = random.Random(1)
    for _ in range(2000):
        eeprom = Eeprom(library)
        eeprom.slots[:] = rng.randbytes(32)
        first = eeprom.start()
        assert eeprom.start() == (first + 1) & 0xFFFF


def kept(library: Any, record: bytes) -> Limits:
    payload = (ctypes.c_uint8 * 14)()
    library.kept_limits(record, payload)
    limits = LIMITS_CODEC.unpack(bytes(payload))
    assert isinstance(limits, Limits)
    return limits


def record_of(library: Any, limits: Limits) -> bytes:
    record = (ctypes.c_uint8 * 16)()
    library.kept_record(LIMITS_CODEC.pack(limits), record)
    return bytes(record)


NARROW = Limits(
    servo_min_us=1100.0,
    servo_straight_us=1520.0,
    servo_max_us=1900.0,
    motor_min_us=1400.0,
    motor_neutral_us=1500.0,
    motor_max_us=1600.0,
    servo_slew_us=40.0,
    motor_slew_us=20.0,
)


def test_limits_are_kept_whole_or_not_at_all(library: Any) -> None:
    record = record_of(library, NARROW)
    assert kept(library, record) == NARROW
    for bit in range(8 * len(record)):
        damaged = bytearray(record)
        damaged[bit // 8] ^= 1 << bit % 8
        assert kept(library, bytes(damaged)) == NO_LIMITS
    for cut in range(16):  # written byte by byte over a blank memory, or over other limits
        assert kept(library, record[:cut] + b"\xff" * (16 - cut)) == NO_LIMITS
        before = record_of(library, WIDE_LIMITS)[cut:]
        assert kept(library, record[:cut] + before) == (NO_LIMITS if cut else WIDE_LIMITS)
    assert kept(library, b"\xff" * 16) == NO_LIMITS
    assert kept(library, bytes(16)) == NO_LIMITS


def test_kept_limits_that_do_not_fit_or_are_of_another_table_are_none(library: Any) -> None:
    payload = LIMITS_CODEC.pack(dataclasses.replace(NARROW, motor_neutral_us=1700.0))  # beyond its maximum
    crc = framing.crc16_dnp(payload, messages.TABLE_HASH)
    assert kept(library, payload + crc.to_bytes(2, "little")) == NO_LIMITS
    payload = LIMITS_CODEC.pack(NARROW)
    for seed, limits in ((messages.TABLE_HASH, NARROW), (messages.TABLE_HASH ^ 1, NO_LIMITS)):
        crc = framing.crc16_dnp(payload, seed)
        assert kept(library, payload + crc.to_bytes(2, "little")) == limits


@pytest.mark.parametrize(
    ("mcusr", "from_bootloader", "cause"),
    [
        (0b0001, 0, ResetCause.POWER_ON),
        (0b0101, 0, ResetCause.POWER_ON),  # the supply's rise
        (0b0010, 0, ResetCause.EXTERNAL),
        (0b0100, 0, ResetCause.BROWN_OUT),
        (0b0110, 0, ResetCause.BROWN_OUT),
        (0b1000, 0, ResetCause.WATCHDOG),
        (0b1010, 0, ResetCause.EXTERNAL),  # a bootloader that left by the watchdog
        (0, 0b1000, ResetCause.WATCHDOG),  # cleared and handed on
        (0, 0b0001, ResetCause.POWER_ON),
        (0, 0, ResetCause.EXTERNAL),  # cleared and hidden
        (0, 0x58, ResetCause.EXTERNAL),  # no flags: whatever was in the register
        (0b0100, 0b1000, ResetCause.BROWN_OUT),
    ],
)
def test_reset_cause(library: Any, mcusr: int, from_bootloader: int, cause: ResetCause) -> None:
    assert library.cause_of(mcusr, from_bootloader) == cause
