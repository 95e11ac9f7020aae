"""The messages between host and board: one table for encoding, decoding, the documentation and the table's hash.

Each message is a frozen dataclass whose fields have their wire format as metadata; `TABLE` lists them with their type
numbers: below 0x80 to the board, above from it. Payloads are little-endian. The CRC of every frame starts from
`TABLE_HASH`, except for `Hello`: its layout and its check never change, so that two programs with different tables can
detect it.
"""

from __future__ import annotations

import dataclasses
import enum
import hashlib
import math
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Generic, NamedTuple, TypeVar

from firmware_link import framing

M = TypeVar("M")

_INTEGERS = {
    "B": (0, 0xFF),
    "H": (0, 0xFFFF),
    "I": (0, 0xFFFFFFFF),
    "h": (-0x8000, 0x7FFF),
    "i": (-1 << 31, (1 << 31) - 1),
}
C_TYPES = {"B": "uint8_t", "H": "uint16_t", "I": "uint32_t", "h": "int16_t", "i": "int32_t"}


@dataclass(frozen=True, slots=True, kw_only=True)
class WireField:
    """The wire format of one field.

    `code` is its struct code; the value is `scale` times the integer, in `unit`, or the integer itself if `scale` is
    None. The integer `none` stands for None.
    """

    name: str
    code: str
    unit: str
    scale: float | None
    none: int | None
    doc: str

    @property
    def c_type(self) -> str:
        """The integer's type in C."""
        return C_TYPES[self.code]

    @property
    def bytes(self) -> int:
        """Its length [bytes]."""
        return struct.calcsize(self.code)

    @property
    def range(self) -> tuple[int, int]:
        """The smallest and the largest integer that stands for a value."""
        low, high = _INTEGERS[self.code]
        return (low + 1 if self.none == low else low), (high - 1 if self.none == high else high)


def wire(code: str, unit: str, doc: str, *, scale: float | None = None, none: int | None = None) -> dict[str, Any]:
    """The metadata of a dataclass field for the wire; see `WireField`."""
    if none is not None and none not in _INTEGERS[code]:
        raise ValueError(f"none: {none} is not an end of the range of {code!r}")
    return {"code": code, "unit": unit, "scale": scale, "none": none, "doc": doc}


class Codec(Generic[M]):
    """Converts one message class to its payload and back.

    Scaled values are limited to the field's range; integers outside it and values that are not finite raise ValueError.
    """

    def __init__(self, cls: type[M]) -> None:
        self.cls = cls
        self.fields = tuple(WireField(name=f.name, **f.metadata) for f in dataclasses.fields(cls))  # type: ignore[arg-type]
        self._struct = struct.Struct("<" + "".join(f.code for f in self.fields))
        self._packers = tuple((f.name, _packer(f)) for f in self.fields)
        self._unpackers = tuple((f.name, _unpacker(f)) for f in self.fields)

    @property
    def payload_bytes(self) -> int:
        """The payload's length [bytes]."""
        return self._struct.size

    def pack(self, message: M) -> bytes:
        """The payload of `message`."""
        try:
            return self._struct.pack(*[packer(getattr(message, name)) for name, packer in self._packers])
        except struct.error as error:
            raise ValueError(f"{message}: {error}") from None

    def unpack(self, payload: bytes) -> M:
        """The message in `payload`, which must have the correct length."""
        raw = self._struct.unpack(payload)
        return self.cls(**{name: unpack(value) for (name, unpack), value in zip(self._unpackers, raw, strict=True)})


def _packer(field: WireField) -> Callable[[Any], int]:
    low, high = field.range
    scale, none, name = field.scale, field.none, field.name

    def scaled(value: float | None) -> int:
        if value is None and none is not None:
            return none
        if value is None or not math.isfinite(value):
            raise ValueError(f"{name}: expected a finite number, got {value}")
        return min(max(round(value / (scale or 1)), low), high)

    def whole(value: int) -> int:
        return value

    return whole if scale is None else scaled


def _unpacker(field: WireField) -> Callable[[int], float | int | None]:
    scale, none = field.scale, field.none

    def scaled(raw: int) -> float | None:
        return None if raw == none else raw * (scale or 1)

    def whole(raw: int) -> int:
        return raw

    return whole if scale is None else scaled


PROTOCOL_VERSION = 2
PULSE_STEP_US = 0.5  # the resolution of a 16-bit timer at 2 MHz
PULSE_RANGE_US = (500.0, 2500.0)  # frames with pulses outside are refused


class CommandFlag(enum.IntFlag):
    """Bits of `Command.flags`; a command with any other bit is refused."""

    FRESH = 1  # feeds the command timer; without it the pulses are ignored and the board goes to neutral and straight


class StatusFlag(enum.IntFlag):
    """Bits of `Status.flags`."""

    ARMED = 1
    NO_LIMITS = 2  # no valid Limits are known: no pulses, and Arm is refused


class Fault(enum.IntFlag):
    """Bits of `Status.faults`.

    `COMMAND_TIMEOUT` is kept until the next arming, `GYRO_FAILED` as long as it lasts; the others refer to the time
    since the last status.
    """

    COMMAND_TIMEOUT = 1 << 0  # the command timer expired while armed: disarmed
    COMMAND_LATE = 1 << 1  # a command came after its deadline: ignored
    COMMAND_REPEATED = 1 << 2  # a command's counter was not ahead of the last one: ignored
    COMMAND_REFUSED = 1 << 3  # a command with impossible pulses or unknown flags: ignored
    FRAME_ERRORS = 1 << 4  # damaged frames
    RX_OVERFLOW = 1 << 5  # received bytes were lost: the buffer was full
    TX_OVERFLOW = 1 << 6  # a message was not sent: the buffer was full
    ARM_REFUSED = 1 << 7  # an Arm with another nonce or boot id
    LIMITS_REFUSED = 1 << 8  # Limits that are inconsistent, or came while armed
    GYRO_FAILED = 1 << 9  # a gyro that worked gives no yaw rate (not for a gyro that is not fitted)


class ResetCause(enum.IntEnum):
    """`Hello.reset_cause`: the cause of the board's start."""

    POWER_ON = 0
    EXTERNAL = 1  # the reset line, for example when the port is opened
    BROWN_OUT = 2
    WATCHDOG = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """The commanded pulses. While armed, a fresh command feeds the command timer; nothing else does."""

    servo_us: float = field(metadata=wire("H", "us", "steering pulse", scale=PULSE_STEP_US))
    motor_us: float = field(metadata=wire("H", "us", "motor pulse", scale=PULSE_STEP_US))
    deadline_ms: int = field(metadata=wire("H", "ms", "board time, modulo 65536, after which the command is ignored"))
    flags: int = field(metadata=wire("B", "bits", "CommandFlag"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """The board's own limits, kept over restarts; accepted only while disarmed and answered by a Hello."""

    servo_min_us: float = field(metadata=wire("H", "us", "smallest steering pulse", scale=PULSE_STEP_US))
    servo_straight_us: float = field(metadata=wire("H", "us", "steering pulse for straight ahead", scale=PULSE_STEP_US))
    servo_max_us: float = field(metadata=wire("H", "us", "largest steering pulse", scale=PULSE_STEP_US))
    motor_min_us: float = field(metadata=wire("H", "us", "smallest motor pulse", scale=PULSE_STEP_US))
    motor_neutral_us: float = field(metadata=wire("H", "us", "motor pulse for neutral", scale=PULSE_STEP_US))
    motor_max_us: float = field(metadata=wire("H", "us", "largest motor pulse", scale=PULSE_STEP_US))
    servo_slew_us: float = field(metadata=wire("B", "us", "maximum steering change per 20 ms servo frame", scale=4.0))
    motor_slew_us: float = field(
        metadata=wire("B", "us", "maximum motor change away from neutral per servo frame", scale=4.0)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Arm:
    """Accept commands from now on; requires the nonce of the newest Status and the boot id of the Hello."""

    nonce: int = field(metadata=wire("H", "", "as in Status"))
    boot_id: int = field(metadata=wire("H", "", "as in Hello"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Disarm:
    """Neutral at once, straight after the roll-out; accepted in every state, and invalidates every earlier Arm."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HelloRequest:
    """Request a Hello."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Hello:
    """Identifies the board; sent after a start, twice a second, and on request. Its layout never changes."""

    table_hash: int = field(metadata=wire("H", "", "hash of the message table"))
    version: int = field(metadata=wire("B", "", "protocol version"))
    reset_cause: int = field(metadata=wire("B", "", "ResetCause"))
    boot_id: int = field(metadata=wire("H", "", "new after every start"))
    limits_crc: int = field(
        metadata=wire("H", "", "CRC-16/DNP of the payload of the Limits in force, of zeros without any")
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """The state of the board; 50 Hz."""

    time_us: int = field(metadata=wire("I", "us", "board time, modulo 2^32"))
    servo_us: float = field(metadata=wire("H", "us", "steering pulse at the pin", scale=PULSE_STEP_US))
    motor_us: float = field(metadata=wire("H", "us", "motor pulse at the pin", scale=PULSE_STEP_US))
    faults: int = field(metadata=wire("H", "bits", "Fault"))
    nonce: int = field(metadata=wire("H", "", "required in the next Arm; new after every start and disarming"))
    command_counter: int = field(metadata=wire("B", "", "counter of the last Command received"))
    flags: int = field(metadata=wire("B", "bits", "StatusFlag"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Odometry:
    """The motion of the car; 50 Hz."""

    time_us: int = field(metadata=wire("I", "us", "board time of the reading, modulo 2^32"))
    wheel_ticks: int = field(metadata=wire("i", "", "wheel ticks since the start, decreasing in reverse"))
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
    """The text that is hashed: names and values of bits; names, types, units and scales of each message's fields."""
    lines = [f"version {PROTOCOL_VERSION}"]
    for numbers in (CommandFlag, StatusFlag, Fault, ResetCause):
        lines += [f"{numbers.__name__} {number.name} {int(number)}" for number in numbers]
    for entry in table:
        lines.append(f"{entry.type_id} {entry.name}")
        lines += [f" {f.name} {f.code} {f.unit} {f.scale} {f.none}" for f in entry.codec.fields]
    return "\n".join(lines)


TABLE_HASH = int.from_bytes(hashlib.sha256(table_text().encode()).digest()[:2], "big")


def limits_crc(limits: Limits) -> int:
    """The value of `Hello.limits_crc` for these limits."""
    return framing.crc16_dnp(_BY_CLASS[Limits].codec.pack(limits))


def encode(message: Message, counter: int, table_hash: int = TABLE_HASH) -> bytes:
    """The frame of `message`; raises ValueError for values that cannot be encoded."""
    type_id, codec = _BY_CLASS[type(message)]
    return framing.encode(type_id, counter, codec.pack(message), check_of(type_id, table_hash))


def decode(frame: framing.RawFrame) -> Message:
    """The message in a frame of a `decoder`."""
    return _BY_TYPE[frame.type].unpack(frame.payload)


def decoder(*, on_board: bool, table_hash: int = TABLE_HASH) -> framing.Decoder:
    """A decoder for the messages that the board receives, or for those that the host receives."""
    return framing.Decoder(
        {
            entry.type_id: framing.FrameFormat(entry.codec.payload_bytes, check_of(entry.type_id, table_hash))
            for entry in TABLE
            if entry.to_board is on_board
        }
    )


def check_of(type_id: int, table_hash: int = TABLE_HASH) -> framing.Check:
    """The check of a type's frames: a Hello's has never changed."""
    return framing.CRC16_CHECK if type_id == _TYPES[Hello] else framing.crc32_check(table_hash)
