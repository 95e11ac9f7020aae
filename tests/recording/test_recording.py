from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from automodel.config import ConfigError, RecordingConfig
from automodel.recording.codec import encode
from automodel.recording.reader import Recording, RecordingSource
from automodel.recording.writer import McapRecorder
from automodel.signals import Frame, LaneEstimate, LaneStatus, StereoFrame
from automodel.sources.errors import EndOfSource, SourceError
from tests.support.recorded_values import (
    CAR_TEXT,
    make_command,
    make_estimate,
    make_event,
    make_frame,
    make_motion,
    make_state,
    record_turn,
)

Run = Callable[[int], Path]


def test_replay_has_the_frames_and_all_that_belongs_to_them(recorded_run: Run) -> None:
    steps = list(Recording(recorded_run(12)).steps())
    assert len(steps) == 12
    for index, step in enumerate(steps):
        assert isinstance(step.frame, Frame)
        np.testing.assert_array_equal(step.frame.image, make_frame(index).image)
        assert (step.frame.t_ns, step.frame.index) == (make_frame(index).t_ns, index)
        assert step.motion == make_motion(index)
        assert step.state == make_state(index)
        assert step.states == (make_state(index),)
        assert step.commands == (make_command(index),)
        assert step.estimate is not None
        assert encode(step.estimate) == encode(make_estimate(index))


def test_source_gives_frame_and_motion_in_pairs(recorded_run: Run) -> None:
    source = RecordingSource(recorded_run(3))
    for index in range(3):
        frame = source.read(0.0)
        assert frame.index == index
        assert source.step is not None
        assert source.step.motion == make_motion(index)
    with pytest.raises(EndOfSource):
        source.read(0.0)
    source.close()
    source.close()
    with pytest.raises(EndOfSource):
        source.read(0.0)


def test_messages_come_in_the_order_of_the_calls(tmp_path: Path) -> None:
    recorder = McapRecorder(tmp_path / "run.mcap", "", RecordingConfig())
    recorder.event(make_event(9))  # later in time than what follows, and before the first frame
    record_turn(recorder, 0)
    recorder.event(make_event(0))
    recorder.close()
    topics = [message.topic for message in Recording(recorder.path)]
    assert topics == ["/event", "/camera", "/motion", "/vehicle_state", "/estimate", "/command", "/event"]
    (step,) = Recording(recorder.path).steps()
    assert step.events == (make_event(9), make_event(0))


def test_the_state_is_the_newest_when_the_estimate_was_made(tmp_path: Path) -> None:
    recorder = McapRecorder(tmp_path / "run.mcap", "", RecordingConfig())
    for index in range(2):
        recorder.frame(make_frame(index))
        recorder.motion(make_motion(index))
        recorder.estimate(make_estimate(index))
        recorder.state(make_state(index))
    recorder.close()
    first, second = Recording(recorder.path).steps()
    assert first.state is None
    assert second.state == make_state(0)


def test_file_tells_its_car_calibration_versions_and_start(recorded_run: Run) -> None:
    recording = Recording(recorded_run(2))
    assert recording.car_text == CAR_TEXT
    calibration = json.loads(recording.calibration)
    assert calibration["camera"]["width_px"] == 64
    assert calibration["camera"]["intrinsics"]["fx_px"] == 480.0
    assert calibration["servo"]["pulse_us"] == [1050.0, 1500.0, 1950.0]
    assert {"automodel", "numpy", "opencv", "python", "started"} <= set(recording.origin)
    assert recording.origin["numpy"] == np.__version__
    assert recording.counts["frames"] == 2
    assert recording.counts["messages"] == 10
    assert recording.counts["dropped_frames"] == 0


def test_file_is_indexed_mcap_with_known_schemas(recorded_run: Run) -> None:
    with open(recorded_run(4), "rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
    assert summary is not None
    by_topic = {c.topic: summary.schemas[c.schema_id] for c in summary.channels.values()}
    assert (by_topic["/camera"].name, by_topic["/camera"].encoding) == ("foxglove.CompressedImage", "protobuf")
    assert all(by_topic[t].encoding == "jsonschema" for t in ("/motion", "/estimate", "/command", "/event"))
    assert summary.statistics is not None
    assert summary.statistics.message_start_time == make_frame(0).t_ns
    assert summary.chunk_indexes


def test_stereo_frames_come_back(tmp_path: Path) -> None:
    recorder = McapRecorder(tmp_path / "run.mcap", "", RecordingConfig(image="png"))
    pairs = [(make_frame(2 * i).image, make_frame(2 * i + 1).image) for i in range(3)]
    for index, (left, right) in enumerate(pairs):
        recorder.frame(StereoFrame(t_ns=index, index=index, left=left, right=right))
        recorder.motion(make_motion(index))
    recorder.close()
    steps = list(Recording(recorder.path).steps())
    for step, (left, right) in zip(steps, pairs, strict=True):
        assert isinstance(step.frame, StereoFrame)
        np.testing.assert_array_equal(step.frame.left, left)
        np.testing.assert_array_equal(step.frame.right, right)
        assert step.motion == make_motion(step.frame.index)


def test_each_image_of_a_pair_keeps_its_time_and_a_missing_camera_stays_missing(tmp_path: Path) -> None:
    recorder = McapRecorder(tmp_path / "run.mcap", "", RecordingConfig(image="png"))
    left, right = make_frame(0).image, make_frame(1).image
    frames: list[Frame | StereoFrame] = [
        StereoFrame(t_ns=1_000, index=0, left=left, right=right, right_late_ns=-3),
        Frame(t_ns=2_000, index=1, image=right, eye=1),
        StereoFrame(t_ns=3_000, index=2, left=left, right=right, right_late_ns=5),
        Frame(t_ns=4_000, index=3, image=left),
    ]
    for frame in frames:
        recorder.frame(frame)
        recorder.motion(make_motion(frame.index))
    recorder.close()
    got = [step.frame for step in Recording(recorder.path).steps()]
    assert [(type(frame), frame.t_ns, frame.index) for frame in got] == [
        (type(frame), frame.t_ns, frame.index) for frame in frames
    ]
    assert [getattr(frame, "right_late_ns", None) for frame in got] == [-3, None, 5, None]
    assert [getattr(frame, "eye", None) for frame in got] == [None, 1, None, 0]
    assert isinstance(got[1], Frame)
    np.testing.assert_array_equal(got[1].image, right)
    with open(recorder.path, "rb") as file:  # what other programs see
        times = {channel.topic: message.log_time for _, channel, message in make_reader(file).iter_messages()}
    assert (times["/camera/left"], times["/camera/right"], times["/camera"]) == (3_000, 3_005, 4_000)


def test_a_file_that_is_there_is_never_overwritten(recorded_run: Run) -> None:
    path = recorded_run(1)
    before = path.read_bytes()
    with pytest.raises(ConfigError, match="already exists"):
        McapRecorder(path, "", RecordingConfig())
    assert path.read_bytes() == before


def test_a_place_where_no_file_can_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be written"):
        McapRecorder(tmp_path / "file" / "run.mcap", "", RecordingConfig())


def test_folders_are_made(tmp_path: Path) -> None:
    recorder = McapRecorder(tmp_path / "a" / "b" / "run.mcap", "", RecordingConfig())
    recorder.close()
    with pytest.raises(SourceError, match="no frames"):
        RecordingSource(recorder.path).read(0.0)


def test_missing_foreign_and_cut_files_are_named(tmp_path: Path, recorded_run: Run) -> None:
    with pytest.raises(SourceError, match=r"none\.mcap: no such file"):
        Recording(tmp_path / "none.mcap")
    with pytest.raises(SourceError, match="cannot be read"):
        Recording(tmp_path)
    for text in ("", "hello", "a,b,c\n" * 100):
        (tmp_path / "text.mcap").write_text(text)
        with pytest.raises(SourceError, match="not an MCAP file"):
            Recording(tmp_path / "text.mcap")
    data = recorded_run(3).read_bytes()
    cut = tmp_path / "cut.mcap"
    for size in (3, 8, 9, 500, len(data) // 2, len(data) - 1):
        cut.write_bytes(data[:size])
        with pytest.raises(SourceError, match=r"is cut; run: automodel recover .*cut\.mcap"):
            Recording(cut)


def test_a_damaged_file_is_named_not_a_traceback(recorded_run: Run) -> None:
    path = recorded_run(3)
    data = bytearray(path.read_bytes())
    place = data.find(encode(make_motion(1)))
    data[place + 5] ^= 1
    path.write_bytes(data)
    with pytest.raises(SourceError, match="damaged"):
        list(Recording(path))


def test_damage_anywhere_gives_a_source_error_or_the_values(recorded_run: Run) -> None:
    path = recorded_run(2)
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    errors = 0
    for place in rng.integers(8, len(data) - 8, 150):
        broken = bytearray(data)
        broken[place] ^= int(rng.integers(1, 256))
        path.write_bytes(broken)
        try:
            list(Recording(path))
        except SourceError:
            errors += 1
    assert errors > 75  # the rest hits text that has no checksum


def test_a_lost_estimate_is_recorded_too(tmp_path: Path) -> None:
    recorder = McapRecorder(tmp_path / "run.mcap", "", RecordingConfig())
    recorder.frame(make_frame(0))
    recorder.estimate(LaneEstimate(t_ns=make_frame(0).t_ns, status=LaneStatus.LOST))
    recorder.close()
    (step,) = Recording(recorder.path).steps()
    assert step.estimate is not None
    assert step.estimate.status is LaneStatus.LOST
    assert step.estimate.pose is None
