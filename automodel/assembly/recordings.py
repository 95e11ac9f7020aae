"""Finds out what a path holds: a recording, a video, pictures or a tub."""

from __future__ import annotations

from pathlib import Path

from automodel.config import CarConfig
from automodel.interfaces import Source
from automodel.recording.reader import RecordingSource
from automodel.sources.errors import SourceError
from automodel.sources.files import ImageSource, TubSource, VideoSource, is_tub

FOLDER_RATE_HZ = 20.0  # pictures carry no time


def open_source(path: Path, car: CarConfig, rate_hz: float | None) -> Source:
    """The source behind `path`; `rate_hz` overrides (videos) or gives (folders, 20 Hz by default) the frames' rate."""
    if not path.exists():
        raise SourceError(f"{path}: no such file or folder")
    if path.is_dir():
        folder = TubSource if is_tub(path) else ImageSource
        return folder(path, rate_hz or FOLDER_RATE_HZ, car.camera.colour)
    if path.suffix.lower() == ".mcap":
        return RecordingSource(path)
    return VideoSource(path, rate_hz, car.camera.colour)
