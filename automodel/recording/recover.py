"""Recovery of cut recordings: reads the records of an MCAP file that may end anywhere or have damaged chunks."""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, TypeAlias

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from zstandard import ZstdError

from automodel.config import ConfigError
from automodel.config.toml_reader import check_file
from automodel.output_files import output_path
from automodel.recording.codec import CAMERA, LEFT
from automodel.recording.run_file import CHUNK_BYTES
from automodel.sources.errors import SourceError

Record: TypeAlias = Schema | Channel | Message | Attachment | Metadata

_HEAD = struct.Struct("<BQ")  # opcode, length of the body
_CHUNK_HEAD = struct.Struct("<QQQII")  # start and end time, size, CRC, length of the compression name
_KEPT = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.ATTACHMENT, Opcode.METADATA)
_DAMAGE = (McapError, ValueError, KeyError, struct.error, RuntimeError, ZstdError)


def salvage(file: IO[bytes], size: int) -> Iterator[Record]:
    """All complete records from the file's position to the end of the data or the cut, in order.

    A cut chunk gives its complete records, unless it is compressed. A complete chunk with a wrong checksum is skipped.
    """
    while True:
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            return
        opcode, length = _HEAD.unpack(head)
        if opcode in (Opcode.DATA_END, 0):  # 0: blocks of zeros, which some file systems leave after a power cut
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Recovered:
    """The number of recovered messages, frames among them, and the time that they span [s]."""

    path: Path
    messages: int
    frames: int
    duration_s: float


def recovered_path(path: str | Path) -> Path:
    """The default path of the recovered file: `run.mcap` -> `run.recovered.mcap`."""
    return Path(path).with_suffix(".recovered.mcap")


def recover(path: str | Path, out: str | Path | None = None, force: bool = False) -> Recovered:
    """Write all complete messages of a cut recording into a new file; the old file is not changed.

    Raises SourceError if there is nothing to recover, ConfigError if `out` exists (unless `force`) or cannot be
    written.
    """
    source, target = Path(path), recovered_path(path) if out is None else Path(out)
    if target.exists():
        if source.exists() and target.samefile(source):
            raise ConfigError(f"{target}: is the file to recover; choose another name for the output")
        if not force:
            raise ConfigError(f"{target}: already exists; choose another name, or overwrite it with --force")
    with _open(source) as file, output_path(target) as part, open(part, "wb") as stream:
        copy = RecordCopy(stream, "automodel recover")
        for record in salvage(file, source.stat().st_size):
            copy.add(record)
        copy.finish()
        if not copy.messages:
            raise SourceError(f"{source}: nothing to recover: no complete message before the cut")
    return Recovered(path=target, messages=copy.messages, frames=copy.frames, duration_s=copy.duration_s)


class RecordCopy:
    """A new MCAP file; channels and schemas get new numbers. `writer` takes what is not copied."""

    def __init__(self, stream: IO[bytes], library: str) -> None:
        self.messages = self.frames = 0
        self._stream = stream
        self.writer: Any = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        self.writer.start(library=library)
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, tuple[int, str]] = {}
        self._first_ns: int | None = None
        self._last_ns = 0

    @property
    def duration_s(self) -> float:
        """The time between the first and the last message [s]."""
        return 0.0 if self._first_ns is None else (self._last_ns - self._first_ns) * 1e-9

    def add(self, record: object) -> None:
        """Copy a record, unless its channel or schema is lost."""
        if isinstance(record, Schema) and record.id not in self._schemas:
            self._schemas[record.id] = self.writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in self._channels and record.schema_id in self._schemas:
            schema = self._schemas[record.schema_id]
            new = self.writer.register_channel(record.topic, record.message_encoding, schema, record.metadata)
            self._channels[record.id] = (new, record.topic)
        elif isinstance(record, Message) and record.channel_id in self._channels:
            self._add_message(record)
        elif isinstance(record, Attachment):
            self.writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        elif isinstance(record, Metadata):
            self.writer.add_metadata(record.name, record.metadata)

    def finish(self) -> None:
        """Write the index; the file stays open."""
        self.writer.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())

    def _add_message(self, record: Message) -> None:
        channel, topic = self._channels[record.channel_id]
        self.writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
        self.messages += 1
        self.frames += topic in (CAMERA, LEFT)
        self._first_ns = record.log_time if self._first_ns is None else min(self._first_ns, record.log_time)
        self._last_ns = max(self._last_ns, record.log_time)


def _open(path: Path) -> IO[bytes]:
    check_file(path)
    try:
        file = open(path, "rb")  # noqa: SIM115 - handed to the caller's with
    except FileNotFoundError:
        raise SourceError(f"{path}: no such file") from None
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror}") from None
    if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        file.close()
        raise SourceError(f"{path}: not an MCAP file")
    return file
