"""Frames on a serial line: bytes <-> (type, counter, payload), without I/O and independent of the payload's meaning.

On the wire: `00, COBS(type, counter, payload), check, 00`. Type and counter are a byte each; the payload's length is
fixed by the type; type, counter and payload are 16 bytes at most. The check is CRC-32 (ISO 3309, that of zlib and
Ethernet) in five bytes: 0x80 and its lowest seven bits, three more of the next seven each, 0x80 and the highest four.
It starts from `seed` instead of 0, so that two programs with different message tables reject each other's frames.

The check covers the bytes on the wire, after COBS, and contains no zeros itself: a wrong bit in a COBS code moves zeros
in the decoded data, but it is a single wrong bit for the check. The polynomial's Hamming distance (8 up to 91 bits of
data, 7 up to 171 bits: P. Koopman, 32-Bit Cyclic Redundancy Codes for Internet Applications, 2002) therefore holds for
the wire: the longest frames have 136 bits, a command 80.

A type that programs of every version must read keeps the older check of three bytes (`CRC16_CHECK`): CRC-16/DNP
(polynomial 0x3D65, reflected, final XOR 0xFFFF) as 0x40 and six bits each, the first byte of the wire last.

The zero before each frame ends any garbage, so that the first frame after garbage is not lost.

A receiver on a microcontroller needs one 22-byte buffer: collect bytes until a zero, then decode; if the buffer is
full, ignore everything up to the next zero.
"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

MAX_BODY_BYTES = 16  # type, counter and payload
_HEADER_BYTES = 2
_MAX_CHUNK_BYTES = MAX_BODY_BYTES + 1 + 5  # between two zeros, with the longer check
_POLYNOMIAL_REFLECTED = 0xA6BC  # 0x3D65 with its bits reversed


def _crc_table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value >> 1) ^ (_POLYNOMIAL_REFLECTED if value & 1 else 0)
        table.append(value)
    return tuple(table)


_CRC_TABLE = _crc_table()


def crc16_dnp(data: bytes, seed: int = 0) -> int:
    """CRC-16/DNP of `data`, started from `seed` (0 in the standard)."""
    crc, table = seed, _CRC_TABLE
    for byte in data:
        crc = (crc >> 8) ^ table[(crc ^ byte) & 0xFF]
    return crc ^ 0xFFFF


def cobs_encode(data: bytes) -> bytes:
    """Consistent overhead byte stuffing of fewer than 254 bytes: no zero in the result, one byte longer."""
    return b"".join(bytes((len(block) + 1,)) + block for block in data.split(b"\0"))


def cobs_decode(data: bytes) -> bytes | None:
    """The inverse of `cobs_encode`; None if `data` is not valid."""
    out = bytearray()
    place, end = 0, len(data)
    while place < end:
        code = data[place]
        if code == 0 or place + code > end:
            return None
        out += data[place + 1 : place + code]
        place += code
        if place < end:
            out.append(0)
    return bytes(out)


class RawFrame(NamedTuple):
    """A frame with a correct CRC."""

    type: int
    counter: int
    payload: bytes


class Check(NamedTuple):
    """What ends a frame: `length` bytes, none of them zero, from all bytes on the wire before it."""

    length: int
    of: Callable[[bytes], bytes]


def crc32_check(seed: int) -> Check:
    """CRC-32 in five bytes, started from `seed`."""
    return Check(5, functools.partial(_crc32_bytes, seed))


def _crc32_bytes(seed: int, stuffed: bytes) -> bytes:
    crc = zlib.crc32(stuffed, seed)
    return bytes(0x80 | crc >> shift & 0x7F for shift in (0, 7, 14, 21, 28))


def _crc16_bytes(stuffed: bytes) -> bytes:
    crc = crc16_dnp(stuffed[1:] + stuffed[:1])
    return bytes((0x40 | crc & 0x3F, 0x40 | crc >> 6 & 0x3F, 0x40 | crc >> 12))


CRC16_CHECK = Check(3, _crc16_bytes)


class FrameFormat(NamedTuple):
    """The constants of a frame type: the payload's length [bytes] and the check."""

    payload_bytes: int
    check: Check


@dataclass(slots=True, kw_only=True)
class FrameErrors:
    """The numbers of rejected frames by cause."""

    cobs: int = 0
    length: int = 0
    unknown_type: int = 0
    crc: int = 0

    @property
    def total(self) -> int:
        """The sum of all counters."""
        return self.cobs + self.length + self.unknown_type + self.crc


def encode(frame_type: int, counter: int, payload: bytes, check: Check) -> bytes:
    """The bytes of one frame with delimiters; raises ValueError if it is too long."""
    body = bytes((frame_type, counter)) + payload
    if len(body) > MAX_BODY_BYTES:
        raise ValueError(f"frame type {frame_type}: expected at most {MAX_BODY_BYTES} bytes, got {len(body)}")
    stuffed = cobs_encode(body)
    return b"\0" + stuffed + check.of(stuffed) + b"\0"


class Decoder:
    """Bytes in, frames out; damaged frames are counted in `errors` and rejected.

    `formats` has the accepted types. The memory is bounded: at most one frame is kept between calls.
    """

    def __init__(self, formats: Mapping[int, FrameFormat]) -> None:
        self._formats = dict(formats)
        self._tail = b""
        self.errors = FrameErrors()

    def reset(self) -> None:
        """Discard an incomplete frame; the counters are kept."""
        self._tail = b""

    def feed(self, data: bytes) -> list[RawFrame]:
        """Process `data`; gives the frames that it completes."""
        if not data:
            return []
        *chunks, tail = (self._tail + data).split(b"\0")
        self._tail = tail[: _MAX_CHUNK_BYTES + 1]  # one more than fits, so that it is still too long at its end
        frames = []
        for chunk in chunks:
            if chunk and (frame := self._decode(chunk)) is not None:
                frames.append(frame)
        return frames

    def _decode(self, chunk: bytes) -> RawFrame | None:
        errors = self.errors
        if len(chunk) > _MAX_CHUNK_BYTES:
            errors.length += 1
            return None
        known = self._formats.get(_type_of(chunk))
        if known is None:
            errors.unknown_type += 1
            return None
        stuffed, received = chunk[: -known.check.length], chunk[-known.check.length :]
        body = cobs_decode(stuffed)
        if body is None:
            errors.cobs += 1
            return None
        if len(body) != known.payload_bytes + _HEADER_BYTES:
            errors.length += 1
            return None
        if received != known.check.of(stuffed):
            errors.crc += 1
            return None
        return RawFrame(body[0], body[1], body[_HEADER_BYTES:])


def _type_of(chunk: bytes) -> int:
    """The type of a frame between its delimiters: the byte behind the first COBS code, or the zero that this means."""
    return chunk[1] if len(chunk) > 1 and chunk[0] > 1 else 0
