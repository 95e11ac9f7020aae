"""A recording -> poses.csv, and a video with the overlay."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from automodel.config import CarConfig
from automodel.geometry import GroundCamera
from automodel.recording.poses_csv import PosesCsv
from automodel.recording.reader import Recording, Step
from automodel.signals import Frame, StereoFrame
from automodel.sources.pictures import check_size
from automodel.types import Image
from automodel.viewer.overlay import draw
from automodel.viewer.video import VideoWriter

Progress = Callable[[int], None]


def export_csv(recording: Recording, path: str | Path, progress: Progress | None = None) -> int:
    """Write the estimates and commands of a run as poses.csv; the number of rows.

    `latency_ms` is from the frame's capture to its first command. Raises ConfigError and SourceError.
    """
    rows = 0
    with PosesCsv(path) as table:
        for step in recording.steps():
            command = step.commands[0] if step.commands else None
            table.row(step.frame, step.estimate, command, latency_ms(step))
            rows += 1
            if progress is not None:
                progress(rows)
    return rows


def export_video(recording: Recording, path: str | Path, car: CarConfig, progress: Progress | None = None) -> int:
    """Write the frames of a run with what was estimated on them, at the frames' mean rate; the number of frames.

    `car` is what the run was driven with (`Recording.car_text`). Raises ConfigError and SourceError.
    """
    camera, rate_hz = GroundCamera.from_config(car.camera), mean_rate_hz(recording)
    frames = 0
    with VideoWriter(path, rate_hz) as video:
        for step in recording.steps():
            picture = picture_of(step.frame)
            check_size(Frame(t_ns=step.frame.t_ns, index=step.frame.index, image=picture), car.camera)
            command = step.commands[0] if step.commands else None
            note = f"frame {step.frame.index}"
            video.write(draw(picture, step.estimate, camera, command, car.vehicle.reference_x_m, note))
            frames += 1
            if progress is not None:
                progress(frames)
    return frames


def latency_ms(step: Step) -> float | None:
    """From the frame's capture to its first command [ms]; None without one."""
    return (step.commands[0].t_ns - step.frame.t_ns) * 1e-6 if step.commands else None


def picture_of(frame: Frame | StereoFrame) -> Image:
    """The picture that overlays are drawn on: of two cameras, the left one's."""
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
