"""Writing a video file."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

import cv2
import numpy as np

from automodel.config import ConfigError
from automodel.output_files import output_path
from automodel.types import Image


class VideoWriter:
    """Writes frames (h, w) or (h, w, 3) BGR, all of the same even size, into an MP4 file.

    The file appears when the `with` block ends without an error, if a frame was written. Raises ConfigError where it
    cannot be written.
    """

    def __init__(self, path: str | Path, rate_hz: float) -> None:
        self.path, self._rate_hz = Path(path), rate_hz
        if not rate_hz > 0:
            raise ValueError(f"rate_hz: expected a positive number, got {rate_hz}")
        if self.path.suffix.lower() != ".mp4":
            raise ConfigError(f"{path}: videos are written as MP4; choose a name that ends in .mp4")
        if not self.path.parent.is_dir():
            raise ConfigError(f"{path}: there is no folder {self.path.parent}")
        self._output = output_path(self.path)
        self._writer: cv2.VideoWriter | None = None
        self._shape: tuple[int, ...] = ()

    def __enter__(self) -> VideoWriter:
        self._part = self._output.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            self._writer.release()
        self._output.__exit__(kind, error, trace)

    def write(self, image: Image) -> None:
        """Add a frame; raises ValueError if its size differs from the first."""
        shape = image.shape[:2]
        if self._writer is None:
            self._writer, self._shape = self._open(shape[1], shape[0]), shape
        if shape != self._shape:
            raise ValueError(f"image: expected shape {self._shape} as the first frame, got {shape}")
        self._writer.write(image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)))

    def _open(self, width_px: int, height_px: int) -> cv2.VideoWriter:
        if width_px % 2 or height_px % 2:
            raise ValueError(f"image: expected an even size, got {width_px}x{height_px}")
        writer = cv2.VideoWriter(
            str(self._part), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), self._rate_hz, (width_px, height_px)
        )
        if not writer.isOpened():
            raise ConfigError(f"{self.path}: cannot be written as a video; is the folder writable, the disk full?")
        return writer
