"""Making a whole recording out of a cut one."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from automodel.config import ConfigError
from automodel.recording.images import CAMERA, LEFT
from automodel.recording.run_file import CHUNK_BYTES
from automodel.recording.salvage import salvage
from automodel.sources.errors import SourceError


@dataclass(frozen=True, slots=True, kw_only=True)
class Recovered:
    """What was saved: messages of all kinds, frames among them, and the time that they span [s]."""

    path: Path
    messages: int
    frames: int
    duration_s: float


def recovered_path(path: str | Path) -> Path:
    """Where the recovered file goes by default: `run.mcap` -> `run.recovered.mcap`."""
    return Path(path).with_suffix(".recovered.mcap")


def recover(path: str | Path, out: str | Path | None = None, force: bool = False) -> Recovered:
    """Write all complete messages of a cut recording into a new file; the old one is left as it is.

    Raises SourceError when there is nothing to save, ConfigError when `out` is there already (unless `force`) or
    cannot be written.
    """
    source, target = Path(path), recovered_path(path) if out is None else Path(out)
    if target.exists():
        if source.exists() and target.samefile(source):
            raise ConfigError(f"{target}: is the file to recover; choose another name for the output")
        if not force:
            raise ConfigError(f"{target}: is there already; choose another name, or overwrite it with --force")
    part = target.with_name(target.name + ".part")
    with _open(source) as file:
        try:
            with open(part, "wb") as stream:
                copy = _Copy(stream)
                for record in salvage(file, source.stat().st_size):
                    copy.add(record)
                copy.finish()
            if copy.messages:
                os.replace(part, target)
        except OSError as error:
            raise ConfigError(f"{target}: cannot be written: {error.strerror}") from None
        finally:
            part.unlink(missing_ok=True)
    if not copy.messages:
        raise SourceError(f"{source}: nothing to recover: no complete message before the cut")
    return Recovered(path=target, messages=copy.messages, frames=copy.frames, duration_s=copy.duration_s)


class _Copy:
    """A new MCAP file that records are put into, channels and schemas numbered anew."""

    def __init__(self, stream: IO[bytes]) -> None:
        self.messages = self.frames = 0
        self._stream = stream
        self._writer: Any = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(library="automodel recover")
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, tuple[int, str]] = {}
        self._first_ns: int | None = None
        self._last_ns = 0

    @property
    def duration_s(self) -> float:
        return 0.0 if self._first_ns is None else (self._last_ns - self._first_ns) * 1e-9

    def add(self, record: object) -> None:
        """Copy a record; one that refers to a channel or schema that is lost is left out."""
        if isinstance(record, Schema) and record.id not in self._schemas:
            self._schemas[record.id] = self._writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in self._channels and record.schema_id in self._schemas:
            schema = self._schemas[record.schema_id]
            new = self._writer.register_channel(record.topic, record.message_encoding, schema, record.metadata)
            self._channels[record.id] = (new, record.topic)
        elif isinstance(record, Message) and record.channel_id in self._channels:
            self._add_message(record)
        elif isinstance(record, Attachment):
            self._writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )
        elif isinstance(record, Metadata):
            self._writer.add_metadata(record.name, record.metadata)

    def finish(self) -> None:
        self._writer.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())

    def _add_message(self, record: Message) -> None:
        channel, topic = self._channels[record.channel_id]
        self._writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
        self.messages += 1
        self.frames += topic in (CAMERA, LEFT)
        self._first_ns = record.log_time if self._first_ns is None else min(self._first_ns, record.log_time)
        self._last_ns = max(self._last_ns, record.log_time)


def _open(path: Path) -> IO[bytes]:
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
