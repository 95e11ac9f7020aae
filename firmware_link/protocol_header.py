"""The message table as a C++ header for the board's program; `python -m firmware_link.protocol_header` writes it."""

from __future__ import annotations

import enum
from pathlib import Path

from firmware_link import messages
from firmware_link.codec import WireField
from firmware_link.emulator import logic

HEADER = Path(__file__).parent / "firmware" / "src" / "logic" / "protocol.h"
_BYTES_WORDS = {1: "8", 2: "16", 4: "32"}


def protocol_header() -> str:
    """The whole header: the table's hash, bits, defaults, one struct a message, payload lengths by type."""
    parts = [
        "// Made from the message table (firmware_link/messages.py) by `python -m firmware_link.protocol_header`.\n"
        "// Do not edit: change the table, then make it anew.\n#pragma once\n\n#include <stdint.h>\n\n"
        '#include "wire.h"\n\nnamespace protocol {',
        _constants(),
        *[_numbers(kind) for kind in (messages.CommandFlag, messages.StatusFlag, messages.Fault, messages.ResetCause)],
        *[_message(entry) for entry in messages.TABLE],
        _default_limits(),
        _payload_bytes(),
        "}  // namespace protocol",
    ]
    return "\n\n".join(parts) + "\n"


def main() -> None:
    """Write the header into the firmware's folder."""
    HEADER.write_text(protocol_header(), encoding="utf-8")


def _constants() -> str:
    low_us, high_us = messages.PULSE_RANGE_US
    return "\n".join(
        [
            f"constexpr uint8_t kVersion = {messages.PROTOCOL_VERSION};",
            f"constexpr uint16_t kTableHash = {messages.TABLE_HASH:#06x};",
            f"constexpr uint16_t kPulseMin = {_steps(low_us)};  // [0.5 us]",
            f"constexpr uint16_t kPulseMax = {_steps(high_us)};  // [0.5 us]",
            f"constexpr uint16_t kCommandTimeoutMs = {logic.COMMAND_TIMEOUT_MS};",
            f"constexpr uint16_t kMaxDeadlineMs = {logic.MAX_DEADLINE_MS};",
            f"constexpr uint16_t kNonceStep = {logic.NONCE_STEP:#06x};",
        ]
    )


def _numbers(kind: type[enum.IntFlag] | type[enum.IntEnum]) -> str:
    code = "uint16_t" if kind is messages.Fault else "uint8_t"
    lines = [f"constexpr {code} {_constant(number.name)} = {int(number)};" for number in kind]
    return "\n".join([f"namespace {_snake(kind.__name__)} {{", *lines, f"}}  // namespace {_snake(kind.__name__)}"])


def _message(entry: messages.Entry) -> str:
    fields = entry.codec.fields
    lines = [
        f"struct {entry.name} {{",
        f"  static constexpr uint8_t kType = {entry.type_id:#04x};",
        f"  static constexpr uint8_t kBytes = {entry.codec.payload_bytes};",
        *[f"  {field.c_type} {field.name};{_comment(field)}" for field in fields],
        *[f"  static constexpr {f.c_type} {_constant('no_' + f.name)} = {_literal(f)};" for f in fields if f.none],
    ]
    if fields and entry.to_board:
        lines += ["", f"  static {entry.name} read(const uint8_t* payload) {{", f"    {entry.name} message;"]
        lines += [f"    message.{f.name} = wire::get{_width(f)}(payload + {at});" for f, at in _placed(fields)]
        lines += ["    return message;", "  }"]
    elif fields:
        lines += ["", "  void write(uint8_t* payload) const {"]
        lines += [f"    wire::put{_width(f)}(payload + {at}, {_unsigned(f)});" for f, at in _placed(fields)]
        lines += ["  }"]
    return "\n".join([*lines, "};"])


def _default_limits() -> str:
    entry = next(entry for entry in messages.TABLE if entry.codec.cls is messages.Limits)
    payload = entry.codec.pack(logic.DEFAULT_LIMITS)
    begin = "constexpr uint8_t kDefaultLimits[Limits::kBytes] = {"
    numbers = [f"{byte:#04x}" for byte in payload]
    rows = [", ".join(numbers[:7]), ", ".join(numbers[7:])]
    return (
        "// The payload of the limits that hold until others are set.\n"
        f"{begin}{rows[0]},\n{' ' * len(begin)}{rows[1]}}};"
    )


def _payload_bytes() -> str:
    cases = [f"    case {e.name}::kType:\n      return {e.name}::kBytes;" for e in messages.TABLE if e.to_board]
    return "\n".join(
        [
            "constexpr uint8_t kUnknownType = 0xff;",
            "",
            "// The payload's length of a message to the board, or kUnknownType.",
            "inline uint8_t payload_bytes(uint8_t type) {",
            "  switch (type) {",
            *cases,
            "    default:\n      return kUnknownType;",
            "  }",
            "}",
        ]
    )


def _comment(field: WireField) -> str:
    unit = field.unit if field.scale is None else f"{field.scale:g} {field.unit}"
    return f"  // {f'[{unit}] ' if unit else ''}{field.doc}"


def _placed(fields: tuple[WireField, ...]) -> list[tuple[WireField, int]]:
    places = [sum(field.bytes for field in fields[:index]) for index in range(len(fields))]
    return list(zip(fields, places, strict=True))


def _width(field: WireField) -> str:
    return _BYTES_WORDS[field.bytes]


def _unsigned(field: WireField) -> str:
    return field.name if field.c_type.startswith("u") else f"static_cast<u{field.c_type}>({field.name})"


def _literal(field: WireField) -> str:
    return f"{field.none}" if field.none is None or field.none >= 0 else f"{field.none + 1} - 1"


def _constant(name: str | None) -> str:
    return "k" + "".join(word.capitalize() for word in str(name).lower().split("_"))


def _snake(name: str) -> str:
    return "".join(f"_{letter.lower()}" if letter.isupper() else letter for letter in name).lstrip("_")


def _steps(pulse_us: float) -> int:
    return round(pulse_us / messages.PULSE_STEP_US)


if __name__ == "__main__":
    main()
