"""Mutated CAN frames: none is accepted, and a supervision without one of its checks is found out."""

from __future__ import annotations

import dataclasses
from random import Random

import pytest

from automodel.config import CanConfig, ConfigError
from automodel.config.can import CanMessage
from firmware_link import can_receiver
from tests.fuzz.can_frames import APART, crc_15, off_wire, on_wire, tried

COUNT = 5400
CONFIG = CanConfig()


def accepted(config: CanConfig = CONFIG) -> set[str]:
    return {name for name, counts in tried(COUNT, 1, config).items() if counts["accepted"] and name not in APART}


def test_no_mutated_frame_is_accepted() -> None:
    found = tried(COUNT, 1)
    assert {
        name: counts["accepted"] for name, counts in found.items() if name not in APART and counts["accepted"]
    } == {}
    assert all(counts["mutated"] == COUNT / len(found) for counts in found.values())
    assert all(counts["arrive"] > 0.9 * counts["mutated"] for name, counts in found.items() if name[:4] != "wire")


def without(**changes: object) -> CanConfig:
    """The mapping without a protection of its messages."""
    return dataclasses.replace(CONFIG, receive=tuple(dataclasses.replace(m, **changes) for m in CONFIG.receive))  # type: ignore[arg-type]


def test_without_a_checksum_frames_are_accepted() -> None:
    assert {"payload_bits", "payload_byte"} <= accepted(without(checksum=""))


def test_without_a_counter_replayed_frames_are_accepted() -> None:
    assert accepted(without(counter="", counter_signal="")) == {"replayed"}


def test_with_one_data_id_for_all_messages_another_one_s_payload_is_accepted() -> None:
    assert "of_another" in accepted(without(data_id=5, reserved_zero=False, counter="", counter_signal=""))


def test_without_its_length_a_frame_is_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    right = can_receiver.MessageReader.verdict
    monkeypatch.setattr(can_receiver.MessageReader, "verdict", lambda self, data: right(self, data[:8].ljust(8, b"\0")))
    assert "length" in accepted()


def test_a_reserved_bit_that_is_not_0_is_out_of_range() -> None:
    functions = can_receiver.Functions(checksums={}, counters={})
    message = CanMessage(name="AM_HEARTBEAT", period_s=0.02, reserved_zero=True)
    reader = can_receiver.MessageReader(can_receiver.load_dbc(()), message, [], functions)
    for bit in range(64):
        used = bit < 12 or 16 <= bit < 48
        verdict, _, _ = reader.verdict((1 << bit).to_bytes(8, "little"))
        assert verdict is (can_receiver.Verdict.GOOD if used else can_receiver.Verdict.RANGE), bit


def test_can_s_crc_is_that_of_the_catalogue() -> None:
    """CRC-15/CAN of the catalogue of parametrised CRC algorithms: check value 0x059E."""
    bits = [byte >> place & 1 for byte in b"123456789" for place in range(7, -1, -1)]
    assert int("".join(map(str, crc_15(bits))), 2) == 0x059E


def test_a_frame_comes_off_the_wire_as_it_went_on_and_no_single_wrong_bit_passes() -> None:
    random = Random(3)
    for _ in range(200):
        frame_id, data = (
            random.randrange(0x800),
            random.choice((random.randbytes(8), bytes(8), b"\xff" * random.randint(0, 8))),
        )
        wire = on_wire(frame_id, data)
        assert off_wire(wire) == (frame_id, data)
        place = random.randrange(len(wire))
        wire[place] ^= 1
        assert off_wire(wire) is None


def test_reserved_bits_of_a_multiplexed_message_are_refused(tmp_path) -> None:
    dbc = tmp_path / "m.dbc"
    dbc.write_text(
        'VERSION ""\nBU_: A\nBO_ 1 M: 8 A\n SG_ K M : 0|8@1+ (1,0) [0|1] "" A\n SG_ V m1 : 8|8@1+ (1,0) [0|1] "" A\n'
    )
    message = CanMessage(name="M", period_s=0.02, reserved_zero=True)
    functions = can_receiver.Functions(checksums={}, counters={})
    with pytest.raises(ConfigError, match="not of a multiplexed message"):
        can_receiver.MessageReader(can_receiver.load_dbc((dbc,)), message, [], functions)
