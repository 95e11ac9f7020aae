"""The messages between host and board: the one table that encoding, decoding, documents and the table's hash come from.

Each message is a frozen dataclass whose fields carry their wire format; `TABLE` lists them with their type numbers.
Numbers below 0x80 go to the board, those above come from it. Every frame's CRC starts from `TABLE_HASH`, but for
`Hello`: its layout never changes and its CRC starts from 0, so that two programs with different tables still learn
of it.
"""

from __future__ import annotations

import enum
import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from firmware_link import framing
from firmware_link.codec import Codec, wire

PROTOCOL_VERSION = 1
PULSE_STEP_US = 0.5  # what a 16-bit timer at 2 MHz resolves
PULSE_RANGE_US = (500.0, 2500.0)  # a pulse outside is no servo pulse: the frame is refused


class CommandFlag(enum.IntFlag):
    """Bits of `Command.flags`; a command with any other bit is refused."""

    FRESH = 1  # feeds the command timer; without it the pulses are ignored: neutral and straight


class StatusFlag(enum.IntFlag):
    """Bits of `Status.flags`."""

    ARMED = 1


class Fault(enum.IntFlag):
    """Bits of `Status.faults`.

    `COMMAND_TIMEOUT` stays until the next arming, `GYRO_FAILED` as long as it lasts; the others tell of the time since
    the last status.
    """

    COMMAND_TIMEOUT = 1 << 0  # the command timer ran out while armed: disarmed
    COMMAND_LATE = 1 << 1  # a command came after its deadline: ignored
    COMMAND_REPEATED = 1 << 2  # a command's counter was not ahead of the last one's: ignored
    COMMAND_REFUSED = 1 << 3  # a command with impossible pulses or unknown flags: ignored
    FRAME_ERRORS = 1 << 4  # damaged frames
    RX_OVERFLOW = 1 << 5  # bytes lost for want of room
    TX_OVERFLOW = 1 << 6  # a message left out for want of room
    ARM_REFUSED = 1 << 7  # an Arm with another nonce or boot id
    LIMITS_REFUSED = 1 << 8  # Limits that contradict themselves, or came while armed
    GYRO_FAILED = 1 << 9  # a gyro that was there gives no yaw rate; one that is not fitted is none


class ResetCause(enum.IntEnum):
    """`Hello.reset_cause`: why the board started."""

    POWER_ON = 0
    EXTERNAL = 1  # the reset line, as when the port is opened
    BROWN_OUT = 2
    WATCHDOG = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """The pulses wanted. While armed, one that is fresh feeds the command timer; nothing else does."""

    servo_us: float = field(metadata=wire("H", "us", "steering pulse", scale=PULSE_STEP_US))
    motor_us: float = field(metadata=wire("H", "us", "motor pulse", scale=PULSE_STEP_US))
    deadline_ms: int = field(metadata=wire("H", "ms", "board time, modulo 65536, after which it is ignored"))
    flags: int = field(metadata=wire("B", "bits", "CommandFlag"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """The board's own limits, kept over restarts; taken only while disarmed and answered by a Hello."""

    servo_min_us: float = field(metadata=wire("H", "us", "least steering pulse", scale=PULSE_STEP_US))
    servo_straight_us: float = field(metadata=wire("H", "us", "steering pulse for straight ahead", scale=PULSE_STEP_US))
    servo_max_us: float = field(metadata=wire("H", "us", "greatest steering pulse", scale=PULSE_STEP_US))
    motor_min_us: float = field(metadata=wire("H", "us", "least motor pulse", scale=PULSE_STEP_US))
    motor_neutral_us: float = field(metadata=wire("H", "us", "motor pulse for neutral", scale=PULSE_STEP_US))
    motor_max_us: float = field(metadata=wire("H", "us", "greatest motor pulse", scale=PULSE_STEP_US))
    servo_slew_us: float = field(metadata=wire("B", "us", "steering change per 20 ms servo frame, at most", scale=4.0))
    motor_slew_us: float = field(metadata=wire("B", "us", "motor change away from neutral per servo frame", scale=4.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Arm:
    """Accept commands from now on; works only with the nonce of the newest status and the boot id of the hello."""

    nonce: int = field(metadata=wire("H", "", "as in Status"))
    boot_id: int = field(metadata=wire("H", "", "as in Hello"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Disarm:
    """Neutral and straight at once; taken in every state, and voids every Arm sent before it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HelloRequest:
    """Say hello now."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Hello:
    """Who the board is; sent after a start, twice a second, and when asked. Its layout never changes."""

    table_hash: int = field(metadata=wire("H", "", "hash of the message table"))
    version: int = field(metadata=wire("B", "", "protocol version"))
    reset_cause: int = field(metadata=wire("B", "", "ResetCause"))
    boot_id: int = field(metadata=wire("H", "", "another one after every start"))
    limits_crc: int = field(metadata=wire("H", "", "CRC-16/DNP of the payload of the Limits in force"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """What the board does; 50 Hz."""

    time_us: int = field(metadata=wire("I", "us", "board time, modulo 2^32"))
    servo_us: float = field(metadata=wire("H", "us", "steering pulse at the pin", scale=PULSE_STEP_US))
    motor_us: float = field(metadata=wire("H", "us", "motor pulse at the pin", scale=PULSE_STEP_US))
    faults: int = field(metadata=wire("H", "bits", "Fault"))
    nonce: int = field(metadata=wire("H", "", "what the next Arm must say; new after every start and disarming"))
    command_counter: int = field(metadata=wire("B", "", "counter of the last Command received"))
    flags: int = field(metadata=wire("B", "bits", "StatusFlag"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Odometry:
    """How the car moves; 50 Hz."""

    time_us: int = field(metadata=wire("I", "us", "board time of the reading, modulo 2^32"))
    wheel_ticks: int = field(metadata=wire("i", "", "wheel ticks since the start, down in reverse"))
    yaw_rate_radps: float | None = field(
        metadata=wire("h", "rad/s", "anticlockwise positive; none without a gyro", scale=2e-4, none=-0x8000)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Ranges:
    """Ultrasonic ranges and the battery; 50 Hz."""

    time_us: int = field(metadata=wire("I", "us", "board time of the reading, modulo 2^32"))
    left_m: float | None = field(metadata=wire("H", "m", "none without an echo", scale=1e-3, none=0xFFFF))
    centre_m: float | None = field(metadata=wire("H", "m", "none without an echo", scale=1e-3, none=0xFFFF))
    right_m: float | None = field(metadata=wire("H", "m", "none without an echo", scale=1e-3, none=0xFFFF))
    battery_v: float = field(metadata=wire("H", "V", "battery", scale=1e-3))


ToBoard = Command | Limits | Arm | Disarm | HelloRequest
FromBoard = Hello | Status | Odometry | Ranges
Message = ToBoard | FromBoard


class Entry(NamedTuple):
    """One row of the message table."""

    type_id: int
    codec: Codec[Message]

    @property
    def name(self) -> str:
        """The message's name."""
        return self.codec.cls.__name__

    @property
    def to_board(self) -> bool:
        """Whether the host sends it."""
        return self.type_id < 0x80


_TYPES: dict[type[Message], int] = {
    Command: 0x01,
    Limits: 0x02,
    Arm: 0x03,
    Disarm: 0x04,
    HelloRequest: 0x05,
    Hello: 0x81,
    Status: 0x82,
    Odometry: 0x83,
    Ranges: 0x84,
}
TABLE = tuple(Entry(type_id, Codec(cls)) for cls, type_id in _TYPES.items())
_BY_CLASS = {entry.codec.cls: entry for entry in TABLE}
_BY_TYPE = {entry.type_id: entry.codec for entry in TABLE}


def table_text(table: Iterable[Entry] = TABLE) -> str:
    """The table as the hash sees it: names and values of bits; per message its fields' names, types, units, scales."""
    lines = [f"version {PROTOCOL_VERSION}"]
    for numbers in (CommandFlag, StatusFlag, Fault, ResetCause):
        lines += [f"{numbers.__name__} {number.name} {int(number)}" for number in numbers]
    for entry in table:
        lines.append(f"{entry.type_id} {entry.name}")
        lines += [f" {f.name} {f.code} {f.unit} {f.scale} {f.none}" for f in entry.codec.fields]
    return "\n".join(lines)


TABLE_HASH = int.from_bytes(hashlib.sha256(table_text().encode()).digest()[:2], "big")


def limits_crc(limits: Limits) -> int:
    """What `Hello.limits_crc` says when these limits are in force."""
    return framing.crc16_dnp(_BY_CLASS[Limits].codec.pack(limits))


def encode(message: Message, counter: int, table_hash: int = TABLE_HASH) -> bytes:
    """The frame of `message`; raises ValueError for values that have no place on the wire."""
    type_id, codec = _BY_CLASS[type(message)]
    return framing.encode(type_id, counter, codec.pack(message), _seed(type_id, table_hash))


def decode(frame: framing.RawFrame) -> Message:
    """The message in a frame of a `decoder`."""
    return _BY_TYPE[frame.type].unpack(frame.payload)


def decoder(*, on_board: bool, table_hash: int = TABLE_HASH) -> framing.Decoder:
    """A decoder for what the board receives, or for what the host receives."""
    return framing.Decoder(
        {
            entry.type_id: framing.FrameFormat(entry.codec.payload_bytes, _seed(entry.type_id, table_hash))
            for entry in TABLE
            if entry.to_board is on_board
        }
    )


def _seed(type_id: int, table_hash: int) -> int:
    return 0 if type_id == _TYPES[Hello] else table_hash
