"""Reading a recording: its messages in the order in which they were written, and its frames as a source."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, McapRecord, Message
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError

from automodel.config.toml_reader import check_file
from automodel.recording.codec import CAMERA, CAMERA_TOPICS, LEFT, RIGHT, TOPICS, Value, decode, decode_image
from automodel.recording.run_file import CALIBRATION, CAR_TOML, END_METADATA, METADATA
from automodel.signals import (
    Command,
    DriverInput,
    Event,
    Frame,
    LaneEstimate,
    Motion,
    MotionSource,
    StereoFrame,
    VehicleState,
)
from automodel.sources.errors import EndOfSource, SourceError

_DAMAGE = (McapError, ValueError, KeyError, struct.error, OverflowError, MemoryError, RuntimeError, ZstdError)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recorded:
    """One message: its value, its topic and the index of its frame."""

    topic: str
    frame_index: int
    value: Frame | StereoFrame | Value


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """One recorded step of the loop: a frame and its values.

    `motion` is the pipeline's input with the frame (source NONE if none was recorded); `state` is the newest vehicle
    state at the time of the estimate; `driver` is what the person wanted who drove, None where the pipeline did.
    `states`, `commands` and `events` are all values up to the next frame, in order.
    """

    frame: Frame | StereoFrame
    motion: Motion
    state: VehicleState | None = None
    estimate: LaneEstimate | None = None
    driver: DriverInput | None = None
    states: tuple[VehicleState, ...] = ()
    commands: tuple[Command, ...] = ()
    events: tuple[Event, ...] = ()


class Recording:
    """A run's MCAP file.

    `car_text` is the car.toml of the run, `calibration` its calibration (JSON), `origin` the versions and the wall time
    of the start, `counts` the numbers of written and dropped values. Raises SourceError for a file that is missing, not
    MCAP or cut (with the command that recovers it), and while reading, for a damaged one.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.car_text, self.calibration = "", ""
        self.origin: dict[str, str] = {}
        self.counts: dict[str, int] = {}
        with self._open() as file:
            self._check_ends(file)
            try:
                self._read_header(file)
            except _DAMAGE as error:
                raise self._damaged(error) from None

    def __iter__(self) -> Iterator[Recorded]:
        """All messages in the order in which they were written, without topics of other programs."""
        left: Frame | None = None
        for topic, record in self.records():
            if not isinstance(record, Message):
                continue
            try:
                if topic == LEFT:
                    left = _recorded_frame(record)
                elif topic in CAMERA_TOPICS or topic in TOPICS.values():
                    yield _recorded(topic, record, left)
            except _DAMAGE as error:
                raise self._damaged(error) from None

    def records(self) -> Iterator[tuple[str, McapRecord]]:
        """All records of the file as they are, each after its topic; "" for those that are no message."""
        channels: dict[int, Channel] = {}
        with self._open() as file:
            try:
                for record in StreamReader(file, validate_crcs=True).records:
                    if isinstance(record, Channel):
                        channels[record.id] = record
                    yield channels[record.channel_id].topic if isinstance(record, Message) else "", record
            except _DAMAGE as error:
                raise self._damaged(error) from None

    def steps(self) -> Iterator[Step]:
        """The steps of the loop, one per frame; values recorded before the first frame belong to its step."""
        waiting: list[Recorded] = []
        frame: Frame | StereoFrame | None = None
        state: VehicleState | None = None
        for message in self:
            if isinstance(message.value, Frame | StereoFrame):
                if frame is not None:
                    step = _step(frame, state, waiting)
                    state = step.states[-1] if step.states else state
                    yield step
                    waiting = []
                frame = message.value
            else:
                waiting.append(message)
        if frame is not None:
            yield _step(frame, state, waiting)

    def _open(self) -> IO[bytes]:
        check_file(self.path)
        try:
            return open(self.path, "rb")
        except FileNotFoundError:
            raise SourceError(f"{self.path}: no such file") from None
        except OSError as error:
            raise SourceError(f"{self.path}: cannot be read: {error.strerror}") from None

    def _check_ends(self, file: IO[bytes]) -> None:
        size = file.seek(0, 2)
        file.seek(0)
        start = file.read(len(MCAP0_MAGIC))
        file.seek(max(size - len(MCAP0_MAGIC), 0))
        end = file.read(len(MCAP0_MAGIC))
        file.seek(0)
        if not start or not MCAP0_MAGIC.startswith(start):
            raise SourceError(f"{self.path}: not an MCAP file")
        if end != MCAP0_MAGIC or size < 2 * len(MCAP0_MAGIC):
            raise SourceError(f"{self.path}: the file is cut; run: automodel recover {self.path}")

    def _read_header(self, file: IO[bytes]) -> None:
        reader: Any = make_reader(file)
        for attachment in reader.iter_attachments():
            if attachment.name == CAR_TOML:
                self.car_text = attachment.data.decode()
            elif attachment.name == CALIBRATION:
                self.calibration = attachment.data.decode()
        for metadata in reader.iter_metadata():
            if metadata.name == METADATA:
                self.origin = dict(metadata.metadata)
            elif metadata.name == END_METADATA:
                self.counts = {name: int(count) for name, count in metadata.metadata.items()}

    def _damaged(self, error: BaseException) -> SourceError:
        why = str(error) or type(error).__name__
        return SourceError(f"{self.path}: damaged ({why}); recover it with: automodel recover {self.path}")


class RecordingSource:
    """The frames of a recording as a source, as the pipeline got them; `step` is that of the last frame read."""

    def __init__(self, path: str | Path) -> None:
        self.recording = Recording(path)
        self.step: Step | None = None
        self._steps: Iterator[Step] | None = self.recording.steps()

    def read(self, timeout_s: float) -> Frame | StereoFrame:
        """The next frame; raises EndOfSource after the last, SourceError if there are none."""
        step = None if self._steps is None else next(self._steps, None)
        if step is None:
            if self._steps is not None and self.step is None:
                raise SourceError(f"{self.recording.path}: holds no frames on {CAMERA}")
            raise EndOfSource
        self.step = step
        return step.frame

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._steps = None


def _recorded(topic: str, message: Message, left: Frame | None) -> Recorded:
    """The value of a message; `left` is the last left image before it, None before the first."""
    value: Frame | StereoFrame | Value
    if topic in (CAMERA, RIGHT):
        value = _recorded_frame(message, eye=int(topic == RIGHT))
        if left is not None and value.eye and left.index == value.index:
            late_ns = value.t_ns - left.t_ns  # 0 in recordings of before each image had its own time
            value = StereoFrame(
                t_ns=left.t_ns, index=left.index, left=left.image, right=value.image, right_late_ns=late_ns
            )
    else:
        value = decode(topic, message.data)
    return Recorded(topic=topic, frame_index=message.sequence, value=value)


def _recorded_frame(message: Message, eye: int = 0) -> Frame:
    return Frame(t_ns=message.log_time, index=message.sequence, image=decode_image(message.data), eye=eye)


def _step(frame: Frame | StereoFrame, state: VehicleState | None, messages: list[Recorded]) -> Step:
    """The step of a frame, without values of frames that the recorder dropped."""
    unknown = Motion(t_ns=frame.t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
    step = Step(frame=frame, motion=unknown, state=state)
    for message in messages:
        mine, value = message.frame_index == frame.index, message.value
        if isinstance(value, VehicleState):
            newest = value if step.estimate is None else step.state
            step = replace(step, states=(*step.states, value), state=newest)
        elif isinstance(value, Event):
            step = replace(step, events=(*step.events, value))
        elif isinstance(value, Motion) and mine:
            step = replace(step, motion=value)
        elif isinstance(value, LaneEstimate) and mine:
            step = replace(step, estimate=value)
        elif isinstance(value, DriverInput) and mine:
            step = replace(step, driver=value)
        elif isinstance(value, Command) and mine:
            step = replace(step, commands=(*step.commands, value))
    return step
