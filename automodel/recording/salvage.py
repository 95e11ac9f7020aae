"""Reading the records of an MCAP file that may end anywhere, or have a damaged chunk."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from typing import IO, TypeAlias

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from zstandard import ZstdError

Record: TypeAlias = Schema | Channel | Message | Attachment | Metadata

_HEAD = struct.Struct("<BQ")  # opcode, length of what follows
_CHUNK_HEAD = struct.Struct("<QQQII")  # start and end time, size, CRC, length of the compression's name
_KEPT = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.ATTACHMENT, Opcode.METADATA)
_DAMAGE = (McapError, ValueError, KeyError, struct.error, RuntimeError, ZstdError)


def salvage(file: IO[bytes], size: int) -> Iterator[Record]:
    """All complete records from the file's place on, in order, up to the end of the data or the cut.

    Of a chunk that is cut, those of its records that are complete are given, unless it is compressed. A complete
    chunk whose checksum is wrong is left out as a whole.
    """
    while True:
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            return
        opcode, length = _HEAD.unpack(head)
        if opcode in (Opcode.DATA_END, 0):  # 0: blocks of zeros, that some file systems leave after a power cut
            return
        body = file.read(min(length, size))
        if opcode == Opcode.CHUNK:
            yield from _whole_chunk(body) if len(body) == length else _cut_chunk(body)
        elif opcode in _KEPT and len(body) == length:
            record = _parse(opcode, body)
            if record is not None:
                yield record


def _whole_chunk(body: bytes) -> Iterator[Record]:
    try:
        records = breakup_chunk(Chunk.read(ReadDataStream(io.BytesIO(body))), validate_crc=True)
    except _DAMAGE:
        return
    for record in records:
        if isinstance(record, Schema | Channel | Message):
            yield record


def _cut_chunk(body: bytes) -> Iterator[Record]:
    if len(body) < _CHUNK_HEAD.size:
        return
    name_length = _CHUNK_HEAD.unpack_from(body)[-1]
    if name_length:  # compressed: the end of the stream is missing
        return
    inner = io.BytesIO(body[_CHUNK_HEAD.size + 8 :])  # 8: the length of the records
    yield from salvage(inner, len(body))


def _parse(opcode: int, body: bytes) -> Record | None:
    stream = ReadDataStream(io.BytesIO(body))
    try:
        if opcode == Opcode.SCHEMA:
            return Schema.read(stream)
        if opcode == Opcode.CHANNEL:
            return Channel.read(stream)
        if opcode == Opcode.MESSAGE:
            return Message.read(stream, len(body))
        if opcode == Opcode.METADATA:
            return Metadata.read(stream)
        crc = struct.unpack("<I", body[-4:])[0]
        return Attachment.read(stream) if crc in (0, zlib.crc32(body[:-4])) else None
    except _DAMAGE:
        return None
