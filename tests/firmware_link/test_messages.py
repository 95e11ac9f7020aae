from __future__ import annotations

import dataclasses
import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_link import framing, messages, protocol_files
from firmware_link.messages import Codec, WireField, wire


def _value(field: WireField) -> st.SearchStrategy[Any]:
    low, high = field.range
    whole = st.integers(low, high)
    scale = field.scale
    if scale is None:
        return whole
    values = whole.map(lambda raw: raw * scale)
    return values if field.none is None else st.none() | values


MESSAGES = st.one_of(
    [st.builds(entry.codec.cls, **{f.name: _value(f) for f in entry.codec.fields}) for entry in messages.TABLE]
)


@given(MESSAGES, st.integers(0, 255))
def test_every_message_comes_back_the_same(message: messages.Message, counter: int) -> None:
    decoders = messages.decoder(on_board=True), messages.decoder(on_board=False)
    wire_bytes = messages.encode(message, counter)
    frames = [frame for decoder in decoders for frame in decoder.feed(wire_bytes)]
    assert [frame.counter for frame in frames] == [counter]
    assert messages.decode(frames[0]) == message


def test_every_message_fits_and_is_taken_by_its_side_only() -> None:
    for entry in messages.TABLE:
        assert 2 + entry.codec.payload_bytes <= framing.MAX_BODY_BYTES
        blank = messages.encode(entry.codec.unpack(bytes(entry.codec.payload_bytes)), 0)
        assert len(messages.decoder(on_board=entry.to_board).feed(blank)) == 1
        other = messages.decoder(on_board=not entry.to_board)
        assert other.feed(blank) == []
        assert other.errors.unknown_type == 1


def test_layout_of_a_command() -> None:
    """Half microseconds, little-endian, in the order of the table."""
    command = messages.Command(servo_us=1500.5, motor_us=1000.0, deadline_ms=0x1234, flags=1)
    body = bytes((0x01, 7)) + struct.pack("<HHHB", 3001, 2000, 0x1234, 1)
    assert messages.encode(command, 7) == framing.encode(0x01, 7, body[2:], framing.crc32_check(messages.TABLE_HASH))
    assert messages.encode(command, 7)[1:-6] == framing.cobs_encode(body)


def test_hello_never_changes() -> None:
    """Programs of other versions must read it: these bytes may not change."""
    hello = messages.Hello(table_hash=0x1234, version=2, reset_cause=3, boot_id=0x5678, limits_crc=0x9ABC)
    assert messages.encode(hello, 1, 0x1111) == messages.encode(hello, 1, 0x2222)
    assert messages.encode(hello, 1).hex(" ") == "00 0b 81 01 34 12 02 03 78 56 bc 9a 49 72 40 00"


def test_other_table_is_rejected() -> None:
    command = messages.Command(servo_us=1500.0, motor_us=1500.0, deadline_ms=0, flags=0)
    for other in (messages.TABLE_HASH ^ 1, messages.TABLE_HASH ^ 0x8000, 0):
        decoder = messages.decoder(on_board=True, table_hash=other)
        assert decoder.feed(messages.encode(command, 1)) == []
        assert decoder.errors.crc == 1


def test_hash_sees_every_change_of_the_table() -> None:
    text = messages.table_text()
    first = messages.TABLE[0]
    field = first.codec.fields[0]
    for change in ({"name": "other_us"}, {"code": "h"}, {"unit": "ms"}, {"scale": 1.0}, {"none": 0}):
        codec = Codec(first.codec.cls)
        codec.fields = (dataclasses.replace(field, **change), *first.codec.fields[1:])
        assert messages.table_text([messages.Entry(first.type_id, codec), *messages.TABLE[1:]]) != text
    assert messages.table_text([first._replace(type_id=0x66), *messages.TABLE[1:]]) != text
    assert "Fault COMMAND_LATE 2" in text


def test_values_beyond_the_range_go_out_as_the_nearest_and_never_as_none() -> None:
    odometry = messages.Odometry(time_us=0, wheel_ticks=-5, yaw_rate_radps=-100.0)
    back = messages.decode(messages.decoder(on_board=False).feed(messages.encode(odometry, 0))[0])
    assert isinstance(back, messages.Odometry)
    assert back.wheel_ticks == -5
    assert back.yaw_rate_radps == pytest.approx(-32767 * 2e-4)
    ranges = messages.Ranges(time_us=0, left_m=1e9, centre_m=None, right_m=-1.0, battery_v=7.4)
    got = messages.decode(messages.decoder(on_board=False).feed(messages.encode(ranges, 0))[0])
    assert got == messages.Ranges(time_us=0, left_m=65.534, centre_m=None, right_m=0.0, battery_v=7.4)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), None])
def test_not_finite_is_refused(bad: Any) -> None:
    with pytest.raises(ValueError, match="servo_us"):
        messages.encode(messages.Command(servo_us=bad, motor_us=1500.0, deadline_ms=0, flags=0), 0)


def test_whole_number_beyond_the_range_is_refused() -> None:
    with pytest.raises(ValueError, match="Command"):
        messages.encode(messages.Command(servo_us=1500.0, motor_us=1500.0, deadline_ms=70000, flags=0), 0)


def test_none_must_be_an_end_of_the_range() -> None:
    with pytest.raises(ValueError, match="none"):
        wire("H", "m", "a range", none=7)


def test_readme_has_the_current_tables() -> None:
    text = protocol_files.README.read_text(encoding="utf-8")
    assert protocol_files.current(text) == text, "make them anew: python -m firmware_link.protocol_files"
    assert f"{messages.TABLE_HASH:#06x}" in text


def test_tables_are_written_between_the_markers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    readme = tmp_path / "README.md"
    readme.write_text(f"before\n{protocol_files.BEGIN}\nold\n{protocol_files.END}\nafter\n")
    monkeypatch.setattr(protocol_files, "README", readme)
    monkeypatch.setattr(protocol_files, "HEADER", tmp_path / "protocol.h")
    protocol_files.main()
    text = readme.read_text()
    assert (
        text == f"before\n{protocol_files.BEGIN}\n\n{protocol_files.protocol_tables()}\n{protocol_files.END}\nafter\n"
    )


def test_readme_without_markers_is_refused() -> None:
    with pytest.raises(ValueError, match="markers"):
        protocol_files.current("nothing here")
