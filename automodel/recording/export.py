"""poses.csv (the pose in the lane, one row per frame), and the export of recordings as CSV, video and for Foxglove."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

from mcap.records import Channel, Message

from automodel.config import CarConfig, ConfigError
from automodel.geometry import GroundCamera
from automodel.output_files import output_path, output_text
from automodel.recording.codec import CAMERA, LEFT, TOPICS, decode
from automodel.recording.reader import Recording, Step
from automodel.recording.recover import RecordCopy
from automodel.signals import Command, Event, Frame, LaneEstimate, LaneLine, Motion, StereoFrame
from automodel.sources.images import check_size
from automodel.types import Image
from automodel.viewer.overlay import draw
from automodel.viewer.video import VideoWriter

COLUMNS = (
    "t_s",
    "frame",
    "status",
    "offset_m",
    "heading_rad",
    "curvature_per_m",
    "width_m",
    "left_seen",
    "right_seen",
    "crossing_distance_m",
    "crossing_angle_rad",
    "steering_rad",
    "latency_ms",
    "offset_bound_m",
    "heading_bound_rad",
    "lane_change",
)


class PosesCsv:
    """Writes poses.csv, one row per frame; missing values are empty, never 0 (also a bound that is not stated).

    Lengths and angles have six decimals (micrometres, microradians). The file appears when the `with` block ends
    without an error. Raises ConfigError where it cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self._output = output_text(path)

    def __enter__(self) -> PosesCsv:
        self._file = self._output.__enter__()
        self._file.write(",".join(COLUMNS) + "\n")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._output.__exit__(kind, error, trace)

    def row(
        self,
        frame: Frame | StereoFrame,
        estimate: LaneEstimate | None,
        command: Command | None = None,
        latency_ms: float | None = None,
    ) -> None:
        """Write a frame's row. `t_s` is the frame's time in its source, with every nanosecond."""
        fields = [f"{frame.t_ns // 10**9}.{frame.t_ns % 10**9:09d}", str(frame.index)]
        fields += [""] * 9 if estimate is None else _fields(estimate)
        fields.append("" if command is None else _decimal(command.steering_rad))
        fields.append("" if latency_ms is None else f"{latency_ms:.3f}")
        fields += [""] * 3 if estimate is None else _bounds(estimate)
        self._file.write(",".join(fields) + "\n")


def _fields(estimate: LaneEstimate) -> list[str]:
    pose, crossing = estimate.pose, estimate.crossing
    fields = [estimate.status.value]
    if pose is None:
        fields += [""] * 4
    else:
        fields += [_decimal(v) for v in (pose.offset_m, pose.heading_rad, pose.curvature_per_m, pose.width_m)]
    fields += [_seen(estimate.left), _seen(estimate.right)]
    fields += ["", ""] if crossing is None else [_decimal(crossing.distance_m), _decimal(crossing.angle_rad)]
    return fields


def _bounds(estimate: LaneEstimate) -> list[str]:
    pose = estimate.pose
    bounds = () if pose is None else (pose.offset_bound_m, pose.heading_bound_rad)
    fields = [_decimal(bound) if math.isfinite(bound) else "" for bound in bounds] or ["", ""]
    return [*fields, str(estimate.lane_change) if estimate.valid else ""]


def _decimal(value: float) -> str:
    return f"{value:.6f}"


def _seen(line: LaneLine | None) -> str:
    return "" if line is None else str(int(line.seen))


Progress = Callable[[int], None]
WHOLE_S = (0.0, math.inf)  # of a run


def steps_between(recording: Recording, span_s: tuple[float, float]) -> Iterator[Step]:
    """The steps whose frames were taken from the first to the second time [s] after the first frame.

    Raises ConfigError where there is none in a part of a run.
    """
    first_ns, there = None, span_s == WHOLE_S
    for step in recording.steps():
        first_ns = step.frame.t_ns if first_ns is None else first_ns
        t_s = (step.frame.t_ns - first_ns) * 1e-9
        if t_s > span_s[1]:
            break
        if t_s >= span_s[0]:
            there = True
            yield step
    if not there:
        raise ConfigError(f"{recording.path}: no frames between --from {span_s[0]:g} and --to {span_s[1]:g} s")


def export_csv(
    recording: Recording,
    path: str | Path,
    progress: Progress | None = None,
    span_s: tuple[float, float] = WHOLE_S,
) -> int:
    """Write the estimates and commands of a run, or of a span of it, as poses.csv; the number of rows.

    `latency_ms` is from the frame's capture to its first command. Raises ConfigError and SourceError.
    """
    rows = 0
    with PosesCsv(path) as table:
        for step in steps_between(recording, span_s):
            command = step.commands[0] if step.commands else None
            table.row(step.frame, step.estimate, command, latency_ms(step))
            rows += 1
            if progress is not None:
                progress(rows)
    return rows


def export_video(
    recording: Recording,
    path: str | Path,
    car: CarConfig,
    progress: Progress | None = None,
    span_s: tuple[float, float] = WHOLE_S,
) -> int:
    """Write a video of the frames of a run, or of a span of it, with their estimates, at the frames' mean rate.

    Returns the number of frames.

    `car` is the configuration of the run (`Recording.car_text`). Raises ConfigError and SourceError.
    """
    camera, rate_hz = GroundCamera.from_config(car.camera), mean_rate_hz(recording)
    frames = 0
    with VideoWriter(path, rate_hz) as video:
        for step in steps_between(recording, span_s):
            image = image_of(step.frame)
            check_size(Frame(t_ns=step.frame.t_ns, index=step.frame.index, image=image), car.camera)
            command = step.commands[0] if step.commands else None
            note, vehicle = f"frame {step.frame.index}", car.vehicle
            video.write(draw(image, step.estimate, camera, command, vehicle.reference_x_m, note, vehicle.wheelbase_m))
            frames += 1
            if progress is not None:
                progress(frames)
    return frames


def export_foxglove(recording: Recording, path: str | Path, car: CarConfig, progress: Progress | None = None) -> int:
    """Write a copy of a recording with the messages of `automodel.recording.foxglove` beside its own; their number.

    `automodel replay` reads the copy as it reads the recording. `car` is the configuration of the run. Raises
    ConfigError and SourceError.
    """
    from automodel.recording import foxglove  # its schemas take a while to load

    scene = foxglove.FoxgloveScene(car)
    made: dict[str, Callable[[Any], Iterator[foxglove.Topical]]] = {
        TOPICS[Motion]: scene.motion,
        TOPICS[LaneEstimate]: scene.estimate,
        TOPICS[Event]: scene.event,
    }
    added, started = 0, False
    with output_path(path) as part, open(part, "wb") as stream:
        copy = RecordCopy(stream, "automodel export")
        channels = {
            topic: copy.writer.register_channel(
                topic, "protobuf", copy.writer.register_schema(name, "protobuf", descriptors)
            )
            for topic, kind in foxglove.TOPICS.items()
            for name, descriptors in [foxglove.schema_of(kind)]
        }
        for topic, record in recording.records():
            if (record.topic if isinstance(record, Channel) else topic) in channels:  # of an earlier export
                continue
            copy.add(record)
            if not isinstance(record, Message):
                continue
            messages = [] if started else list(scene.start(record.log_time))
            started = True
            if topic in made:
                messages += made[topic](decode(topic, record.data))
            for name, message in messages:
                data, t_ns = message.SerializeToString(), record.log_time
                copy.writer.add_message(channels[name], t_ns, data, t_ns, record.sequence)
            added += len(messages)
            if progress is not None and topic in (CAMERA, LEFT):
                progress(copy.frames)
        copy.finish()
    return added


def latency_ms(step: Step) -> float | None:
    """The time from the frame's capture to its first command [ms]; None without a command."""
    return (step.commands[0].t_ns - step.frame.t_ns) * 1e-6 if step.commands else None


def image_of(frame: Frame | StereoFrame) -> Image:
    """The image for overlays: that of the left camera if there are two."""
    return frame.left if isinstance(frame, StereoFrame) else frame.image


def mean_rate_hz(recording: Recording, first: int = 100) -> float:
    """The mean rate of the first frames; 20 Hz where there are fewer than two."""
    times: list[int] = []
    for message in recording:
        if isinstance(message.value, Frame | StereoFrame):
            times.append(message.value.t_ns)
            if len(times) > first:
                break
    span_ns = times[-1] - times[0] if times else 0
    return (len(times) - 1) * 1e9 / span_ns if span_ns > 0 else 20.0
