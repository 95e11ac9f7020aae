from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from automodel.config import ConfigError
from automodel.recording.reader import Recording
from automodel.recording.recover import recover, recovered_path
from automodel.sources.errors import SourceError

Run = Callable[[int], Path]
Raw = tuple[str, int, int, bytes]


def raw_messages(path: Path) -> list[Raw]:
    """Topic, time, sequence and data of every message, by the library's own reader."""
    with open(path, "rb") as file:
        found = make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        return [(c.topic, m.log_time, m.sequence, m.data) for _, c, m in found]


def ends_of(data: bytes, messages: list[Raw]) -> list[int]:
    """Where each message's record ends in the file: its payload stands there as it is, and is the record's end."""
    ends, place = [], 0
    for message in messages:
        place = data.index(message[3], place) + len(message[3])
        ends.append(place)
    return ends


def test_a_cut_at_any_byte_keeps_every_message_before_it(recorded_run: Run, tmp_path: Path) -> None:
    path = recorded_run(8)
    data, messages = path.read_bytes(), raw_messages(path)
    ends = ends_of(data, messages)
    cut, out = tmp_path / "cut.mcap", tmp_path / "whole.mcap"
    sizes = {int(s) for s in np.random.default_rng(1).integers(ends[0], len(data), 60)}
    sizes |= {end + step for end in ends[::5] for step in (-1, 0, 1)} | {ends[0], len(data) - 1}
    for size in sorted(s for s in sizes if s >= ends[0]):
        cut.write_bytes(data[:size])
        whole = sum(end <= size for end in ends)
        report = recover(cut, out, force=True)
        assert raw_messages(out) == messages[:whole], size
        assert report.messages == whole
        assert report.frames == sum(topic == "/camera" for topic, *_ in messages[:whole])


def test_what_is_recovered_is_a_recording(recorded_run: Run, tmp_path: Path) -> None:
    path = recorded_run(6)
    original = Recording(path)
    data = path.read_bytes()
    place = ends_of(data, raw_messages(path))[-2]
    path.write_bytes(data[:place])
    report = recover(path)
    assert report.path == recovered_path(path) == tmp_path / "run.recovered.mcap"
    recording = Recording(report.path)
    assert recording.car_text == original.car_text
    assert recording.origin == original.origin
    assert recording.calibration == original.calibration
    steps = list(recording.steps())
    assert len(steps) == 6
    assert steps[-1].estimate is not None
    assert steps[-1].commands == ()
    assert report.duration_s == pytest.approx(5 * 16_666_667e-9, rel=0.05)


def test_zeros_after_the_cut_are_not_read(recorded_run: Run) -> None:
    path = recorded_run(6)
    data, messages = path.read_bytes(), raw_messages(path)
    ends = ends_of(data, messages)
    path.write_bytes(data[: ends[12]] + bytes(8192))
    assert raw_messages(recover(path).path) == messages[:13]


def test_nothing_to_recover(tmp_path: Path, recorded_run: Run) -> None:
    path = recorded_run(2)
    data = path.read_bytes()
    first = ends_of(data, raw_messages(path))[0]
    cut = tmp_path / "cut.mcap"
    for size in (8, 9, 200, first - 1):
        cut.write_bytes(data[:size])
        with pytest.raises(SourceError, match="nothing to recover"):
            recover(cut)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cut.mcap", "run.mcap"]


def test_missing_and_foreign_files(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no such file"):
        recover(tmp_path / "none.mcap")
    (tmp_path / "text.mcap").write_text("hello, not MCAP")
    with pytest.raises(SourceError, match="not an MCAP file"):
        recover(tmp_path / "text.mcap")


def test_the_output_is_not_overwritten_without_force(recorded_run: Run, tmp_path: Path) -> None:
    path, out = recorded_run(1), tmp_path / "out.mcap"
    out.write_text("mine")
    with pytest.raises(ConfigError, match="--force"):
        recover(path, out)
    assert out.read_text() == "mine"
    recover(path, out, force=True)
    assert len(raw_messages(out)) == 5


def test_the_file_itself_is_never_the_output(recorded_run: Run) -> None:
    path = recorded_run(1)
    before = path.read_bytes()
    with pytest.raises(ConfigError, match="choose another name"):
        recover(path, path, force=True)
    assert path.read_bytes() == before


def test_a_place_that_cannot_be_written(recorded_run: Run, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be written"):
        recover(recorded_run(1), tmp_path / "no" / "such" / "folder.mcap")


def test_a_chunk_that_is_damaged_is_left_out_and_the_next_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "chunks.mcap"
    with open(path, "wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start()
        channel = writer.register_channel("/any", "json", writer.register_schema("any", "jsonschema", b"{}"))
        for number in range(30):
            writer.add_message(channel, number, b"message-%02d" % number, number)
            if number % 10 == 9:
                writer.flush()
        writer.finish()
    data = bytearray(path.read_bytes())
    data[data.find(b"message-13")] ^= 1
    path.write_bytes(data)
    kept = [data for *_, data in raw_messages(recover(path).path)]
    assert kept == [b"message-%02d" % n for n in (*range(10), *range(20, 30))]


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_compressed_files_of_others_lose_the_cut_chunk_only(tmp_path: Path, compression: CompressionType) -> None:
    path = tmp_path / "compressed.mcap"
    with open(path, "wb") as stream:
        writer = Writer(stream, compression=compression)
        writer.start()
        channel = writer.register_channel("/any", "json", writer.register_schema("any", "jsonschema", b"{}"))
        for number in range(20):
            writer.add_message(channel, number, b"message-%02d" % number, number)
            if number == 9:
                writer.flush()
                stream.flush()
                first = stream.tell()
        writer.finish()
    path.write_bytes(path.read_bytes()[: first + 70])  # 53 bytes are the chunk's head
    assert len(raw_messages(recover(path).path)) == 10
