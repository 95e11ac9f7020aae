"""Dataclasses <-> fixed little-endian payloads, from the wire format noted at each field."""

from __future__ import annotations

import dataclasses
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

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
    """How one field lies on the wire.

    `code` is its struct code; the value is `scale` times the integer there, in `unit`; where `scale` is None the
    value is that integer. The integer `none` stands for "not there" (None).
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
        """How many bytes it takes."""
        return struct.calcsize(self.code)

    @property
    def range(self) -> tuple[int, int]:
        """The least and the greatest integer that stands for a value."""
        low, high = _INTEGERS[self.code]
        return (low + 1 if self.none == low else low), (high - 1 if self.none == high else high)


def wire(code: str, unit: str, doc: str, *, scale: float | None = None, none: int | None = None) -> dict[str, Any]:
    """The metadata of a dataclass field that goes over the wire; see `WireField`."""
    if none is not None and none not in _INTEGERS[code]:
        raise ValueError(f"none: {none} is not an end of the range of {code!r}")
    return {"code": code, "unit": unit, "scale": scale, "none": none, "doc": doc}


class Codec(Generic[M]):
    """One message class <-> its payload.

    Scaled values beyond the field's range go out as the nearest that fits; integers beyond it, and values that are
    not finite, raise ValueError.
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
        """The message in `payload`, which must have the right length."""
        raw = self._struct.unpack(payload)
        return self.cls(**{name: unpack(value) for (name, unpack), value in zip(self._unpackers, raw, strict=True)})


def _packer(field: WireField) -> Callable[[Any], int]:
    low, high = field.range
    scale, none, name = field.scale, field.none, field.name

    def scaled(value: float | None) -> int:
        if value is None and none is not None:
            return none
        if value is None or not math.isfinite(value):
            raise ValueError(f"{name}: {value} where a finite number is wanted")
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
