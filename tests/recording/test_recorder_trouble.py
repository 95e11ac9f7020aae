from __future__ import annotations

import resource
import shutil
import threading
import time
from pathlib import Path

import pytest

from automodel.config import RecordingConfig
from automodel.recording import writer as writer_module
from automodel.recording.reader import Recording
from automodel.recording.recover import recover
from automodel.recording.run_file import RunFile
from automodel.recording.writer import McapRecorder
from automodel.signals import Frame, Motion, MotionSource, StereoFrame
from automodel.sources.errors import SourceError
from tests.support.recorded_values import (
    make_command,
    make_estimate,
    make_frame,
    make_motion,
    record_turn,
)


class Gate:
    """Holds the recorder's thread while it writes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.open, self.entered = threading.Event(), threading.Event()
        write = RunFile.frame

        def frame(file: RunFile, value: Frame | StereoFrame) -> None:
            self.entered.set()
            self.open.wait(20)
            write(file, value)

        monkeypatch.setattr(RunFile, "frame", frame)


def test_a_slow_disk_costs_frames_first_and_mixes_nothing_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gate = Gate(monkeypatch)
    monkeypatch.setattr(writer_module, "_MAX_WAITING_BYTES", 3 * make_frame(0).image.nbytes)
    recorder = McapRecorder(tmp_path / "run.mcap", "", RecordingConfig())
    recorder.frame(make_frame(0))
    recorder.motion(make_motion(0))
    gate.entered.wait(20)
    for index in range(1, 20):
        record_turn(recorder, index)  # returns at once, or this test hangs
    dropped = recorder.dropped_frames
    gate.open.set()
    recorder.close()
    assert dropped == 19 - 4  # the gate's frame is out of the queue: 4 more until *more* than 3 wait
    assert recorder.dropped_values == 0
    assert "15 frames" in recorder.summary()
    recording = Recording(recorder.path)
    assert recording.counts["dropped_frames"] == dropped
    steps = list(recording.steps())
    assert [step.frame.index for step in steps] == [0, 1, 2, 3, 4]
    assert [step.motion for step in steps] == [make_motion(i) for i in range(5)]
    assert [step.commands for step in steps[1:]] == [(make_command(i),) for i in range(1, 5)]
    assert sum(message.topic == "/motion" for message in recording) == 20


def test_values_are_dropped_far_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gate = Gate(monkeypatch)
    monkeypatch.setattr(writer_module, "_MAX_WAITING", 10)
    recorder = McapRecorder(tmp_path / "run.mcap", "", RecordingConfig())
    recorder.frame(make_frame(0))
    gate.entered.wait(20)
    for index in range(25):
        recorder.command(make_command(index))
    gate.open.set()
    recorder.close()
    assert recorder.dropped_values == 15
    assert recorder.error is None


def test_a_full_disk_ends_the_recording_not_the_run(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, hard))
    try:
        recorder = McapRecorder(path, "", RecordingConfig())
        for index in range(60):
            record_turn(recorder, index)
        recorder.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert recorder.error
    record_turn(recorder, 60)
    recorder.close()
    assert "automodel recover" in recorder.summary()
    with pytest.raises(SourceError, match="automodel recover"):
        Recording(path)
    saved = recover(path)
    assert saved.messages > 0
    frames = [step.frame.index for step in Recording(saved.path).steps()]
    assert frames == list(range(len(frames)))


def test_a_value_that_cannot_be_written_is_left_out(tmp_path: Path) -> None:
    recorder = McapRecorder(tmp_path / "run.mcap", "", RecordingConfig())
    recorder.frame(make_frame(0))
    recorder.motion(Motion(t_ns=1, speed_mps=float("nan"), yaw_rate_radps=0.0))
    recorder.motion(Motion(t_ns=-1, speed_mps=0.0, yaw_rate_radps=0.0))
    recorder.command(make_command(0))
    recorder.close()
    assert (recorder.refused, recorder.error) == (2, None)
    assert "2 values left out" in recorder.summary()
    (step,) = Recording(recorder.path).steps()
    assert step.motion.source is MotionSource.NONE
    assert step.commands == (make_command(0),)


def test_what_was_written_is_on_the_disk_within_the_second_without_close(tmp_path: Path) -> None:
    recorder = McapRecorder(tmp_path / "run.mcap", "", RecordingConfig())
    for index in range(5):
        record_turn(recorder, index)
    copy, saved = tmp_path / "cut.mcap", 0
    deadline = time.monotonic() + 20.0
    while saved < 25 and time.monotonic() < deadline:
        time.sleep(0.05)
        shutil.copy(recorder.path, copy)
        try:
            saved = recover(copy, force=True).messages
        except SourceError:
            continue
    recorder.close()
    assert saved == 25


def test_every_sync_reaches_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import os

    sizes: list[int] = []
    fsync = os.fsync

    def watched(descriptor: int) -> None:
        sizes.append(os.fstat(descriptor).st_size)
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    file = RunFile(tmp_path / "run.mcap", "", RecordingConfig())
    header = sizes[0]
    file.frame(make_frame(0))
    file.value(make_estimate(0), 0)
    file.sync()
    assert sizes[-1] > header + make_frame(0).image.nbytes
    cut = tmp_path / "cut.mcap"
    cut.write_bytes((tmp_path / "run.mcap").read_bytes()[: sizes[-1]])
    file.abandon()
    assert recover(cut).messages == 2
