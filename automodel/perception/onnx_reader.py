"""Reads the parts of a protobuf message, which is what an ONNX file is, without the onnx package.

Written for files that nobody vouches for: every length is checked against what is there, nothing is copied, nothing
recurses by itself, and the number of parts is bounded, so that a file can neither hang nor surprise its reader. What
is read of a message is one level; the caller opens the parts that it wants. Stricter than protobuf where readers may
differ: no groups, no message or string that is given twice where one is wanted (protobuf would merge or replace).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

MAX_PARTS = 200_000  # of one file, at all levels together; a network of 100 layers has a few thousand

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5


class MalformedError(ValueError):
    """The bytes are no protobuf message, or not the one that was looked for."""


@dataclass(slots=True)
class Allowance:
    """How many parts may still be read of one file."""

    parts: int = MAX_PARTS

    def take(self) -> None:
        """One part more; raises MalformedError when there have been too many."""
        self.parts -= 1
        if self.parts < 0:
            raise MalformedError(f"more than {MAX_PARTS} parts")


class Message:
    """One message's parts by field number; `what` names it in errors. Raises MalformedError.

    A varint, fixed32 and fixed64 are int (unsigned); a string, bytes or a message within is a memoryview.
    """

    def __init__(self, data: memoryview, what: str, allowance: Allowance) -> None:
        self.what, self._allowance = what, allowance
        self._parts: dict[int, list[tuple[int, int | memoryview]]] = {}
        for number, kind, value in self._read(data):
            self._parts.setdefault(number, []).append((kind, value))

    @property
    def fields(self) -> frozenset[int]:
        """The numbers of the fields that are there."""
        return frozenset(self._parts)

    def messages(self, number: int, what: str) -> list[Message]:
        """All messages of a repeated field."""
        return [Message(data, what, self._allowance) for data in self.blobs(number)]

    def message(self, number: int, what: str) -> Message:
        """The one message of a field."""
        return Message(self.blob(number, what), what, self._allowance)

    def blobs(self, number: int) -> list[memoryview]:
        """The bytes of each part of a repeated field."""
        return [value for value in self._of_kind(number, BYTES) if isinstance(value, memoryview)]

    def blob(self, number: int, what: str) -> memoryview:
        """The bytes of a field that must be there once."""
        found = self.blobs(number)
        if len(found) != 1:
            raise MalformedError(f"{self.what} has {len(found)} of {what} where 1 is wanted")
        return found[0]

    def texts(self, number: int) -> list[str]:
        """A repeated field of strings."""
        return [_text(data, self.what) for data in self.blobs(number)]

    def text(self, number: int) -> str:
        """A string that may be there once; empty when it is not there."""
        found = self.texts(number)
        if len(found) > 1:
            raise MalformedError(f"{self.what} has {len(found)} strings in field {number} where 1 is wanted")
        return found[0] if found else ""

    def number(self, number: int) -> int:
        """A whole number that may be there once; 0 when it is not there."""
        found = self._of_kind(number, VARINT)
        if len(found) > 1:
            raise MalformedError(f"{self.what} has {len(found)} numbers in field {number} where 1 is wanted")
        value = found[0] if found else 0
        assert isinstance(value, int)
        return value

    def _of_kind(self, number: int, wanted: int) -> list[int | memoryview]:
        parts = self._parts.get(number, [])
        if any(kind != wanted for kind, _ in parts):
            raise MalformedError(f"field {number} of {self.what} is of another type than ONNX gives it")
        return [value for _, value in parts]

    def _read(self, data: memoryview) -> Iterator[tuple[int, int, int | memoryview]]:
        at = 0
        while at < len(data):
            self._allowance.take()
            key, at = _varint(data, at, self.what)
            number, kind = key >> 3, key & 7
            if not 0 < number < 1 << 29:
                raise MalformedError(f"{self.what} has a field {number}")
            if kind == VARINT:
                value, at = _varint(data, at, self.what)
                yield number, kind, value
                continue
            if kind == BYTES:
                size, at = _varint(data, at, self.what)
            elif kind in (FIXED32, FIXED64):
                size = 4 if kind == FIXED32 else 8
            else:
                raise MalformedError(f"{self.what} has a part of the unknown kind {kind}")
            if size > len(data) - at:
                raise MalformedError(
                    f"{self.what} ends too early: a part of {size} bytes where {len(data) - at} are left"
                )
            part = data[at : at + size]
            at += size
            yield number, kind, part if kind == BYTES else int.from_bytes(part, "little")


def _varint(data: memoryview, at: int, what: str) -> tuple[int, int]:
    """A number (unsigned, 64 bits) that begins at `at`, and where it ends."""
    value = 0
    for index in range(10):
        if at + index >= len(data):
            raise MalformedError(f"{what} ends within a number")
        byte = data[at + index]
        value |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            if value >= 1 << 64:
                break
            return value, at + index + 1
    raise MalformedError(f"{what} has a number longer than 64 bits")


def _text(data: memoryview, what: str) -> str:
    try:
        return bytes(data).decode("utf-8")
    except UnicodeDecodeError:
        raise MalformedError(f"{what} has a text that is not UTF-8") from None
